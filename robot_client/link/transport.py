"""The thin edge between a link and a Twisted connection: bytes, timers, backpressure, last words."""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.interfaces import IPushProducer
from twisted.internet.protocol import Protocol as TwistedProtocol
from twisted.internet.protocol import connectionDone
from twisted.internet.tcp import Client
from twisted.python.failure import Failure
from zope.interface import implementer

from relay_protocol.errors import PeerError, SwitchboardError
from relay_protocol.limits import KIB, UNPROVEN_SECONDS
from robot_client.link.protocol import NANO, Event, Link, LinkState
from robot_client.link.tls import explain
from robot_client.twisted_types import DelayedCall, ReactorClock

GOODBYE_SECONDS = 2.0
"""How long the last words may take to leave; a relay that takes nothing would hold the connection for ever."""

MOST_AT_ONCE = 64 * KIB
"""Bytes of samples written at a time."""

_SPACING = KIB
"""Bytes of samples between two probes, at least; else a quarter of the window."""

_UNSENT = 64 * KIB
"""Bytes the kernel may hold unsent; more would be delay nobody sees."""

_UNWRITTEN = 32 * KIB
"""Bytes written to TLS that make it pause: one part of a large sample fills it, and nothing small has to wait behind
a second one. A plain connection pauses with the first byte the socket does not take.
"""

_TCP_NOTSENT_LOWAT = getattr(socket, "TCP_NOTSENT_LOWAT", 25 if sys.platform == "linux" else None)
_TCP_USER_TIMEOUT = getattr(socket, "TCP_USER_TIMEOUT", None)

_UNKNOWN = frozenset((LinkState.GREETING, LinkState.PROVING, LinkState.ENROLLING, LinkState.JOINING))


class LinkOwner(Protocol):
    """Who is told what happens on a link."""

    def on_event(self, event: Event) -> None:
        """The relay said something."""

    def on_lost(self, reason: SwitchboardError) -> None:
        """The link is gone; called once."""

    def on_pause(self) -> None:
        """The transport is full."""

    def on_resume(self) -> None:
        """The transport has room."""


class LinkLost(SwitchboardError):
    """A link ended; the text says why."""


