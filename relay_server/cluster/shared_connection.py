"""One connection between two relays, which carries the websockets of all clients of one whose robots are at the other.

Each websocket is a stream of bytes with a number. What several streams get in the same reactor turn, such as a sample
that clients of a topic share, goes over the connection once, with their numbers. Either side can pause a stream, so
that a client that does not read holds up no other.

A frame is a head, ``count`` numbers of streams (32 bits each), and ``length`` bytes for each of these streams:

=======  ======  ========================================================================
Field    Bits    Meaning
=======  ======  ========================================================================
kind     8       see :class:`FrameKind`
count    16      at most :data:`MOST_NUMBERS`
length   32      0 unless the kind is ``DATA``
=======  ======  ========================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from enum import IntEnum
from struct import Struct, pack, unpack_from
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.internet.error import ConnectionDone
from twisted.internet.interfaces import IConsumer, IPushProducer, ITransport
from twisted.internet.protocol import Protocol as TwistedProtocol
from twisted.internet.protocol import connectionDone
from twisted.logger import Logger
from twisted.python.failure import Failure
from zope.interface import implementer

from relay_protocol.limits import KIB, MIB
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.socket_writer import FlushScheduler, writer_for
from relay_server.common.tcp import PushProducer, enable_tcp_keepalive, tcp_of

UPGRADE = "switchboard-streams"
"""The protocol to which the relay that connects asks to switch (RFC 9110 section 7.8)."""

ACCEPTED = f"HTTP/1.1 101 Switching Protocols\r\nConnection: Upgrade\r\nUpgrade: {UPGRADE}\r\n\r\n".encode()

HEAD_BYTES = 16 * KIB
"""Most bytes of the answer to the request for the connection."""

MOST_NUMBERS = 1024
"""Most streams that one frame is for."""

JOINED_BYTES = 32 * KIB
"""Bytes that are written before the end of the reactor turn, so that it is soon known if the transport is full."""

BUFFER_BYTES = 256 * KIB
"""Bytes in the transport's buffer that pause all streams."""

UNREAD_BYTES = 64 * KIB
"""Bytes that wait for a stream that is not read, after which the other relay is asked to pause it."""

READ_SECONDS = 20.0
"""Seconds in which the last bytes of a stream that has ended must be read."""

MOST_UNREAD_BYTES = 64 * MIB
"""The same, after which the stream ends: the other relay did not pause it. One message may be large."""

PING_SECONDS = 2.0
"""Seconds between pings of the relay that has connected."""

MOST_UNANSWERED = 5
"""Pings after which no byte came, and the connection is given up. A relay that stood still itself sends only one for
that time, and none while its own bytes are not taken: the kernel detects that
(:func:`~relay_server.common.tcp.enable_tcp_keepalive`)."""

APART_SECONDS = 0.0005
"""Small pieces this far apart are written at once, and not at the end of the turn."""

AT_ONCE_BYTES = 2 * KIB
"""Most bytes of such a piece. A larger one may be what many streams get."""

_HEAD = Struct("!BHI")
_SINGLE = Struct("!BHII")
"""The head of a frame for one stream."""


class FrameKind(IntEnum):
    """What a frame says of its streams."""

    OPEN = 1
    """One begins; the relay that has connected chooses the number."""
    DATA = 2
    PAUSE = 3
    """The sender takes no more bytes for now."""
    RESUME = 4
    END = 5
    """The sender has closed it, behind its bytes."""
    ABORT = 6
    """The sender has dropped it; what waits to be read is of no use."""
    PING = 7
    """The sender, which has connected, wants to know whether the other relay is there. The number is of no stream, but
    one that the answer repeats."""
    PONG = 8
    """The answer: all that came before the ping was read."""


class _HeldFrame:
    """A frame that is sent at the end of the reactor turn, if not before.

    :param index: its place in the order of frames
    :ivar more: what the only stream of this frame gets behind its first data
    """

    __slots__ = ("data", "index", "kind", "more", "numbers")

    def __init__(self, index: int, kind: FrameKind, numbers: list[int], data: bytes) -> None:
        self.index = index
        self.kind = kind
        self.numbers = numbers
        self.data = data
        self.more: list[bytes] = []

    def parts(self) -> Iterable[bytes]:
        """The frame in parts."""
        count, length = len(self.numbers), len(self.data) + sum(map(len, self.more))
        head = _HEAD.pack(self.kind, count, length)
        return (head, pack(f"!{count}I", *self.numbers), self.data, *self.more)


