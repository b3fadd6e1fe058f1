"""What the API answers about resources, goals, events, orders and tokens (SPEC sections 1.11 to 1.14)."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict

from relay_protocol.link import VideoSettings

RobotState = Literal["offline", "online", "in_use"]
Quality = Literal["", "good", "fair", "bad", "lost"]


class CurrentUser(TypedDict):
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


class HealthInfo(TypedDict):
    """That the relay and its database answer."""

    status: Literal["ok"]


class ServerInfo(TypedDict):
    """What speaks at a robot's websocket."""

    product: str
    version: str
    protocol: str
    transport: str


# --- robots -----------------------------------------------------------------------------------------------


class RepeatedStopInfo(TypedDict):
    """That a stopped robot was stopped once more.

    :param since: Unix seconds
    """

    by: str
    why: str
    since: float


class StopInfo(TypedDict):
    """That a robot is stopped.

    :param since: Unix seconds
    :param told: whether the robot has confirmed it
    :param again: the latest of those who have stopped it since
    """

    by: str
    why: str
    since: float
    told: bool
    again: RepeatedStopInfo | None


class ClientInfo(TypedDict):
    """Who works with a robot or watches it.

    :param since: Unix seconds
    :param camera: empty for who does not watch
    """

    user: str
    since: float
    camera: str


class OverrideInfo(TypedDict):
    """A topic that somebody commands, or keeps quiet, without control of the robot.

    :param hold: whether it says its last value again and again
    """

    resource: str
    by: str
    hold: bool


class RobotInfo(TypedDict):
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
    clients: list[ClientInfo]
    people: int
    holder: str | None
    stopped: StopInfo | None
    suppressed: list[OverrideInfo]
    inhibited: list[OverrideInfo]
    battery: float | None
    rtt_ms: float | None
    quality: Quality
    host: str
    platform: str
    distro: str
    last_seen: float | None


class RobotPage(TypedDict):
    """A page of the robots the caller has a right on.

    :param next: the name behind which there is more, or empty
    """

    robots: list[RobotInfo]
    next: str


class LinkQualityInfo(TypedDict):
    """How good a way is; milliseconds, of the last 30 s.

    :param lost: seconds of these without an answer
    :param quality: of the last 5 s; empty where nobody knows yet
    """

    rtt_ms: float | None
    p95_ms: float | None
    jitter_ms: float | None
    lost: int
    quality: Quality


class ConnectionInfo(TypedDict):
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


class ViewedCamera(TypedDict):
    """A camera somebody watches."""

    camera: str
    since: float
    address: str


class RobotUser(TypedDict):
    """A user who is at a robot."""

    user: str
    you: bool
    control: bool
    connections: list[ConnectionInfo]
    watching: list[ViewedCamera]


class RobotUsers(TypedDict):
    """Who is at a robot.

    :param drops: samples the robot has dropped since its daemon started
    :param battery: charge, 0 to 1
    :param more: connections and cameras that are left out
    """

    robot: str
    state: RobotState
    link: LinkQualityInfo
    drops: int | None
    battery: float | None
    people: list[RobotUser]
    more: int


# --- control ----------------------------------------------------------------------------------------------


class HolderInfo(TypedDict):
    """Who moves a robot.

    :param implicit: whether a command took it
    """

    user: str
    client: int
    since: float
    you: bool
    implicit: bool


class ControlRequestInfo(TypedDict):
    """Who asks to move it.

    :param until: Unix seconds from which an owner, or anybody from an implicit holder, takes over by asking again
    """

    user: str
    client: int
    since: float
    why: str
    you: bool
    until: float


class SuppressionInfo(TypedDict):
    """A topic commanded by others than the holder.

    :param ms: milliseconds that are left
    """

    resource: str
    ms: int
    sources: list[int]
    by: str


class InhibitionInfo(TypedDict):
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


class ControlInfo(TypedDict):
    """Who moves a robot.

    :param limits: by level
    """

    robot: str
    state: Literal["free", "held", "requested"]
    holder: HolderInfo | None
    request: ControlRequestInfo | None
    stopped: StopInfo | None
    moving: bool
    suppressed: list[SuppressionInfo]
    inhibited: list[InhibitionInfo]
    limits: dict[str, SpeedLimits]
    you: YouAndControl


class ControlAnswer(TypedDict):
    """What became of it.

    :param message: for people
    """

    success: bool
    message: str


class ControlTakeInfo(ControlAnswer):
    """What became of it; without success who has control is asked for it.

    :param message: for people
    :param kept: seconds for which it lasts when the caller asks for nothing more
    """

    kept: float
    control: ControlInfo


