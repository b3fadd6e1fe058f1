"""Frames over a websocket (``/robots/<robot>/video/ws``, SPEC 1.8): a JSON header, then the image.

Handshake, closing and pings are those of every client's websocket.
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
from relay_server.common.clock import Clock, PeriodicTimer, PeriodicTimers
from relay_server.common.send_queue import SendQueue
from relay_server.http.limits import ConnectionLimits, RequestLimits
from relay_server.sessions.manager import Admission
from relay_server.sessions.message_age import MessageAge
from relay_server.sessions.ports import ClientTransport, Timing
from relay_server.video.frames import (
    CHECK_SECONDS,
    STALL_SECONDS,
    AckTracker,
    FrameQueue,
    RenderCache,
    VideoFrameInfo,
    limit_send_buffer,
)
from relay_server.video.parameters import StreamParameters, parse_parameters
from relay_server.video.viewer import CameraViewer, FrameSink, check_view
from relay_server.ws.connection import ClientConnection, ClientFactory
from relay_server.ws.handshake import HandshakeAuth, HandshakeSessions, WebSocketHandler, code_of

MAX_USELESS_MESSAGES = 100
"""Useless messages in a row after which a viewer is cut, since reading them costs the relay time."""


class FrameAcknowledged(Message, tag="frame_ack", frozen=True, kw_only=True):
    """The viewer has the frame of this number; send the next."""

    number: int


_decoder: msgspec.json.Decoder[FrameAcknowledged] = msgspec.json.Decoder(FrameAcknowledged)


class VideoSessions(HandshakeSessions, Protocol):
    """Opens viewers of cameras; see :class:`relay_server.sessions.manager.SessionManager`."""

    timing: Timing

    def watch(
        self, admission: Admission, camera: str, settings: link.VideoSettings, sink: FrameSink
    ) -> CameraViewer:
        """Show a camera to an authorised client. The admission is used up in any case."""


class VideoTransport(ClientTransport, Protocol):
    """The websocket of a viewer."""

    def cut(self, reason: str) -> None:
        """End the connection at once, and drop unsent bytes.

        :param reason: for the log
        """


def frame_message(frame: VideoFrameInfo) -> bytes:
    """Both messages of a frame as websocket frames. ``reduced`` is left to ``stream_status``."""
    head = {
        "op": "frame",
        "number": frame.number,
        "stamp": frame.stamp,
        "width": frame.width,
        "height": frame.height,
        "size": len(frame.body),
        "codec": frame.codec,
        "key": frame.key,
    }
    return websocket_frames.text(jsontext.encode(head)) + websocket_frames.binary(frame.body)


@functools.lru_cache(maxsize=64)
def status_message(playing: link.StreamStatus, instead: tuple[tuple[str, Any], ...] = ()) -> bytes:
    """The message ``stream_status``, rendered once for all viewers.

    :param instead: parameters that differ from the requested ones, with their values
    """
    message = {"op": "stream_status", **msgspec.structs.asdict(playing), "instead": dict(instead) or None}
    return websocket_frames.text(jsontext.encode(message))


class VideoClient:
    """One viewer's session.

    :param acks: of its connection
    :param opened_ns: when the handshake was answered, monotonic nanoseconds
    """

    def __init__(
        self,
        shared: VideoFactory,
        transport: VideoTransport,
        admission: Admission,
        parameters: StreamParameters,
        acks: AckTracker,
        opened_ns: int,
    ) -> None:
        self.send_queue = SendQueue(transport.send, shared.clock.seconds, self._overflow)
        self._shared = shared
        self._transport = transport
        self._acks = acks
        self._admission = admission
        self._parameters = parameters
        self._viewer: CameraViewer | None = None
        self._queue = FrameQueue(shared.clock.seconds, self._request_keyframe)
        self._in_flight: int | None = None
        """Number of the last frame that was sent and not acknowledged by the viewer."""
        self._differing: tuple[tuple[str, Any], ...] = ()
        self._last_seen = shared.clock.seconds()
        self._useless = 0
        self._ended = False
        self._freshness = MessageAge(shared.clock_ns, opened_ns, lambda: secrets.token_bytes(8))
        # A viewer sends no commands, whatever its rights, so the age of its messages does not matter.
        self._rounds = (
            PeriodicTimer(self._ping, shared.sessions.timing.client_ping),
            PeriodicTimer(self._check_stalled, CHECK_SECONDS),
        )

    # --- WebSocketHandler ----------------------------------------------------------------------------------

    @property
    def earliest_sent(self) -> int:
        return self._freshness.earliest_sent

    def start(self) -> None:
        try:
            self._viewer = self._shared.sessions.watch(
                self._admission, self._parameters.camera, self._parameters.settings, self
            )
        except SwitchboardError as error:
            self.close(code_of(error), str(error))
            return
        for each in self._rounds:
            self._shared.rounds.start(each)

    def message(self, payload: bytes, *, earliest_sent: int | None = None) -> None:
        """``frame_ack`` lets the next frame go."""
        try:
            number = jsontext.decode(_decoder, payload).number
        except MalformedMessage:
            number = None
        self._last_seen = self._shared.clock.seconds()
        if number is not None and number == self._in_flight:
            self._in_flight = None
            self._useless = 0
            self._send()
            return
        self._useless += 1
        if self._useless >= MAX_USELESS_MESSAGES:
            self.close(
                close_codes.TOO_MANY_ERRORS, "send nothing here but 'frame_ack' with the number of a frame"
            )

    def ping(self) -> None:
        self._ping()

    def pong(self, payload: bytes) -> None:
        self._last_seen = self._shared.clock.seconds()
        self._freshness.pong(payload)

    def pause(self) -> None:
        """The transport's buffer is full."""
        self.send_queue.pause()

    def resume(self) -> None:
        """The transport accepts bytes again."""
        self.send_queue.resume()
        self._send()

    def close(self, code: int, reason: str) -> None:
        if not self._ended:
            self._transport.close(code, reason)
            self.end()

    def end(self, *, orderly: bool = False) -> None:
        """The websocket is gone; release everything."""
        self._ended = True
        self.send_queue.close()
        for each in self._rounds:
            each.stop()
        viewer, self._viewer = self._viewer, None
        if viewer is not None:
            viewer.leave()

    # --- FrameSink -----------------------------------------------------------------------------------------

    def frame_received(self, frame: VideoFrameInfo) -> None:
        self._queue.put(frame)
        self._send()

    def status_changed(self, playing: link.StreamStatus) -> None:
        """Sent between frames; only the latest counts."""
        self.send_queue.send_droppable("stream_status", status_message(playing, self._differing), depth=1)

    def settings_differ(self, other: dict[str, Any]) -> None:
        """Sent with the next status, which always follows."""
        self._differing = tuple(other.items())

    def ended(self, error: SwitchboardError) -> None:
        if isinstance(error, Refused) and not self.send_queue.passing and not self._ended:
            # A revoked right ends the frame that is being sent too, and a close frame would have to wait
            # behind it.
            self._transport.cut(str(error))
            self.end()
        else:
            self.close(code_of(error), str(error))

    # --- sending -------------------------------------------------------------------------------------------

    def _send(self) -> None:
        if self._in_flight is not None or not self.send_queue.passing:
            return
        for frame in self._queue.take():
            self._in_flight = frame.number
            self.send_queue.write(self._shared.frames.rendered(frame))
            self._acks.sent()

    def _request_keyframe(self) -> None:
        if self._viewer is not None and self._parameters.settings.codec == "h264":
            self._viewer.request_keyframe()

    def _ping(self) -> None:
        """Keep the connection open, and check that the client is there. Answers wait behind a frame in
        flight."""
        timing = self._shared.sessions.timing
        silent = self._shared.clock.seconds() - self._last_seen
        if self._in_flight is None and silent > max(timing.client_ping * 3, timing.stall_limit):
            self.close(close_codes.TOO_SLOW, f"no answer to pings for {silent:.0f} s")
        else:
            self._transport.ping(self._freshness.ping())

    def _check_stalled(self) -> None:
        """A slow viewer may take long for a frame, as long as some of it arrives."""
        # A viewer may acknowledge frames that it has not read.
        waits = self._in_flight is not None or not self.send_queue.passing
        if self._acks.stalled_for() >= STALL_SECONDS and waits:
            self.close(
                close_codes.TOO_SLOW,
                f"nothing was accepted for {STALL_SECONDS:g} s, and no 'frame_ack' came",
            )

    def _overflow(self) -> None:
        self.close(close_codes.TOO_SLOW, "too much data waits for this client")