@implementer(ITransport, IConsumer, IPushProducer)
class StreamTransport:
    """One end of a stream: the transport of a protocol.

    :ivar protocol: receives the bytes; may be replaced
    """

    TLS = False

    def __init__(self, shared: SharedConnection, number: int, protocol: Any) -> None:
        self.protocol = protocol
        self.disconnecting = False
        self.number = number
        self._shared = shared
        self._producer: Any = None
        self._producer_paused = False
        self._held_by_peer = False
        self._reading = True
        self._unread: list[bytes] = []
        self._unread_bytes = 0
        self._asked_to_pause = False
        self._over = False
        """Whether no byte can come any more."""
        self._read_by: Timer | None = None
        """Ends a stream that is over, and whose last bytes are not read."""

    # --- ITransport, IConsumer ----------------------------------------------------------------------------

    def write(self, data: bytes) -> None:
        """Send bytes, at the end of the reactor turn."""
        if data and not (self.disconnecting or self._over):
            self._shared.send_data(self.number, data)

    def writeSequence(self, data: list[bytes]) -> None:
        """See ``ITransport``."""
        self.write(b"".join(data))

    def loseConnection(self) -> None:
        """Close the stream behind what was written."""
        self._close(FrameKind.END)

    def abortConnection(self) -> None:
        """Drop the stream, also at the other relay."""
        self._close(FrameKind.ABORT)

    def _close(self, kind: FrameKind) -> None:
        if not self.disconnecting:
            self.disconnecting = True
            self._shared.close_stream(self, kind)

    def getPeer(self) -> Any:
        """The address of the other relay."""
        return self._shared.transport.getPeer()

    def getHost(self) -> Any:
        """The address of this relay."""
        return self._shared.transport.getHost()

    def setTcpNoDelay(self, enabled: bool) -> None:
        """Nothing: the connection is shared."""

    def setTcpKeepAlive(self, enabled: bool) -> None:
        """Nothing: the connection is shared."""

    def registerProducer(self, producer: Any, streaming: bool) -> None:
        """See ``IConsumer``; only producers that push."""
        self._producer = producer
        self._producer_paused = False
        self.update_producer()

    def unregisterProducer(self) -> None:
        """See ``IConsumer``."""
        self._producer = None

    def confirm(self, seconds: float) -> Deferred[bool]:
        """See :meth:`SharedConnection.confirm`. What is written to a stream that has ended is never read."""
        return succeed(False) if self.disconnecting or self._over else self._shared.confirm(seconds)

    # --- IPushProducer ------------------------------------------------------------------------------------

    def pauseProducing(self) -> None:
        """Pass no more bytes to the protocol."""
        self._reading = False

    def resumeProducing(self) -> None:
        """Pass bytes to the protocol again, those that wait in a reactor turn of their own."""
        if self._reading:
            return
        self._reading = True
        if self._unread or self._over:
            self._shared.clock.callLater(0, self._read_waiting)

    def stopProducing(self) -> None:
        """See ``IPushProducer``."""
        self.loseConnection()

    def _read_waiting(self) -> None:
        if not self._reading:
            return
        data, self._unread, self._unread_bytes = b"".join(self._unread), [], 0
        if self._asked_to_pause:
            self._asked_to_pause = False
            self._shared.send_control(FrameKind.RESUME, self.number)
        if data:
            self._pass_on(data)
        if self._over and self._reading:
            self.lost()

    # --- the shared connection ----------------------------------------------------------------------------

    def received(self, data: bytes) -> None:
        """Bytes have come."""
        if self._reading and not self._unread:
            self._pass_on(data)
            return
        self._unread.append(data)
        self._unread_bytes += len(data)
        if self._unread_bytes > MOST_UNREAD_BYTES:
            self.loseConnection()
        elif self._unread_bytes > UNREAD_BYTES and not self._asked_to_pause:
            self._asked_to_pause = True
            self._shared.send_control(FrameKind.PAUSE, self.number)

    def _pass_on(self, data: bytes) -> None:
        if not self.disconnecting:
            self.guarded(self.protocol.dataReceived, data)

    def guarded(self, call: Callable[..., object], *arguments: object) -> None:
        """Call what may fail because of this stream alone; then it ends, and not the shared connection."""
        try:
            call(*arguments)
        except Exception:
            self._shared.log.failure("a stream of another relay failed; it is closed")
            self.loseConnection()

    def held(self, paused: bool) -> None:
        """The other relay takes no bytes, or takes them again."""
        self._held_by_peer = paused
        self.update_producer()

    def update_producer(self) -> None:
        """Pause or resume the producer."""
        pause = self._held_by_peer or self._shared.full
        if self._producer is None or pause == self._producer_paused:
            return
        self._producer_paused = pause
        self.guarded(self._producer.pauseProducing if pause else self._producer.resumeProducing)

    def ended(self) -> None:
        """The other relay has closed the stream; what waits is read first."""
        self._over = True
        if self._unread:
            self._read_by = self._shared.clock.callLater(READ_SECONDS, self.lost)
        else:
            self.lost()

    def lost(self) -> None:
        """The stream is over."""
        cancel(self._read_by)
        self._shared.forget(self)
        self.disconnecting = True
        protocol, self.protocol, self._producer = self.protocol, None, None
        self._unread.clear()
        if protocol is not None:
            self.guarded(protocol.connectionLost, Failure(ConnectionDone()))


