"""The client side of a session that the relay opens itself."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_protocol import rosbridge
from relay_protocol.errors import Invalid, Refused, SwitchboardError, Unavailable
from relay_server.common import close_codes
from relay_server.in_process_sessions.in_process_port import (
    FAILED,
    InProcessPort,
    MaybeDone,
    ServiceReply,
)


class FakeSession:
    """A session with the methods that its client calls."""

    def __init__(self) -> None:
        self.performed: list[Any] = []
        self.ages: list[int] = []
        self.started = False
        self.meanwhile: Callable[[], None] = lambda: None
        """Runs while it performs an operation."""
        age = SimpleNamespace(as_of=lambda moment: nullcontext(self.ages.append(moment)))
        self.refused: list[None] = []
        self.client = SimpleNamespace(age=age, count_refusal=lambda: self.refused.append(None))

    def start(self) -> None:
        self.started = True

    def perform(self, operation: rosbridge.ClientOp) -> None:
        self.performed.append(operation)
        self.meanwhile()


@pytest.fixture
def session() -> FakeSession:
    return FakeSession()


@pytest.fixture
def port(session: FakeSession) -> InProcessPort:
    made = InProcessPort()
    made.begin(session)  # type: ignore[arg-type]
    return made


def calls(port: InProcessPort, service: str) -> tuple[list[ServiceReply], list[SwitchboardError]]:
    """Calls a service; the lists get the answer and the error."""
    answers: list[ServiceReply] = []
    errors: list[SwitchboardError] = []
    running = Deferred.fromCoroutine(port.call(service, b"{}"))
    running.addCallbacks(answers.append, lambda failure: errors.append(failure.value))
    return answers, errors


def test_calls_get_their_own_answers(port: InProcessPort, session: FakeSession) -> None:
    """In any order; an answer without a call is ignored."""
    assert session.started
    first, _ = calls(port, "/a")
    second, _ = calls(port, "/b")
    one, two = session.performed
    port.service_response(two, False, b'"no"')
    port.service_response(rosbridge.CallService(service="/c", id="unknown"), True, b"{}")
    assert (first, [each.read for each in second]) == ([], ["no"])
    port.service_response(one, True, b'{"sum":3}')
    assert [each.read for each in first] == [{"sum": 3}]


def test_undated_request_has_unknown_age(port: InProcessPort, session: FakeSession) -> None:
    port.perform(rosbridge.Publish(topic="/a"))
    port.perform(rosbridge.Publish(topic="/a"), earliest_sent=5)
    assert session.ages == [0, 5]


def test_later_failure_is_raised_once(port: InProcessPort) -> None:
    port.check("a")
    port.status("error", "no such topic", "a")
    port.status("error", "and more", "a")
    port.check("b")
    with pytest.raises(Refused, match="no such topic"):
        port.check("b", "a")
    port.check("a")


@pytest.mark.parametrize(("level", "kind"), [("error", Invalid), ("warning", Refused)])
def test_a_status_about_an_operation_is_raised_by_it(
    port: InProcessPort, session: FakeSession, level: str, kind: type[SwitchboardError]
) -> None:
    operation = rosbridge.Publish(id="mine", topic="/a")
    session.meanwhile = lambda: port.status(level, "of other", "other")
    port.perform(operation)
    session.meanwhile = lambda: port.status(level, "of mine", "mine")
    with pytest.raises(kind, match="of mine"):
        port.perform(operation)


def test_a_refused_operation_is_counted(port: InProcessPort, session: FakeSession) -> None:
    """As for a websocket."""

    def refuse() -> None:
        raise Refused("no")

    session.meanwhile = refuse
    with pytest.raises(Refused):
        port.perform(rosbridge.Publish(topic="/a"))
    assert len(session.refused) == 1


def test_reasons_of_failed_operations_are_bounded(port: InProcessPort) -> None:
    for number in range(2 * FAILED):
        port.status("error", "no", f"{number}")
    assert len(port._failed) == FAILED
    port.check("0")
    with pytest.raises(Refused):
        port.check(f"{2 * FAILED - 1}")


@pytest.mark.parametrize(
    ("code", "kind"), [(close_codes.GOING_AWAY, Unavailable), (close_codes.FORBIDDEN, Refused)]
)
def test_a_session_that_is_closed_ends_what_waits(
    port: InProcessPort, code: int, kind: type[SwitchboardError]
) -> None:
    """With the reason; this includes later calls."""
    answers, errors = calls(port, "/a")
    port.disconnect(code, "your right was revoked")
    assert not answers
    (error,) = errors
    # It was sent already.
    assert isinstance(error, MaybeDone) and type(error.reason) is kind
    assert "revoked" in str(error) and "may have been done" in str(error)
    for attempt in (port.check, lambda: port.perform(rosbridge.Publish(topic="/a"))):
        with pytest.raises(kind, match="revoked"):
            attempt()


def test_a_call_that_was_not_sent_was_not_done(port: InProcessPort, session: FakeSession) -> None:
    """It was refused at once, or made after the end of the session."""
    session.meanwhile = lambda: port.status("error", "no", session.performed[-1].id)
    _, refused = calls(port, "/a")
    port.disconnect(close_codes.FORBIDDEN, "your right was revoked")
    _, late = calls(port, "/a")
    assert [type(each) for each in refused + late] == [Invalid, Refused]