class StopAnswer(TypedDict):
    """How the robot stands now."""

    stopped: StopInfo | None


class StopProblem(TypedDict):
    """A stop that the robot could not do whole."""

    type: str
    title: str
    status: int
    detail: str
    code: str
    stopped: NotRequired[StopInfo | None]


Severity = Literal["info", "warning", "error"]


class Acknowledged(TypedDict):
    """Who looks after an alert, since when (Unix seconds)."""

    by: str
    at: float


class AlertInfo(TypedDict):
    """What people should know of a robot (SPEC section 1.10).

    :param first: Unix seconds it was told first
    :param last: Unix seconds it was told last
    :param over: Unix seconds, or null while it lasts
    :param news: counts what is worth telling
    :param notify: whether the caller's rules for the portal want it shown
    """

    id: str
    robot: str
    kind: str
    about: str
    level: Severity
    text: str
    first: float
    last: float
    count: int
    state: Literal["open", "over"]
    over: float | None
    acknowledged: Acknowledged | None
    may_acknowledge: bool
    news: int
    notify: bool


class AlertPage(TypedDict):
    """A page of alerts, the latest first.

    :param next: what goes on after these as ``before``
    """

    alerts: list[AlertInfo]
    next: str | None


QuietHours = TypedDict("QuietHours", {"from": str, "to": str, "zone": str, "least": str})


class RuleStatus(TypedDict):
    """What was told by a rule.

    :param last: Unix seconds of the last message
    """

    sent: int
    failed: int
    reason: str
    last: float | None


class RuleInfo(TypedDict):
    """A rule by which the caller is told of alerts.

    :param url: as far as its host or scheme
    :param secret: where the relay made it, this once
    """

    id: int
    label: str
    robots: str
    kinds: list[str]
    level: str
    channel: str
    url: str
    over: bool
    group_s: float
    quiet: QuietHours | None
    status: RuleStatus
    secret: NotRequired[str]


class RuleList(TypedDict):
    """The caller's rules, and what a rule may say here."""

    rules: list[RuleInfo]
    kinds: list[str]
    levels: list[str]
    channels: list[str]
    schemes: list[str]


class Tested(TypedDict):
    """Whether a message arrived, and why not."""

    ok: bool
    reason: str


# --- recordings and cameras -------------------------------------------------------------------------------


class RecordingInfo(TypedDict):
    """A recording.

    :param begun: Unix seconds
    :param ended: Unix seconds
    :param lasted: seconds so far, or in all
    :param megabytes: most that the file may have
    """

    id: str
    robot: str
    user: str
    topics: list[str]
    cameras: list[str]
    begun: float
    ended: float | None
    lasted: float | None
    state: Literal["recording", "finishing", "complete", "incomplete", "recovered"]
    reason: str
    seconds: float
    megabytes: float
    bytes: int
    messages: int
    drops: int
    problems: list[str]


class RecordingPage(TypedDict):
    """A page of recordings, the latest first."""

    recordings: list[RecordingInfo]
    next: str | None


class Recordable(TypedDict):
    """What the caller could record now.

    :param denied: why it is nothing
    :param megabytes: what all recordings of the realm may have together
    :param full: why there can't be one more
    """

    topics: list[str]
    cameras: list[str]
    denied: str
    megabytes: float
    left: float
    full: str


class ShownStream(TypedDict):
    """How a camera is shown now."""

    viewers: int
    state: str
    settings: VideoSettings
    playing: dict[str, Any] | None


class CameraInfo(TypedDict):
    """A camera; what it is like is null before somebody watched.

    :param seen: Unix seconds at the robot when it was like this
    """

    name: str
    type: str
    encoding: str | None
    width: int | None
    height: int | None
    fps: float | None
    seen: float | None
    streams: list[ShownStream]


class CameraList(TypedDict):
    """The cameras the caller may view."""

    cameras: list[CameraInfo]


GoalState = Literal["active", "cancelling", "succeeded", "canceled", "aborted", "refused"]


class TopicInfo(TypedDict):
    """A topic; publishers and subscribers are nodes.

    :param moves: whether it moves the robot
    """

    name: str
    types: list[str]
    publishers: NotRequired[list[str]]
    subscribers: NotRequired[list[str]]
    moves: bool


class Provided(TypedDict):
    """A service or an action; providers are nodes.

    :param moves: whether it moves the robot
    """

    name: str
    types: list[str]
    providers: NotRequired[list[str]]
    moves: bool


