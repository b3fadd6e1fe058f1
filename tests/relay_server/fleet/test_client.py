"""The client's end of a session that is opened for an order."""

from __future__ import annotations

import json
from typing import Any, cast

import pytest
from twisted.internet.defer import Deferred

from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_server import closing, wsframe
from relay_server.fleet.client import Answer, OrderClient, texts_in
from relay_server.session import Session


class Other:
    """The session, as far as it is spoken to."""

    def __init__(self) -> None:
        self.heard: list[dict[str, Any]] = []
        self.pongs: list[bytes] = []
        self.started = False

    def start(self) -> None:
        """It begins."""
        self.started = True

    def message(self, data: bytes) -> None:
        """Keep it."""
        self.heard.append(json.loads(data))

    def pong(self, payload: bytes) -> None:
        """Keep it."""
        self.pongs.append(payload)


@pytest.fixture
def other() -> Other:
    """A session."""
    return Other()


@pytest.fixture
def client(other: Other) -> OrderClient:
    """Its client, who has begun."""
    made = OrderClient()
    made.begin(cast(Session, other))
    return made


def says(client: OrderClient, **message: Any) -> None:
    """The session says something."""
    client.send(wsframe.text(json.dumps(message).encode()))


def asks(client: OrderClient, service: str) -> tuple[list[Answer], list[SwitchboardError]]:
    """Call a service; where answer and error will be."""
    answers: list[Answer] = []
    errors: list[SwitchboardError] = []
    running = Deferred.fromCoroutine(client.call(service, {}))
    running.addCallbacks(answers.append, lambda failure: errors.append(failure.value))
    return answers, errors


def test_it_begins_as_a_client_who_wants_to_hear_errors(client: OrderClient, other: Other) -> None:
    """And answers pings at once."""
    assert other.started
    assert other.heard == [{"op": "set_level", "level": "error"}]
    client.ping(b"12345678")
    assert other.pongs == [b"12345678"]


def test_each_call_gets_its_own_answer(client: OrderClient, other: Other) -> None:
    """In whatever order they come; one that nobody waits for is passed over."""
    first, _ = asks(client, "/a")
    second, _ = asks(client, "/b")
    one, two = (each["id"] for each in other.heard[1:])
    says(client, op="service_response", id=two, result=False, values="no")
    says(client, op="service_response", id="unknown", result=True)
    says(client, op="publish", topic="/x", msg={})
    assert (first, second) == ([], [Answer(False, "no")])
    says(client, op="service_response", id=one, result=True, values={"sum": 3})
    assert first == [Answer(True, {"sum": 3})]


def test_what_goes_wrong_is_told_by_the_first_error(client: OrderClient) -> None:
    """Where there is no answer to wait for."""
    client.check()
    says(client, op="status", level="error", msg="no such topic")
    says(client, op="status", level="error", msg="and more")
    with pytest.raises(Refused, match="no such topic"):
        client.check()


@pytest.mark.parametrize(("code", "kind"), [(closing.GOING_AWAY, Unavailable), (closing.FORBIDDEN, Refused)])
def test_a_session_that_is_closed_ends_what_waits(
    client: OrderClient, code: int, kind: type[SwitchboardError]
) -> None:
    """With the reason, now and for whatever is tried later."""
    answers, errors = asks(client, "/a")
    client.close(code, "your right was revoked")
    assert not answers
    assert [type(each) for each in errors] == [kind]
    for attempt in (client.check, lambda: client.say("publish")):
        with pytest.raises(kind, match="revoked"):
            attempt()


@pytest.mark.parametrize("length", [0, 1, 125, 126, 127, 65535, 65536, 70000])
def test_texts_are_found_in_frames(length: int) -> None:
    """Of every length, and nothing else than texts."""
    payloads = [b"a" * length, b"b", b"c" * length]
    frames = b"".join(
        wsframe.text(each) + wsframe.binary(b"x" * 130) + wsframe.ping(b"y") for each in payloads
    )
    assert list(texts_in(frames)) == payloads
