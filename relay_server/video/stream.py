"""A stream: one camera with one set of parameters, encoded once by the robot, shown to all viewers that want
just that."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from msgspec import structs
from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import MalformedMessage, NotFound, SwitchboardError, Unavailable
from relay_protocol.frames import VideoFrame
from relay_protocol.image_check import validate
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.robots.registry import RobotState
from relay_server.video.errors import NO_CAMERA, EncoderUnavailable, NoFrame
from relay_server.video.frame_waits import UNKNOWN_RATE_SECONDS, FirstFrameTimeout, Keyframes, frame_interval
from relay_server.video.frames import FREQUENT_FPS, STALE_SECONDS, DelayEstimator, VideoFrameInfo


class StreamState(enum.Enum):
    NEW = "new"
    WAITING = "waiting for the robot or its camera"
    OPENING = "opening"
    OPEN = "open"
    LINGERING = "open, without viewers"
    CLOSED = "closed"


class StreamEvent(enum.Enum):
    WANTED = "it has a viewer"
    CAMERA_THERE = "the robot has the camera"
    ROBOT_OFFLINE = "the robot is gone"
    JOINED = "the robot joined"
    LINK_LOST = "the stream's link broke"
    LATE = "the robot did not join in time"
    LEFT = "the last viewer left"
    SHUT = "it is over"


NEXT: dict[tuple[StreamState, StreamEvent], StreamState] = {
    (StreamState.NEW, StreamEvent.WANTED): StreamState.WAITING,
    (StreamState.WAITING, StreamEvent.CAMERA_THERE): StreamState.OPENING,
    (StreamState.WAITING, StreamEvent.LEFT): StreamState.CLOSED,
    (StreamState.WAITING, StreamEvent.SHUT): StreamState.CLOSED,
    (StreamState.OPENING, StreamEvent.JOINED): StreamState.OPEN,
    (StreamState.OPENING, StreamEvent.LATE): StreamState.OPENING,
    (StreamState.OPENING, StreamEvent.ROBOT_OFFLINE): StreamState.WAITING,
    (StreamState.OPENING, StreamEvent.LEFT): StreamState.CLOSED,
    (StreamState.OPENING, StreamEvent.SHUT): StreamState.CLOSED,
    (StreamState.OPEN, StreamEvent.LINK_LOST): StreamState.OPENING,
    (StreamState.OPEN, StreamEvent.ROBOT_OFFLINE): StreamState.WAITING,
    (StreamState.OPEN, StreamEvent.LEFT): StreamState.LINGERING,
    (StreamState.OPEN, StreamEvent.SHUT): StreamState.CLOSED,
    (StreamState.LINGERING, StreamEvent.WANTED): StreamState.OPEN,
    (StreamState.LINGERING, StreamEvent.LINK_LOST): StreamState.CLOSED,
    (StreamState.LINGERING, StreamEvent.ROBOT_OFFLINE): StreamState.CLOSED,
    (StreamState.LINGERING, StreamEvent.SHUT): StreamState.CLOSED,
}
"""Events that are not listed for a state change nothing."""

LINKED = (StreamState.OPEN, StreamState.LINGERING)
"""States in which frames come."""

STREAM_VIEWERS = 256
"""Most viewers of one stream."""

LINGER_SECONDS = 1.0
"""Seconds that a stream continues after its last viewer has left."""

JOIN_SECONDS = 10.0
"""A robot that has not joined by then is asked again."""

REOPEN_SECONDS = 0.5
MAX_REOPEN_SECONDS = 5.0
"""Pause before a broken link is requested again. It doubles each time until a frame comes."""

INHIBITED_SECONDS = 0.2
"""How often a viewer that waits for an inhibited camera checks whether it may be shown again."""

STATUS_SECONDS = 0.1
"""Viewers get the robot's status at most this often, the newest one. A robot could send it a thousand times a
second."""


class StreamRequest(NamedTuple):
    """The stream that a viewer requested.

    :param settings: may differ from those of the stream that the viewer is shown while the robot is at its limit
    :param newest: show the newest frame of a slow camera until the next one comes
    :param first: be served before others when a stream becomes free, and take late frames too: a recording cannot be
        repeated
    """

    settings: link.VideoSettings
    newest: bool = False
    first: bool = False


class VideoPort(Protocol):
    """The robot's link of a stream."""

    def send(self, message: link.Message) -> None:
        """Queue a message that must not be lost."""

    def close(self, reason: str) -> None:
        """Send ``bye`` and close the connection."""


