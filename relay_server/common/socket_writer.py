"""Writes to sockets directly, and joins messages that follow closely into one write for each reactor turn.

Twisted buffers what is written until the socket is reported writable, which costs one more turn and two system calls.
Here a message is written to the socket at once. Messages that follow closely are joined and written at the end of the
turn, so a flood costs one system call, not one for each message. Bytes that the socket does not accept go into
Twisted's buffer, which pauses the producer as usual.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.tcp import Client, Server

from relay_server.common.clock import Clock

APART_SECONDS = 0.0005
"""Messages this far apart are written one by one. Finding out where a reactor turn begins would cost more."""

JOINED_BYTES = 32 * 1024
"""Joined bytes that are written before the end of the turn, so that Twisted learns soon if the socket is full."""


TICK_SECONDS = 0.02
"""Seconds between checks whether the reactor stands still; shorter stalls are not noticed."""

TICKS = 50
"""Checks after the latest call of :meth:`Stalls.seconds`."""

UNLIMITED = 1 << 62
"""Budget of a writer without a limit."""


class FlushScheduler:
    """Flushes writers at the end of a reactor turn. One serves all writers of a listening port.

    :param clock: the reactor, or one in a test
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.seconds = clock.seconds
        self.stalls = Stalls(clock)
        self._held: list[DirectSocketWriter] = []

    def schedule(self, writer: DirectSocketWriter) -> None:
        """Flush this writer at the end of the turn."""
        if not self._held:
            # The reactor makes due calls before it polls for events again.
            self._clock.callLater(0, self._over)
        self._held.append(writer)

    def _over(self) -> None:
        held, self._held = self._held, []
        for writer in held:
            writer.flush()


class Stalls:
    """A clock that stands still while the reactor does, so that a busy relay does not look like a slow connection.

    It is exact to :data:`TICK_SECONDS` while it is read at least once a second.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._stalled = 0.0
        self._due = 0.0
        self._left = 0
        """Checks until they stop."""

    def seconds(self) -> float:
        """Monotonic seconds, without the time for which the reactor stood still."""
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
    """In front of a transport. Everything must be written through it, otherwise the order is lost.

    :ivar budget: bytes that may be written until ``over_budget`` is called, see :mod:`relay_server.common.pacing`
    :ivar over_budget: called with data that exceeds the budget, instead of writing it
    """

    budget: int
    over_budget: Callable[[bytes], None]

    def write(self, data: bytes) -> None:
        """Write, now or at the end of the turn."""

    def write_beyond_budget(self, data: bytes) -> None:
        """As :meth:`write`, whatever the budget."""

    def flush(self) -> None:
        """Write what is held. To be called before the transport is closed."""


def _unlimited(data: bytes) -> None:
    raise AssertionError(f"{len(data)} bytes exceed a budget that was never set")


class DirectSocketWriter:
    """Writes to the socket of a TCP connection without TLS, past Twisted while that has no bytes to send."""

    __slots__ = (
        "_flushes",
        "_held",
        "_held_bytes",
        "_seconds",
        "_sent_at",
        "_socket",
        "_transport",
        "_twisted_has_bytes",
        "budget",
        "over_budget",
    )

    def __init__(self, transport: Any, flushes: FlushScheduler) -> None:
        self._transport = transport
        self._socket = transport.getHandle()
        self._flushes = flushes
        self._seconds = flushes.seconds
        self._twisted_has_bytes = True
        """Whether Twisted may have bytes to send; earlier users of the connection may have left some."""
        self._sent_at = -math.inf
        self._held: list[bytes] = []
        self._held_bytes = 0
        self.budget = UNLIMITED
        self.over_budget: Callable[[bytes], None] = _unlimited

    def write(self, data: bytes) -> None:
        """Write at once if nothing was written just before, else at the end of the turn."""
        size = len(data)
        budget = self.budget - size
        if budget < 0:
            self.over_budget(data)
            return
        self.budget = budget
        if not self._held:
            now = self._seconds()
            if now - self._sent_at >= APART_SECONDS:
                self._sent_at = now
                self._send(data)
                return
            self._flushes.schedule(self)
        self._held.append(data)
        self._held_bytes = size = self._held_bytes + size
        if size >= JOINED_BYTES:
            self.flush()

    def write_beyond_budget(self, data: bytes) -> None:
        """See :class:`TransportWriter`."""
        self.budget += len(data)
        self.write(data)

    def flush(self) -> None:
        """Write what is held, in one piece."""
        if self._held:
            data = b"".join(self._held)
            self._held.clear()
            self._held_bytes = 0
            self._send(data)

    def _send(self, data: bytes) -> None:
        if self._twisted_has_bytes:
            # Bytes that Twisted still has go first: those counted by ``_tempDataLen`` (written, not yet joined) and
            # those in ``dataBuffer`` (being sent). Both are only read here; tests show if a new Twisted changes them.
            transport = self._transport
            if transport._tempDataLen or transport.dataBuffer:
                transport.write(data)
                return
            self._twisted_has_bytes = False
        try:
            sent = self._socket.send(data)
        except OSError:
            # Full, broken or closed: Twisted finds out when it writes, and notifies the protocol.
            sent = 0
        if sent < len(data):
            self._twisted_has_bytes = True
            self._transport.write(data[sent:])


class PassThroughWriter:
    """Passes each message on to the transport at once: for TLS, which joins the small writes of a turn itself."""

    __slots__ = ("_write", "budget", "over_budget")

    def __init__(self, transport: Any) -> None:
        self._write = transport.write
        self.budget = UNLIMITED
        self.over_budget: Callable[[bytes], None] = _unlimited

    def write(self, data: bytes) -> None:
        """Write to the transport."""
        budget = self.budget - len(data)
        if budget < 0:
            self.over_budget(data)
        else:
            self.budget = budget
            self._write(data)

    def write_beyond_budget(self, data: bytes) -> None:
        """See :class:`TransportWriter`."""
        self._write(data)

    def flush(self) -> None:
        """Nothing: no data is held here."""


def writer_for(transport: Any, flushes: FlushScheduler) -> TransportWriter:
    """The writer for a connection. It writes to the socket itself only if nothing but Twisted's TCP does."""
    if type(transport) in (Server, Client) and not transport.TLS:
        return DirectSocketWriter(transport, flushes)
    return PassThroughWriter(transport)
