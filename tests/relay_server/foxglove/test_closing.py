"""The relay closes a connection: by bytes, a status with the reason, then the close frame (SPEC 1.4-2)."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from typing import Any

import pytest
from websockets.frames import Frame, Opcode

from relay_protocol import link
from relay_protocol.errors import Refused
from relay_protocol.limits import CLIENT_MESSAGE
from relay_protocol.rights import Level
from relay_server.access import BadCredentials
from relay_server.common import close_codes
from relay_server.foxglove import messages
from relay_server.sessions.websocket_port import MAX_MALFORMED
from tests.worlds.foxglove_client import SDK, Foxglove, FoxgloveWorld
from tests.worlds.relay import TIMING

ROSBRIDGE = "rosbridge_v2"


@pytest.fixture
def world() -> FoxgloveWorld:
    """A robot that is online, and the right of a viewer."""
    made = FoxgloveWorld()
    made.robot_comes()
    made.gate.person("ann", Level.VIEWER)
    return made


def sends_frame(client: Foxglove, first: int, payload: bytes = b"", length: int | None = None) -> None:
    """Sends a masked frame, valid or not.

    :param first: its first byte
    :param length: what its header says; ``None``: the payload's
    """
    head = struct.pack("!BBQ", first, 0xFF, len(payload) if length is None else length)
    client.core.writes.append(head + bytes(4) + payload)
    client.run()


def many_malformed(world: FoxgloveWorld, client: Foxglove) -> None:
    """More messages in a row that can't be read than are tolerated."""
    for _ in range(MAX_MALFORMED):
        client.core.send_text(b"{")
    client.run()


def fails_inside(world: FoxgloveWorld, client: Foxglove) -> None:
    """A message meets a fault of the relay."""

    def broken(*given: Any) -> None:
        raise RuntimeError("the secret of our insides")

    client.end.on_text = client.end.onMessage = broken
    client.says('{"op":"subscribe"}')


def stalls(world: FoxgloveWorld, client: Foxglove) -> None:
    """The client reads nothing for too long, and then again."""
    client.end.pause()
    client.end.transport.clear()
    for _ in range(int(TIMING.stall_limit) + 10):
        world.clock.advance(1)
    client.run()


CAUSES: dict[str, tuple[Callable[[FoxgloveWorld, Foxglove], None], int, str]] = {
    "reserved bits": (lambda _, client: sends_frame(client, 0xC1, b"x" * 200), 1002, "RSV"),
    "unknown opcode": (lambda _, client: sends_frame(client, 0x83, b"x" * 200), 1002, "opcode"),
    "fragment of nothing": (lambda _, client: sends_frame(client, 0x80, bytes(70_000)), 1002, "continuation"),
    "not UTF-8": (lambda _, client: client.core.send_text(b"\xff" * 20), close_codes.NOT_UTF8, "UTF-8"),
    "fragment not UTF-8": (
        lambda _, client: client.core.send_text(b"\xff", fin=False),
        close_codes.NOT_UTF8,
        "UTF-8",
    ),
    "too large": (
        lambda _, client: sends_frame(client, 0x82, length=CLIENT_MESSAGE + 1),
        close_codes.TOO_BIG,
        "exceed",
    ),
    "malformed": (many_malformed, close_codes.TOO_MANY_ERRORS, f"{MAX_MALFORMED} messages in a row"),
    "a fault": (fails_inside, close_codes.INTERNAL, "the relay failed; see its log"),
    "no reading": (stalls, close_codes.TOO_SLOW, "nothing was taken for"),
    "revoked": (
        lambda world, _: world.gate.permits["ann"].on_revoke(BadCredentials("the token was revoked")),
        close_codes.UNAUTHENTICATED,
        "the token was revoked",
    ),
    "right withdrawn": (
        lambda world, _: world.gate.permits["ann"].on_revoke(Refused("you have no right on it any more")),
        close_codes.FORBIDDEN,
        "you have no right on it any more",
    ),
    "long reason": (
        lambda world, _: world.people[0].close(close_codes.GOING_AWAY, "going down " * 50),
        close_codes.GOING_AWAY,
        "going down " * 50,
    ),
}