class ViewerPort(Protocol):
    """A viewer of a stream. Nothing is called before :meth:`CameraStreams.watch` has returned."""

    @property
    def user(self) -> int:
        """The user's number: how much one user may watch is bounded over all of their connections."""

    def frame_received(self, frame: VideoFrameInfo) -> None:
        """A new frame; the viewer keeps the newest until it can send it.

        A viewer that drops a frame of H.264 calls :meth:`CameraStream.request_keyframe`.
        """

    def status_changed(self, playing: link.StreamStatus) -> None:
        """The status of the stream, which holds from the next frame on."""

    def moved(self, stream: CameraStream) -> None:
        """The viewer watches this stream now, and leaves it by ``detach``.

        It is the nearest one, because the robot is at its limit, or, once there is room again, the requested one.
        """

    def ended(self, error: SwitchboardError) -> None:
        """The stream is not available, or no longer. Called once; the viewer is detached already."""


def differing(requested: link.VideoSettings, shown: link.VideoSettings) -> dict[str, Any]:
    """The parameters in which ``shown`` differs from ``requested``, with their values in ``shown``."""
    asked = structs.asdict(requested)
    return {name: value for name, value in structs.asdict(shown).items() if value != asked[name]}


@dataclass(frozen=True)
class StreamCallbacks:
    """How a stream reaches the collection of streams.

    :param issue_ticket: makes the ticket with which the robot joins
    :param busy: called when the robot has no room for this stream; the viewers are moved to another one if
        there is one, the rest get the robot's reason
    :param left: called when a viewer has left and others stay
    :param closed: called once, at the end
    """

    issue_ticket: Callable[[CameraStream], str]
    busy: Callable[[CameraStream], None]
    left: Callable[[CameraStream], None]
    closed: Callable[[CameraStream], None]


