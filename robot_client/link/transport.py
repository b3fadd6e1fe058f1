"""Connects a link to a Twisted transport: bytes, timers, backpressure, closing.

The owner of a link receives its events: :class:`~robot_client.link.control_connection.ControlConnection`, or
:class:`~robot_client.channel.channel.ChannelConnection` for a channel.
"""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.error import ConnectionDone, ConnectionLost
from twisted.internet.interfaces import IPushProducer
from twisted.internet.protocol import Protocol as TwistedProtocol
from twisted.internet.protocol import connectionDone
from twisted.internet.tcp import Client
from twisted.python.failure import Failure
from zope.interface import implementer

from relay_protocol.errors import PeerError, SwitchboardError
from relay_protocol.limits import KIB, UNAUTHENTICATED_SECONDS
from robot_client.link.links import NANO, Event, Link, LinkState
from robot_client.link.tls import explain
from robot_client.twisted_types import DelayedCall, ReactorClock

CLOSE_SECONDS = 2.0
"""Seconds in which the last messages must be sent: a relay that reads nothing would keep the connection open."""

MAX_WRITE = 64 * KIB
"""Most bytes of samples written at a time."""

_PROBE_SPACING = KIB
"""Least bytes of samples between two probes; a quarter of the window if that is more."""

_KERNEL_UNSENT = 64 * KIB
"""Most unsent bytes in the kernel, where they would be an unnoticed delay (``TCP_NOTSENT_LOWAT``)."""

_TLS_BUFFER = 32 * KIB
"""Buffered bytes at which a TLS connection pauses: one part of a large sample, so that small samples never
wait behind two. A plain connection pauses with the first byte that the socket does not accept.
"""

_TCP_NOTSENT_LOWAT = getattr(socket, "TCP_NOTSENT_LOWAT", 25 if sys.platform == "linux" else None)
_TCP_USER_TIMEOUT = getattr(socket, "TCP_USER_TIMEOUT", None)

_UNPROVEN = frozenset((LinkState.GREETING, LinkState.PROVING, LinkState.ENROLLING, LinkState.JOINING))


class LinkOwner(Protocol):
    """Receives the events of a link."""

    def on_event(self, event: Event) -> None:
        """The link decoded an event."""

    def on_lost(self, reason: SwitchboardError) -> None:
        """The link is lost; called once."""

    def on_pause(self) -> None:
        """The transport is full."""

    def on_resume(self) -> None:
        """The transport has room."""


class LinkLost(SwitchboardError):
    """A link ended; the text is the reason."""


