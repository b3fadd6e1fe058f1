"""The page's stream over a websocket (``/api/v1/robots/stream``, SPEC section 1.7).

Browsers allow six connections to a host over HTTP/1.1, of all tabs together, and a stream of server-sent events holds
one for ever; of websockets they allow hundreds. Who comes in, and how it is closed, is as for every client's websocket.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from autobahn.websocket.types import ConnectionRequest
from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger

from relay_protocol.errors import SwitchboardError
from relay_server.access import BadCredentials, Principal
from relay_server.auth.authenticator import TicketPurpose, session_token
from relay_server.auth.origins import Origins
from relay_server.common import close_codes, websocket_frames
from relay_server.common.clock import Clock
from relay_server.common.send_queue import SendQueue
from relay_server.common.timers import PeriodicTimer, PeriodicTimers
from relay_server.http.live_updates import STALL_SECONDS, LiveUpdates
from relay_server.http.update_sources import Sources
from relay_server.sessions.ports import ClientTransport, Timing
from relay_server.ws.client import ClientFactory, ClientProtocol
from relay_server.ws.handshake import code_of

MESSAGE_BYTES = 125
"""A page has nothing to say: what is larger is not even read."""


class UpdatesServices(Protocol):
    """What is asked for; the composition root's."""

    timing: Timing

    async def token(self, token: str) -> Principal:
        """The principal of a token."""


@dataclass(frozen=True)
class TokenPrincipal(Principal):
    """Somebody, with the token that proved it: it is asked again and again whether that still counts."""

    token: str = field(default="", repr=False)


class UpdatesGate:
    """Who may come in: whoever proves who he is. A :class:`relay_server.ws.handshake.HandshakeAuth`.

    :param cookie: name of the session cookie
    """

    def __init__(
        self, clock: Clock, desk: UpdatesServices, origins: Origins, cookie: str, sources: Sources
    ) -> None:
        self.accepting = True
        self.clock = clock
        self.desk = desk
        self.sources = sources
        self.rounds = PeriodicTimers(clock)
        self._origins = origins
        self._cookie = cookie
        self._open: set[UpdatesClient] = set()

    async def bearer(self, token: str) -> Principal:
        """The principal of an access token."""
        return TokenPrincipal(**vars(await self.desk.token(token)), token=token)

    async def ticket(self, ticket: str, asked: TicketPurpose) -> Principal:
        """A ticket opens something of one robot."""
        raise BadCredentials("a ticket opens a robot, and this is about all of them; send an access token")

    async def cookie(self, header: str, origin: str | None, host: str) -> Principal | None:
        """The principal of a session cookie, ``None`` when there is no such cookie."""
        token = session_token(self._origins, self._cookie, header, origin, host)
        return None if token is None else await self.bearer(token)

    async def admit(self, principal: Principal, robot: str, address: str) -> Any:
        """Everybody may be told of his robots, though he has none. What this returns is for :meth:`open`."""
        return principal

    def open(self, admission: Any, transport: ClientTransport, opened_ns: int) -> UpdatesClient:
        """Begin to tell somebody who was admitted."""
        client = UpdatesClient(self, transport, admission.token, self._open.discard)
        self._open.add(client)
        return client

    def turn_away(self, admission: Any) -> None:
        """Nothing was taken for him."""

    def say_goodbye(self, reason: str) -> None:
        """Refuse newcomers and close what is open: the relay is going down."""
        self.accepting = False
        for client in list(self._open):
            client.close(close_codes.GOING_AWAY, reason)


