"""One camera stream: encodes the newest frame when the uplink can carry it, and sends it over its own
link."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from msgspec.structs import replace
from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import limits, link
from relay_protocol.errors import SwitchboardError, Unavailable
from robot_client.camera.frame import Encoded, EncodeRequest, Frame
from robot_client.camera.images import DamagedImage
from robot_client.camera.ipc import OpenStream
from robot_client.camera.packetizer import Packetizer
from robot_client.camera.rate_control import TARGET, RateControl, RttProbe
from robot_client.link.links import Event, JoinedChannel, LinkEnded, MessageReceived
from robot_client.link.transport import LinkLost, LinkProtocol
from robot_client.twisted_types import DelayedCall, ReactorClock

MAX_FAULTS = 10
"""Damaged frames in a row after which a stream that has shown none is refused. A stream that has shown a
frame survives any number of them. Only an H.264 encoder that fails so often is refused, because another
codec may work."""

DAMAGED_SECONDS = 5.0
"""Seconds after a damaged first frame in which a good one must arrive. The refusal, with its reason, then
comes before the relay reports that it received nothing."""

REPORT_INTERVAL = 1.0
"""Least seconds between two ``stream_status`` messages that differ only in measured values."""


class StreamLimitReached(Unavailable):
    """The robot encodes as many streams as it is set to."""


class CameraViewPort(Protocol):
    """One stream's view of a camera."""

    @property
    def fps(self) -> float:
        """Recent frames per second."""

    @property
    def latched(self) -> bool:
        """Whether the publisher keeps the latest frame for late joiners."""

    def encode(self, frame: Frame, request: EncodeRequest) -> Deferred[Encoded]:
        """Encode a frame in a thread; one at a time."""

    def latest(self) -> Frame | None:
        """The newest frame so far if it is still current."""

    def close(self) -> None:
        """End the view."""


OpenView = Callable[[OpenStream, Callable[[Frame], None]], CameraViewPort]
"""Opens a view of a camera; raises a :class:`SwitchboardError` if that is not possible."""


