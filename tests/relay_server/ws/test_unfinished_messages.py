"""Messages that a client begins and does not finish: their memory, their time, and what they count for."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import pytest
from twisted.internet.task import Clock
from websockets.frames import Frame, Opcode

from relay_protocol.limits import KIB
from relay_server.common import close_codes, websocket_frames
from relay_server.http.limits import RequestLimits
from tests.worlds.websocket_client import Client, MemoryGate

LARGEST = 1_000_000
PART = b"x" * 400_000

Begin = Callable[[Client], None]


def frames_without_the_last(client: Client) -> None:
    """Sends the beginning of a message in frames, and a pong after it."""
    client.core.send_text(PART, fin=False)
    client.core.send_continuation(PART, fin=False)
    client.core.send_frame(Frame(Opcode.PONG, b""))
    client.run()


def part_of_a_frame(client: Client) -> None:
    """Sends the beginning of a message in one frame."""
    client.end.dataReceived(websocket_frames.masked(websocket_frames.TEXT, PART + PART)[:-5])
    client.run()


def part_of_a_binary_frame(client: Client) -> None:
    """The same of a binary message."""
    client.end.dataReceived(websocket_frames.masked(websocket_frames.BINARY, PART + PART)[:-5])
    client.run()


def empty_frames(client: Client) -> None:
    """Sends frames without any bytes."""
    client.core.send_text(b"", fin=False)
    for _ in range(12_000):
        client.core.send_continuation(b"", fin=False)
    client.run()


WAYS = [frames_without_the_last, part_of_a_frame, part_of_a_binary_frame]


@pytest.fixture
def limits() -> RequestLimits:
    """Of all websockets; four messages of a user, of a million bytes each, may be unfinished."""
    return RequestLimits(0.0, Clock().seconds, largest_message=LARGEST)


@pytest.fixture
def gate() -> MemoryGate:
    """Accepts clients."""
    return MemoryGate()


def connected(gate: MemoryGate, limits: RequestLimits) -> Client:
    """A client of one and the same user."""
    return Client(gate, request_limits=limits, Authorization="Bearer good")


def reason(client: Client) -> str:
    """Of the close frame."""
    return client.core.close_rcvd.reason if client.core.close_rcvd else ""


@pytest.mark.parametrize("begin", WAYS)
def test_what_an_ended_connection_sent_is_gone_with_it(
    gate: MemoryGate, limits: RequestLimits, begin: Begin
) -> None:
    """Even while something still refers to the connection, as cycles do."""
    client = connected(gate, limits)
    tracemalloc.start()
    try:
        begin(client)
        assert tracemalloc.get_traced_memory()[0] > 2 * len(PART) - 10
        client.transport.abortConnection()
        assert tracemalloc.get_traced_memory()[0] < len(PART) / 4
    finally:
        tracemalloc.stop()
    assert limits.unfinished.of(1) == 0
    assert not [call for call in client.clock.getDelayedCalls() if call.getTime() > 1]


@pytest.mark.parametrize("begin", [*WAYS, empty_frames])
def test_unfinished_messages_of_all_connections_of_a_user_are_bounded(
    gate: MemoryGate, limits: RequestLimits, begin: Begin
) -> None:
    """The connection that begins one too many is closed with the reason, and holds nothing; the others go on."""
    clients = []
    while not clients or clients[-1].closed is None:
        assert len(clients) < 8
        clients.append(connected(gate, limits))
        begin(clients[-1])
    assert len(clients) > 4
    assert clients[-1].closed == close_codes.TOO_BIG
    assert reason(clients[-1]) == (
        "unfinished messages of one user have at most 4000000 bytes, over all connections"
    )
    assert all(client.closed is None for client in clients[:-1])
    assert limits.unfinished.of(1) <= 4 * LARGEST
    clients[0].transport.abortConnection()
    begin(another := connected(gate, limits))
    assert another.closed is None


def test_a_large_frame_over_the_users_limit_is_refused_by_its_head(
    gate: MemoryGate, limits: RequestLimits
) -> None:
    """Before its bytes have come."""
    for _ in range(4):
        connected(gate, limits).end.dataReceived(
            websocket_frames.masked(websocket_frames.TEXT, bytes(LARGEST - 200))[:20]
        )
    client = connected(gate, limits)
    client.end.dataReceived(websocket_frames.masked(websocket_frames.TEXT, bytes(1000))[:20])
    client.run()
    assert client.closed == close_codes.TOO_BIG


@pytest.mark.parametrize("begin", WAYS)
def test_a_message_must_be_finished_in_time(gate: MemoryGate, limits: RequestLimits, begin: Begin) -> None:
    """In 30 s and a second for each 16 KiB, whatever else the client sends."""
    client = connected(gate, limits)
    begin(client)
    seconds = 30 + (2 * len(PART)) / (16 * KIB)
    client.clock.advance(seconds - 1)
    client.clock.advance(0)
    client.run()
    assert client.closed is None
    client.clock.advance(1.5)
    client.run()
    assert client.closed == close_codes.TOO_SLOW
    assert reason(client) == f"a message was not finished within {seconds:.0f} s"
    assert limits.unfinished.of(1) == 0


def test_messages_that_are_finished_count_no_longer(gate: MemoryGate, limits: RequestLimits) -> None:
    """However many there are on one connection, and for however long."""
    client = connected(gate, limits)
    for _ in range(7):
        frames_without_the_last(client)
        client.core.send_continuation(b"", fin=True)
        client.run()
        whole = websocket_frames.masked(websocket_frames.TEXT, PART + PART)
        client.end.dataReceived(whole[:1000])
        client.end.dataReceived(whole[1000:])
        client.clock.advance(25)
    client.run()
    assert client.closed is None
    assert limits.unfinished.of(1) == 0
    assert [len(each) for each in gate.sessions[0].got if isinstance(each, bytes)] == 14 * [2 * len(PART)]
