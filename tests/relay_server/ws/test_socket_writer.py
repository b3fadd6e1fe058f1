"""Eager and joined writing, over real sockets."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import pytest
from twisted.internet import reactor as running_reactor
from twisted.internet.protocol import Protocol
from twisted.internet.task import Clock
from twisted.internet.tcp import Server
from twisted.internet.testing import StringTransport

from relay_server.common.socket_writer import (
    JOINED_BYTES,
    DirectSocketWriter,
    FlushScheduler,
    PassThroughWriter,
    writer_for,
)

reactor: Any = running_reactor


class Producer:
    """Records the transport's calls."""

    def __init__(self) -> None:
        self.reported: list[str] = []

    def pauseProducing(self) -> None:
        self.reported.append("pause")

    def resumeProducing(self) -> None:
        self.reported.append("resume")

    def stopProducing(self) -> None:
        self.reported.append("stop")


class Pair:
    """Twisted's side of a TCP connection, served only by the test, and the peer's socket."""

    def __init__(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as listening:
            self.peer = socket.create_connection(listening.getsockname())
            ours, address = listening.accept()
        ours.setblocking(False)
        self.peer.setblocking(False)
        self.protocol = Protocol()
        self.transport = Server(ours, self.protocol, address, None, 1, reactor)  # type: ignore[arg-type]
        self.protocol.makeConnection(self.transport)
        self.producer = Producer()
        self.transport.registerProducer(self.producer, True)  # type: ignore[arg-type]
        self.clock = Clock()
        self.flushes = FlushScheduler(self.clock)
        self.writer = writer_for(self.transport, self.flushes)

    def watched(self) -> list[bytes]:
        """Chunks that the writer gives to the socket from now on."""
        sent: list[bytes] = []
        real = self.transport.getHandle()

        class Watched:
            def send(self, data: bytes) -> int:
                sent.append(data)
                return int(real.send(data))

        self.writer._socket = Watched()  # type: ignore[attr-defined]
        return sent

    def received(self) -> bytes:
        """Bytes that the peer has now."""
        found = b""
        while True:
            try:
                data = self.peer.recv(1 << 20)
            except BlockingIOError:
                return found
            if not data:
                return found
            found += data

    def fill(self) -> int:
        """Writes until the kernel takes no more; returns the number of bytes."""
        written = 0
        while not self.transport.dataBuffer and not self.transport._tempDataLen:
            self.writer.write(b"x" * 60_000)
            written += 60_000
            self.clock.advance(0.001)
        return written

    def drain(self, size: int) -> bytes:
        """Lets the peer read this many bytes while Twisted writes."""
        found = b""
        while len(found) < size:
            self.transport.doWrite()
            found += self.received()
        return found

    def close(self) -> None:
        """Closes both ends."""
        self.peer.close()
        if self.transport.getHandle().fileno() >= 0:
            self.transport.stopReading()
            self.transport.stopWriting()
            self.transport.getHandle().close()


@pytest.fixture
def pair() -> Iterator[Pair]:
    """A connection."""
    made = Pair()
    yield made
    made.close()


def test_a_message_after_a_pause_is_on_the_socket_at_once(pair: Pair) -> None:
    """It passes neither the reactor nor Twisted's buffer."""
    assert isinstance(pair.writer, DirectSocketWriter)
    pair.writer.write(b"first")
    assert pair.received() == b"first"
    assert pair.transport not in reactor.getWriters()


def test_following_writes_are_joined_until_the_end_of_the_turn(pair: Pair) -> None:
    """In one piece and in order; a message a little later is sent at once again."""
    sent = pair.watched()
    for text in (b"a", b"b", b"c"):
        pair.writer.write(text)
    assert sent == [b"a"]
    pair.clock.advance(0.001)
    assert sent == [b"a", b"bc"]
    pair.writer.write(b"d")
    assert sent == [b"a", b"bc", b"d"]
    assert pair.received() == b"abcd"


def test_much_is_not_held_until_the_end_of_the_turn(pair: Pair) -> None:
    """Much data in one turn reaches the socket in large pieces, and Twisted's buffer limit when the socket is
    full.
    """
    sent = pair.watched()
    for _ in range(100):
        pair.writer.write(b"x" * 1024)
    assert [len(each) for each in sent] == [1024] + [JOINED_BYTES] * 3
    pair.clock.advance(0.001)
    assert sum(map(len, sent)) == 100 * 1024


def test_unsent_bytes_wait_in_twisteds_buffer(pair: Pair) -> None:
    """Twisted pauses the producer at its own limit and resumes it when all is sent; no bytes are lost or
    swapped.
    """
    written = pair.fill()
    assert pair.transport in reactor.getWriters()
    assert pair.producer.reported == []
    sent = pair.watched()
    pair.writer.write(b"y" * pair.transport.bufferSize)
    assert pair.producer.reported == ["pause"]
    assert sent == [], "the socket was asked past what waits already"
    pair.clock.advance(0.001)
    got = pair.drain(written + pair.transport.bufferSize)
    assert got == b"x" * written + b"y" * pair.transport.bufferSize
    assert pair.producer.reported == ["pause", "resume"]
    pair.writer.write(b"z")
    assert pair.received() == b"z"


def test_twisted_still_keeps_its_bytes_where_we_look(pair: Pair) -> None:
    """Bytes written and not joined, and joined and partly sent: both count as waiting, in Twisted's
    attributes.

    When this fails, find out how the installed Twisted keeps unsent bytes, and make DirectSocketWriter look
    there.
    """
    pair.transport.write(b"w")
    assert pair.transport._tempDataLen == 1
    sent = pair.watched()
    pair.writer.write(b"1")
    assert sent == []
    pair.transport.doWrite()
    assert pair.received() == b"w1"
    assert not pair.transport._tempDataLen
    assert not pair.transport.dataBuffer
    pair.clock.advance(0.001)
    written = pair.fill()
    pair.transport.doWrite()
    assert pair.transport.dataBuffer
    assert not pair.transport._tempDataLen
    pair.writer.write(b"2")
    assert pair.drain(written + 1).endswith(b"x2")


def test_a_broken_socket_is_left_to_twisted_to_notice(pair: Pair) -> None:
    """The writer raises nothing; Twisted's own write finds the error and ends the connection."""
    pair.peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")
    pair.peer.close()
    pair.writer.write(b"a")
    pair.clock.advance(0.001)
    pair.writer.write(b"b")
    assert pair.transport in reactor.getWriters()
    assert pair.transport.doWrite() is not None


def test_writing_to_a_closed_transport_is_ignored(pair: Pair) -> None:
    """No exception is raised, as with Twisted's own transports."""
    pair.writer.write(b"a")
    pair.writer.write(b"held")
    pair.transport.connected = 0
    pair.close()
    pair.writer.flush()
    pair.clock.advance(0.001)
    pair.writer.write(b"late")
    assert not pair.transport._tempDataLen


def test_buffered_bytes_can_be_flushed_before_a_close(pair: Pair) -> None:
    """The end of the turn has nothing left to do."""
    pair.writer.write(b"a")
    pair.writer.write(b"b")
    pair.writer.flush()
    assert pair.received() == b"ab"
    sent = pair.watched()
    pair.clock.advance(0.001)
    assert sent == []


def test_a_turn_is_shared(pair: Pair) -> None:
    """Many writers in one turn schedule its end once."""
    other = Pair()
    try:
        other.writer = writer_for(other.transport, pair.flushes)
        for writer in (pair.writer, other.writer):
            writer.write(b"1")
            writer.write(b"2")
        assert len(pair.clock.getDelayedCalls()) == 1
        pair.clock.advance(0.001)
        assert (pair.received(), other.received()) == (b"12", b"12")
    finally:
        other.close()


def test_only_plain_tcp_is_written_past_twisted(pair: Pair) -> None:
    """TLS has its own records, and other transports have no socket."""
    transport = StringTransport()
    writer = writer_for(transport, pair.flushes)
    assert isinstance(writer, PassThroughWriter)
    writer.write(b"a")
    writer.write(b"b")
    writer.flush()
    assert transport.value() == b"ab"
    pair.transport.TLS = True
    assert isinstance(writer_for(pair.transport, pair.flushes), PassThroughWriter)
