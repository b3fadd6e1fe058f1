"""Stops that a client sends by a websocket to a relay at which its robot is not."""

from __future__ import annotations

import json
import struct
from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_protocol.errors import Unavailable
from relay_server.control.service import StopResult
from relay_server.relay_node import interfaces
from relay_server.sessions.service_calls import STOPPING_CALLS
from relay_server.ws.forwarded_stops import MOST_BYTES, ForwardedStops

CDR = interfaces.TYPES.from_json("switchboard_msgs/srv/Stop_Request", b'{"why":"test","stop_id":"one"}', 0)
WILL_STOP = "robot rover will be stopped as soon as it can be reached"


class Forwarded:
    """The websocket of the client."""

    def __init__(self) -> None:
        self.asked: list[Deferred[bool]] = []
        self.answers: list[Any] = []

    async def confirm(self, seconds: float) -> bool:
        self.asked.append(Deferred())
        return await self.asked[-1]

    def answer(self, frame: bytes) -> None:
        self.answers.append(json.loads(frame[frame.index(b"{") :]))


class Stops:
    """The stops of one client, and what was done here."""

    def __init__(self, foxglove: bool = False) -> None:
        self.websocket = Forwarded()
        self.made: list[tuple[str, str]] = []
        self.error: Exception | None = None
        forwarded: Any = self.websocket
        self.stops = ForwardedStops(forwarded, "rover", foxglove, self._stop)

    async def _stop(self, why: str, stop_id: str) -> StopResult:
        self.made.append((why, stop_id))
        if self.error is not None:
            raise self.error
        return StopResult(False, None)

    def sent(self, payload: bytes, *, binary: bool = False, read: bool | None = False) -> None:
        """The client has sent a message, and the home has read it or not, if it is asked; ``None``: it waits."""
        before = len(self.websocket.asked)
        self.stops.message(payload, binary)
        if read is not None and len(self.websocket.asked) > before:
            self.websocket.asked[-1].callback(read)


def call(service: str = "/relay/stop", **fields: Any) -> bytes:
    return json.dumps({"op": "call_service", "id": "a", "service": service, **fields}).encode()


def foxglove_call(encoding: bytes, payload: bytes, service: int = 1) -> bytes:
    return struct.pack("<BIII", 2, service, 7, len(encoding)) + encoding + payload


def test_a_stop_that_the_home_has_read_is_left_to_it() -> None:
    stops = Stops()
    stops.sent(call(), read=True)
    assert (len(stops.websocket.asked), stops.made, stops.websocket.answers) == (1, [], [])


@pytest.mark.parametrize(
    ("payload", "made"),
    [
        (call(), ("", "")),
        (call("relay/stop", args={"why": "test", "stop_id": "one"}), ("test", "one")),
        (call(args=["test", "one"]), ("test", "one")),
        # What is wrong with a stop holds up no stop.
        (call(args={"why": 5}), ("", "")),
        (call(args="x"), ("", "")),
        (call(args={"why": float("nan")}), ("", "")),
        (call().replace(b"/", b"\\/"), ("", "")),
        (call().replace(b"relay", b"\\u0072elay"), ("", "")),
    ],
)
def test_a_stop_that_the_home_has_not_read_is_made_here(payload: bytes, made: tuple[str, str]) -> None:
    stops = Stops()
    stops.sent(payload)
    assert stops.made == [made]
    (answer,) = stops.websocket.answers
    assert (answer["op"], answer["id"], answer["result"]) == ("service_response", "a", True)
    assert answer["values"] == {"success": True, "message": WILL_STOP, "done": False, "stopped": None}


@pytest.mark.parametrize(
    ("encoding", "payload", "made"),
    [
        (b"cdr", CDR, ("test", "one")),
        (b"json", b'{"why":"test","stop_id":"one"}', ("test", "one")),
        (b"cdr", b"", ("", "")),
        (b"json", b"{", ("", "")),
        (b"what" * 1000, b"", ("", "")),
    ],
)
def test_a_stop_by_foxglove_is_made_here_too(encoding: bytes, payload: bytes, made: tuple[str, str]) -> None:
    stops = Stops(foxglove=True)
    stops.sent(foxglove_call(encoding, payload), binary=True)
    assert stops.made == [made]
    failure = {"op": "serviceCallFailure", "serviceId": 1, "callId": 7, "message": WILL_STOP}
    assert stops.websocket.answers == [failure]


@pytest.mark.parametrize(
    ("foxglove", "binary", "payload"),
    [
        (False, False, b""),
        (False, False, b'{"op":"stop"'),
        (False, False, call("/stop")),
        (False, False, call("/relay/stop_module")),
        (False, False, call(args={"why": "x" * MOST_BYTES})),
        (False, False, b'{"op":"publish","topic":"/relay/stop","msg":{}}'),
        (False, True, foxglove_call(b"json", b"{}")),
        (True, False, call()),
        (True, True, b""),
        (True, True, foxglove_call(b"json", b"{}", 2)),
        (True, True, foxglove_call(b"json", b"{}")[:9]),
    ],
)
def test_other_messages_are_not_taken_for_stops(foxglove: bool, binary: bool, payload: bytes) -> None:
    stops = Stops(foxglove)
    stops.sent(payload, binary=binary)
    assert (stops.websocket.asked, stops.made, stops.websocket.answers) == ([], [], [])


def test_a_stop_that_fails_here_is_answered_with_the_reason() -> None:
    stops = Stops()
    stops.error = Unavailable("the database does not answer")
    stops.sent(call())
    values = {"success": False, "message": "the database does not answer", "done": False, "stopped": None}
    assert stops.websocket.answers[0]["values"] == values


def test_only_some_stops_of_a_client_are_watched_at_a_time() -> None:
    stops = Stops()
    for _ in range(2 * STOPPING_CALLS):
        stops.sent(call(), read=None)
    assert len(stops.websocket.asked) == STOPPING_CALLS
    for each in stops.websocket.asked:
        each.callback(True)
    stops.sent(call())
    assert len(stops.made) == 1