class TopicPage(TypedDict):
    """A page of topics.

    :param next: the name behind which there is more, or empty
    """

    topics: list[TopicInfo]
    next: str
    online: bool


class ServicePage(TypedDict):
    """A page of services.

    :param next: the name behind which there is more, or empty
    """

    services: list[Provided]
    next: str
    online: bool


class ActionPage(TypedDict):
    """A page of actions.

    :param next: the name behind which there is more, or empty
    """

    actions: list[Provided]
    next: str
    online: bool


class ParamName(TypedDict):
    """A parameter: ``<node>:<parameter>``."""

    name: str


class ParamPage(TypedDict):
    """A page of parameters.

    :param next: the name behind which there is more, or empty
    """

    params: list[ParamName]
    next: str


class NodeInfo(TypedDict):
    """A node in the robot's graph.

    :param publishes: topics
    :param subscribes: topics
    """

    name: str
    publishes: list[str]
    subscribes: list[str]
    services: list[str]


class NodePage(TypedDict):
    """A page of modules.

    :param next: the name behind which there is more, or empty
    """

    modules: list[NodeInfo]
    next: str
    online: bool


class TopicMessage(TypedDict):
    """The newest message of a topic.

    :param at: Unix seconds when the relay got it
    """

    topic: str
    type: str
    at: float
    value: Any


class ParamValue(TypedDict):
    """A parameter and its value."""

    name: str
    value: Any


class CallAnswer(TypedDict):
    """What a service answered."""

    values: Any


class GoalSummary(TypedDict):
    """A goal.

    :param reason: why it did not succeed
    :param begun: Unix seconds
    :param ended: Unix seconds
    """

    id: str
    action: str
    type: str
    state: GoalState
    reason: str | None
    begun: float
    ended: float | None


class GoalInfo(GoalSummary):
    """A goal with how far it came and what came of it."""

    feedback: Any
    result: Any


class GoalPage(TypedDict):
    """A page of the caller's own goals.

    :param next: the goal behind which there is more, or empty
    """

    goals: list[GoalSummary]
    next: str


class EventInfo(TypedDict):
    """Something that happened (SPEC section 1.14).

    :param at: Unix seconds
    :param used: how often a query has given it
    """

    id: int
    source: str
    kind: str
    robot: str | None
    user: str | None
    at: float
    data: dict[str, Any]
    used: int


class EventPage(TypedDict):
    """Events, the newest first.

    :param next: goes into ``after`` of the next request
    """

    events: list[EventInfo]
    next: str | None


class EventsKept(TypedDict):
    """Events as they were kept."""

    events: list[EventInfo]


class EventCount(TypedDict):
    """How many events match.

    :param next: there may be more, to be counted by what has this as its ``after``
    """

    count: int
    next: str | None


class RobotGroupInfo(TypedDict):
    """A group of robots, with those the caller has a right on."""

    name: str
    robots: list[str]


class RobotGroupList(TypedDict):
    """Groups of robots."""

    groups: list[RobotGroupInfo]


class TokenInfo(TypedDict):
    """A token (RFC 6749 section 5.1).

    :param expires_in: seconds
    """

    access_token: str
    token_type: Literal["Bearer"]
    expires_in: int
    scope: NotRequired[str]
    refresh_token: NotRequired[str]


class TokenForm(TypedDict, total=False):
    """What is sent for a token."""

    grant_type: Literal["password", "client_credentials", "refresh_token"]
    username: str
    password: str
    refresh_token: str
    scope: str
    realm: str
    client_id: str
    client_secret: str


class AboutToken(TypedDict):
    """The token that is asked about; and, if they are not sent otherwise, key and secret of the program that asks."""

    token: str
    client_id: NotRequired[str]
    client_secret: NotRequired[str]


class Introspection(TypedDict):
    """What is left of a token (RFC 7662).

    :param iat: Unix seconds
    :param exp: Unix seconds
    :param expires_in: seconds
    """

    active: bool
    token_type: NotRequired[str]
    username: NotRequired[str]
    sub: NotRequired[str]
    realm: NotRequired[str]
    iat: NotRequired[int]
    scope: NotRequired[str]
    client_id: NotRequired[str]
    exp: NotRequired[int]
    expires_in: NotRequired[int]


class Nothing(TypedDict):
    """An empty object."""


class OAuthProblem(TypedDict):
    """An error in the words of RFC 6749 section 5.2, which are problem details, too."""

    type: str
    title: str
    status: int
    detail: str
    error: str
    error_description: str


class Available(TypedDict):
    """An error that names the media types there are."""

    type: str
    title: str
    status: int
    detail: str
    code: str
    available: list[str]
