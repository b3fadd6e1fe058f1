"""Pictures over a websocket (``/robots/<robot>/video/ws``, SPEC section 1.8): a header in JSON, then the picture.

Who comes in, how it is closed and pinged is as for every client's websocket.
"""

from __future__ import annotations

import functools
import secrets
from collections.abc import Callable
from typing import Any, Protocol
from urllib.parse import unquote

import msgspec
from autobahn.websocket.types import ConnectionRequest

from relay_protocol import jsontext, limits, link
from relay_protocol.errors import MalformedMessage, Refused, SwitchboardError
from relay_protocol.message import Message
from relay_server.access import Principal
from relay_server.auth.authenticator import TicketPurpose
from relay_server.common import close_codes, websocket_frames
from relay_server.common.clock import Clock
from relay_server.common.send_queue import SendQueue
from relay_server.common.timers import PeriodicTimer, PeriodicTimers
from relay_server.http.connection_limits import ConnectionLimits
from relay_server.http.rate_limits import RequestLimits
from relay_server.sessions.manager import AuthorizedSession
from relay_server.sessions.message_age import MessageAge
from relay_server.sessions.ports import ClientTransport, Timing
from relay_server.video.frames import VideoFrameInfo
from relay_server.video.parameters import StreamParameters, parse_parameters
from relay_server.video.viewer import CameraViewer, FrameSink, check_view
from relay_server.video.viewing import (
    LOOK_SECONDS,
    STALL_SECONDS,
    AckTracker,
    FrameQueue,
    RenderCache,
    limit_send_buffer,
)
from relay_server.ws.client import ClientFactory, ClientProtocol
from relay_server.ws.handshake import HandshakeAuth, WebSocketSession, code_of

MISTAKES = 100
"""Messages in a row that open the way for no picture, before a viewer is cut: reading them costs the relay time."""


class FrameAcknowledged(Message, tag="took", frozen=True, kw_only=True):
    """Viewer: the picture of this number is here, send the next."""

    number: int


_decoder: msgspec.json.Decoder[FrameAcknowledged] = msgspec.json.Decoder(FrameAcknowledged)


class VideoGate(HandshakeAuth, Protocol):
    """Who may come in, and what he may watch; the composition root's."""

    timing: Timing

    def watch(
        self, admission: AuthorizedSession, camera: str, settings: link.VideoSettings, screen: FrameSink
    ) -> CameraViewer:
        """Have a camera shown to somebody who was admitted, which uses the admission up."""


class VideoTransport(ClientTransport, Protocol):
    """The websocket under a viewer."""

    def cut(self, reason: str) -> None:
        """End the connection at once; what was not taken yet goes no more.

        :param reason: for the log
        """


def framed(picture: VideoFrameInfo) -> bytes:
    """Both messages of a picture as websocket frames. What is reduced ``playing`` tells."""
    head = {
        "op": "picture",
        "number": picture.number,
        "stamp": picture.stamp,
        "width": picture.width,
        "height": picture.height,
        "size": len(picture.body),
        "codec": picture.codec,
        "key": picture.key,
    }
    return websocket_frames.text(jsontext.encode(head)) + websocket_frames.binary(picture.body)


@functools.lru_cache(maxsize=64)
def told(playing: link.Playing, instead: tuple[tuple[str, Any], ...] = ()) -> bytes:
    """The message that says what is sent from now on; made once for all who watch.

    :param instead: parameters by which what is shown differs from what was asked for, and what they are in it
    """
    message = {"op": "playing", **msgspec.structs.asdict(playing), "instead": dict(instead) or None}
    return websocket_frames.text(jsontext.encode(message))


