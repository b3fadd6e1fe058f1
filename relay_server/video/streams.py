"""All streams of a relay: which there are, who may join one, and the tickets with which robots come."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from relay_protocol import link
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.common.clock import Clock
from relay_server.common.connection_ids import name_of
from relay_server.common.token_bucket import TokenBucket
from relay_server.robots.registry import RobotState
from relay_server.robots.tickets import Tickets
from relay_server.video.ports import StreamRequest, TooManyStreamStarts, ViewerPort
from relay_server.video.stream import CameraStream, StreamCallbacks, StreamState

ROBOT_STREAMS = 16
"""Most streams of one robot, if it does not say that it makes fewer."""

USER_SHARE = 0.75
"""Of these one user may watch so many alone, rounded up: who asks for ever other sizes, or for cameras that are not
there, leaves room for others."""

USER_VIEWERS = 32
"""Most viewers of one user on one robot, over all his connections."""

STREAMS_A_SECOND = 2.0
STREAMS_AT_ONCE = 48
"""Streams of one robot that one user may begin: the robot makes an encoder for each. A page with as many cameras as
there may be can be loaded four times at once, and again every six seconds."""

Key = tuple[int, str, link.VideoSettings]
"""Robot, camera, and how it is wanted: what is equal is shown by one stream."""


class CameraStreams:
    """Opens streams on demand and tells robots' joining links to which one they belong.

    :param new_ticket: makes an unguessable text
    """

    def __init__(self, clock: Clock, *, new_ticket: Callable[[], str]) -> None:
        self._clock = clock
        self._streams: dict[Key, CameraStream] = {}
        self._tickets: Tickets[CameraStream] = Tickets(clock, new_ticket)
        self._hooks = StreamCallbacks(self._tickets.issue, self._busy, self._left, self._forget)
        self._begun: dict[tuple[int, int], TokenBucket] = {}
        """By user and robot. Each is kept for good: who comes back has what he has left."""
        self._refused: CameraStream | None = None
        """The latest that the robot had no place for: that it is over makes no place either."""
        self._free: set[int] = set()
        """Ids of robots that may have a place again, which is given away in the next turn."""

    def __iter__(self) -> Iterator[CameraStream]:
        return iter(list(self._streams.values()))

    def of(self, robot: RobotState) -> list[CameraStream]:
        """The robot's streams, oldest first."""
        return [stream for stream in self if stream.robot is robot]

    def watch(
        self,
        robot: RobotState,
        camera: str,
        settings: link.VideoSettings,
        viewer: ViewerPort,
        *,
        newest: bool = False,
        first: bool = False,
    ) -> CameraStream:
        """Have a camera shown to a viewer, until he detaches from the stream or is told that it has ended.

        Where one more stream can't be it is the nearest there is, which its ``settings`` tell; he is moved as soon as
        there is a place.

        :param newest: as in :class:`StreamRequest`
        :param first: as in :class:`StreamRequest`
        :raises Unavailable: too many are shown or watch already
        :raises TooOften: the user begins new ones too fast
        """
        watched = sum(each.user == viewer.user for stream in self.of(robot) for each in stream.viewers)
        if watched >= USER_VIEWERS:
            raise Unavailable(f"you watch robot {robot.name} {watched} times already")
        stream = self._streams.get((robot.robot_id, camera, settings)) or self._place(
            robot, camera, settings, viewer.user
        )
        stream.attach(viewer, StreamRequest(settings, newest, first))
        return stream

    def redeem(self, ticket: str) -> CameraStream | None:
        """The stream a ticket is for, and the ticket is spent; ``None`` when it is not for a stream."""
        return self._tickets.redeem(ticket)

    def end(self, robot: RobotState, error: SwitchboardError) -> None:
        """End all streams of a robot.

        :param error: what the viewers are told
        """
        for stream in self.of(robot):
            stream.shut(error)

    def shut(self) -> None:
        """The relay is going down."""
        for stream in self:
            stream.shut(Unavailable("the relay is going down"))

    def _place(self, robot: RobotState, camera: str, settings: link.VideoSettings, user: int) -> CameraStream:
        """A new stream, or the nearest one where no more may be."""
        here = self.of(robot)
        most = min(robot.streams or ROBOT_STREAMS, ROBOT_STREAMS)
        alone = sum({each.user for each in stream.viewers} == {user} for stream in here)
        if alone >= math.ceil(most * USER_SHARE):
            return self._instead(
                robot, camera, settings, f"you have {_streams(alone)} of robot {robot.name} to yourself"
            )
        idle: CameraStream | None = None
        if len(here) >= most:
            idle = next((stream for stream in here if stream.state is StreamState.LINGERING), None)
            if idle is None:
                return self._instead(
                    robot,
                    camera,
                    settings,
                    f"robot {robot.name} shows {_streams(most)} already, the most it can",
                )
        self._count(robot, user)
        if idle is not None:
            idle.shut(Unavailable("others need the place"))
        return self._new(robot, camera, settings)

    def _new(self, robot: RobotState, camera: str, settings: link.VideoSettings) -> CameraStream:
        name = name_of(f"{robot.name}#video", (each.name for each in self))
        stream = CameraStream(self._clock, robot, camera, settings, name, self._hooks)
        self._streams[robot.robot_id, camera, settings] = stream
        return stream

    def _count(self, robot: RobotState, user: int) -> None:
        """Note that a user begins a stream.

        :raises TooOften: not one more at present
        """
        bucket = self._begun.get((user, robot.robot_id))
        if bucket is None:
            bucket = TokenBucket(STREAMS_A_SECOND, STREAMS_AT_ONCE, self._clock.seconds)
            self._begun[user, robot.robot_id] = bucket
        if not bucket.take():
            raise TooManyStreamStarts(robot.name, bucket.wait)

    def _instead(
        self, robot: RobotState, camera: str, settings: link.VideoSettings, why: str
    ) -> CameraStream:
        """What is nearest to a stream that can't be, or the reason."""
        nearest = self._nearest(robot, camera, settings)
        if nearest is None:
            raise Unavailable(why)
        return nearest

    def _busy(self, stream: CameraStream) -> None:
        self._refused = stream
        nearest = self._nearest(stream.robot, stream.camera, stream.settings)
        if nearest is not None:
            for viewer in list(stream.viewers):
                stream.move(viewer, nearest)

    def _give_away(self, robot: RobotState) -> None:
        """Who is shown another form than he asked for gets that, as far as there is room; recordings first."""
        self._free.discard(robot.robot_id)
        if robot.control is None:
            # Whether there is a place it can't be asked.
            return
        waiting = [
            (viewer, stream, wish)
            for stream in self.of(robot)
            for viewer, wish in stream.wishes.items()
            if wish.settings != stream.settings
        ]
        for viewer, stream, wish in sorted(waiting, key=lambda each: not each[2].first):
            key = (robot.robot_id, stream.camera, wish.settings)
            try:
                found = self._streams.get(key) or self._place(
                    robot, stream.camera, wish.settings, viewer.user
                )
            except Unavailable:
                continue
            if found.settings == wish.settings:
                stream.move(viewer, found)
        for stream in self.of(robot):
            if stream.viewers and not _asked_for(stream):
                self._replace(stream)

    def _replace(self, stream: CameraStream) -> None:
        """None of those who are shown it asked for it: one of them gets what he asked for in its place."""
        wishes = stream.wishes.values()
        fitting = (
            (viewer, wish.settings)
            for viewer, wish in sorted(stream.wishes.items(), key=lambda each: not each[1].first)
            if all(_may_stand_for(wish.settings, each.settings) for each in wishes)
        )
        viewer, settings = next(fitting, (None, stream.settings))
        if viewer is None:
            return
        try:
            self._count(stream.robot, viewer.user)
        except TooManyStreamStarts:
            return
        found = self._new(stream.robot, stream.camera, settings)
        for each in list(stream.wishes):
            stream.move(each, found)
        stream.shut(Unavailable("others need the place"))

    def _left(self, stream: CameraStream) -> None:
        if stream is not self._refused and not _asked_for(stream):
            self._look_for_places(stream.robot)

    def _look_for_places(self, robot: RobotState) -> None:
        """Give away what there is in the next turn, and not at once: who has just freed a place may need it."""
        if robot.robot_id not in self._free:
            self._free.add(robot.robot_id)
            self._clock.callLater(0, self._give_away, robot)

    def _nearest(self, robot: RobotState, camera: str, settings: link.VideoSettings) -> CameraStream | None:
        """The stream of a camera that is nearest in size, then in quality, then in the time between two pictures.

        Rather one that has the time burned in, or not, as wished. Never one that is turned or cropped otherwise: an
        upside-down picture misleads who drives by it.
        """
        wanted = _pixels(robot, camera, settings)

        def distance(stream: CameraStream) -> tuple[bool, int, int, float]:
            picture, its = stream.newest, stream.settings
            there = picture.width * picture.height if picture is not None else 0
            return (
                its.stamp != settings.stamp,
                abs(there - wanted),
                abs(its.quality - settings.quality),
                abs(_pause(its) - _pause(settings)),
            )

        shown = [
            stream
            for stream in self.of(robot)
            if stream.camera == camera
            and stream.settings != settings
            and _part(stream.settings) == _part(settings)
            and stream.settings.codec == settings.codec
            and _may_stand_for(stream.settings, settings)
            and stream.newest is not None
        ]
        return min(shown, key=distance, default=None)

    def _forget(self, stream: CameraStream) -> None:
        robot = stream.robot
        del self._streams[robot.robot_id, stream.camera, stream.settings]
        self._tickets.withdraw(stream)
        if stream is not self._refused:
            self._look_for_places(robot)


