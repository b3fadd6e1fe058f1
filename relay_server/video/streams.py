"""All camera streams of a relay: joining them, limits, and the tickets with which robots open them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from relay_protocol import link
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.common.clock import Clock
from relay_server.common.connection_ids import unused_name
from relay_server.common.token_bucket import TokenBucket
from relay_server.robots.registry import RobotState
from relay_server.robots.tickets import Tickets
from relay_server.video.errors import TooManyStreamStarts
from relay_server.video.stream import CameraStream, StreamCallbacks, StreamRequest, StreamState, ViewerPort

ROBOT_STREAMS = 16
"""Most streams of one robot, unless it offers fewer."""

USER_SHARE = 0.75
"""The share of these that one user may watch alone, rounded up. It leaves room for others when one user asks
for many sizes, or for cameras that do not exist."""

USER_VIEWERS = 32
"""Most viewers of one user on one robot, over all of their connections."""

STREAMS_A_SECOND = 2.0
STREAMS_AT_ONCE = 48
"""Streams of one robot that one user may start; the robot starts an encoder for each. A page with the most
cameras can be loaded four times at once, and again every six seconds."""

Key = tuple[int, str, link.VideoSettings]
"""Robot, camera and parameters: equal keys share one stream."""


class CameraStreams:
    """Opens streams on demand, and finds the stream that a robot's link belongs to.

    :param new_ticket: makes an unguessable text
    """

    def __init__(self, clock: Clock, *, new_ticket: Callable[[], str]) -> None:
        self._clock = clock
        self._streams: dict[Key, CameraStream] = {}
        self._tickets: Tickets[CameraStream] = Tickets(clock, new_ticket)
        self._callbacks = StreamCallbacks(self._tickets.issue, self._busy, self._left, self._forget)
        self._starts: dict[tuple[int, int], TokenBucket] = {}
        """By user and robot. Buckets are never dropped, so reconnecting does not refill them."""
        self._refused: CameraStream | None = None
        """The latest stream that the robot had no room for. Its end frees no room."""
        self._robots_to_assign: set[int] = set()
        """Ids of robots that may have room again, which is assigned in the next turn of the reactor."""

    def __iter__(self) -> Iterator[CameraStream]:
        return iter(list(self._streams.values()))

    def streams_of(self, robot: RobotState) -> list[CameraStream]:
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
        """Show a camera to a viewer, until it detaches or is notified that the stream has ended.

        Without room for another stream the viewer gets the nearest one, whose ``settings`` differ, and is
        moved as soon as there is room.

        :param newest: as in :class:`StreamRequest`
        :param first: as in :class:`StreamRequest`
        :raises Unavailable: there are too many streams or viewers
        :raises TooManyStreamStarts: the user starts streams too fast
        """
        watched = sum(
            each.user == viewer.user for stream in self.streams_of(robot) for each in stream.viewers
        )
        if watched >= USER_VIEWERS:
            raise Unavailable(
                f"you watch robot {robot.name} {watched} times already, the most that one user may"
            )
        stream = self._streams.get((robot.robot_id, camera, settings)) or self._open(
            robot, camera, settings, viewer.user
        )
        stream.attach(viewer, StreamRequest(settings, newest, first))
        return stream

    def redeem(self, ticket: str) -> CameraStream | None:
        """The stream that a ticket is for; it is used up. ``None`` if it is not for a stream."""
        return self._tickets.redeem(ticket)

    def close_streams(self, robot: RobotState, error: SwitchboardError) -> None:
        """End all streams of a robot.

        :param error: given to the viewers
        """
        for stream in self.streams_of(robot):
            stream.close(error)

    def close(self) -> None:
        """Shut down."""
        for stream in self:
            stream.close(Unavailable("the relay is going down"))

    def _open(self, robot: RobotState, camera: str, settings: link.VideoSettings, user: int) -> CameraStream:
        """A new stream, or the nearest one where no more are allowed."""
        here = self.streams_of(robot)
        most = min(robot.streams or ROBOT_STREAMS, ROBOT_STREAMS)
        alone = sum({each.user for each in stream.viewers} == {user} for stream in here)
        if alone >= math.ceil(most * USER_SHARE):
            return self._nearest_or_raise(
                robot,
                camera,
                settings,
                f"you watch {_streams(alone)} of robot {robot.name} alone; that leaves too little for others",
            )
        idle: CameraStream | None = None
        if len(here) >= most:
            idle = next((stream for stream in here if stream.state is StreamState.LINGERING), None)
            if idle is None:
                return self._nearest_or_raise(
                    robot,
                    camera,
                    settings,
                    f"robot {robot.name} has {_streams(most)} open, the most it can",
                )
        self._count_start(robot, user)
        if idle is not None:
            idle.close(Unavailable("another viewer needs this stream's place"))
        return self._new(robot, camera, settings)

    def _new(self, robot: RobotState, camera: str, settings: link.VideoSettings) -> CameraStream:
        name = unused_name(f"{robot.name}#video", (each.name for each in self))
        stream = CameraStream(self._clock, robot, camera, settings, name, self._callbacks)
        self._streams[robot.robot_id, camera, settings] = stream
        return stream

    def _count_start(self, robot: RobotState, user: int) -> None:
        """Count a start of a stream by a user.

        :raises TooManyStreamStarts: too many recently
        """
        bucket = self._starts.get((user, robot.robot_id))
        if bucket is None:
            bucket = TokenBucket(STREAMS_A_SECOND, STREAMS_AT_ONCE, self._clock.seconds)
            self._starts[user, robot.robot_id] = bucket
        if not bucket.take():
            raise TooManyStreamStarts(robot.name, bucket.wait)

    def _nearest_or_raise(
        self, robot: RobotState, camera: str, settings: link.VideoSettings, why: str
    ) -> CameraStream:
        """The nearest stream.

        :raises Unavailable: there is none
        """
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

    def _assign_requested(self, robot: RobotState) -> None:
        """Give viewers of other streams the ones they asked for, as far as there is room; recordings first."""
        self._robots_to_assign.discard(robot.robot_id)
        if robot.control_link is None:
            # Without a link the robot cannot be asked.
            return
        waiting = [
            (viewer, stream, request)
            for stream in self.streams_of(robot)
            for viewer, request in stream.requests.items()
            if request.settings != stream.settings
        ]
        for viewer, stream, request in sorted(waiting, key=lambda each: not each[2].first):
            key = (robot.robot_id, stream.camera, request.settings)
            try:
                found = self._streams.get(key) or self._open(
                    robot, stream.camera, request.settings, viewer.user
                )
            except Unavailable:
                continue
            if found.settings == request.settings:
                stream.move(viewer, found)
        for stream in self.streams_of(robot):
            if stream.viewers and not _is_requested(stream):
                self._replace_unrequested(stream)

    def _replace_unrequested(self, stream: CameraStream) -> None:
        """None of the viewers asked for this stream: one of them gets its own in this stream's place."""
        requests = stream.requests.values()
        fitting = (
            (viewer, request.settings)
            for viewer, request in sorted(stream.requests.items(), key=lambda each: not each[1].first)
            if all(_may_stand_for(request.settings, each.settings) for each in requests)
        )
        viewer, settings = next(fitting, (None, stream.settings))
        if viewer is None:
            return
        try:
            self._count_start(stream.robot, viewer.user)
        except TooManyStreamStarts:
            return
        found = self._new(stream.robot, stream.camera, settings)
        for each in list(stream.requests):
            stream.move(each, found)
        stream.close(Unavailable("another viewer needs this stream's place"))

    def _left(self, stream: CameraStream) -> None:
        if stream is not self._refused and not _is_requested(stream):
            self._assign_later(stream.robot)

    def _assign_later(self, robot: RobotState) -> None:
        """Assign free room in the next turn of the reactor, since the viewer that freed it may need it."""
        if robot.robot_id not in self._robots_to_assign:
            self._robots_to_assign.add(robot.robot_id)
            self._clock.callLater(0, self._assign_requested, robot)

    def _nearest(self, robot: RobotState, camera: str, settings: link.VideoSettings) -> CameraStream | None:
        """The stream of the same camera that is nearest in size, then in quality, then in frame rate.

        One with the same choice of a burned-in time is preferred. It is never rotated or cropped differently:
        an upside-down image misleads its driver.
        """
        wanted = _pixels(robot, camera, settings)

        def distance(stream: CameraStream) -> tuple[bool, int, int, float]:
            frame, its = stream.newest, stream.settings
            there = frame.width * frame.height if frame is not None else 0
            return (
                its.stamp != settings.stamp,
                abs(there - wanted),
                abs(its.quality - settings.quality),
                abs(_frame_seconds(its) - _frame_seconds(settings)),
            )

        shown = [
            stream
            for stream in self.streams_of(robot)
            if stream.camera == camera
            and stream.settings != settings
            and _view_of(stream.settings) == _view_of(settings)
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
            self._assign_later(robot)


def _streams(count: int) -> str:
    return f"{count} stream{'' if count == 1 else 's'}"


def _is_requested(stream: CameraStream) -> bool:
    """Whether any viewer asked for just this stream."""
    return any(request.settings == stream.settings for request in stream.requests.values())


def _may_stand_for(settings: link.VideoSettings, wanted: link.VideoSettings) -> bool:
    """Whether one stream may stand for another: another transport may be another topic, with rights of its
    own."""
    return settings.transport in ("", wanted.transport)


def _view_of(settings: link.VideoSettings) -> tuple[object, ...]:
    """Which part of the image is shown, and how it is rotated."""
    return settings.crop, settings.rotate, settings.invert


def _frame_seconds(settings: link.VideoSettings) -> float:
    """Seconds between frames; 0 when all frames were requested."""
    return 1 / settings.fps if settings.fps else 0.0


def _pixels(robot: RobotState, camera: str, settings: link.VideoSettings) -> int:
    """Pixels requested, as far as they are known here."""
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