class UpdatesClient:
    """What goes on over one page's websocket.

    :param token: whose page it is
    :param ended: told when this is over
    """

    log = Logger()
    not_before = 0
    """A page commands nothing."""

    def __init__(
        self,
        gate: UpdatesGate,
        transport: ClientTransport,
        token: str,
        ended: Callable[[UpdatesClient], None],
    ) -> None:
        desk = gate.desk
        self.outbox = SendQueue(transport.send, gate.clock.seconds, self.cut)
        self.outbox.on_hold = self._held
        self._clock = gate.clock
        self._rounds = gate.rounds
        self._timing = desk.timing
        self._transport = transport
        self._ended = ended
        self._telling = LiveUpdates(gate.clock, self, lambda: desk.token(token), gate.sources)
        self._running: Deferred[None] | None = None
        self._pinging = PeriodicTimer(self._ping, self._timing.client_ping)
        self._heard_at = gate.clock.seconds()
        self._pings = 0

    # --- Occupant -----------------------------------------------------------------------------------------

    def start(self) -> None:
        """Tell, from now on."""
        self._rounds.start(self._pinging)
        self._running = Deferred.fromCoroutine(self._telling.run())
        self._running.addErrback(self._over)

    def message(self, payload: bytes, *, since: int | None = None) -> None:
        """There is nothing to say here."""
        self.close(close_codes.INVALID, "say nothing here: what there is to tell is told unasked")

    def ping(self) -> None:
        """Send a ping now."""
        self._ping()

    def pong(self, payload: bytes) -> None:
        """It is still there."""
        self._heard_at = self._clock.seconds()

    def pause(self) -> None:
        """The transport's buffer is full."""
        self.outbox.pause()
        if self._running is not None:
            self._telling.pause()

    def resume(self) -> None:
        """The transport takes bytes again."""
        self.outbox.resume()
        if self._running is not None:
            self._telling.resume()

    def close(self, code: int, reason: str) -> None:
        """Close the websocket, and end."""
        self._transport.close(code, reason)
        self.end()

    def end(self, *, orderly: bool = False) -> None:
        """The websocket is gone, or goes."""
        self._pinging.stop()
        self.outbox.close()
        self._ended(self)
        running, self._running = self._running, None
        if running is not None:
            running.cancel()

    def _held(self, held: bool) -> None:
        """The connection is thin: what changes meanwhile is told as it is when there is room again."""
        if self._running is None:
            return
        if held:
            self._telling.wait()
        else:
            self._telling.resume()

    # --- Page ---------------------------------------------------------------------------------------------

    def tell(self, event: str, body: bytes) -> None:
        """One event."""
        head = b'{"event":"' + event.encode() + b'","data":'
        self.outbox.control(websocket_frames.text_of(head, body, b"}"))

    def moves(self) -> bool:
        """A page that takes something is never paused for long: little is on its way to it."""
        return False

    def cut(self) -> None:
        """It takes nothing any more."""
        self.close(close_codes.TOO_SLOW, f"for {STALL_SECONDS:g} s nothing was taken")

    def _over(self, failure: Any) -> None:
        error = failure.value
        if isinstance(error, SwitchboardError):
            self.close(code_of(error), str(error))
        elif not isinstance(error, CancelledError):
            self.log.failure("a page can't be told any more", failure)
            self.close(close_codes.INTERNAL, "the relay failed; its log tells more")

    def _ping(self) -> None:
        """Keep the way open, and see whether somebody is there."""
        silent = self._clock.seconds() - self._heard_at
        if silent > max(self._timing.client_ping * 3, self._timing.stall_limit):
            self.close(close_codes.TOO_SLOW, f"no answer to pings for {silent:.0f} s")
        else:
            self._pings += 1
            self._transport.ping(self._pings.to_bytes(8, "big"))


class UpdatesProtocol(ClientProtocol):
    """The websocket of one page."""

    takes = MESSAGE_BYTES
    is_stream = True

    def _asked_for(self, request: ConnectionRequest) -> TicketPurpose:
        # All robots: there is none of this name.
        return TicketPurpose("")


class UpdatesFactory(ClientFactory):
    """Builds a :class:`UpdatesProtocol` for each websocket; its gate is a :class:`UpdatesGate`."""

    protocol = UpdatesProtocol
