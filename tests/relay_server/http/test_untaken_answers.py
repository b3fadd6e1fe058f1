"""Answers that clients do not accept: pipelined requests wait, memory stays bounded, and stalled clients are cut."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from twisted.internet.abstract import FileDescriptor
from twisted.internet.address import IPv4Address

from relay_server.http import limits
from relay_server.http import site as module
from relay_server.http.limits import Unsent
from tests.worlds.http_client import World, parse

ASSET = 300_000
BOUND = 3 * module.PIECE_BYTES
"""Bytes that the transport holds at most: a piece more than are enough for it to call itself full, and a head."""


class Socket(FileDescriptor):
    """A connection with the buffers of Twisted's TCP; the client takes as many bytes as the test says."""

    bufferSize = module.PIECE_BYTES

    def __init__(self, world: World, address: str = "192.0.2.9") -> None:
        super().__init__(world.clock)
        self.connected = True
        self.taken = b""
        self.reading = True
        self._room = 0
        self._address = address
        self.protocol: Any = world.site.buildProtocol(None)
        self.protocol.makeConnection(self)

    def takes(self, size: int) -> None:
        """The client reads."""
        self._room = size
        while self._room and self.connected and (self.unsent or self.disconnecting):
            ended = self.doWrite()
            if ended is not None:
                self.connectionLost(ended)

    @property
    def unsent(self) -> int:
        """Bytes that the transport holds."""
        return len(self.dataBuffer) - self.offset + self._tempDataLen

    def send(self, data: bytes, size: int = module.PIECE_BYTES) -> int:
        """Bytes of the client, as far as they are read; returns how many."""
        sent = 0
        while sent < len(data) and self.reading and self.connected:
            self.protocol.dataReceived(data[sent : sent + size])
            sent += size
        return min(sent, len(data))

    # --- FileDescriptor -----------------------------------------------------------------------------------

    def writeSomeData(self, data: bytes) -> int:
        taken, self._room = data[: self._room], self._room - min(self._room, len(data))
        self.taken += taken
        return len(taken)

    def startWriting(self) -> None:
        """The test asks."""

    stopWriting = startWriting

    def stopReading(self) -> None:
        self.reading = False

    def startReading(self) -> None:
        self.reading = True

    def getPeer(self) -> IPv4Address:
        """The client."""
        return IPv4Address("TCP", self._address, 50000)

    getHost = getPeer

    def abortConnection(self) -> None:
        """Close at once."""
        if self.connected:
            self.connectionLost(None)

    def connectionLost(self, reason: Any) -> None:
        super().connectionLost(reason)
        self.protocol.connectionLost(reason)


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site with a portal that has one large file."""
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "app.bin").write_bytes(bytes(range(256)) * (ASSET // 256))
    return World(tmp_path)


def get(path: str, headers: str = "") -> bytes:
    """A request."""
    return f"GET {path} HTTP/1.1\r\nHost: x\r\n{headers}\r\n".encode()


def turns(world: World, count: int = 10) -> None:
    """Of the reactor."""
    world.clock.pump([0] * count)


@pytest.mark.parametrize(
    "path", ["/assets/app.bin", "/nothing", "/api/v1/session", "/robots/rover", "/healthz"]
)
def test_pipelined_requests_of_a_client_that_accepts_nothing_wait(world: World, path: str) -> None:
    """Of 200 KB of requests, the bytes read and the bytes in the transport are bounded."""
    transport = Socket(world)
    one = get(path)
    sent = transport.send(one * (200_000 // len(one)))
    turns(world, 3000)
    assert transport.connected
    assert not transport.reading
    assert sent <= module.AHEAD_BYTES + 2 * module.PIECE_BYTES
    assert transport.unsent < BOUND


def test_pipelined_requests_are_answered_in_order(world: World) -> None:
    transport = Socket(world)
    transport.send(get("/assets/app.bin") + get("/nothing") + get("/assets/app.bin", "Connection: close\r\n"))
    for _ in range(2000):
        transport.takes(1000)
        turns(world, 1)
        assert transport.unsent < BOUND
    first, _, rest = transport.taken.partition(b"HTTP/1.1 404")
    file = bytes(range(256)) * (ASSET // 256)
    assert parse(first).body == file
    assert parse(rest[rest.index(b"HTTP/1.1 200") :]).body == file
    assert not transport.connected


def test_pipelined_requests_are_answered_one_per_reactor_turn(world: World) -> None:
    """Other connections are served in between."""
    transport = Socket(world)
    transport.send(get("/nothing") * 5)
    transport.takes(10_000)
    assert transport.taken.count(b"HTTP/1.1 404") == 1
    turns(world)
    transport.takes(10_000)
    assert transport.taken.count(b"HTTP/1.1 404") == 5


def test_a_client_that_accepts_nothing_of_an_answer_is_cut(world: World) -> None:
    """A client that accepts a little now and then is not."""
    slow, silent = Socket(world), Socket(world)
    for each in (slow, silent):
        each.send(get("/assets/app.bin"))
    for _ in range(4):
        world.clock.advance(module.STALL_SECONDS * 0.7)
        slow.takes(BOUND)
    assert slow.connected
    assert not silent.connected
    slow.abortConnection()
    assert not world.cap._counts
    assert not world.site.unsent._waiting
    assert not world.clock.getDelayedCalls()


def test_a_client_that_accepts_nothing_at_the_end_of_a_stream_is_cut(world: World) -> None:
    """The stream has a limit of its own; this one is for the bytes that it leaves in the transport."""
    transport = Socket(world)
    transport.send(get("/api/v1/robots/stream", "Authorization: Bearer ann\r\n"))
    transport.write(b"x" * BOUND)
    del world.service.tokens["ann"]
    transport.protocol._requestProducer = None
    world.clock.pump([1.0] * 4)
    world.clock.advance(module.STALL_SECONDS)
    assert not transport.connected


@pytest.mark.parametrize("full", [False, True])
def test_bytes_read_ahead_of_an_answer_are_bounded(world: World, full: bool) -> None:
    """The answer is an endless stream, with and without a full transport."""
    transport = Socket(world)
    transport.send(get("/api/v1/robots/stream", "Authorization: Bearer ann\r\n"))
    if full:
        transport.write(b"x" * BOUND)
    sent = transport.send(b"x" * 1_000_000)
    assert sent <= module.AHEAD_BYTES + 2 * module.PIECE_BYTES
    assert not transport.reading


def test_a_long_pipelined_request_is_not_cut_as_idle(world: World) -> None:
    """The idle time ends when the next request has arrived."""
    transport = Socket(world)
    transport.send(get("/nothing") + get("/api/v1/robots/stream", "Authorization: Bearer ann\r\n"))
    for _ in range(int(module.IDLE_SECONDS) + 5):
        world.clock.advance(1.0)
        transport.takes(100_000)
    assert transport.connected
    assert b"event: robots" in transport.taken


def test_unsent_bytes_of_a_network_are_bounded(tmp_path: Path) -> None:
    """The connection that has waited longest is cut; other networks are not affected."""
    world = World(tmp_path)
    world.cap = world.site.connection_limits = limits.ConnectionLimits(100)
    world.site.unsent = Unsent(most=1_000_000)
    body = b"x" * 400_000
    transports = [Socket(world, address) for address in ("192.0.2.9",) * 4 + ("203.0.113.5",)]
    for each in transports:
        each.protocol._handlingRequest = True
        each.protocol.write(body)
    assert [each.connected for each in transports] == [False, False, True, True, True]


def test_waiting_files_of_the_portal_cost_no_memory(tmp_path: Path) -> None:
    """Of many downloads of one large file, compressed or not, only the heads of the answers count."""
    words = b"".join(b"%d," % number for number in range(100_000))
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "app.js").write_bytes(words)
    world = World(tmp_path)
    world.cap = world.site.connection_limits = limits.ConnectionLimits(100)
    world.site.unsent = Unsent(most=len(words))
    transports = [Socket(world) for _ in range(40)]
    for number, each in enumerate(transports):
        each.send(get("/assets/app.js", "Accept-Encoding: gzip\r\n" if number % 2 else ""))
        assert each.protocol._pieces
    assert not world.site.unsent._waiting
    own = [Socket(world) for _ in range(3)]
    for each in own:
        each.protocol._handlingRequest = True
        each.protocol.write(bytes(bytearray(words[: len(words) * 2 // 3])))
    assert [each.connected for each in own] == [False, False, True]
    assert all(each.connected for each in transports)
    transports[0].takes(len(words) + 1000)
    assert transports[0].taken.endswith(words)


def test_the_rest_of_a_large_answer_counts_as_the_whole_answer(tmp_path: Path) -> None:
    """The whole answer is held until its last part is accepted."""
    world = World(tmp_path)
    world.site.unsent = Unsent(most=1_000_000)
    first, second = Socket(world), Socket(world)
    for each in (first, second):
        each.protocol._handlingRequest = True
        each.protocol.write(bytes(bytearray(600_000)))
        each.takes(500_000)
    assert (first.connected, second.connected) == (False, True)


def test_an_error_of_a_pipelined_request_follows_the_answer_before_it(world: World) -> None:
    """The second of two requests has a body that is too large."""
    transport = Socket(world)
    transport.send(
        get("/nothing") + b"POST /api/v1/session HTTP/1.1\r\nHost: x\r\nContent-Length: 100000\r\n\r\n"
    )
    turns(world)
    transport.takes(10_000)
    assert transport.taken.index(b"HTTP/1.1 404") < transport.taken.index(b"HTTP/1.1 413")


def test_a_client_that_leaves_leaves_nothing_behind(world: World) -> None:
    for taken in (0, 10_000, ASSET, 2 * ASSET):
        transport = Socket(world)
        transport.send(get("/assets/app.bin") * 2)
        transport.takes(taken)
        turns(world, 2)
        transport.abortConnection()
        assert not world.site.unsent._waiting
        assert not world.clock.getDelayedCalls()
    assert not world.cap._counts