@implementer(IPushProducer)
class LinkProtocol(TwistedProtocol):
    """Carries one link.

    :param clock: for heartbeats and deadlines
    """

    transport: Any

    def __init__(
        self, link: Link, make_owner: Callable[[LinkProtocol], LinkOwner], clock: ReactorClock
    ) -> None:
        self.link = link
        self.owner = make_owner(self)
        self._clock = clock
        self._ping: DelayedCall | None = None
        self._deadline: DelayedCall | None = None
        self._socket: socket.socket | None = None
        self._heard = False
        self._patience: DelayedCall | None = None
        self._reason: SwitchboardError | None = None
        self._transport_full = self._window_full = False
        self._probed = 0
        """Bytes of samples sent when the latest probe was."""

    def connectionMade(self) -> None:
        """The connection stands."""
        self._socket = tune(self.transport, self.link.heartbeat * 3)
        self.transport.registerProducer(self, True)
        self._deadline = self._clock.callLater(UNPROVEN_SECONDS, self._too_slow)
        self.link.begin()
        self.flush()

    def dataReceived(self, data: bytes) -> None:
        """Bytes from the relay."""
        self._heard = True
        if self._over():
            return
        try:
            events = self.link.receive(data)
        except SwitchboardError as reason:
            self.end(reason)
            return
        if self._deadline is not None and self.link.state not in _UNKNOWN:
            self._deadline.cancel()
            self._deadline = None
            self._beat()
        for event in events:
            if self._over():
                return  # what came behind the end of the link must not be done any more
            self.owner.on_event(event)
        self.flush()
        self._look_at_window()

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        """The connection is gone."""
        for timer in (self._ping, self._deadline, self._patience):
            if timer is not None and timer.active():
                timer.cancel()
        lost = self._reason or self._as_ours(reason)
        self._reason = lost
        self.owner.on_lost(lost)

    def flush(self) -> None:
        """Write what the link has to say."""
        out = self.link.take()
        if out and self.transport is not None:
            self._put(b"".join(out))

    def write(self, frames: list[bytes]) -> None:
        """Write sample frames behind all that was said before."""
        size = sum(map(len, frames))
        if self.link.unsaid:
            frames = [*self.link.take(), *frames]
        self._put(b"".join(frames))
        window = self.link.window
        if window is None:
            return
        window.sent += size
        full = window.room(self._seconds()) <= 0
        if full or window.sent - self._probed >= max(_SPACING, window.size / 4):
            self._probe(full)
        if full and not self._window_full:
            self._window_full = True
            self.owner.on_pause()

    @property
    def room(self) -> int:
        """Bytes of samples that should be written now."""
        window = self.link.window
        return MOST_AT_ONCE if window is None else min(MOST_AT_ONCE, int(window.room(self._seconds())))

    def _probe(self, full: bool) -> None:
        """Ping, to learn when all samples before have arrived."""
        window = self.link.window
        assert window is not None
        self._probed = window.sent
        self.link.ping(full)
        self.flush()

    def _look_at_window(self) -> None:
        window = self.link.window
        if window is None or not self._window_full or self._over():
            return
        if window.room(self._seconds()) > 0:
            self._window_full = False
            if not self._transport_full:
                self.owner.on_resume()
        elif not window.probed:
            self._probe(True)

    def _seconds(self) -> float:
        return self.link.clock() / NANO

    def _put(self, data: bytes) -> None:
        """Write at once where that can be.

        Twisted keeps what is written until the reactor has found the socket writable: a turn and two calls to the
        kernel more for each sample. ``_tempDataLen`` (written, not yet joined) and ``dataBuffer`` (being sent) are all
        it keeps.
        """
        transport = self.transport
        if self._socket is None or transport.disconnecting:
            transport.write(data)
            return
        if not (transport._tempDataLen or transport.dataBuffer):
            try:
                sent = self._socket.send(data)
            except OSError:  # full, or broken: Twisted finds out which, and tells
                sent = 0
            if sent == len(data):
                return
            data = data[sent:]
        transport.write(data)
        if not transport.producerPaused:
            # Twisted would take some more first; what is small would wait behind it.
            transport.producerPaused = True
            self.pauseProducing()

    def end(self, reason: SwitchboardError, gently: bool = False) -> None:
        """Close the connection; ``gently`` lets what was written leave first."""
        if self._reason is not None:
            return
        self._reason = reason
        self.transport.unregisterProducer()
        if gently:
            self.flush()
            self.transport.loseConnection()
            self._patience = self._clock.callLater(GOODBYE_SECONDS, self.transport.abortConnection)
        else:
            self.transport.abortConnection()

    def _over(self) -> bool:
        return self._reason is not None

    def _as_ours(self, failure: Failure) -> SwitchboardError:
        if isinstance(failure.value, SwitchboardError):
            return failure.value
        silent = "" if self._heard else " before it said a word; is it a relay, with TLS as it is set here?"
        return LinkLost(explain(failure) + silent)

    def _beat(self) -> None:
        try:
            self.link.check_silence()
        except PeerError as reason:
            self.end(reason)
            return
        self.link.ping()
        self.flush()
        self._ping = self._clock.callLater(self.link.ping_every, self._beat)

    def ping_every(self, seconds: float) -> None:
        """Ping in this rhythm from now on."""
        self.link.ping_every = seconds
        if self._ping is not None and self._ping.active():
            self._ping.cancel()
            self._beat()

    def _too_slow(self) -> None:
        self._deadline = None
        self.end(LinkLost(f"the relay did not answer within {UNPROVEN_SECONDS:.0f} s"))

    def pauseProducing(self) -> None:
        """The transport is full."""
        self._transport_full = True
        self.owner.on_pause()

    def resumeProducing(self) -> None:
        """The transport has room."""
        self._transport_full = False
        if not self._window_full:
            self.owner.on_resume()

    def stopProducing(self) -> None:
        """The transport wants no more."""
        self.owner.on_pause()


def tune(transport: Any, patience: float) -> socket.socket | None:
    """Set what the kernel should do: no delay, no long silent retries, little data unsent.

    :param patience: seconds after which unacknowledged data means the connection is lost
    :return: the socket, if bytes may be put on it as they are
    """
    found = _tcp_of(transport)
    if found is None:
        return None
    connection, handle = found
    handle.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    handle.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in ((_TCP_USER_TIMEOUT, int(patience * 1000)), (_TCP_NOTSENT_LOWAT, _UNSENT)):
        if option is not None:
            handle.setsockopt(socket.IPPROTO_TCP, option, value)
    plain = connection is transport and type(transport) is Client and not transport.TLS
    if not plain:
        connection.bufferSize = _UNWRITTEN
    return handle if plain else None


def _tcp_of(transport: Any) -> tuple[Any, socket.socket] | None:
    """The TCP connection under a transport, through TLS, and its socket; ``None`` in memory."""
    while transport is not None:
        handle = getattr(transport, "getHandle", lambda: None)()
        if isinstance(handle, socket.socket):
            return transport, handle
        transport = getattr(transport, "transport", None)
    return None