class SharedConnection(TwistedProtocol):
    """One end of the connection.

    :param flushes: of the connections of this relay
    :param accept: builds the protocol of a stream that the other relay opens; ``None``: it opens none
    :ivar full: whether the transport takes no more bytes for now
    :ivar on_lost: called when the connection is gone
    """

    log = Logger()
    transport: Any

    def __init__(
        self, clock: Clock, flushes: FlushScheduler, accept: Callable[[Any], Any] | None = None
    ) -> None:
        self.clock = clock
        self.full = False
        self.on_lost: Callable[[], object] = _nothing
        self._flushes = flushes
        self._accept = accept
        self._lost = False
        self._streams: dict[int, StreamTransport] = {}
        self._ending: set[StreamTransport] = set()
        """Those that the other relay has ended, and whose last bytes are not read yet."""
        self._opened = 0
        self._rest = b""
        self._unanswered = 0
        self._ping_timer: Timer | None = None
        self._confirming: dict[int, tuple[Deferred[bool], Timer]] = {}
        """Those that wait for the answer to a ping, by its number; and when they give up."""
        self._receptions = 0
        """How often bytes have come."""
        self._confirmations = 0
        self._numbers: tuple[int, ...] = ()
        self._left = 0
        """Bytes that are left of a frame for :attr:`_numbers`."""
        self._held: list[_HeldFrame] = []
        self._held_bytes = 0
        self._sent_at = -math.inf
        self._by_data: dict[int, _HeldFrame] = {}
        """Held frames by the identity of their data."""
        self._latest: dict[int, int] = {}
        """The last held frame of each stream."""

    def connectionMade(self) -> None:
        """Both relays have agreed on it."""
        enable_tcp_keepalive(self.transport)
        tcp = tcp_of(self.transport)
        if tcp is not None:
            tcp.bufferSize = BUFFER_BYTES
        self._writer = writer_for(self.transport, self._flushes)
        self.transport.registerProducer(PushProducer(self), True)
        if self._accept is None:
            self._ping_timer = self.clock.callLater(PING_SECONDS, self._ping)

    def _ping(self) -> None:
        if self._unanswered >= MOST_UNANSWERED:
            self.log.warn("another relay is silent; its connection is given up", limited="silent relay")
            self.transport.abortConnection()
            return
        if not self.full:
            self._unanswered += 1
            self.send_control(FrameKind.PING, 0)
        self._ping_timer = self.clock.callLater(PING_SECONDS, self._ping)

    def confirm(self, seconds: float) -> Deferred[bool]:
        """Ask whether the other relay has read what was written before. For the side that has connected.

        :returns: fires with false if that is not known within so many seconds, or twice as many if other bytes
            come meanwhile, behind which the answer may wait
        """
        if self._lost:
            return succeed(False)
        self._confirmations += 1
        number = self._confirmations
        confirming: Deferred[bool] = Deferred()
        timer = self.clock.callLater(seconds, self._not_confirmed, number, seconds, self._receptions)
        self._confirming[number] = confirming, timer
        self.send_control(FrameKind.PING, number)
        return confirming

    def _not_confirmed(self, number: int, seconds: float, receptions: int) -> None:
        confirming, _ = self._confirming[number]
        if self._receptions == receptions:
            self._confirm(number, False)
        else:
            self._confirming[number] = (
                confirming,
                self.clock.callLater(seconds, self._confirm, number, False),
            )

    def _confirm(self, number: int, read: bool) -> None:
        if number in self._confirming:
            confirming, timer = self._confirming.pop(number)
            cancel(timer)
            confirming.callback(read)

    def close(self) -> None:
        """Close the connection behind what was written."""
        self._flush()
        # TLS would not shut down while a producer is registered.
        self.transport.unregisterProducer()
        self.transport.loseConnection()

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        """All streams are over."""
        cancel(self._ping_timer)
        streams, self._streams = [*self._streams.values(), *self._ending], {}
        self._lost = True
        self._clear()
        self.on_lost()
        for number in list(self._confirming):
            self._confirm(number, False)
        for each in streams:
            each.lost()

    def pause(self) -> None:
        """The transport's buffer is full."""
        self._set_full(True)

    def resume(self) -> None:
        """The transport takes bytes again."""
        self._set_full(False)

    def _set_full(self, full: bool) -> None:
        self.full = full
        for number, each in list(self._streams.items()):
            if self.full is not full:
                # What the streams before wrote has changed it.
                break
            if not full and self._streams.get(number) is each:
                # The next time it comes after those that had no turn now.
                self._streams[number] = self._streams.pop(number)
            each.update_producer()

    def open(self, protocol: Any) -> StreamTransport:
        """Open a stream, which the protocol can use at once."""
        self._opened += 1
        stream = self._streams[self._opened] = StreamTransport(self, self._opened, protocol)
        self.send_control(FrameKind.OPEN, stream.number)
        stream.guarded(protocol.makeConnection, stream)
        return stream

    # --- sending ------------------------------------------------------------------------------------------

    def send_data(self, number: int, data: bytes) -> None:
        """Send bytes of a stream, in one frame with others that get the same object."""
        held = self._by_data.get(id(data))
        latest = self._latest
        # Not twice in one frame, whose bytes may come in parts.
        if held is not None and latest.get(number, -1) < held.index and len(held.numbers) < MOST_NUMBERS:
            held.numbers.append(number)
            latest[number] = held.index
            return
        if not self._held:
            now = self._flushes.seconds()
            if now - self._sent_at >= APART_SECONDS and len(data) <= AT_ONCE_BYTES:
                self._sent_at = now
                self._write(_SINGLE.pack(FrameKind.DATA, 1, len(data), number) + data)
                return
            self._by_data[id(data)] = self._hold(FrameKind.DATA, number, data)
        else:
            last = self._held[-1]
            if last.kind is FrameKind.DATA and len(last.numbers) == 1 and last.numbers[0] == number:
                # In one piece, which the other relay reads at once. It is not shared then.
                self._by_data.pop(id(last.data), None)
                last.more.append(data)
            else:
                if self._held_bytes >= JOINED_BYTES:
                    # Not behind the piece that reached the limit: other streams may get the same.
                    self._flush()
                self._by_data[id(data)] = self._hold(FrameKind.DATA, number, data)
        self._held_bytes += len(data)

    def send_control(self, kind: FrameKind, number: int) -> None:
        """Send a frame without data, in order with the others."""
        self._hold(kind, number, b"")

    def _hold(self, kind: FrameKind, number: int, data: bytes) -> _HeldFrame:
        if not self._held:
            # The reactor makes due calls before it polls for events again.
            self.clock.callLater(0, self._flush)
        held = _HeldFrame(len(self._held), kind, [number], data)
        self._held.append(held)
        self._latest[number] = held.index
        return held

    def _flush(self) -> None:
        held = self._clear()
        if held:
            self._write(b"".join(part for each in held for part in each.parts()))

    def _clear(self) -> list[_HeldFrame]:
        held, self._held = self._held, []
        self._by_data.clear()
        self._latest.clear()
        self._held_bytes = 0
        return held

    def _write(self, data: bytes) -> None:
        if self._lost:
            return
        self._writer.write(data)
        self._writer.flush()

    def close_stream(self, stream: StreamTransport, kind: FrameKind) -> None:
        """End a stream of this side; its protocol learns of it in a reactor turn of its own."""
        if self._streams.get(stream.number) is stream:
            del self._streams[stream.number]
            self.send_control(kind, stream.number)
        self.clock.callLater(0, stream.lost)

    def forget(self, stream: StreamTransport) -> None:
        """The stream is over."""
        self._ending.discard(stream)

    # --- receiving ----------------------------------------------------------------------------------------

    def dataReceived(self, data: bytes) -> None:
        """Pass on the bytes of streams as they come."""
        self._unanswered = 0
        self._receptions += 1
        if self._rest:
            data, self._rest = self._rest + data, b""
        at, size = 0, len(data)
        while at < size:
            if self._left:
                part = data[at : at + self._left] if at or self._left < size else data
                at += len(part)
                self._left -= len(part)
                self._pass_on(part)
                continue
            start = at + _HEAD.size
            if start > size:
                break
            kind, count, length = _HEAD.unpack_from(data, at)
            if count > MOST_NUMBERS:
                self.log.error("another relay sent a frame for {count} streams", count=count)
                self.transport.abortConnection()
                return
            end = start + 4 * count
            if end > size:
                break
            numbers = unpack_from(f"!{count}I", data, start)
            at = end
            self._numbers, self._left = numbers if kind == FrameKind.DATA else (), length
            if kind != FrameKind.DATA:
                for number in numbers:
                    self._control(kind, number)
        self._rest = data[at:]

    def _pass_on(self, data: bytes) -> None:
        streams = self._streams
        for number in self._numbers:
            stream = streams.get(number)
            # Bytes may still come for one that this side has closed.
            if stream is not None:
                stream.received(data)

    def _control(self, kind: int, number: int) -> None:
        if kind == FrameKind.OPEN:
            self._open_accepted(number)
            return
        if kind == FrameKind.PING:
            self.send_control(FrameKind.PONG, number)
            return
        if kind == FrameKind.PONG:
            self._confirm(number, True)
            return
        stream = self._streams.get(number)
        if stream is None:
            return
        if kind == FrameKind.END:
            del self._streams[number]
            self._ending.add(stream)
            stream.ended()
        elif kind == FrameKind.ABORT:
            del self._streams[number]
            stream.lost()
        elif kind in (FrameKind.PAUSE, FrameKind.RESUME):
            stream.held(kind == FrameKind.PAUSE)

    def _open_accepted(self, number: int) -> None:
        if number in self._streams:
            self.log.error("another relay opened a stream twice")
            self.transport.abortConnection()
            return
        protocol = None if self._accept is None else self._accept(self.transport.getPeer())
        if protocol is None:
            self.send_control(FrameKind.END, number)
            return
        stream = self._streams[number] = StreamTransport(self, number, protocol)
        stream.guarded(protocol.makeConnection, stream)


