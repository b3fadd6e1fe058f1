"""A stream: one camera in one form, made once by the robot, shown to everybody who wants just that."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass

from msgspec import structs
from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import MalformedMessage, NotFound, SwitchboardError, Unavailable
from relay_protocol.frames import VideoFrame
from relay_protocol.image_check import look_at
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.robots.registry import RobotState
from relay_server.video.first_frame_timeout import UNKNOWN_SECONDS, FirstFrameTimeout, between
from relay_server.video.frames import OFTEN, STALE_SECONDS, DelayEstimator, VideoFrameInfo
from relay_server.video.keyframes import Keyframes
from relay_server.video.ports import (
    NO_CAMERA,
    EncoderUnavailable,
    NoFrame,
    StreamRequest,
    VideoPort,
    ViewerPort,
)


class StreamState(enum.Enum):
    """Where a stream is in its life."""

    NEW = "new"
    WAITING = "waiting for the robot or its camera"
    OPENING = "opening"
    OPEN = "open"
    LINGERING = "open, without viewers"
    CLOSED = "closed"


class StreamEvent(enum.Enum):
    """What happens to a stream."""

    WANTED = "somebody watches"
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
"""An event that is not listed for a state changes nothing."""

LINKED = (StreamState.OPEN, StreamState.LINGERING)
"""States in which pictures come."""

STREAM_VIEWERS = 256
"""Most viewers of a stream."""

LINGER_SECONDS = 1.0
"""A stream goes on for so long after its last viewer."""

JOIN_SECONDS = 10.0
"""A robot that has not joined by then is asked again."""

REOPEN_SECONDS = 0.5
MOST_REOPEN_SECONDS = 5.0
"""Pause before a broken link is asked for anew; it doubles each time, until a picture comes."""

INHIBITED_SECONDS = 0.2
"""How often it is looked whether a camera of which somebody is owed a picture may be seen again."""

TELL_SECONDS = 0.1
"""Viewers are told no more often what is sent; the newest counts, and a robot could say it a thousand times at once."""


@dataclass(frozen=True)
class StreamCallbacks:
    """What a stream needs of its hub.

    :param issue_ticket: makes the ticket the robot joins with
    :param busy: called when the robot can't make one stream more: the hub moves the viewers to another stream,
        if there is one; who stays is told the robot's reason
    :param left: called when somebody has left, but not all
    :param closed: called once, when it is over
    """

    issue_ticket: Callable[[CameraStream], str]
    busy: Callable[[CameraStream], None]
    left: Callable[[CameraStream], None]
    closed: Callable[[CameraStream], None]


class CameraStream:
    """One camera in one form.

    :param name: what relay and robot call it
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        robot: RobotState,
        camera: str,
        settings: link.VideoSettings,
        name: str,
        hooks: StreamCallbacks,
    ) -> None:
        self._clock = clock
        self.robot = robot
        self.camera = camera
        self.settings = settings
        self.name = name
        self._hooks = hooks
        self.state = StreamState.NEW
        self.viewers: set[ViewerPort] = set()
        self.wishes: dict[ViewerPort, StreamRequest] = {}
        """What each of them came for."""
        self.newest: VideoFrameInfo | None = None
        self.told: link.Playing | None = None
        """What the robot sends at present, once it has said so."""
        self.failed: link.Playing | None = None
        """What it sent before it could not show the camera any more, and why it can't; ``None`` while all is well."""
        self._link: VideoPort | None = None
        self._lateness = DelayEstimator()
        self._patience = FirstFrameTimeout(clock, self._due, self._in_vain)
        self._keys = Keyframes(clock, self._ask_for_key, lambda: len(self.viewers) > 1)
        self._late = False
        """Whether the newest picture came too late for everybody."""
        self._viewers_told: link.Playing | None = None
        self._telling: Timer | None = None
        self._timer: Timer | None = None
        self._pause = REOPEN_SECONDS
        robot.watchers.append(self)

    # --- viewers ------------------------------------------------------------------------------------------

    def attach(self, viewer: ViewerPort, wish: StreamRequest | None = None) -> None:
        """Somebody begins to watch; he is told nothing before this has returned.

        :param wish: what he came for; by default this stream, from its next picture on
        :raises Unavailable: too many watch
        """
        if len(self.viewers) >= STREAM_VIEWERS:
            raise Unavailable(f"{STREAM_VIEWERS} viewers watch this stream already")
        self.viewers.add(viewer)
        self.wishes[viewer] = wish or StreamRequest(self.settings)
        self._keys.enters([viewer])
        self._patience.begins(viewer)
        self._happen(StreamEvent.WANTED)
        self._look_for_camera()
        if self.state in LINKED:
            self._clock.callLater(0, self._greet, viewer)
            self._want_key(viewer)

    def detach(self, viewer: ViewerPort) -> None:
        """Somebody watches no more; nothing is told to him from now on."""
        if viewer in self.viewers:
            self._drop(viewer)
            if self.viewers:
                self._hooks.left(self)
            else:
                self._happen(StreamEvent.LEFT)

    def start_anew(self, viewer: ViewerPort) -> None:
        """A viewer has left out a picture of H.264: what follows is no use to him before one that stands alone."""
        if viewer not in self.viewers:
            return
        if self._link is None:
            self._keys.enters([viewer])
        elif self._late:
            self._keys.wants(viewer)
        else:
            self._keys.left_out(viewer)

    def shut(self, error: SwitchboardError) -> None:
        """It is over at once.

        :param error: what the viewers are told
        """
        told, self.viewers = self.viewers, set()
        for viewer in told:
            self._drop(viewer)
        self._happen(StreamEvent.SHUT)
        for viewer in told:
            viewer.ended(error)

    def move(self, viewer: ViewerPort, stream: CameraStream) -> None:
        """A viewer watches another stream from now on, unless that does not take him."""
        try:
            stream.attach(viewer, self.wishes[viewer])
        except Unavailable:
            return
        self.detach(viewer)
        viewer.moved(stream)

    def _drop(self, viewer: ViewerPort) -> None:
        self.viewers.discard(viewer)
        self.wishes.pop(viewer, None)
        self._keys.leaves(viewer)
        self._patience.ends(viewer)

    def _greet(self, viewer: ViewerPort) -> None:
        """Who comes later is told what the others know."""
        if viewer in self.viewers and self.told is not None:
            viewer.playing(self.told)
        self._show_newest(viewer)

    def _show_newest(self, viewer: ViewerPort) -> None:
        """He sees the newest picture, if it is not old.

        Who wanted to is shown that of a slow camera, too, as everybody is one that its publisher keeps; its stamp tells
        how old it is. While the camera is inhibited nobody is shown any.
        """
        if viewer in self.viewers and self._inhibited():
            self._clock.callLater(INHIBITED_SECONDS, self._show_newest, viewer)
            return
        newest, now = self.newest, self._clock.seconds()
        if viewer not in self.viewers or newest is None or not newest.key or not self._keys.waits(viewer):
            return
        kept = self.told is not None and self.told.latched
        due = self._due() or (UNKNOWN_SECONDS if newest.number <= 1 else 0.0)
        if now <= newest.good_until:
            self._show(newest, [viewer])
        elif kept or (self.wishes[viewer].newest and now - newest.good_until + STALE_SECONDS <= due):
            self._show(structs.replace(newest, good_until=now + STALE_SECONDS), [viewer])

    def _show(self, picture: VideoFrameInfo, viewers: list[ViewerPort]) -> None:
        in_time = self._clock.seconds() <= picture.good_until
        for viewer in viewers:
            # One may leave while another is shown the picture.
            if viewer not in self.viewers:
                continue
            if picture.key:
                self._keys.shown(viewer)
            if not self._keys.waits(viewer):
                if in_time or self.wishes[viewer].first:
                    self._patience.ends(viewer)
                viewer.picture(picture)

    def _due(self) -> float:
        """Seconds from one picture to the next; 0: not known, or there is no link on which any could come."""
        return between(self.settings, self._named(), self.told) if self.state in LINKED else 0.0

    def _in_vain(self, viewer: ViewerPort, waited: float) -> None:
        """No picture has come for him.

        :param waited: seconds
        """
        error = self._why_none(waited)
        self.detach(viewer)
        viewer.ended(error)

    def _why_none(self, waited: float) -> SwitchboardError:
        robot = self.robot.name
        if self.robot.control is None:
            return Unavailable(f"robot {robot} is offline")
        if self.state is StreamState.WAITING:
            return NotFound(NO_CAMERA)
        if self.state is StreamState.OPENING:
            return NoFrame(f"robot {robot} does not open the video of {self.camera}")
        trouble = f": {self.told.trouble}" if self.told is not None and self.told.trouble else ""
        return NoFrame(f"camera {self.camera} has given no picture for {waited:.0f} s{trouble}")

    # --- the robot ----------------------------------------------------------------------------------------

    def robot_online(self) -> None:
        """The robot has registered; what cameras it has it tells later."""

    def robot_offline(self) -> None:
        """The control link is gone, and with it what the robot did for us."""
        self._happen(StreamEvent.ROBOT_OFFLINE)

    def graph_changed(self) -> None:
        """Cameras are told of on their own."""

    def described(self) -> None:
        """The robot told facts about itself: its cameras, perhaps."""
        self._look_for_camera()

    def joined(self, video_link: VideoPort) -> None:
        """The robot has come with our ticket."""
        if self.state is not StreamState.OPENING:
            video_link.close("this stream is not being opened")
            return
        self._link = video_link
        # Its clock may have been set while it was away.
        self._lateness = DelayEstimator()
        self._happen(StreamEvent.JOINED)

    def part(self) -> None:
        """A part of a picture came over the link; the rest is still on its way."""
        self._patience.coming()

    def picture(self, frame: VideoFrame) -> None:
        """A picture came over the link.

        :raises MalformedMessage: it is none; the link must end
        """
        if self._link is None:
            return
        self._link.send(link.Took(number=frame.number))
        try:
            picture = self._checked(frame)
        except MalformedMessage as error:
            # The link is told by whoever broke off, not by us.
            self._link = None
            self._fails(f"robot {self.robot.name} sent what is no picture: {error}")
            raise
        self._pause = REOPEN_SECONDS
        self.newest = picture
        self._late = self._clock.seconds() > picture.good_until
        self._show(picture, list(self.viewers))

    def message(self, message: link.RobotVideo) -> None:
        """A message came over the link; pings and farewells are the connection's."""
        if isinstance(message, link.Playing):
            self.told, self.failed = message, None
            if self._telling is None or not self._telling.active():
                self._tell()
        elif isinstance(message, link.NotPlaying):
            reason = message.reason or f"robot {self.robot.name} can't show {self.camera}"
            if message.busy:
                self._hooks.busy(self)
                self.shut(Unavailable(reason))
            else:
                self._fails(reason)

    def _fails(self, reason: str) -> None:
        """The camera can't be shown now, and the link ends.

        Viewers that have seen pictures stay, and the robot is asked again: a camera's bad spell must not freeze pages.
        Others are told why. So are all of H.264, since another codec may do.
        """
        error = self._not_so(reason)
        stay = [each for each in self.viewers if not self._patience.waits(each)]
        if not stay or isinstance(error, EncoderUnavailable):
            self.shut(error)
            return
        for viewer in self.viewers.difference(stay):
            self._drop(viewer)
            viewer.ended(error)
        told = self.told
        self._happen(StreamEvent.LINK_LOST)
        if told is not None:
            self.failed = structs.replace(told, trouble=reason)
            for viewer in stay:
                viewer.playing(self.failed)

    def _tell(self) -> None:
        """Tell the viewers the newest of what the robot says it sends, and then nothing for a while."""
        told = self.told
        if told is None or told == self._viewers_told:
            return
        self._viewers_told = told
        self._telling = self._clock.callLater(TELL_SECONDS, self._tell)
        for viewer in list(self.viewers):
            viewer.playing(told)

    def _not_so(self, reason: str) -> Unavailable:
        """The robot can't show it in this form; of H.264, there is another one that it may."""
        return EncoderUnavailable(reason) if self.settings.codec == "h264" else Unavailable(reason)

    def lost(self, video_link: VideoPort) -> None:
        """The link has ended."""
        if self._link is video_link:
            self._happen(StreamEvent.LINK_LOST)

    def _checked(self, frame: VideoFrame) -> VideoFrameInfo:
        seen = look_at(self.settings.codec, frame.body)
        width, height = seen.width, seen.height
        if not width:
            if self.told is None:
                raise MalformedMessage("a picture came before 'playing', which tells its size")
            width, height = self.told.width, self.told.height
        stamp, now = frame.stamp / 1e9, self._clock.seconds()
        # What its publisher keeps may be old through no fault of the network's, and no other one may follow.
        kept = self.told is not None and self.told.latched and self.told.source_fps < OFTEN
        late = 0.0 if kept else self._lateness.of(stamp, now)
        return VideoFrameInfo(
            number=frame.number,
            stamp=stamp,
            good_until=now + STALE_SECONDS - late,
            codec=self.settings.codec,
            width=width,
            height=height,
            key=seen.key,
            body=frame.body,
            reduced=self.told.reduced if self.told is not None else 0.0,
        )

    # --- key frames ---------------------------------------------------------------------------------------

    def _want_key(self, viewer: ViewerPort) -> None:
        if self.settings.codec == "h264":
            self._keys.wants(viewer)

    def _ask_for_key(self) -> None:
        if self._link is not None:
            self._link.send(link.KeyFrame())

    # --- life ---------------------------------------------------------------------------------------------

    def _happen(self, event: StreamEvent) -> None:
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
            self._timer = self._clock.callLater(LINGER_SECONDS, self._happen, StreamEvent.SHUT)
        elif following is StreamState.CLOSED:
            self._end(before)

    def _look_for_camera(self) -> None:
        if self.robot.control is not None and self._named() is not None:
            self._happen(StreamEvent.CAMERA_THERE)

    def _named(self) -> link.Camera | None:
        """The camera as the robot tells of it."""
        names = self._names()
        return next((each for each in self.robot.cameras if each.name in names), None)

    def _names(self) -> set[str]:
        names = {self.camera}
        if self.settings.transport == "compressed":
            # Some cameras publish nothing else; image_transport's users name them by their raw topic all the same.
            names.add(link.compressed_of(self.camera))
        return names

    def _inhibited(self) -> bool:
        """Whether nobody is to get pictures of the camera now, not even its last one (SPEC section 1.7)."""
        names = self._names()
        return any(each.resource in names and not each.hold for each in self.robot.safety.inhibited)

    def _open_later(self, event: StreamEvent) -> None:
        pause = 0.0
        if event is StreamEvent.LINK_LOST:
            pause, self._pause = self._pause, min(2 * self._pause, MOST_REOPEN_SECONDS)
        self._timer = self._clock.callLater(pause, self._ask_to_open)

    def _ask_to_open(self) -> None:
        if self.robot.control is not None:
            self.robot.control.send(
                link.OpenVideo(
                    stream=self.name,
                    ticket=self._hooks.issue_ticket(self),
                    camera=self.camera,
                    settings=self.settings,
                )
            )
        self._timer = self._clock.callLater(JOIN_SECONDS, self._happen, StreamEvent.LATE)

    def _leave_link(self, event: StreamEvent) -> None:
        broken, self._link = self._link, None
        if broken is not None:
            broken.close(event.value)
        self.newest = self.told = self._viewers_told = None
        self._late = False
        self._keys.enters(self.viewers)
        self._keys.rest()
        cancel(self._telling)

    def _end(self, before: StreamState) -> None:
        if before is not StreamState.WAITING and self.robot.control is not None:
            self.robot.control.send(link.CloseVideo(stream=self.name))
        self.robot.watchers.remove(self)
        self._hooks.closed(self)