class CameraStream:
    """One camera with one set of parameters.

    :param name: its name on the link
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        robot: RobotState,
        camera: str,
        settings: link.VideoSettings,
        name: str,
        callbacks: StreamCallbacks,
    ) -> None:
        self._clock = clock
        self.robot = robot
        self.camera = camera
        self.settings = settings
        self.name = name
        self._callbacks = callbacks
        self.state = StreamState.NEW
        self.viewers: set[ViewerPort] = set()
        self.requests: dict[ViewerPort, StreamRequest] = {}
        """The requests by viewer."""
        self.newest: VideoFrameInfo | None = None
        self.status: link.StreamStatus | None = None
        """The status that the robot reported last."""
        self.last_status: link.StreamStatus | None = None
        """The last status before the camera failed, with the reason; ``None`` while it works."""
        self._link: VideoPort | None = None
        self._delay = DelayEstimator()
        self._first_frame: FirstFrameTimeout[ViewerPort] = FirstFrameTimeout(
            clock, self._frame_interval, self._no_frame_came
        )
        self._keyframes: Keyframes[ViewerPort] = Keyframes(
            clock, self._send_keyframe_request, lambda: len(self.viewers) > 1
        )
        self._newest_was_late = False
        """Whether the newest frame came too late to be shown."""
        self._sent_status: link.StreamStatus | None = None
        self._status_timer: Timer | None = None
        self._timer: Timer | None = None
        self._pause = REOPEN_SECONDS
        robot.observers.append(self)

    # --- viewers ------------------------------------------------------------------------------------------

    def attach(self, viewer: ViewerPort, request: StreamRequest | None = None) -> None:
        """Add a viewer. Nothing is called on it before this has returned.

        :param request: the viewer's request; by default this stream, from its next frame on
        :raises Unavailable: there are too many viewers
        """
        if len(self.viewers) >= STREAM_VIEWERS:
            raise Unavailable(f"{STREAM_VIEWERS} viewers watch this stream already")
        self.viewers.add(viewer)
        self.requests[viewer] = request or StreamRequest(self.settings)
        self._keyframes.add([viewer])
        self._first_frame.start(viewer)
        self._handle(StreamEvent.WANTED)
        self._check_camera()
        if self.state in LINKED:
            self._clock.callLater(0, self._send_current, viewer)
            self._request_key_for(viewer)

    def detach(self, viewer: ViewerPort) -> None:
        """Remove a viewer. Nothing is called on it from now on."""
        if viewer in self.viewers:
            self._drop(viewer)
            if self.viewers:
                self._callbacks.left(self)
            else:
                self._handle(StreamEvent.LEFT)

    def request_keyframe(self, viewer: ViewerPort) -> None:
        """A viewer dropped a frame of H.264, so it can show nothing before the next key frame."""
        if viewer not in self.viewers:
            return
        if self._link is None:
            self._keyframes.add([viewer])
        elif self._newest_was_late:
            self._keyframes.request(viewer)
        else:
            self._keyframes.frame_dropped(viewer)

    def close(self, error: SwitchboardError) -> None:
        """End the stream at once.

        :param error: given to the viewers
        """
        status, self.viewers = self.viewers, set()
        for viewer in status:
            self._drop(viewer)
        self._handle(StreamEvent.SHUT)
        for viewer in status:
            viewer.ended(error)

    def move(self, viewer: ViewerPort, stream: CameraStream) -> None:
        """Move a viewer to another stream, unless that one is full."""
        try:
            stream.attach(viewer, self.requests[viewer])
        except Unavailable:
            return
        self.detach(viewer)
        viewer.moved(stream)

    def _drop(self, viewer: ViewerPort) -> None:
        self.viewers.discard(viewer)
        self.requests.pop(viewer, None)
        self._keyframes.remove(viewer)
        self._first_frame.stop(viewer)

    def _send_current(self, viewer: ViewerPort) -> None:
        """A late viewer gets the status that the others have already."""
        if viewer in self.viewers and self.status is not None:
            viewer.status_changed(self.status)
        self._show_newest(viewer)

    def _show_newest(self, viewer: ViewerPort) -> None:
        """Show a new viewer the newest frame, if it is not old.

        Viewers that asked for it are shown the newest frame of a slow camera too, and every viewer is shown a
        latched one; its stamp shows its age. While the camera is inhibited nothing is shown.
        """
        if viewer in self.viewers and self._inhibited():
            self._clock.callLater(INHIBITED_SECONDS, self._show_newest, viewer)
            return
        newest, now = self.newest, self._clock.seconds()
        if (
            viewer not in self.viewers
            or newest is None
            or not newest.key
            or not self._keyframes.is_waiting(viewer)
        ):
            return
        latched = self.status is not None and self.status.latched
        due = self._frame_interval() or (UNKNOWN_RATE_SECONDS if newest.number <= 1 else 0.0)
        if now <= newest.good_until:
            self._show(newest, [viewer])
        elif latched or (self.requests[viewer].newest and now - newest.good_until + STALE_SECONDS <= due):
            self._show(structs.replace(newest, good_until=now + STALE_SECONDS), [viewer])

    def _show(self, frame: VideoFrameInfo, viewers: list[ViewerPort]) -> None:
        in_time = self._clock.seconds() <= frame.good_until
        for viewer in viewers:
            # One viewer may leave while another is shown the frame.
            if viewer not in self.viewers:
                continue
            if frame.key:
                self._keyframes.keyframe_shown(viewer)
            if not self._keyframes.is_waiting(viewer):
                if in_time or self.requests[viewer].first:
                    self._first_frame.stop(viewer)
                viewer.frame_received(frame)

    def _frame_interval(self) -> float:
        """Seconds between frames; 0 when it is not known, or without a link on which frames could come."""
        return (
            frame_interval(self.settings, self._camera_info(), self.status) if self.state in LINKED else 0.0
        )

    def _no_frame_came(self, viewer: ViewerPort, waited: float) -> None:
        """A viewer has got no frame.

        :param waited: seconds
        """
        error = self._no_frame_error(waited)
        self.detach(viewer)
        viewer.ended(error)

    def _no_frame_error(self, waited: float) -> SwitchboardError:
        robot = self.robot.name
        if self.robot.control_link is None:
            return Unavailable(f"robot {robot} is offline")
        if self.state is StreamState.WAITING:
            return NotFound(NO_CAMERA)
        if self.state is StreamState.OPENING:
            return NoFrame(f"robot {robot} does not open the stream of {self.camera}")
        trouble = f": {self.status.problem}" if self.status is not None and self.status.problem else ""
        return NoFrame(f"camera {self.camera} has sent no frame for {waited:.0f} s{trouble}")

    # --- the robot ----------------------------------------------------------------------------------------

    def robot_online(self) -> None:
        """The robot has registered. It lists its cameras later."""

    def robot_offline(self) -> None:
        """The control link is gone, and the streams that the robot opened for it."""
        self._handle(StreamEvent.ROBOT_OFFLINE)

    def graph_changed(self) -> None:
        """Cameras are listed apart from the graph."""

    def described(self) -> None:
        """The robot sent facts about itself, perhaps its cameras."""
        self._check_camera()

    def joined(self, video_link: VideoPort) -> None:
        """The robot has connected with this stream's ticket."""
        if self.state is not StreamState.OPENING:
            video_link.close("this stream is not being opened")
            return
        self._link = video_link
        # Its clock may have been set while it was away.
        self._delay = DelayEstimator()
        self._handle(StreamEvent.JOINED)

    def frame_part_received(self) -> None:
        """A part of a frame came over the link; more parts follow."""
        self._first_frame.part_received()

    def frame_received(self, frame: VideoFrame) -> None:
        """A frame came over the link.

        :raises MalformedMessage: it is not an image; the link must end
        """
        if self._link is None:
            return
        self._link.send(link.FrameAck(number=frame.number))
        try:
            info = self._frame_info(frame)
        except MalformedMessage as error:
            # The caller ends the link.
            self._link = None
            self._fail(f"robot {self.robot.name} sent a frame that is not an image: {error}")
            raise
        self._pause = REOPEN_SECONDS
        self.newest = info
        self._newest_was_late = self._clock.seconds() > info.good_until
        self._show(info, list(self.viewers))

    def message_received(self, message: link.RobotVideo) -> None:
        """A message came over the link, other than pings and ``bye``."""
        if isinstance(message, link.StreamStatus):
            self.status, self.last_status = message, None
            if self._status_timer is None or not self._status_timer.active():
                self._send_status()
        elif isinstance(message, link.StreamRefused):
            reason = message.reason or f"robot {self.robot.name} cannot show {self.camera}"
            if message.busy:
                self._callbacks.busy(self)
                self.close(Unavailable(reason))
            else:
                self._fail(reason)

    def _fail(self, reason: str) -> None:
        """The camera cannot be shown now, and the link ends.

        Viewers that have seen frames stay, and the robot is asked again, so that a camera's failure does not
        freeze pages. Other viewers get the reason. So do all viewers of H.264, since another codec may work.
        """
        error = self._unavailable(reason)
        stay = [each for each in self.viewers if not self._first_frame.is_waiting(each)]
        if not stay or isinstance(error, EncoderUnavailable):
            self.close(error)
            return
        for viewer in self.viewers.difference(stay):
            self._drop(viewer)
            viewer.ended(error)
        status = self.status
        self._handle(StreamEvent.LINK_LOST)
        if status is not None:
            self.last_status = structs.replace(status, problem=reason)
            for viewer in stay:
                viewer.status_changed(self.last_status)

    def _send_status(self) -> None:
        """Send the viewers the newest status, then none for :data:`STATUS_SECONDS`."""
        status = self.status
        if status is None or status == self._sent_status:
            return
        self._sent_status = status
        self._status_timer = self._clock.callLater(STATUS_SECONDS, self._send_status)
        for viewer in list(self.viewers):
            viewer.status_changed(status)

    def _unavailable(self, reason: str) -> Unavailable:
        """The error for a stream that the robot cannot make; for H.264 another codec may work."""
        return EncoderUnavailable(reason) if self.settings.codec == "h264" else Unavailable(reason)

    def lost(self, video_link: VideoPort) -> None:
        """The link has ended."""
        if self._link is video_link:
            self._handle(StreamEvent.LINK_LOST)

    def _frame_info(self, frame: VideoFrame) -> VideoFrameInfo:
        seen = validate(self.settings.codec, frame.body)
        width, height = seen.width, seen.height
        if not width:
            if self.status is None:
                raise MalformedMessage("a frame came before 'stream_status', which gives its size")
            width, height = self.status.width, self.status.height
        stamp, now = frame.stamp / 1e9, self._clock.seconds()
        # A latched frame may be old without any delay, and no other one may follow.
        latched = self.status is not None and self.status.latched and self.status.source_fps < FREQUENT_FPS
        late = 0.0 if latched else self._delay.delay_of(stamp, now)
        return VideoFrameInfo(
            number=frame.number,
            stamp=stamp,
            good_until=now + STALE_SECONDS - late,
            codec=self.settings.codec,
            width=width,
            height=height,
            key=seen.key,
            body=frame.body,
            reduced=self.status.reduced if self.status is not None else 0.0,
        )

    # --- key frames ---------------------------------------------------------------------------------------

    def _request_key_for(self, viewer: ViewerPort) -> None:
        if self.settings.codec == "h264":
            self._keyframes.request(viewer)

    def _send_keyframe_request(self) -> None:
        if self._link is not None:
            self._link.send(link.RequestKeyFrame())

    # --- life ---------------------------------------------------------------------------------------------

    def _handle(self, event: StreamEvent) -> None:
        following = NEXT.get((self.state, event))
        if following is None:
            return
        before, self.state = self.state, following
        self.log.debug("stream {name}: {event}, now {state}", name=self.name, event=event, state=following)
        cancel(self._timer)
        self._timer = None
        if before in LINKED and following not in LINKED:
            self._leave_link(event)
        if following is StreamState.OPENING:
            self._open_later(event)
        elif following is StreamState.LINGERING:
            self._timer = self._clock.callLater(LINGER_SECONDS, self._handle, StreamEvent.SHUT)
        elif following is StreamState.CLOSED:
            self._end(before)

    def _check_camera(self) -> None:
        if self.robot.control_link is not None and self._camera_info() is not None:
            self._handle(StreamEvent.CAMERA_THERE)

    def _camera_info(self) -> link.Camera | None:
        """The camera as the robot lists it."""
        names = self._topics()
        return next((each for each in self.robot.cameras if each.name in names), None)

    def _topics(self) -> set[str]:
        names = {self.camera}
        if self.settings.transport == "compressed":
            # Some cameras publish nothing else; users of image_transport name them by their raw topic all the
            # same.
            names.add(link.compressed_of(self.camera))
        return names

    def _inhibited(self) -> bool:
        """Whether no frame of the camera may be shown now, not even its last one (SPEC 1.7)."""
        names = self._topics()
        return any(each.resource in names and not each.hold for each in self.robot.motion_state.inhibited)

    def _open_later(self, event: StreamEvent) -> None:
        pause = 0.0
        if event is StreamEvent.LINK_LOST:
            pause, self._pause = self._pause, min(2 * self._pause, MAX_REOPEN_SECONDS)
        self._timer = self._clock.callLater(pause, self._send_open)

    def _send_open(self) -> None:
        if self.robot.control_link is not None:
            self.robot.control_link.send(
                link.OpenVideo(
                    stream=self.name,
                    ticket=self._callbacks.issue_ticket(self),
                    camera=self.camera,
                    settings=self.settings,
                )
            )
        self._timer = self._clock.callLater(JOIN_SECONDS, self._handle, StreamEvent.LATE)

    def _leave_link(self, event: StreamEvent) -> None:
        broken, self._link = self._link, None
        if broken is not None:
            broken.close(event.value)
        self.newest = self.status = self._sent_status = None
        self._newest_was_late = False
        self._keyframes.add(self.viewers)
        self._keyframes.cancel()
        cancel(self._status_timer)

    def _end(self, before: StreamState) -> None:
        if before is not StreamState.WAITING and self.robot.control_link is not None:
            self.robot.control_link.send(link.CloseVideo(stream=self.name))
        self.robot.observers.remove(self)
        self._callbacks.closed(self)
