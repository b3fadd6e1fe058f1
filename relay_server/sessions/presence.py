"""Robots and their users, as the HTTP API answers with them.

Users of a robot with their connections, and viewers of its cameras (SPEC 1.7).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple, Protocol, TypedDict

from relay_protocol.rights import Level, Operation, Rules
from relay_server.control.view import OverrideInfo, StopInfo
from relay_server.robots.link_quality import LinkQuality, LinkQualityInfo, Quality, joined, milliseconds
from relay_server.robots.registry import RobotState

AvailabilityName = Literal["offline", "online", "in_use"]


class ClientInfo(TypedDict):
    """A client of a robot, or a viewer of one of its cameras.

    :param since: Unix seconds at which it connected
    :param camera: empty for a client
    """

    user: str
    since: float
    camera: str


class RobotFacts(TypedDict):
    """What is known of a robot, whoever asks; see :class:`RobotInfo`."""

    state: AvailabilityName
    clients: list[ClientInfo]
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


class RobotInfo(RobotFacts):
    """A robot, as far as the caller may know of it.

    :param level: level of the caller's rights
    :param people: number of its users and viewers
    :param holder: the user who has control of it
    :param battery: charge, 0 to 1
    :param rtt_ms: round trip to it, milliseconds
    :param last_seen: Unix seconds
    """

    name: str
    description: str
    level: Level
    people: int


class RobotPage(TypedDict):
    """A page of the robots on which the caller has a right.

    :param next: ``after`` of the next page, or empty
    """

    robots: list[RobotInfo]
    next: str


class RobotsUpdate(TypedDict):
    """The live update ``robots``: all robots on which the caller has a right."""

    robots: list[RobotInfo]


class ConnectionInfo(TypedDict):
    """One connection of a user.

    :param client: number of the connection
    :param since: Unix seconds at which it connected
    :param drops: samples dropped because the client did not read in time
    :param address: network address; empty unless the caller is an owner
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
    """A camera that a user views."""

    camera: str
    since: float
    address: str


class RobotUser(TypedDict):
    """A user of a robot."""

    user: str
    you: bool
    control: bool
    connections: list[ConnectionInfo]
    watching: list[ViewedCamera]


class RobotUsers(TypedDict):
    """The users of a robot.

    :param drops: samples that the robot has dropped since its daemon started
    :param battery: charge, 0 to 1
    :param more: number of connections and views that are left out
    """

    robot: str
    state: AvailabilityName
    link: LinkQualityInfo
    drops: int | None
    battery: float | None
    people: list[RobotUser]
    more: int


MAX_LISTED = 100
"""Most connections and camera viewers of one robot that are listed."""

CACHE_SECONDS = 0.5
"""Seconds for which a summary of connections is reused: each reader asks once a second."""


def client_rows(robot: RobotState, sessions: Iterable[ConnectedClient]) -> list[ClientInfo]:
    """The clients of a robot, and the viewers of its cameras."""
    found = [ClientInfo(user=each.name, since=each.since, camera="") for each in sessions]
    viewers = robot.viewers.items()
    return found + [ClientInfo(user=each.name, since=since, camera=each.camera) for each, since in viewers]


def visible_clients(clients: Iterable[ClientInfo], rules: Rules) -> list[ClientInfo]:
    """The clients without the viewers of cameras that a reader with these rights may not view."""
    return [each for each in clients if not each["camera"] or _may_view(rules, each["camera"])]


class ConnectedClient(Protocol):
    """One connection of a client, as it is listed."""

    @property
    def number(self) -> int:
        """Number of the connection, unique in this relay."""

    @property
    def address(self) -> str:
        """Network address of the client."""

    @property
    def since(self) -> float:
        """Unix seconds at which it connected."""

    @property
    def name(self) -> str:
        """Name of its user."""

    @property
    def drops(self) -> int:
        """Samples dropped because the client did not read in time."""

    def link_quality(self) -> LinkQuality:
        """The quality of the link to the client."""


class ConnectionSummary(NamedTuple):
    """The connections to a robot, shared by many readers and never changed.

    :param at: when it was made, monotonic seconds
    :param numbers: numbers of all connections
    :param holder: number of the connection that had control, 0 for none
    :param people: entries by user, the first to connect first; no user is marked as "you" yet
    """

    at: float
    numbers: list[int]
    holder: int
    people: dict[str, RobotUser]


class PresenceReader(NamedTuple):
    """The reader of a list.

    :param user: its name
    :param rules: its rights on the robot
    :param connection: number of its connection; ``None``: all connections of the user count as its own
    """

    user: str
    rules: Rules
    connection: int | None


