"""Writing without delay and without waste: at once when nothing waits, else joined, once a turn of the reactor.

Twisted keeps what is written until the socket is reported writable: one more turn, and two calls to the kernel to
ask for the report and to take that back. Here a message goes to the socket directly. What follows closely is joined
and goes at the end of the turn: a flood costs one call to the kernel, not one a message. What the socket does not take
goes into Twisted's own buffer, which pauses the producer as ever.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

from twisted.internet.tcp import Server

from relay_server.clock import Clock

APART_SECONDS = 0.0005
"""Messages that come so far apart are sent one by one. To ask the reactor where a turn begins would cost more."""

JOINED_BYTES = 32 * 1024
"""So much is not held until the end of the turn: the socket takes it now, or Twisted has to know that it is full."""


class Turns:
    """Flushes writers when a turn of the reactor is over. One for all writers of a listening port.

    :param clock: the reactor, or one in a test
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.seconds = clock.seconds
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


class Writer(Protocol):
    """In front of a transport. All that goes over the transport must go through it, or order is lost."""

    def write(self, data: bytes) -> None:
        """Send, now or at the end of the turn."""

    def flush(self) -> None:
        """Send what is held. Call before the transport is told to close."""


class SocketWriter:
    """In front of a plain TCP connection."""

    __slots__ = ("_behind", "_held", "_held_bytes", "_seconds", "_sent_at", "_socket", "_transport", "_turns")

    def __init__(self, transport: Any, turns: Turns) -> None:
        self._transport = transport
        self._socket = transport.getHandle()
        self._turns = turns
        self._seconds = turns.seconds
        self._behind = True
        """Whether Twisted may have bytes of this connection: whoever had it before may have left some."""
        self._sent_at = -math.inf
        self._held: list[bytes] = []
        self._held_bytes = 0

    def write(self, data: bytes) -> None:
        """At once if nothing was sent just before, else at the end of the turn."""
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

    __slots__ = ("write",)

    def __init__(self, transport: Any) -> None:
        self.write = transport.write

    def flush(self) -> None:
        """Nothing is held."""


def writer_for(transport: Any, turns: Turns) -> Writer:
    """The writer for a connection; bytes may be put on its socket only when nothing else writes there."""
    if type(transport) is Server and not transport.TLS:
        return SocketWriter(transport, turns)
    return PlainWriter(transport)