def _streams(count: int) -> str:
    return f"{count} stream{'' if count == 1 else 's'}"


def _asked_for(stream: CameraStream) -> bool:
    """Whether anybody who is shown it asked for just that."""
    return any(wish.settings == stream.settings for wish in stream.wishes.values())


def _may_stand_for(settings: link.VideoSettings, wanted: link.VideoSettings) -> bool:
    """Whether who wants the one may be shown the other: another transport may be another topic, with its own rights."""
    return settings.transport in ("", wanted.transport)


def _part(settings: link.VideoSettings) -> tuple[object, ...]:
    """What of the camera's picture is shown, and how it is turned."""
    return settings.crop, settings.rotate, settings.invert


def _pause(settings: link.VideoSettings) -> float:
    """Seconds between two pictures; 0 where all there are were asked for."""
    return 1 / settings.fps if settings.fps else 0.0


def _pixels(robot: RobotState, camera: str, settings: link.VideoSettings) -> int:
    """How many are wanted, as far as can be known here."""
    whole = next(((each.width, each.height) for each in robot.cameras if each.name == camera), (0, 0))
    width, height = settings.crop[2:] if any(settings.crop) else whole
    if settings.rotate in (90, 270):
        width, height = height, width
    if settings.width and settings.height:
        return settings.width * settings.height
    if settings.width:
        return settings.width**2 * height // max(width, 1)
    if settings.height:
        return settings.height**2 * width // max(height, 1)
    return width * height