class PresenceService:
    """Lists the users of robots.

    :param sessions: the open sessions of a robot by its id, oldest first
    :param holder: the number of the connection that has control of a robot, 0 for none
    :param seconds: a monotonic clock
    """

    def __init__(
        self,
        sessions: Callable[[int], Iterable[ConnectedClient]],
        holder: Callable[[RobotState], int],
        seconds: Callable[[], float],
    ) -> None:
        self._sessions = sessions
        self._holder = holder
        self._seconds = seconds
        self._summaries: dict[tuple[int, bool], ConnectionSummary] = {}

    def users(self, robot: RobotState, reader: PresenceReader) -> tuple[list[RobotUser], int]:
        """Users of a robot, the first to connect first; and the number of connections and viewers left out."""
        owner = reader.rules.level is Level.OWNER
        summary = self._summary(robot, owner)
        people = dict(summary.people)
        if reader.user in people:
            people[reader.user] = _own_entry(people[reader.user], reader)
        watched = [(each, at) for each, at in robot.viewers.items() if _may_view(reader.rules, each.camera)]
        count = len(summary.numbers)
        room = max(0, MAX_LISTED - count)
        for viewer, since in watched[:room]:
            # A new entry, since the summary is shared with other readers.
            entry = people.get(viewer.name) or _user_entry(viewer.name, you=viewer.name == reader.user)
            address = viewer.address if owner else ""
            view = ViewedCamera(camera=viewer.camera, since=since, address=address)
            people[viewer.name] = {**entry, "watching": [*entry["watching"], view]}
        more = max(0, count - MAX_LISTED) + max(0, len(watched) - room)
        return (sorted(people.values(), key=_since) if watched else list(people.values())), more

    def _summary(self, robot: RobotState, owner: bool) -> ConnectionSummary:
        """The connections to a robot, summarised once for all readers within :data:`CACHE_SECONDS`."""
        key, now, holder = (robot.robot_id, owner), self._seconds(), self._holder(robot)
        sessions = list(self._sessions(robot.robot_id))
        numbers = [each.number for each in sessions]
        known = self._summaries.get(key)
        if (
            known is not None
            and now - known.at < CACHE_SECONDS
            and known.holder == holder
            and known.numbers == numbers
        ):
            return known
        summary = ConnectionSummary(
            now, numbers, holder, _by_user(sessions, robot.link_quality(), holder, owner)
        )
        if numbers:
            self._summaries[key] = summary
        else:
            self._summaries.pop(key, None)
        return summary


def _by_user(
    sessions: list[ConnectedClient], robot_link: LinkQuality, holder: int, owner: bool
) -> dict[str, RobotUser]:
    """Users with their connections, at most :data:`MAX_LISTED`; the holder of control is always listed."""
    listed = sorted(sessions, key=lambda each: each.number != holder)[:MAX_LISTED]
    people: dict[str, RobotUser] = {}
    for each in listed:
        entry = people.setdefault(each.name, _user_entry(each.name))
        entry["control"] = entry["control"] or each.number == holder
        entry["connections"].append(_connection(each, robot_link, each.number == holder, owner))
    return {each["user"]: each for each in sorted(people.values(), key=_since)}


def _user_entry(user: str, *, you: bool = False) -> RobotUser:
    return {"user": user, "you": you, "control": False, "connections": [], "watching": []}


def _connection(
    session: ConnectedClient, robot_link: LinkQuality, control: bool, owner: bool
) -> ConnectionInfo:
    link = session.link_quality()
    return {
        "client": session.number,
        "since": session.since,
        "you": False,
        "control": control,
        "rtt_ms": milliseconds(link.rtt),
        "robot_rtt_ms": milliseconds(joined(link, robot_link).rtt),
        "quality": link.quality,
        "drops": session.drops,
        "address": session.address if owner else "",
    }


def _own_entry(entry: RobotUser, reader: PresenceReader) -> RobotUser:
    """The entry of the reader's own user."""
    connections: list[ConnectionInfo] = [
        {**each, "you": reader.connection is None or each["client"] == reader.connection}
        for each in entry["connections"]
    ]
    return {**entry, "you": True, "connections": connections}


def _may_view(rules: Rules, camera: str) -> bool:
    return rules.decide(Operation.VIEW, camera).allowed


def _since(entry: RobotUser) -> float:
    """Unix seconds of a user's first connection or view."""
    times = [each["since"] for each in entry["connections"]]
    return min(times + [each["since"] for each in entry["watching"]])
