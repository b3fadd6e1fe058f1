"""The client's end of a session that the relay opens itself."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, cast

import msgspec
import pytest
from twisted.internet.defer import Deferred

from relay_protocol import rosbridge
from relay_protocol.errors import Invalid, Refused, SwitchboardError, Unavailable
from relay_server.common import close_codes, websocket_frames
from relay_server.http_sessions.loopback_client import (
    FAILED,
    LoopbackClient,
    MaybeDone,
    ServiceReply,
    texts_in,
)
from relay_server.sessions.session import Session

NOTHING = msgspec.Raw(b"{}")


class Other:
    """The session, as far as it is spoken to."""

    def __init__(self) -> None:
        self.heard: list[dict[str, Any]] = []
        self.pongs: list[bytes] = []
        self.started = False
        self.meanwhile: Callable[[], None] = lambda: None
        """What happens while it does something."""

    def start(self) -> None:
        """It begins."""
        self.started = True

    def do(self, operation: rosbridge.ClientOp, since: int | None) -> None:
        """Keep it."""
        self.heard.append(json.loads(msgspec.json.encode(operation)))
        self.meanwhile()

    def pong(self, payload: bytes) -> None:
        """Keep it."""
        self.pongs.append(payload)


@pytest.fixture
def other() -> Other:
    """A session."""
    return Other()


@pytest.fixture
def client(other: Other) -> LoopbackClient:
    """Its client, who has begun."""
    made = LoopbackClient()
    made.begin(cast(Session, other))
    return made


def says(client: LoopbackClient, **message: Any) -> None:
    """The session says something."""
    client.send(websocket_frames.text(json.dumps(message).encode()))


def asks(client: LoopbackClient, service: str) -> tuple[list[ServiceReply], list[SwitchboardError]]:
    """Call a service; where answer and error will be."""
    answers: list[ServiceReply] = []
    errors: list[SwitchboardError] = []
    running = Deferred.fromCoroutine(client.call(service, NOTHING))
    running.addCallbacks(answers.append, lambda failure: errors.append(failure.value))
    return answers, errors


def test_it_begins_as_a_client_who_wants_to_hear_errors(client: LoopbackClient, other: Other) -> None:
    """And answers pings at once."""
    assert other.started
    assert [(each["op"], each["level"]) for each in other.heard] == [("set_level", "warning")]
    client.ping(b"12345678")
    assert other.pongs == [b"12345678"]


def test_each_call_gets_its_own_answer(client: LoopbackClient, other: Other) -> None:
    """In whatever order they come; one that nobody waits for is passed over."""
    first, _ = asks(client, "/a")
    second, _ = asks(client, "/b")
    one, two = (each["id"] for each in other.heard[1:])
    says(client, op="service_response", id=two, result=False, values="no")
    says(client, op="service_response", id="unknown", result=True)
    says(client, op="publish", topic="/x", msg={})
    assert (first, [each.read for each in second]) == ([], ["no"])
    says(client, op="service_response", id=one, result=True, values={"sum": 3})
    assert [each.read for each in first] == [{"sum": 3}]


def test_what_goes_wrong_later_is_told_to_who_asked(client: LoopbackClient) -> None:
    """Once; where there is no answer to wait for."""
    client.check("a")
    says(client, op="status", level="error", msg="no such topic", id="a")
    says(client, op="status", level="error", msg="and more", id="a")
    client.check("b")
    with pytest.raises(Refused, match="no such topic"):
        client.check("b", "a")
    client.check("a")


@pytest.mark.parametrize(("level", "kind"), [("error", Invalid), ("warning", Refused)])
def test_what_is_told_meanwhile_is_raised(
    client: LoopbackClient, other: Other, level: str, kind: type[SwitchboardError]
) -> None:
    """Of this operation, and of no other."""
    asked = rosbridge.Publish(id="mine", topic="/a")
    other.meanwhile = lambda: says(client, op="status", level=level, msg="of other", id="other")
    client.do(asked)
    other.meanwhile = lambda: says(client, op="status", level=level, msg="of mine", id="mine")
    with pytest.raises(kind, match="of mine"):
        client.do(asked)


def test_why_operations_failed_is_not_kept_for_ever(client: LoopbackClient) -> None:
    """Of so many, the latest."""
    for number in range(2 * FAILED):
        says(client, op="status", level="error", msg="no", id=f"{number}")
    assert len(client._failed) == FAILED
    client.check("0")
    with pytest.raises(Refused):
        client.check(f"{2 * FAILED - 1}")


@pytest.mark.parametrize(
    ("code", "kind"), [(close_codes.GOING_AWAY, Unavailable), (close_codes.FORBIDDEN, Refused)]
)
def test_a_session_that_is_closed_ends_what_waits(
    client: LoopbackClient, code: int, kind: type[SwitchboardError]
) -> None:
    """With the reason, now and for whatever is tried later."""
    answers, errors = asks(client, "/a")
    client.close(code, "your right was revoked")
    assert not answers
    (error,) = errors
    # It was sent already.
    assert isinstance(error, MaybeDone) and type(error.reason) is kind
    assert "revoked" in str(error) and "may have been done" in str(error)
    for attempt in (client.check, lambda: client.do(rosbridge.Publish(topic="/a"))):
        with pytest.raises(kind, match="revoked"):
            attempt()


def test_a_call_that_was_not_sent_was_not_done(client: LoopbackClient, other: Other) -> None:
    """Refused at once, or asked for when the session is over."""
    other.meanwhile = lambda: says(
        client, op="status", level="error", msg="no", id=str(other.heard[-1]["id"])
    )
    _, refused = asks(client, "/a")
    client.close(close_codes.FORBIDDEN, "your right was revoked")
    _, late = asks(client, "/a")
    assert [type(each) for each in refused + late] == [Invalid, Refused]


@pytest.mark.parametrize("length", [0, 1, 125, 126, 127, 65535, 65536, 70000])
def test_texts_are_found_in_frames(length: int) -> None:
    """Of every length, and nothing else than texts."""
    payloads = [b"a" * length, b"b", b"c" * length]
    frames = b"".join(
        websocket_frames.text(each) + websocket_frames.binary(b"x" * 130) + websocket_frames.ping(b"y")
        for each in payloads
    )
    assert list(texts_in(frames)) == payloads