class VideoClient:
    """What goes on over one viewer's websocket.

    :param progress: of its connection
    :param opened_ns: when its handshake was answered, monotonic nanoseconds
    """

    def __init__(
        self,
        shared: VideoFactory,
        transport: VideoTransport,
        admission: AuthorizedSession,
        wanted: StreamParameters,
        progress: AckTracker,
        opened_ns: int,
    ) -> None:
        self.outbox = SendQueue(transport.send, shared.clock.seconds, self._overflow)
        self._shared = shared
        self._transport = transport
        self._progress = progress
        self._admission = admission
        self._wanted = wanted
        self._watching: CameraViewer | None = None
        self._waiting = FrameQueue(shared.clock.seconds, self._start_anew)
        self._under_way: int | None = None
        """Number of the last picture that was sent and that the viewer has not taken."""
        self._instead: tuple[tuple[str, Any], ...] = ()
        self._heard_at = shared.clock.seconds()
        self._mistakes = 0
        self._ended = False
        self._freshness = MessageAge(shared.clock_ns, opened_ns, lambda: secrets.token_bytes(8))
        # A viewer commands nothing, whatever his rights: nobody wants to know how old what he says is.
        self._rounds = (
            PeriodicTimer(self._ping, shared.gate.timing.client_ping),
            PeriodicTimer(self._look, LOOK_SECONDS),
        )

    # --- Occupant -----------------------------------------------------------------------------------------

    @property
    def not_before(self) -> int:
        """By the pings."""
        return self._freshness.not_before

    def start(self) -> None:
        """Watch."""
        try:
            self._watching = self._shared.gate.watch(
                self._admission, self._wanted.camera, self._wanted.settings, self
            )
        except SwitchboardError as error:
            self.close(code_of(error), str(error))
            return
        for each in self._rounds:
            self._shared.rounds.start(each)

    def message(self, payload: bytes, *, since: int | None = None) -> None:
        """``took`` opens the way for the next picture."""
        try:
            number = jsontext.decode(_decoder, payload).number
        except MalformedMessage:
            number = None
        self._heard_at = self._shared.clock.seconds()
        if number is not None and number == self._under_way:
            self._under_way = None
            self._mistakes = 0
            self._send()
            return
        self._mistakes += 1
        if self._mistakes >= MISTAKES:
            self.close(
                close_codes.TOO_MANY_ERRORS, "say nothing here but 'took' with the number of a picture"
            )

    def ping(self) -> None:
        """Send a ping now."""
        self._ping()

    def pong(self, payload: bytes) -> None:
        """It is still there."""
        self._heard_at = self._shared.clock.seconds()
        self._freshness.pong(payload)

    def pause(self) -> None:
        """The transport's buffer is full."""
        self.outbox.pause()

    def resume(self) -> None:
        """The transport takes bytes again."""
        self.outbox.resume()
        self._send()

    def close(self, code: int, reason: str) -> None:
        """Close the websocket, and end."""
        if not self._ended:
            self._transport.close(code, reason)
            self.end()

    def end(self, *, orderly: bool = False) -> None:
        """The websocket is gone; give everything back."""
        self._ended = True
        self.outbox.close()
        for each in self._rounds:
            each.stop()
        watching, self._watching = self._watching, None
        if watching is not None:
            watching.leave()

    # --- Screen -------------------------------------------------------------------------------------------

    def picture(self, picture: VideoFrameInfo) -> None:
        """It goes now, or when the last has been taken."""
        self._waiting.put(picture)
        self._send()

    def playing(self, playing: link.Playing) -> None:
        """Told between pictures; the latest counts."""
        self.outbox.data("playing", told(playing, self._instead), depth=1)

    def instead(self, other: dict[str, Any]) -> None:
        """Told with what is played, which comes next."""
        self._instead = tuple(other.items())

    def ended(self, error: SwitchboardError) -> None:
        """There is nothing to see, or no more."""
        if isinstance(error, Refused) and not self.outbox.passing and not self._ended:
            # A right that is gone is gone for the rest of a picture too, and the code would come behind that.
            self._transport.cut(str(error))
            self.end()
        else:
            self.close(code_of(error), str(error))

    # --- what goes ----------------------------------------------------------------------------------------

    def _send(self) -> None:
        if self._under_way is not None or not self.outbox.passing:
            return
        for picture in self._waiting.take():
            self._under_way = picture.number
            self.outbox.write(self._shared.frames.of(picture))
            self._progress.sent()

    def _start_anew(self) -> None:
        if self._watching is not None and self._wanted.settings.codec == "h264":
            self._watching.start_anew()

    def _ping(self) -> None:
        """Keep the way open, and see whether somebody is there. A picture under way has answers wait behind it."""
        timing = self._shared.gate.timing
        silent = self._shared.clock.seconds() - self._heard_at
        if self._under_way is None and silent > max(timing.client_ping * 3, timing.stall_limit):
            self.close(close_codes.TOO_SLOW, f"no answer to pings for {silent:.0f} s")
        else:
            self._transport.ping(self._freshness.ping())

    def _look(self) -> None:
        """A slow viewer may take his time for a picture, as long as something of it arrives."""
        # He may say 'took' of what he has not read.
        waits = self._under_way is not None or not self.outbox.passing
        if self._progress.stands() >= STALL_SECONDS and waits:
            self.close(
                close_codes.TOO_SLOW,
                f"for {STALL_SECONDS:g} s nothing was taken, and no 'took' came",
            )

    def _overflow(self) -> None:
        self.close(close_codes.TOO_SLOW, "too much waits for you")


class VideoProtocol(ClientProtocol):
    """The websocket of one viewer."""

    is_stream = True
    takes = limits.UNPROVEN_BYTES
    factory: VideoFactory
    _wanted: StreamParameters
    _progress: AckTracker

    def connectionMade(self) -> None:
        """The site has handed over a connection that asked to become a websocket."""
        self._progress = AckTracker(limit_send_buffer(self.transport), self.factory.clock.seconds)
        super().connectionMade()

    def _asked_for(self, request: ConnectionRequest) -> TicketPurpose:
        # Autobahn's own look at the parameters leaves those without a value out.
        self._wanted = parse_parameters(self.http_request_uri.partition("?")[2], "ws")
        path = request.path.removeprefix("/robots/").removesuffix("/video/ws")
        return TicketPurpose(unquote(path), video=True, camera=self._wanted.camera)

    async def _admit(self, principal: Principal) -> AuthorizedSession:
        admission = await super()._admit(principal)
        try:
            check_view(admission.permit, self._wanted.camera, self._wanted.settings.transport)
        except SwitchboardError:
            self.factory.gate.turn_away(admission)
            raise
        return admission

    def cut(self, reason: str) -> None:
        """End the connection at once."""
        self._drop(reason)

    def _pace(self, session: WebSocketSession) -> None:
        """One picture at a time is on its way, and the viewer says itself when it is there."""

    def _occupant(self, admission: AuthorizedSession) -> VideoClient:
        return VideoClient(self.factory, self, admission, self._wanted, self._progress, self._opened_ns)


class VideoFactory(ClientFactory):
    """Builds a :class:`VideoProtocol` for each websocket.

    :param rounds: what is looked at now and then, of all viewers
    """

    protocol = VideoProtocol
    gate: VideoGate

    def __init__(
        self,
        clock: Clock,
        clock_ns: Callable[[], int],
        gate: VideoGate,
        cap: ConnectionLimits,
        rounds: PeriodicTimers,
        request_limits: RequestLimits,
    ) -> None:
        super().__init__(clock, clock_ns, gate, cap, request_limits)
        self.rounds = rounds
        self.frames = RenderCache(framed)