class VideoProtocol(ClientConnection):
    has_dialects = False
    is_stream = True
    message_limit = limits.UNAUTHENTICATED_BYTES
    factory: VideoFactory
    _parameters: StreamParameters
    _acks: AckTracker

    def connectionMade(self) -> None:
        """The site hands over a connection that asked to become a websocket."""
        self._acks = AckTracker(limit_send_buffer(self.transport), self.factory.clock.seconds)
        super().connectionMade()

    def _purpose_of(self, request: ConnectionRequest) -> TicketPurpose:
        # Autobahn's own parameters lack those without a value.
        self._parameters = parse_parameters(self.http_request_uri.partition("?")[2], "ws")
        path = request.path.removeprefix("/robots/").removesuffix("/video/ws")
        return TicketPurpose(unquote(path), video=True, camera=self._parameters.camera)

    async def _admit(self, principal: Principal) -> Admission:
        admission = await super()._admit(principal)
        try:
            check_view(admission.permit, self._parameters.camera, self._parameters.settings.transport)
        except SwitchboardError:
            self.factory.sessions.release(admission)
            raise
        return admission

    def cut(self, reason: str) -> None:
        self._drop(reason)

    def _pace(self, handler: WebSocketHandler) -> None:
        """One frame at a time is in flight, and the viewer acknowledges it itself."""

    def _open_handler(self, admission: Admission) -> VideoClient:
        return VideoClient(self.factory, self, admission, self._parameters, self._acks, self._opened_ns)


class VideoFactory(ClientFactory):
    """Builds a :class:`VideoProtocol` for each websocket.

    :param rounds: timers shared by all viewers
    """

    protocol = VideoProtocol
    sessions: VideoSessions

    def __init__(
        self,
        clock: Clock,
        clock_ns: Callable[[], int],
        auth: HandshakeAuth,
        sessions: VideoSessions,
        connection_limits: ConnectionLimits,
        rounds: PeriodicTimers,
        request_limits: RequestLimits,
    ) -> None:
        super().__init__(clock, clock_ns, auth, sessions, connection_limits, request_limits)
        self.rounds = rounds
        self.frames = RenderCache(frame_message)
