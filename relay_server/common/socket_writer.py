"""Writing without delay and without waste: at once when nothing waits, else joined, once a turn of the reactor.

Twisted keeps what is written until the socket is reported writable: one more turn, and two calls to the kernel to
ask for the report and to take that back. Here a message goes to the socket directly. What follows closely is joined
and goes at the end of the turn: a flood costs one call to the kernel, not one a message. What the socket does not take
goes into Twisted's own buffer, which pauses the producer as ever.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.tcp import Server

from relay_server.common.clock import Clock

APART_SECONDS = 0.0005
"""Messages that come so far apart are sent one by one. To ask the reactor where a turn begins would cost more."""

JOINED_BYTES = 32 * 1024
"""So much is not held until the end of the turn: the socket takes it now, or Twisted has to know that it is full."""


TICK_SECONDS = 0.02
"""How often it is looked whether the reactor stands still; a turn that takes less is not noticed."""

TICKS = 50
"""It is looked so often after the last time anybody asked."""

UNLIMITED = 1 << 62
"""Budget of a writer that nobody limits."""


class FlushScheduler:
    """Flushes writers when a turn of the reactor is over. One for all writers of a listening port.

    :param clock: the reactor, or one in a test
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.seconds = clock.seconds
        self.stalls = Stalls(clock)
        self._held: list[SocketWriter] = []

    def hold(self, writer: SocketWriter) -> None:
        """Flush this writer at the end of the turn."""
        if not self._held:
            # The reactor makes due calls before it looks for events again.
            self._clock.callLater(0, self._over)
        self._held.append(writer)

    def _over(self) -> None:
        held, self._held = self._held, []
        for writer in held:
            writer.flush()


class Stalls:
    """A clock that stands still while the reactor does, so that a busy relay is not taken for a slow connection.

    It is exact to :data:`TICK_SECONDS` while it is asked for at least once a second.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._stalled = 0.0
        self._due = 0.0
        self._left = 0
        """Ticks until it is no longer looked."""

    def seconds(self) -> float:
        """Monotonic seconds, without those for which the reactor stood still."""
        now = self._clock.seconds()
        if not self._left:
            self._tick_from(now)
        self._left = TICKS
        return now - self._stalled - max(0.0, now - self._due)

    def _tick_from(self, now: float) -> None:
        self._due = now + TICK_SECONDS
        self._clock.callLater(TICK_SECONDS, self._tick)

    def _tick(self) -> None:
        now = self._clock.seconds()
        self._stalled += max(0.0, now - self._due)
        self._left -= 1
        if self._left:
            self._tick_from(now)
        else:
            self._due = math.inf


class TransportWriter(Protocol):
    """In front of a transport. All that goes over the transport must go through it, or order is lost.

    :ivar budget: bytes that may be written until ``spent`` is called, see :mod:`relay_server.common.pacing`
    :ivar spent: takes the data that exceeds the budget, instead of it being written; ``budget`` is negative then
    """

    budget: int
    spent: Callable[[bytes], None]

    def write(self, data: bytes) -> None:
        """Send, now or at the end of the turn."""

    def urgent(self, data: bytes) -> None:
        """The same without a look at the budget."""

    def flush(self) -> None:
        """Send what is held. Call before the transport is told to close."""


def _unlimited(data: bytes) -> None:
    raise AssertionError(f"{len(data)} bytes exceed a budget that nobody set")


class SocketWriter:
    """In front of a plain TCP connection."""

    __slots__ = (
        "_behind",
        "_held",
        "_held_bytes",
        "_seconds",
        "_sent_at",
        "_socket",
        "_transport",
        "_turns",
        "budget",
        "spent",
    )

    def __init__(self, transport: Any, turns: FlushScheduler) -> None:
        self._transport = transport
        self._socket = transport.getHandle()
        self._turns = turns
        self._seconds = turns.seconds
        self._behind = True
        """Whether Twisted may have bytes of this connection: whoever had it before may have left some."""
        self._sent_at = -math.inf
        self._held: list[bytes] = []
        self._held_bytes = 0
        self.budget = UNLIMITED
        self.spent: Callable[[bytes], None] = _unlimited

    def write(self, data: bytes) -> None:
        """At once if nothing was sent just before, else at the end of the turn."""
        self.budget -= len(data)
        if self.budget < 0:
            self.spent(data)
            return
        if not self._held:
            now = self._seconds()
            if now - self._sent_at >= APART_SECONDS:
                self._sent_at = now
                self._put(data)
                return
            self._turns.hold(self)
        self._held.append(data)
        self._held_bytes += len(data)
        if self._held_bytes >= JOINED_BYTES:
            self.flush()

    def urgent(self, data: bytes) -> None:
        """See :class:`TransportWriter`."""
        self.budget += len(data)
        self.write(data)

    def flush(self) -> None:
        """What was held, in one piece."""
        if self._held:
            data = b"".join(self._held)
            self._held.clear()
            self._held_bytes = 0
            self._put(data)

    def _put(self, data: bytes) -> None:
        if self._behind:
            # Bytes that Twisted still has go first. ``_tempDataLen`` (written, not yet joined) and ``dataBuffer``
            # (being sent) are all it keeps; they are only read here, and the tests notice when they are not that any
            # more.
            transport = self._transport
            if transport._tempDataLen or transport.dataBuffer:
                transport.write(data)
                return
            self._behind = False
        try:
            sent = self._socket.send(data)
        except OSError:
            # Full, broken or closed: Twisted finds out which when it writes, and tells the protocol.
            sent = 0
        if sent < len(data):
            self._behind = True
            self._transport.write(data[sent:])


class PlainWriter:
    """In front of any other transport. TLS joins small writes of a turn itself."""

    __slots__ = ("_write", "budget", "spent")

    def __init__(self, transport: Any) -> None:
        self._write = transport.write
        self.budget = UNLIMITED
        self.spent: Callable[[bytes], None] = _unlimited

    def write(self, data: bytes) -> None:
        """To the transport."""
        self.budget -= len(data)
        if self.budget < 0:
            self.spent(data)
        else:
            self._write(data)

    def urgent(self, data: bytes) -> None:
        """See :class:`TransportWriter`."""
        self._write(data)

    def flush(self) -> None:
        """Nothing is held."""


def writer_for(transport: Any, turns: FlushScheduler) -> TransportWriter:
    """The writer for a connection; bytes may be put on its socket only when nothing else writes there."""
    if type(transport) is Server and not transport.TLS:
        return SocketWriter(transport, turns)
    return PlainWriter(transport)