@implementer(IPushProducer)
class LinkProtocol(TwistedProtocol):
    """The Twisted protocol of one link.

    :param build_owner: called once, with this protocol
    :param clock: for heartbeats and deadlines
    """

    transport: Any

    def __init__(
        self, link: Link, build_owner: Callable[[LinkProtocol], LinkOwner], clock: ReactorClock
    ) -> None:
        self.link = link
        self.owner = build_owner(self)
        self._clock = clock
        self._ping_timer: DelayedCall | None = None
        self._ping_due = 0.0
        self._deadline: DelayedCall | None = None
        self._socket: socket.socket | None = None
        self._received = False
        self._close_timer: DelayedCall | None = None
        self._reason: SwitchboardError | None = None
        self._transport_full = self._window_full = False
        self._probed_at = 0
        """Bytes of samples that were sent before the latest probe."""

    def connectionMade(self) -> None:
        self._socket = tune(self.transport, self.link.heartbeat * 3)
        self.transport.registerProducer(self, True)
        self._deadline = self._clock.callLater(UNAUTHENTICATED_SECONDS, self._handshake_timed_out)
        self.link.begin()
        self.flush()

    def dataReceived(self, data: bytes) -> None:
        if not self._received and data.startswith(b"HTTP/"):
            self.end(
                LinkLost("this is a port for browsers and clients; robots dial another one, 9091 by default")
            )
        self._received = True
        if self._has_ended():
            return
        try:
            events = self.link.receive(data)
        except SwitchboardError as reason:
            self.end(reason)
            return
        if self._deadline is not None and self.link.state not in _UNPROVEN:
            self._deadline.cancel()
            self._deadline = None
            self._ping_due = self._clock.seconds()
            self._send_heartbeat()
        for event in events:
            if self._has_ended():
                return  # messages after the end of the link must not be carried out
            self.owner.on_event(event)
        self.flush()
        self._check_window()

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        for timer in (self._ping_timer, self._deadline, self._close_timer):
            if timer is not None and timer.active():
                timer.cancel()
        lost = self._reason or self._link_error(reason)
        self._reason = lost
        self.link.discard()
        self.owner.on_lost(lost)

    def flush(self) -> None:
        """Write the messages that the link has queued."""
        out = self.link.take()
        if out and self.transport is not None:
            self._write_directly(b"".join(out))

    def write(self, frames: list[bytes]) -> None:
        """Write sample frames after all queued messages."""
        size = sum(map(len, frames))
        if self.link.unsent:
            frames = [*self.link.take(), *frames]
        self._write_directly(b"".join(frames))
        window = self.link.window
        if window is None:
            return
        window.sent += size
        full = window.room(self._seconds()) <= 0
        if full or window.sent - self._probed_at >= max(_PROBE_SPACING, window.size / 4):
            self._probe(full)
        if full and not self._window_full:
            self._window_full = True
            self.owner.on_pause()

    @property
    def room(self) -> int:
        """Bytes of samples that may be written now."""
        window = self.link.window
        return MAX_WRITE if window is None else min(MAX_WRITE, int(window.room(self._seconds())))

    def _probe(self, full: bool) -> None:
        """Send a ping; its answer shows that all samples before it have arrived."""
        window = self.link.window
        assert window is not None
        self._probed_at = window.sent
        self.link.ping(full)
        self.flush()

    def _check_window(self) -> None:
        window = self.link.window
        if window is None or not self._window_full or self._has_ended():
            return
        if window.room(self._seconds()) > 0:
            self._window_full = False
            if not self._transport_full:
                self.owner.on_resume()
        elif not window.probed:
            self._probe(True)

    def _seconds(self) -> float:
        return self.link.clock() / NANO

    def _write_directly(self, data: bytes) -> None:
        """Write directly to the socket if possible.

        Twisted buffers until the reactor finds the socket writable, which costs one turn and two system
        calls more for each sample. Its buffers are ``_tempDataLen`` (written, not joined yet) and
        ``dataBuffer`` (being sent).
        """
        transport = self.transport
        if self._socket is None or transport.disconnecting:
            transport.write(data)
            return
        if not (transport._tempDataLen or transport.dataBuffer):
            try:
                sent = self._socket.send(data)
            except OSError:  # full or broken: Twisted finds out which and reports it
                sent = 0
            if sent == len(data):
                return
            data = data[sent:]
        transport.write(data)
        if not transport.producerPaused:
            # Twisted would accept more before it pauses, and small samples would wait behind that.
            transport.producerPaused = True
            self.pauseProducing()

    def end(self, reason: SwitchboardError, gently: bool = False) -> None:
        """Close the connection.

        :param gently: whether written bytes are sent first
        """
        if self._reason is not None:
            return
        self._reason = reason
        self.transport.unregisterProducer()
        if gently:
            self.flush()
            self.transport.loseConnection()
            self._close_timer = self._clock.callLater(CLOSE_SECONDS, self.transport.abortConnection)
        else:
            self.transport.abortConnection()

    def _has_ended(self) -> bool:
        return self._reason is not None

    def _link_error(self, failure: Failure) -> SwitchboardError:
        if isinstance(failure.value, SwitchboardError):
            return failure.value
        reason = explain(failure)
        if not self._received and failure.check(ConnectionDone, ConnectionLost):
            reason += " before it sent anything; check that the address is a relay's, and TLS as on the relay"
        return LinkLost(reason)

    def _send_heartbeat(self) -> None:
        now = self._clock.seconds()
        # If this process was busy or stopped, what the relay has sent meanwhile is not read yet.
        if now - self._ping_due < self.link.heartbeat:
            try:
                self.link.check_silence()
            except PeerError as reason:
                self.end(reason)
                return
        self.link.ping()
        self.flush()
        self._ping_due = now + self.link.ping_every
        self._ping_timer = self._clock.callLater(self.link.ping_every, self._send_heartbeat)

    def ping_every(self, seconds: float) -> None:
        """Change the interval between pings."""
        self.link.ping_every = seconds
        if self._ping_timer is not None and self._ping_timer.active():
            self._ping_timer.cancel()
            self._send_heartbeat()

    def _handshake_timed_out(self) -> None:
        self._deadline = None
        self.end(LinkLost(f"the relay did not answer within {UNAUTHENTICATED_SECONDS:.0f} s"))

    def pauseProducing(self) -> None:
        self._transport_full = True
        self.owner.on_pause()

    def resumeProducing(self) -> None:
        self._transport_full = False
        if not self._window_full:
            self.owner.on_resume()

    def stopProducing(self) -> None:
        self.owner.on_pause()


def tune(transport: Any, timeout: float) -> socket.socket | None:
    """Set socket options: no Nagle delay, a bound for unacknowledged data, little unsent data.

    :param timeout: seconds after which unacknowledged data means that the connection is lost
    :return: the socket if bytes may be written to it directly (no TLS), else ``None``
    """
    found = _tcp_of(transport)
    if found is None:
        return None
    connection, handle = found
    handle.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    handle.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in ((_TCP_USER_TIMEOUT, int(timeout * 1000)), (_TCP_NOTSENT_LOWAT, _KERNEL_UNSENT)):
        if option is not None:
            handle.setsockopt(socket.IPPROTO_TCP, option, value)
    plain = connection is transport and type(transport) is Client and not transport.TLS
    if not plain:
        connection.bufferSize = _TLS_BUFFER
    return handle if plain else None


def _tcp_of(transport: Any) -> tuple[Any, socket.socket] | None:
    """The TCP connection below a transport, through TLS, and its socket; ``None`` for transports in
    memory."""
    while transport is not None:
        handle = getattr(transport, "getHandle", lambda: None)()
        if isinstance(handle, socket.socket):
            return transport, handle
        transport = getattr(transport, "transport", None)
    return None