class SharedConnectionRequest(TwistedProtocol):
    """Asks another relay for a :class:`SharedConnection` over a new TCP connection.

    :param head: the request (RFC 9110 section 7.8)
    :param done: gets the answered status, 0 if there is none; after 101 the connection is in use
    """

    transport: Any

    def __init__(self, shared: SharedConnection, head: bytes, done: Callable[[int], object]) -> None:
        self._shared = shared
        self._request = head
        self._done = done
        self._answer = b""
        self._accepted = False

    def connectionMade(self) -> None:
        """Send the request."""
        self.transport.write(self._request)

    def dataReceived(self, data: bytes) -> None:
        """The answer, and what follows it."""
        if self._accepted:
            self._shared.dataReceived(data)
            return
        self._answer += data
        head, end, rest = self._answer.partition(b"\r\n\r\n")
        if not end and len(self._answer) <= HEAD_BYTES:
            return
        words = head.split(b" ", 2)
        status = int(words[1]) if end and len(words) > 1 and words[1].isdigit() else 502
        if status != 101:
            self.transport.loseConnection()
            self._done(status)
            return
        self._accepted = True
        used: Any = self._shared
        used.makeConnection(self.transport)
        self._done(status)
        if rest:
            self._shared.dataReceived(rest)

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        """The connection is gone."""
        if self._accepted:
            self._shared.connectionLost(reason)
        else:
            self._done(0)


def _nothing() -> None:
    """Nothing waits for the end."""
