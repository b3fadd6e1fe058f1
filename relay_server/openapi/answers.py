"""What the API answers about robots: who is there, and who moves them (SPEC section 1.7)."""

from __future__ import annotations

from typing import Literal, NotRequired, TypedDict

RobotState = Literal["offline", "online", "in_use"]
Quality = Literal["", "good", "fair", "bad", "lost"]


class Me(TypedDict):
    """Who is logged in."""

    user: str
    admin: bool
    realm: str


Ticket = TypedDict(
    "Ticket",
    {"ticket": str, "expires_in": float, "robot": str, "for": Literal["robot", "video"], "camera": str},
)
Ticket.__doc__ = """A ticket for one use.

:param expires_in: seconds
"""


class Health(TypedDict):
    """That the relay and its database answer."""

    status: Literal["ok"]


class About(TypedDict):
    """What speaks at a robot's websocket."""

    product: str
    version: str
    protocol: str
    transport: str


# --- robots -----------------------------------------------------------------------------------------------


class Again(TypedDict):
    """That a stopped robot was stopped once more.

    :param since: Unix seconds
    """

    by: str
    why: str
    since: float


class Stopped(TypedDict):
    """That a robot is stopped.

    :param since: Unix seconds
    :param told: whether the robot has confirmed it
    :param again: the latest of those who have stopped it since
    """

    by: str
    why: str
    since: float
    told: bool
    again: Again | None


class ClientHere(TypedDict):
    """Who works with a robot or watches it.

    :param since: Unix seconds
    :param camera: empty for who does not watch
    """

    user: str
    since: float
    camera: str


class Hand(TypedDict):
    """A topic that somebody commands, or keeps quiet, without control of the robot.

    :param hold: whether it says its last value again and again
    """

    resource: str
    by: str
    hold: bool


class Robot(TypedDict):
    """A robot.

    :param level: what the caller may do with it
    :param people: how many users are at it
    :param holder: the user who moves it
    :param battery: charge, 0 to 1
    :param rtt_ms: round trip to it, milliseconds
    :param last_seen: Unix seconds
    """

    name: str
    description: str
    state: RobotState
    level: str
    clients: list[ClientHere]
    people: int
    holder: str | None
    stopped: Stopped | None
    suppressed: list[Hand]
    inhibited: list[Hand]
    battery: float | None
    rtt_ms: float | None
    quality: Quality
    host: str
    platform: str
    distro: str
    last_seen: float | None


class Robots(TypedDict):
    """A page of the robots the caller has a right on.

    :param next: the name behind which there is more, or empty
    """

    robots: list[Robot]
    next: str


class Link(TypedDict):
    """How good a way is; milliseconds, of the last 30 s.

    :param lost: seconds of these without an answer
    :param quality: of the last 5 s; empty where nobody knows yet
    """

    rtt_ms: float | None
    p95_ms: float | None
    jitter_ms: float | None
    lost: int
    quality: Quality


class Connection(TypedDict):
    """One connection of a user.

    :param client: its number
    :param since: Unix seconds
    :param drops: samples it did not take in time
    :param address: empty for all but owners
    """

    client: int
    since: float
    you: bool
    control: bool
    rtt_ms: float | None
    robot_rtt_ms: float | None
    quality: Quality
    drops: int
    address: str


class Watched(TypedDict):
    """A camera somebody watches."""

    camera: str
    since: float
    address: str


class Person(TypedDict):
    """A user who is at a robot."""

    user: str
    you: bool
    control: bool
    connections: list[Connection]
    watching: list[Watched]


class People(TypedDict):
    """Who is at a robot.

    :param drops: samples the robot has dropped since its daemon started
    :param battery: charge, 0 to 1
    :param more: connections and cameras that are left out
    """

    robot: str
    state: RobotState
    link: Link
    drops: int | None
    battery: float | None
    people: list[Person]
    more: int


# --- control ----------------------------------------------------------------------------------------------


class Holder(TypedDict):
    """Who moves a robot.

    :param implicit: whether a command took it
    """

    user: str
    client: int
    since: float
    you: bool
    implicit: bool


class ControlRequest(TypedDict):
    """Who asks to move it.

    :param until: Unix seconds from which an owner, or anybody from an implicit holder, takes over by asking again
    """

    user: str
    client: int
    since: float
    why: str
    you: bool
    until: float


class Suppressed(TypedDict):
    """A topic commanded by others than the holder.

    :param ms: milliseconds that are left
    """

    resource: str
    ms: int
    sources: list[int]
    by: str


class Inhibited(TypedDict):
    """A topic that says nothing, or its last value.

    :param ms: milliseconds that are left
    """

    resource: str
    ms: int
    hold: bool
    by: str


class SpeedLimits(TypedDict):
    """How fast a level may move the robot, in SI units; null is without a limit."""

    linear: float | None
    angular: float | None
    linear_acceleration: float | None
    angular_acceleration: float | None


class YouAndControl(TypedDict):
    """What the caller may do about control.

    :param client: the one of the caller's connections that has control
    """

    client: int | None
    may_control: bool
    may_resume: bool


class Control(TypedDict):
    """Who moves a robot.

    :param limits: by level
    """

    robot: str
    state: Literal["free", "held", "requested"]
    holder: Holder | None
    request: ControlRequest | None
    stopped: Stopped | None
    moving: bool
    suppressed: list[Suppressed]
    inhibited: list[Inhibited]
    limits: dict[str, SpeedLimits]
    you: YouAndControl


class ControlAnswer(TypedDict):
    """What became of it.

    :param message: for people
    """

    success: bool
    message: str


class ControlTaken(ControlAnswer):
    """What became of it; without success who has control is asked for it.

    :param message: for people
    :param kept: seconds for which it lasts when the caller asks for nothing more
    """

    kept: float
    control: Control


class StopAnswer(TypedDict):
    """How the robot stands now."""

    stopped: Stopped | None


class StopProblem(TypedDict):
    """A stop that the robot could not do whole."""

    type: str
    title: str
    status: int
    detail: str
    code: str
    stopped: NotRequired[Stopped | None]
