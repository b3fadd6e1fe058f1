"""A stream: one camera in one form, made once by the robot, shown to everybody who wants just that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import MalformedMessage, NotFound, SwitchboardError, Unavailable
from relay_protocol.frames import VideoFrame
from relay_protocol.pictures import look_at
from relay_server.clock import Clock, Timer, cancel
from relay_server.registry import Presence
from relay_server.video.ends import NO_CAMERA, NothingCame, VideoLink, Viewer
from relay_server.video.pictures import STALE_SECONDS, Lateness, Picture
from relay_server.video.states import LINKED, NEXT, Event, State

STREAM_VIEWERS = 256
"""Most viewers of a stream."""

FIRST_PICTURE_SECONDS = 10.0
"""A viewer that has got no picture by then is told why; one that has got some waits on."""

LINGER_SECONDS = 1.0
"""A stream goes on for so long after its last viewer."""

JOIN_SECONDS = 10.0
"""A robot that has not joined by then is asked again."""

REOPEN_SECONDS = 0.5
MOST_REOPEN_SECONDS = 5.0
"""Pause before a broken link is asked for anew; it doubles each time, until a picture comes."""

KEY_SECONDS = 0.5
"""The robot is asked for a key frame no more often than this, whoever comes."""


@dataclass(frozen=True)
class Hooks:
    """What a stream needs of its hub.

    :param issue_ticket: makes the ticket the robot joins with
    :param busy: called when the robot can't make one stream more: the hub moves the viewers to another stream,
        if there is one; who stays is told the robot's reason
    :param closed: called once, when it is over
    """

    issue_ticket: Callable[[Stream], str]
    busy: Callable[[Stream], None]
    closed: Callable[[Stream], None]


class Stream:
    """One camera in one form.

    :param name: what relay and robot call it
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        robot: Presence,
        camera: str,
        settings: link.VideoSettings,
        name: str,
        hooks: Hooks,
    ) -> None:
        self._clock = clock
        self.robot = robot
        self.camera = camera
        self.settings = settings
        self.name = name
        self._hooks = hooks
        self.state = State.NEW
        self.viewers: set[Viewer] = set()
        self.newest: Picture | None = None
        self.told: link.Playing | None = None
        """What the robot sends at present, once it has said so."""
        self._link: VideoLink | None = None
        self._lateness = Lateness()
        self._patience: dict[Viewer, Timer] = {}
        """Of those who have not got any picture."""
        self._unready: set[Viewer] = set()
        """Those who can't show anything but a picture that stands alone."""
        self._timer: Timer | None = None
        self._pause = REOPEN_SECONDS
        self._key_timer: Timer | None = None
        self._key_asked = -KEY_SECONDS
        robot.watchers.append(self)

    # --- viewers ------------------------------------------------------------------------------------------

    def attach(self, viewer: Viewer) -> None:
        """Somebody begins to watch; he is told nothing before this has returned.

        :raises Unavailable: too many watch
        """
        if len(self.viewers) >= STREAM_VIEWERS:
            raise Unavailable(f"{STREAM_VIEWERS} viewers watch this stream already")
        self.viewers.add(viewer)
        self._unready.add(viewer)
        self._patience[viewer] = self._clock.callLater(FIRST_PICTURE_SECONDS, self._in_vain, viewer)
        self._happen(Event.WANTED)
        self._look_for_camera()
        if self.state in LINKED:
            self._clock.callLater(0, self._greet, viewer)
            self._want_key()

    def detach(self, viewer: Viewer) -> None:
        """Somebody watches no more; nothing is told to him from now on."""
        if viewer in self.viewers:
            self._drop(viewer)
            if not self.viewers:
                self._happen(Event.LEFT)

    def start_anew(self, viewer: Viewer) -> None:
        """A viewer has left out a picture: what follows is no use to him before one that stands alone."""
        if viewer in self.viewers:
            self._unready.add(viewer)
            self._want_key()

    def shut(self, error: SwitchboardError) -> None:
        """It is over at once.

        :param error: what the viewers are told
        """
        told, self.viewers = self.viewers, set()
        for viewer in told:
            self._drop(viewer)
        self._happen(Event.SHUT)
        for viewer in told:
            viewer.ended(error)

    def move(self, stream: Stream) -> None:
        """The viewers watch another stream from now on, but for those it does not take."""
        for viewer in list(self.viewers):
            try:
                stream.attach(viewer)
            except Unavailable:
                continue
            self._drop(viewer)
            viewer.moved(stream)

    def _drop(self, viewer: Viewer) -> None:
        self.viewers.discard(viewer)
        self._unready.discard(viewer)
        cancel(self._patience.pop(viewer, None))

    def _greet(self, viewer: Viewer) -> None:
        """Who comes later is told what the others know."""
        if viewer in self.viewers and self.told is not None:
            viewer.playing(self.told)
        newest = self.newest
        if newest is not None and newest.key and self._clock.seconds() <= newest.good_until:
            self._show(newest, [viewer] if viewer in self._unready else [])

    def _show(self, picture: Picture, viewers: list[Viewer]) -> None:
        for viewer in viewers:
            if picture.key:
                self._unready.discard(viewer)
            # One may leave while another is shown the picture.
            if viewer in self.viewers and viewer not in self._unready:
                cancel(self._patience.pop(viewer, None))
                viewer.picture(picture)

    def _in_vain(self, viewer: Viewer) -> None:
        """No picture has come for him."""
        error = self._why_none()
        self.detach(viewer)
        viewer.ended(error)

    def _why_none(self) -> SwitchboardError:
        robot = self.robot.name
        if self.robot.control is None:
            return Unavailable(f"robot {robot} is offline")
        if self.state is State.WAITING:
            return NotFound(NO_CAMERA)
        if self.state is State.OPENING:
            return NothingCame(f"robot {robot} does not open the video of {self.camera}")
        return NothingCame(f"camera {self.camera} has given no picture for {FIRST_PICTURE_SECONDS:g} s")

    # --- the robot ----------------------------------------------------------------------------------------

    def robot_online(self) -> None:
        """The robot has registered; what cameras it has it tells later."""

    def robot_offline(self) -> None:
        """The control link is gone, and with it what the robot did for us."""
        self._happen(Event.ROBOT_OFFLINE)

    def graph_changed(self) -> None:
        """Cameras are told of on their own."""

    def described(self) -> None:
        """The robot told facts about itself: its cameras, perhaps."""
        self._look_for_camera()

    def joined(self, video_link: VideoLink) -> None:
        """The robot has come with our ticket."""
        if self.state is not State.OPENING:
            video_link.close("this stream is not being opened")
            return
        self._link = video_link
        self._happen(Event.JOINED)

    def picture(self, frame: VideoFrame) -> None:
        """A picture came over the link.

        :raises MalformedMessage: it is none; the stream is over, and so must be the link
        """
        if self._link is None:
            return
        self._link.send(link.Took(number=frame.number))
        try:
            picture = self._checked(frame)
        except MalformedMessage as error:
            # The link is told by whoever broke off, not by us.
            self._link = None
            self.shut(Unavailable(f"robot {self.robot.name} sent what is no picture: {error}"))
            raise
        self._pause = REOPEN_SECONDS
        self.newest = picture
        self._show(picture, list(self.viewers))

    def message(self, message: link.RobotVideo) -> None:
        """A message came over the link; pings and farewells are the connection's."""
        if isinstance(message, link.Playing):
            self.told = message
            for viewer in list(self.viewers):
                viewer.playing(message)
        elif isinstance(message, link.NotPlaying):
            if message.busy:
                self._hooks.busy(self)
            self.shut(Unavailable(message.reason or f"robot {self.robot.name} can't show {self.camera}"))

    def lost(self, video_link: VideoLink) -> None:
        """The link has ended."""
        if self._link is video_link:
            self._happen(Event.LINK_LOST)

    def _checked(self, frame: VideoFrame) -> Picture:
        seen = look_at(self.settings.codec, frame.body)
        width, height = seen.width, seen.height
        if not width:
            if self.told is None:
                raise MalformedMessage("a picture came before 'playing', which tells its size")
            width, height = self.told.width, self.told.height
        stamp, now = frame.stamp / 1e9, self._clock.seconds()
        return Picture(
            number=frame.number,
            stamp=stamp,
            good_until=now + STALE_SECONDS - self._lateness.of(stamp, now),
            codec=self.settings.codec,
            width=width,
            height=height,
            key=seen.key,
            body=frame.body,
        )

    # --- key frames ---------------------------------------------------------------------------------------

    def _want_key(self) -> None:
        if self.settings.codec != "h264" or (self._key_timer is not None and self._key_timer.active()):
            return
        wait = self._key_asked + KEY_SECONDS - self._clock.seconds()
        if wait > 0:
            self._key_timer = self._clock.callLater(wait, self._ask_for_key)
        else:
            self._ask_for_key()

    def _ask_for_key(self) -> None:
        if self._link is not None and self._unready:
            self._key_asked = self._clock.seconds()
            self._link.send(link.KeyFrame())

    # --- life ---------------------------------------------------------------------------------------------

    def _happen(self, event: Event) -> None:
        following = NEXT.get((self.state, event))
        if following is None:
            return
        before, self.state = self.state, following
        self.log.debug("stream {name}: {event}, now {state}", name=self.name, event=event, state=following)
        cancel(self._timer)
        self._timer = None
        if before in LINKED and following not in LINKED:
            self._leave_link(event)
        if following is State.OPENING:
            self._open_later(event)
        elif following is State.LINGERING:
            self._timer = self._clock.callLater(LINGER_SECONDS, self._happen, Event.SHUT)
        elif following is State.CLOSED:
            self._end(before)

    def _look_for_camera(self) -> None:
        names = {self.camera}
        if self.settings.transport == "compressed":
            # Some cameras publish nothing else; image_transport's users name them by their raw topic all the same.
            names.add(link.compressed_of(self.camera))
        if self.robot.control is not None and any(each.name in names for each in self.robot.cameras):
            self._happen(Event.CAMERA_THERE)

    def _open_later(self, event: Event) -> None:
        pause = 0.0
        if event is Event.LINK_LOST:
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
        self._timer = self._clock.callLater(JOIN_SECONDS, self._happen, Event.LATE)

    def _leave_link(self, event: Event) -> None:
        broken, self._link = self._link, None
        if broken is not None:
            broken.close(event.value)
        self.newest = self.told = None
        self._unready |= self.viewers
        cancel(self._key_timer)

    def _end(self, before: State) -> None:
        if before is not State.WAITING and self.robot.control is not None:
            self.robot.control.send(link.CloseVideo(stream=self.name))
        self.robot.watchers.remove(self)
        self._hooks.closed(self)