@pytest.mark.parametrize("cause", CAUSES)
def test_a_status_with_the_reason_comes_before_the_close_frame(world: FoxgloveWorld, cause: str) -> None:
    act, code, words = CAUSES[cause]
    client = Foxglove(world.gate)
    client.take()
    act(world, client)
    client.run()
    *_, last, close = client.frames
    assert status_of(last) == {
        "op": "status",
        "level": messages.ERROR,
        "message": reason_of(last),
        "id": "closed",
    }
    assert words in reason_of(last)
    assert (close.opcode, client.closed) == (Opcode.CLOSE, code)
    assert reason_of(last).encode().startswith(close.data[2:])
    assert "secret" not in reason_of(last)
    assert world.people == []


def status_of(frame: Frame) -> Any:
    """The JSON of a text frame."""
    assert frame.opcode is Opcode.TEXT
    return json.loads(frame.data)


def reason_of(frame: Frame) -> str:
    """The text of a status of either dialect."""
    status = status_of(frame)
    return str(status.get("message") or status["msg"])


@pytest.mark.parametrize("level", ["info", "error"])
@pytest.mark.parametrize("cause", CAUSES)
def test_so_it_does_for_a_rosbridge_client_that_has_requested_errors(
    world: FoxgloveWorld, cause: str, level: str
) -> None:
    act, code, words = CAUSES[cause]
    client = Foxglove(world.gate, protocol=ROSBRIDGE)
    client.sends("set_level", level=level)
    act(world, client)
    client.run()
    *_, last, close = client.frames
    assert status_of(last) == {"op": "status", "level": "error", "msg": reason_of(last), "id": "closed"}
    assert words in reason_of(last)
    assert (close.opcode, client.closed) == (Opcode.CLOSE, code)


@pytest.mark.parametrize("level", [None, "none"])
@pytest.mark.parametrize("cause", CAUSES)
def test_a_rosbridge_client_that_has_not_gets_the_close_frame_alone(
    world: FoxgloveWorld, cause: str, level: str | None
) -> None:
    """Common clients break on an op that they do not know."""
    act, code, _ = CAUSES[cause]
    client = Foxglove(world.gate, protocol=ROSBRIDGE)
    if level is not None:
        client.sends("set_level", level=level)
    act(world, client)
    client.run()
    assert client.heard == []
    assert client.closed == code


@pytest.mark.parametrize(
    ("size", "arrives"), [(100, True), (20_000, True), (40_000, True), (4_000_000, False)]
)
def test_a_status_never_divides_a_message_that_is_sent_in_pieces(
    world: FoxgloveWorld, size: int, arrives: bool
) -> None:
    """The rest of the message goes first if it is short; otherwise the close frame alone comes between its pieces."""
    client = Foxglove(world.gate)
    world.settle(client)
    channel = client.channels()["/chatter"]["id"]
    client.sends("subscribe", subscriptions=[{"id": 7, "channelId": channel}])
    number = world.link.take(link.Subscribe)[-1].number
    world.subscribed(number)
    client.take()
    # Not read by the client until the relay has closed.
    world.channel.sample(number, bytes(size), 1)
    world.channel.sample(number, bytes(size), 1)
    world.people[0].close(close_codes.FORBIDDEN, "you have no right on it any more")
    taken = client.take()
    assert client.closed == close_codes.FORBIDDEN
    statuses = [each for each in taken if isinstance(each, dict)]
    assert [each["message"] for each in statuses] == arrives * ["you have no right on it any more"]
    assert all(len(each) == size + 13 for each in taken if isinstance(each, bytes))


def test_a_refused_browser_gets_the_status_too(world: FoxgloveWorld) -> None:
    browser = Foxglove(world.gate, "eve", SDK, Origin="https://app.foxglove.dev")
    status, close = browser.frames
    assert status_of(status)["id"] == "closed"
    assert "access token is unknown" in reason_of(status)
    assert close.opcode is Opcode.CLOSE
