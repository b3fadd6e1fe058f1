"""What a channel's parts share: the link to the robot, when there is one, and numbers for what goes over it."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from typing import NamedTuple, Protocol

from twisted.internet.defer import Deferred

from relay_protocol import limits, link, rosbridge
from relay_protocol.errors import Invalid
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.robots.registry import RobotState

NAMES = 4096
"""Topics subscribed or advertised, and services and actions offered, on one robot at a time."""

USER_TOPICS = 256
"""Topics of one robot that one user may have subscribed, and again advertised, over all connections."""

ASKS = 64
"""Requests to a robot that may be without an answer at a time."""

ASK_SECONDS = 5.0
"""A request without an answer for so long no longer holds up others."""

_NAME = re.compile(r"/[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*\Z")


class ChannelPort(Protocol):
    """The robot's end of a channel."""

    def send(self, message: link.Message) -> None:
        """Queue a message that must not be lost.

        :raises Unavailable: it is a call, a goal or an answer, and too much waits for a slow robot already
        """

    def sample(self, number: int, stamp: int, body: bytes) -> None:
        """Queue a sample; the newest survive."""

    def command(self, number: int, stamp: int, source: int, body: bytes) -> None:
        """The same of a command, with the connection it comes from (SPEC section 2.5)."""

    def newest(self, key: str, message: link.Message) -> None:
        """Queue a message of which, under one key, only the newest must survive."""

    def close(self, reason: str) -> None:
        """Say ``bye`` and end the connection."""

    def round_trip(self) -> Deferred[float]:
        """Ping the robot; seconds, or a failure when the link ends first."""


class Subscriber(Protocol):
    """A session, as a channel uses it."""

    @property
    def user(self) -> int:
        """Whose it is: what one person may ask of a robot is bounded over all of his connections."""

    def tell(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Report something in words, to clients that want to hear it."""


class Publisher(Subscriber, Protocol):
    """A member that publishes, calls and pursues goals.

    :ivar number: which connection it is, by which the robot knows who moves it
    """

    number: int


class MotionRequestPort(Protocol):
    """A call or a goal that moves the robot."""

    async def controls(self) -> None:
        """Wait until who asks for it controls the robot.

        :raises Refused: somebody else does, or it may be too old by now
        :raises Unavailable: the robot does not agree
        """

    def judge(self) -> None:
        """See that it is not too old by now.

        :raises Refused: it may be
        """


class RequestContext(NamedTuple):
    """What goes with a call or a goal on its way to the robot.

    :param source: the connection it comes from
    :param stamp: the relay's monotonic nanoseconds before which it can't have been sent
    :param movement: where it moves the robot
    """

    source: int
    stamp: int | None = None
    movement: MotionRequestPort | None = None

    async def controls(self) -> None:
        """Wait until it may move the robot, if it does; see :meth:`MotionRequestPort.controls`."""
        if self.movement is not None:
            await self.movement.controls()

    def judge(self) -> None:
        """See that it may still be sent; see :meth:`MotionRequestPort.judge`."""
        if self.movement is not None:
            self.movement.judge()


class SessionPort(Subscriber, Protocol):
    """A member that has come for somebody, who may not hear everything."""

    def judge_again(self) -> None:
        """The robot's topics or cameras are others: what may be heard is judged anew."""


Key = tuple[str, int | str]
"""What a request is about: its op, and the number or name it concerns."""


class Request(NamedTuple):
    """A request to the robot.

    :param key: what it is about; a newer one about the same replaces one that waits
    :param sent: called when it goes out
    """

    key: Key
    message: link.Message
    sent: Callable[[], None]


class RequestQueue:
    """Requests to the robot, a bounded number under way at a time, so that no client can flood its link.

    :param send: puts one on the link
    """

    def __init__(self, clock: Clock, send: Callable[[link.Message], None]) -> None:
        self._clock = clock
        self._send = send
        self._under_way: dict[Key, float] = {}
        self._waiting: dict[Key, Request] = {}
        self._timer: Timer | None = None

    def ask(self, ask: Request) -> None:
        """Send it, now or when its turn comes."""
        if ask.key in self._under_way or len(self._under_way) >= ASKS:
            self._waiting[ask.key] = ask
            self._look_later()
        else:
            self._put(ask)

    def answered(self, key: Key) -> None:
        """The robot has answered, one way or the other."""
        if self._under_way.pop(key, None) is not None:
            self._go_on()

    def withdraw(self, key: Key) -> bool:
        """Don't ask any more; whether the robot knows of it already."""
        waited = self._waiting.pop(key, None) is not None
        return not waited or key in self._under_way

    def reset(self) -> None:
        """The link is gone."""
        self._under_way.clear()
        self._waiting.clear()
        cancel(self._timer)
        self._timer = None

    def _put(self, ask: Request) -> None:
        self._under_way[ask.key] = self._clock.seconds()
        self._send(ask.message)
        ask.sent()

    def _go_on(self) -> None:
        for key in list(self._waiting):
            if len(self._under_way) >= ASKS:
                break
            if key not in self._under_way:
                self._put(self._waiting.pop(key))

    def _look_later(self) -> None:
        if self._timer is None:
            self._timer = self._clock.callLater(ASK_SECONDS, self._look)

    def _look(self) -> None:
        """A robot that leaves a request without an answer must not hold up the others."""
        self._timer = None
        oldest = self._clock.seconds() - ASK_SECONDS
        self._under_way = {key: since for key, since in self._under_way.items() if since > oldest}
        self._go_on()
        if self._waiting:
            self._look_later()


class RobotLinkState:
    """The open link to the robot, or none, and what names and numbers are in use on it."""

    def __init__(self, clock: Clock, robot: RobotState) -> None:
        self.clock = clock
        self.robot = robot
        self.link: ChannelPort | None = None
        self.asks = RequestQueue(clock, self.send)
        self.names = 0
        self._numbers = itertools.count(1)

    @property
    def cdr(self) -> bool:
        """Whether bodies go as CDR; else as JSON."""
        return "cdr" in self.robot.encodings

    def number(self) -> int:
        """A fresh number for a subscription or publication.

        :raises Invalid: too many topics are in use on this robot
        """
        self.take_name()
        return next(self._numbers)

    def take_name(self) -> None:
        """One more name is in use.

        :raises Invalid: too many are
        """
        if self.names >= NAMES:
            raise Invalid(f"more than {NAMES} names are in use on this robot")
        self.names += 1

    def send(self, message: link.Message) -> None:
        """Send if there is a link; what matters is sent again when one opens.

        :raises Unavailable: see :meth:`ChannelPort.send`
        """
        if self.link is not None:
            self.link.send(message)


def resolve(name: str) -> str:
    """The full name of a topic or service as a client wrote it, with or without its leading slash.

    :raises Invalid: no name ROS 2 could have (design.ros2.org, topic and service names)
    """
    full = name if name.startswith("/") else "/" + name
    if len(full) > limits.NAME or not _NAME.match(full):
        raise Invalid(
            f"'{name[:80]}' is no ROS name: letters, digits and '_' between slashes, "
            f"no part beginning with a digit, at most {limits.NAME} characters"
        )
    return full
