"""All streams of a relay: which there are, who may join one, and the tickets with which robots come."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

from relay_protocol import link
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.bucket import TokenBucket
from relay_server.clock import Clock
from relay_server.registry import Presence
from relay_server.tickets import Tickets
from relay_server.video.ends import TooOften, Viewer
from relay_server.video.states import State
from relay_server.video.stream import Hooks, Stream

ROBOT_STREAMS = 16
"""Most streams of one robot, if it does not say that it makes fewer."""

USER_SHARE = 0.75
"""Of these one user may watch so many alone: who asks for ever other sizes, or for cameras that are not there, leaves
room for others."""

USER_VIEWERS = 32
"""Most viewers of one user on one robot, over all his connections."""

STREAMS_A_SECOND = 2.0
STREAMS_AT_ONCE = 48
"""Streams of one robot that one user may begin: the robot makes an encoder for each. A page with as many cameras as
there may be can be loaded four times at once, and again every six seconds."""

Key = tuple[int, str, link.VideoSettings]
"""Robot, camera, and how it is wanted: what is equal is shown by one stream."""


class Videos:
    """Opens streams on demand and tells robots' joining links to which one they belong.

    :param new_ticket: makes an unguessable text
    """

    def __init__(self, clock: Clock, *, new_ticket: Callable[[], str]) -> None:
        self._clock = clock
        self._streams: dict[Key, Stream] = {}
        self._tickets: Tickets[Stream] = Tickets(clock, new_ticket)
        self._hooks = Hooks(self._tickets.issue, self._busy, self._forget)
        self._counter = itertools.count(1)
        self._begun: dict[tuple[int, int], TokenBucket] = {}
        """By user and robot. Each is kept for good: who comes back has what he has left."""

    def __iter__(self) -> Iterator[Stream]:
        return iter(list(self._streams.values()))

    def of(self, robot: Presence) -> list[Stream]:
        """The robot's streams, oldest first."""
        return [stream for stream in self if stream.robot is robot]

    def watch(self, robot: Presence, camera: str, settings: link.VideoSettings, viewer: Viewer) -> Stream:
        """Have a camera shown to a viewer, until he detaches from the stream or is told that it has ended.

        :raises Unavailable: too many are shown or watch already
        :raises TooOften: the user begins new ones too fast
        """
        watched = sum(each.user == viewer.user for stream in self.of(robot) for each in stream.viewers)
        if watched >= USER_VIEWERS:
            raise Unavailable(f"you watch robot {robot.name} {watched} times already")
        stream = self._streams.get((robot.robot_id, camera, settings)) or self._place(
            robot, camera, settings, viewer.user
        )
        stream.attach(viewer)
        return stream

    def redeem(self, ticket: str) -> Stream | None:
        """The stream a ticket is for, and the ticket is spent; ``None`` when it is not for a stream."""
        return self._tickets.redeem(ticket)

    def end(self, robot: Presence, error: SwitchboardError) -> None:
        """End all streams of a robot.

        :param error: what the viewers are told
        """
        for stream in self.of(robot):
            stream.shut(error)

    def shut(self) -> None:
        """The relay is going down."""
        for stream in self:
            stream.shut(Unavailable("the relay is going down"))

    def _place(self, robot: Presence, camera: str, settings: link.VideoSettings, user: int) -> Stream:
        """A new stream, or the nearest one where no more may be."""
        here = self.of(robot)
        most = min(robot.streams or ROBOT_STREAMS, ROBOT_STREAMS)
        alone = sum({each.user for each in stream.viewers} == {user} for stream in here)
        if alone >= max(1, int(most * USER_SHARE)):
            return self._instead(
                robot, camera, settings, f"you have {alone} streams of robot {robot.name} to yourself"
            )
        idle: Stream | None = None
        if len(here) >= most:
            idle = next((stream for stream in here if stream.state is State.LINGERING), None)
            if idle is None:
                return self._instead(
                    robot,
                    camera,
                    settings,
                    f"robot {robot.name} shows {most} streams already, the most it can",
                )
        self._count(robot, user)
        if idle is not None:
            idle.shut(Unavailable("others need the place"))
        name = f"{robot.name}#video{next(self._counter)}"
        stream = Stream(self._clock, robot, camera, settings, name, self._hooks)
        self._streams[robot.robot_id, camera, settings] = stream
        return stream

    def _count(self, robot: Presence, user: int) -> None:
        """Note that a user begins a stream.

        :raises TooOften: not one more at present
        """
        bucket = self._begun.get((user, robot.robot_id))
        if bucket is None:
            bucket = TokenBucket(STREAMS_A_SECOND, STREAMS_AT_ONCE, self._clock.seconds)
            self._begun[user, robot.robot_id] = bucket
        if not bucket.take():
            raise TooOften(robot.name, bucket.wait)

    def _instead(self, robot: Presence, camera: str, settings: link.VideoSettings, why: str) -> Stream:
        """What is nearest to a stream that can't be, or the reason."""
        nearest = self._nearest(robot, camera, settings)
        if nearest is None:
            raise Unavailable(why)
        return nearest

    def _busy(self, stream: Stream) -> None:
        nearest = self._nearest(stream.robot, stream.camera, stream.settings)
        if nearest is not None:
            stream.move(nearest)

    def _nearest(self, robot: Presence, camera: str, settings: link.VideoSettings) -> Stream | None:
        """The stream of a camera that is nearest in size, rather one that has the time burned in, or not, as wished.

        Never one that is turned or cropped otherwise: an upside-down picture misleads who drives by it.
        """
        wanted = _pixels(robot, camera, settings)

        def distance(stream: Stream) -> tuple[bool, int]:
            picture = stream.newest
            there = picture.width * picture.height if picture is not None else 0
            return stream.settings.stamp != settings.stamp, abs(there - wanted)

        shown = [
            stream
            for stream in self.of(robot)
            if stream.camera == camera
            and stream.settings != settings
            and _part(stream.settings) == _part(settings)
            and stream.settings.codec == settings.codec
            # Another transport may be another topic, with rights of its own.
            and stream.settings.transport in ("", settings.transport)
            and stream.newest is not None
        ]
        return min(shown, key=distance, default=None)

    def _forget(self, stream: Stream) -> None:
        del self._streams[stream.robot.robot_id, stream.camera, stream.settings]
        self._tickets.withdraw(stream)


def _part(settings: link.VideoSettings) -> tuple[object, ...]:
    """What of the camera's picture is shown, and how it is turned."""
    return settings.crop, settings.rotate, settings.invert


def _pixels(robot: Presence, camera: str, settings: link.VideoSettings) -> int:
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