class EncodedStream:
    """Streams one camera over one link.

    :param request: of the daemon
    :param protocol: the connection
    :param on_closed: called once when the link is closed, with the reason
    :param rtt_probe: shared by all streams to this relay
    :param target: longest delay that rate control aims for, seconds
    """

    def __init__(
        self,
        request: OpenStream,
        protocol: LinkProtocol,
        open_view: OpenView,
        clock: ReactorClock,
        on_closed: Callable[[EncodedStream, str], None],
        rtt_probe: RttProbe,
        target: float = TARGET,
    ) -> None:
        self.request = request
        self.rate_control = RateControl(request.settings, rtt_probe, target)
        self._protocol = protocol
        self._packetizer = Packetizer(self.rate_control, protocol.write)
        self._open_view = open_view
        self._clock = clock
        self._on_closed = on_closed
        self._view: CameraViewPort | None = None
        self._newest: Frame | None = None
        self._encoding = False
        self._key = True
        """Whether the next frame must be a key frame."""
        self._needs_key = False
        """Whether the relay lacks a frame, so that it can't use H.264 frames before the next key frame."""
        self._number = 0
        self._faults = 0
        self._damaged = 0
        """Frames that could not be encoded."""
        self._fault: tuple[float, str] | None = None
        """Since when frames can't be encoded, after some were, and why."""
        self._first_damaged: tuple[float, str] | None = None
        """When the first damaged frame arrived, before any good one, and what is wrong with it."""
        self._reported: link.StreamStatus | None = None
        self._reported_at = 0.0
        self._wait_timer: DelayedCall | None = None
        self._check_timer: DelayedCall | None = None
        self._log = Logger("camera")

    # --- the link ------------------------------------------------------------------------------------------

    def on_event(self, event: Event) -> None:
        """Handle an event of the link."""
        if isinstance(event, JoinedChannel):
            self._joined(event.channel)
        elif isinstance(event, MessageReceived) and isinstance(event.message, link.FrameAck):
            self._acknowledged(event.message)
        elif isinstance(event, MessageReceived):
            self._key = True
            self._repeat_latched()
            self._encode_next()
        elif isinstance(event, LinkEnded):
            self._protocol.end(LinkLost(f"the relay closed the stream: {event.reason}"), gently=True)

    def on_lost(self, reason: SwitchboardError) -> None:
        """The connection is closed."""
        self._stop()
        self._on_closed(self, str(reason))

    def on_pause(self) -> None:
        """Nothing to do: unacknowledged bytes are limited more strictly than the transport does."""

    def on_resume(self) -> None:
        """Nothing to do, see :meth:`on_pause`."""

    def close(self, reason: str) -> None:
        """End the stream."""
        self._stop()
        self._send(link.Bye(reason=reason))
        self._protocol.end(LinkLost(reason), gently=True)

    def refuse(self, reason: str, busy: bool = False) -> None:
        """Report that the camera can't be shown, and end the stream.

        :param busy: whether it could be shown if there were fewer streams
        """
        self._stop()
        self._send(link.StreamRefused(reason=reason, busy=busy))
        self._protocol.end(LinkLost(reason), gently=True)

    def _joined(self, name: str) -> None:
        if name != self.request.stream:
            self._protocol.end(
                LinkLost(f"the relay joined this link to '{name}' instead of '{self.request.stream}'")
            )
            return
        try:
            self._view = self._open_view(self.request, self._on_frame)
        except SwitchboardError as error:
            self.refuse(str(error), busy=isinstance(error, StreamLimitReached))
            return
        self._check_timer = self._clock.callLater(REPORT_INTERVAL, self._check)
        latest = self._view.latest()
        if latest is not None:
            self._on_frame(latest.as_new(self._clock.seconds()))

    def _repeat_latched(self) -> None:
        """Encode a latched frame again: no other one may follow."""
        latched = self._view.latest() if self._view is not None and self._view.latched else None
        if latched is not None and self._newest is None:
            self._newest = latched.as_new(self._clock.seconds())

    def _send(self, message: link.Message) -> None:
        self._protocol.link.send(message)
        self._protocol.flush()

    def _stop(self) -> None:
        view, self._view = self._view, None
        if view is not None:
            view.close()
        if self._wait_timer is not None:
            self._wait_timer.cancel()
            self._wait_timer = None
        if self._check_timer is not None:
            self._check_timer.cancel()
            self._check_timer = None
        self._newest = None
        self.rate_control.close(self._clock.seconds())

    # --- frames --------------------------------------------------------------------------------------------

    def _on_frame(self, frame: Frame) -> None:
        self._newest = frame
        self._encode_next()

    def _encode_next(self) -> None:
        """Encode the newest frame if it would arrive in time."""
        if self._newest is None or self._encoding or self._view is None:
            return
        now = self._clock.seconds()
        control = self.rate_control
        if not control.may_send(now):
            wait = control.wait(now)
            if wait > 0 and self._wait_timer is None:
                self._wait_timer = self._clock.callLater(wait, self._waited)
            return
        frame, self._newest = self._newest, None
        request = EncodeRequest(
            quality=control.quality,
            scale=control.scale,
            reduced=control.reduced > 0,
            key=self._key,
            fps=control.fps or self._view.fps,
        )
        self._encoding, self._key = True, False
        self._view.encode(frame, request).addCallbacks(
            self._encoded, self._not_encoded, callbackArgs=(frame, request), errbackArgs=(request,)
        ).addErrback(self._internal_error)

    def _waited(self) -> None:
        self._wait_timer = None
        self._encode_next()

    def _encoded(self, encoded: Encoded, frame: Frame, request: EncodeRequest) -> None:
        self._encoding = False
        if self._view is None:
            return
        self._faults = 0
        self._fault = None
        key = request.key or self.request.settings.codec != "h264"
        if self._needs_key and not key:
            self._newest = self._newest or frame
            self._encode_next()
            return
        self._needs_key = False
        self._first_damaged = None
        self._number += 1
        self._report(encoded, request, self._view)
        self._packetizer.put(self._number, frame, encoded.body, self._clock.seconds(), key)
        self._encode_next()

    def _not_encoded(self, failure: Failure, request: EncodeRequest) -> None:
        self._encoding = False
        if self._view is None:
            return
        failure.trap(SwitchboardError)
        self._key = self._key or request.key
        self._faults += 1
        self._damaged += 1
        reason = failure.getErrorMessage()
        # Cameras often start with damaged frames, but a wrong encoding or size does not change by itself.
        if self._number:
            no_encoder = self.request.settings.codec == "h264" and failure.check(Unavailable) is not None
            permanent = no_encoder and self._faults >= MAX_FAULTS
        else:
            permanent = failure.check(DamagedImage) is None or self._faults >= MAX_FAULTS
        if permanent:
            self.refuse(reason)
            return
        if not self._number and self._first_damaged is None:
            self._first_damaged = self._clock.seconds(), reason
        self._continue(reason)

    def _internal_error(self, failure: Failure) -> None:
        if self._fault is None:
            self._log.failure("a frame could not be encoded", failure=failure)
        reason = "a frame could not be encoded; the robot's log says why"
        if self._number and self._view is not None:
            self._continue(reason)
        elif self._view is not None:
            self.refuse(reason)

    def _continue(self, reason: str) -> None:
        """Continue with the next frame; :meth:`_check` reports the reason if the fault lasts."""
        if self._number:
            since = self._clock.seconds() if self._fault is None else self._fault[0]
            self._fault = since, reason
        self._encode_next()

    def _acknowledged(self, ack: link.FrameAck) -> None:
        measured = self._protocol.link.offset.round_trip
        round_trip = measured / 1e9 if measured is not None else None
        if self._packetizer.on_ack(ack, self._clock.seconds(), round_trip):
            self._key = self._needs_key = True  # later H.264 frames must not need a discarded one
            if not self._encoding:
                self._repeat_latched()
        self._encode_next()

    def _check(self) -> None:
        """Report changes that come without a new frame: another publisher, or frames that can't be shown."""
        if (
            self._first_damaged is not None
            and self._clock.seconds() - self._first_damaged[0] >= DAMAGED_SECONDS
        ):
            self._check_timer = None
            self.refuse(self._first_damaged[1])
            return
        self._check_timer = self._clock.callLater(REPORT_INTERVAL, self._check)
        if self._reported is None or self._view is None:
            return
        problem = ""
        if self._fault is not None and self._clock.seconds() - self._fault[0] >= REPORT_INTERVAL:
            problem = self._fault[1]
        # During a fault the count follows with its end.
        damaged = self._damaged if self._fault is None else self._reported.damaged
        now = replace(self._reported, latched=self._view.latched, problem=problem, damaged=damaged)
        if now != self._reported:
            self._reported = now
            self._send(now)

    def _report(self, encoded: Encoded, request: EncodeRequest, view: CameraViewPort) -> None:
        """Queue a description of this frame and the following ones, if it changed."""
        control = self.rate_control
        delay = control.delay
        playing = link.StreamStatus(
            width=encoded.width,
            height=encoded.height,
            quality=request.quality,
            fps=control.fps,
            reduced=round(control.reduced, 3),
            delay_ms=None if delay is None else round(delay * 1000, 1),
            encoding=encoded.encoding[: limits.LABEL_LENGTH],
            source_fps=view.fps,
            latched=view.latched,
            damaged=self._damaged,
        )
        now = self._clock.seconds()
        if self._reported is not None:
            before = self._reported
            same = playing == replace(
                before, delay_ms=playing.delay_ms, source_fps=playing.source_fps, damaged=playing.damaged
            )
            if playing == before or (same and now - self._reported_at < REPORT_INTERVAL):
                return
        self._reported, self._reported_at = playing, now
        self._protocol.link.send(playing)
