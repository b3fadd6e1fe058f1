"""Updates of a page over a websocket, and its stops of many robots (``/api/v1/robots/stream``, SPEC 1.7).

Browsers allow six HTTP/1.1 connections to a host, for all tabs together, and a stream of server-sent events keeps one
of them. They allow hundreds of websockets. Authentication and closing are as for every client's websocket.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from autobahn.websocket.types import ConnectionRequest
from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger

from relay_protocol.errors import SwitchboardError
from relay_server.access import BadCredentials, Principal
from relay_server.auth.authenticator import TicketPurpose, session_token
from relay_server.auth.origins import Origins
from relay_server.common import close_codes, websocket_frames
from relay_server.common.clock import Clock, PeriodicTimer, PeriodicTimers
from relay_server.common.send_queue import SendQueue
from relay_server.http.live_updates import STALL_SECONDS, LiveUpdates, Sources
from relay_server.sessions.ports import ClientTransport, Timing
from relay_server.ws.connection import ClientConnection, ClientFactory
from relay_server.ws.handshake import code_of

MESSAGE_BYTES = 4096
"""Largest message that is read. A page sends only orders to stop."""

STOPS = 8
"""Orders to stop of one page at a time."""


class UpdatesTokens(Protocol):
    """Looks up access tokens; see :class:`relay_server.auth.service.AuthService`."""

    async def token(self, token: str) -> Principal:
        """The principal of a token."""


class PageStops(Protocol):
    """Stops many robots; see :class:`relay_server.fleet.websocket_stops.WebsocketStops`."""

    async def carry_out(
        self, principal: Principal, payload: bytes, address: str, send: Callable[[bytes], None]
    ) -> None:
        """Carry out one order, and send the lines of its answer."""


class PageAdmission(NamedTuple):
    """Who opens a page, and where."""

    principal: TokenPrincipal
    address: str


@dataclass(frozen=True)
class TokenPrincipal(Principal):
    """A principal with the token that proved it; the token is checked again and again."""

    token: str = field(default="", repr=False)


class UpdatesAuth:
    """Authenticates users, and opens updates for each.

    A :class:`relay_server.ws.handshake.HandshakeAuth` and a :class:`relay_server.ws.handshake.HandshakeSessions`.

    :param cookie: name of the session cookie
    """

    def __init__(
        self,
        clock: Clock,
        tokens: UpdatesTokens,
        timing: Timing,
        origins: Origins,
        cookie: str,
        sources: Sources,
        stops: PageStops,
    ) -> None:
        self.accepting = True
        self.clock = clock
        self.tokens = tokens
        self.timing = timing
        self.sources = sources
        self.stops = stops
        self.rounds = PeriodicTimers(clock)
        self._origins = origins
        self._cookie = cookie
        self._open: set[UpdatesClient] = set()

    async def bearer(self, token: str) -> Principal:
        """The principal of an access token."""
        return TokenPrincipal(**vars(await self.tokens.token(token)), token=token)

    async def ticket(self, ticket: str, purpose: TicketPurpose) -> Principal:
        """Refuse: a ticket is for one robot."""
        raise BadCredentials("a ticket is for one robot, and updates are about all; send an access token")

    async def url_token(self, token: str, address: str) -> Principal:
        """Refuse: a token in a URL is for one robot."""
        raise BadCredentials(
            "a token in a URL is for one robot, and updates are about all; send an access token"
        )

    async def cookie(self, header: str, origin: str | None, host: str) -> Principal | None:
        """The principal of a session cookie; ``None``: there is no such cookie."""
        token = session_token(self._origins, self._cookie, header, origin, host)
        return None if token is None else await self.bearer(token)

    async def admit(self, principal: Principal, robot: str, address: str) -> Any:
        """Every user may follow their robots, even without any. :meth:`open` takes the result."""
        assert isinstance(principal, TokenPrincipal)
        return PageAdmission(principal, address)

    def open(self, admission: Any, transport: ClientTransport, opened_ns: int) -> UpdatesClient:
        """Begin to send updates to an authorized principal."""
        client = UpdatesClient(self, transport, admission, self._open.discard)
        self._open.add(client)
        return client

    def release(self, admission: Any) -> None:
        """Nothing to release."""

    def shutdown(self, reason: str) -> None:
        """The relay shuts down: refuse new clients, and close what is open."""
        self.accepting = False
        self.close_all(reason)

    def close_all(self, reason: str) -> None:
        """Close the websockets of all pages, which may connect again."""
        for client in list(self._open):
            client.close(close_codes.GOING_AWAY, reason)


class UpdatesClient:
    """The websocket of one page.

    :param admission: its user
    :param ended: called when the websocket is closed
    """

    log = Logger()
    earliest_sent = 0
    """A page sends no commands, so the age of its messages does not matter."""

    def __init__(
        self,
        auth: UpdatesAuth,
        transport: ClientTransport,
        admission: PageAdmission,
        ended: Callable[[UpdatesClient], None],
    ) -> None:
        self.send_queue = SendQueue(transport.send, auth.clock.seconds, self.cut)
        self.send_queue.on_window_full = self._window_full
        self._clock = auth.clock
        self._rounds = auth.rounds
        self._timing = auth.timing
        self._transport = transport
        self._ended = ended
        self._admission = admission
        token = admission.principal.token
        self._updates = LiveUpdates(auth.clock, self, lambda: auth.tokens.token(token), auth.sources)
        self._stops = auth.stops
        self._stopping = 0
        self._running: Deferred[None] | None = None
        self._pinging = PeriodicTimer(self._ping, self._timing.client_ping)
        self._last_pong = auth.clock.seconds()
        self._pings = 0

    # --- WebSocketHandler ---------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to send updates."""
        self._rounds.start(self._pinging)
        self._running = Deferred.fromCoroutine(self._updates.run())
        self._running.addErrback(self._over)

    def message(self, payload: bytes, *, earliest_sent: int | None = None) -> None:
        """Carry out an order to stop; it continues when the websocket is closed."""
        if self._stopping == STOPS:
            self.close(close_codes.TOO_MANY_ERRORS, f"at most {STOPS} orders to stop at a time")
            return
        self._stopping += 1
        stopping = Deferred.fromCoroutine(self._stop(payload))
        stopping.addErrback(self._over)

    async def _stop(self, payload: bytes) -> None:
        principal, address = self._admission
        try:
            await self._stops.carry_out(principal, payload, address, lambda line: self.send("order", line))
        finally:
            self._stopping -= 1

    def ping(self) -> None:
        """Send a ping now."""
        self._ping()

    def pong(self, payload: bytes) -> None:
        """The page is still connected."""
        self._last_pong = self._clock.seconds()

    def pause(self) -> None:
        """The transport's buffer is full."""
        self.send_queue.pause()
        if self._running is not None:
            self._updates.pause()

    def resume(self) -> None:
        """The transport takes bytes again."""
        self.send_queue.resume()
        if self._running is not None:
            self._updates.resume()

    def close(self, code: int, reason: str) -> None:
        """Close the websocket and end the updates."""
        self._transport.close(code, reason)
        self.end()

    def end(self, *, orderly: bool = False) -> None:
        """End the updates; the websocket is closed or closing."""
        self._pinging.stop()
        self.send_queue.close()
        self._ended(self)
        running, self._running = self._running, None
        if running is not None:
            running.cancel()

    def _window_full(self, full: bool) -> None:
        """Hold updates back while the send queue is full; then send the state of that moment."""
        if self._running is None:
            return
        if full:
            self._updates.wait()
        else:
            self._updates.resume()

    # --- UpdateSink ---------------------------------------------------------------------------------------

    def send(self, event: str, body: bytes) -> None:
        """Send one event."""
        head = b'{"event":"' + event.encode() + b'","data":'
        self.send_queue.send_reliable(websocket_frames.text_of(head, body, b"}"))

    def made_progress(self) -> bool:
        """Always false: few bytes are in flight, so a page that reads is never paused for long."""
        return False

    def cut(self) -> None:
        """Close: the page accepts no more bytes."""
        self.close(close_codes.TOO_SLOW, f"nothing was accepted for {STALL_SECONDS:g} s")

    def _over(self, failure: Any) -> None:
        error = failure.value
        if isinstance(error, SwitchboardError):
            self.close(code_of(error), str(error))
        elif not isinstance(error, CancelledError):
            self.log.failure("serving a page failed", failure)
            self.close(close_codes.INTERNAL, "the relay failed; see its log")

    def _ping(self) -> None:
        """Send a ping, or close when the page has not answered for too long."""
        silent = self._clock.seconds() - self._last_pong
        if silent > max(self._timing.client_ping * 3, self._timing.stall_limit):
            self.close(close_codes.TOO_SLOW, f"no answer to pings for {silent:.0f} s")
        else:
            self._pings += 1
            self._transport.ping(self._pings.to_bytes(8, "big"))


class UpdatesProtocol(ClientConnection):
    """The websocket of one page."""

    message_limit = MESSAGE_BYTES
    has_dialects = False
    is_stream = True

    def _purpose_of(self, request: ConnectionRequest) -> TicketPurpose:
        # The empty name stands for all robots: no robot has it.
        return TicketPurpose("")


class UpdatesFactory(ClientFactory):
    """Builds an :class:`UpdatesProtocol` for each websocket; its auth and its sessions are one :class:`UpdatesAuth`."""

    protocol = UpdatesProtocol
    takes_forwarded = False
