"""Who is at a robot: users with their connections, and who watches which of its cameras (SPEC section 1.7)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, Protocol

from relay_protocol.rights import Level, Operation, Rules
from relay_server.robots.link_quality import LinkQuality, joined, milliseconds
from relay_server.robots.registry import CameraViewers, RobotState

TOLD = 100
"""Most connections and watched cameras of one robot that are told."""

FRESH_SECONDS = 0.5
"""What was found out about connections is good for so long: everybody who is told asks once a second."""


def client_rows(robot: RobotState, sessions: Iterable[ConnectedClient], rules: Rules) -> list[dict[str, Any]]:
    """Who works with a robot, and who watches those of its cameras that somebody with these rights may view."""
    found = [{"user": each.name, "since": each.since, "camera": ""} for each in sessions]
    found += [
        {"user": each.name, "since": since, "camera": each.camera}
        for each, since in robot.onlookers.items()
        if _may_see(rules, each)
    ]
    return found


class ConnectedClient(Protocol):
    """One connection of a client: a session, as far as this goes."""

    @property
    def number(self) -> int:
        """What it is known by as long as the relay runs."""

    @property
    def address(self) -> str:
        """Where the client is."""

    @property
    def since(self) -> float:
        """Unix time it came."""

    @property
    def name(self) -> str:
        """The user's."""

    @property
    def drops(self) -> int:
        """Samples it did not take in time."""

    def reading(self) -> LinkQuality:
        """How good the way to the client is."""


class ConnectionSummary(NamedTuple):
    """The connections to a robot as they are told, the same for many askers. What it holds is never changed.

    :param at: when they were looked at, monotonic seconds
    :param numbers: of all connections there were
    :param holder: the number of the one that had control, 0 for none
    :param people: by user, who came first standing first; nobody is "you" yet
    """

    at: float
    numbers: list[int]
    holder: int
    people: dict[str, dict[str, Any]]


class PresenceReader(NamedTuple):
    """Who is told.

    :param user: its name
    :param rules: its rights on the robot
    :param connection: number of its connection; ``None``: all of the user are its own
    """

    user: str
    rules: Rules
    connection: int | None


class PresenceService:
    """Tells who is at which robot.

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
        self._crowds: dict[tuple[int, bool], ConnectionSummary] = {}

    def told(self, robot: RobotState, asker: PresenceReader) -> tuple[list[dict[str, Any]], int]:
        """Who is at a robot, by user, who came first standing first; and how many connections are left out."""
        owner = asker.rules.level is Level.OWNER
        crowd = self._crowd(robot, owner)
        people = dict(crowd.people)
        if asker.user in people:
            people[asker.user] = _yourself(people[asker.user], asker)
        watched = [(each, at) for each, at in robot.onlookers.items() if _may_see(asker.rules, each)]
        count = len(crowd.numbers)
        room = max(0, TOLD - count)
        for onlooker, since in watched[:room]:
            # A new one each time: what the crowd holds is for others too.
            person = people.get(onlooker.name) or _person(onlooker.name) | {
                "you": onlooker.name == asker.user
            }
            sight = {"camera": onlooker.camera, "since": since, "address": onlooker.address if owner else ""}
            people[onlooker.name] = {**person, "watching": [*person["watching"], sight]}
        more = max(0, count - TOLD) + max(0, len(watched) - room)
        return (sorted(people.values(), key=_since) if watched else list(people.values())), more

    def count(self, robot: RobotState, rules: Rules) -> int:
        """How many users are at a robot, for somebody with these rights."""
        users = {each.name for each in self._sessions(robot.robot_id)}
        return len(users | {each.name for each in robot.onlookers if _may_see(rules, each)})

    def _crowd(self, robot: RobotState, owner: bool) -> ConnectionSummary:
        """The connections to a robot; looked at once for all who ask at a time."""
        key, now, holder = (robot.robot_id, owner), self._seconds(), self._holder(robot)
        sessions = list(self._sessions(robot.robot_id))
        numbers = [each.number for each in sessions]
        known = self._crowds.get(key)
        if (
            known is not None
            and now - known.at < FRESH_SECONDS
            and known.holder == holder
            and known.numbers == numbers
        ):
            return known
        crowd = ConnectionSummary(now, numbers, holder, _by_user(sessions, robot.reading(), holder, owner))
        if numbers:
            self._crowds[key] = crowd
        else:
            self._crowds.pop(key, None)
        return crowd


def _by_user(
    sessions: list[ConnectedClient], onward: LinkQuality, holder: int, owner: bool
) -> dict[str, dict[str, Any]]:
    """Users with their connections, as many as are told; who holds control is, however many there are."""
    told = sorted(sessions, key=lambda each: each.number != holder)[:TOLD]
    people: dict[str, dict[str, Any]] = {}
    for each in told:
        person = people.setdefault(each.name, _person(each.name))
        person["control"] = person["control"] or each.number == holder
        person["connections"].append(_connection(each, onward, each.number == holder, owner))
    return {each["user"]: each for each in sorted(people.values(), key=_since)}


def _person(user: str) -> dict[str, Any]:
    return {"user": user, "you": False, "control": False, "connections": [], "watching": []}


def _connection(session: ConnectedClient, onward: LinkQuality, control: bool, owner: bool) -> dict[str, Any]:
    link = session.reading()
    return {
        "client": session.number,
        "since": session.since,
        "you": False,
        "control": control,
        "rtt_ms": milliseconds(link.rtt),
        "robot_rtt_ms": milliseconds(joined(link, onward).rtt),
        "quality": link.quality,
        "drops": session.drops,
        "address": session.address if owner else "",
    }


def _yourself(person: dict[str, Any], asker: PresenceReader) -> dict[str, Any]:
    """The person as he himself is told."""
    connections = [
        {**each, "you": asker.connection is None or each["client"] == asker.connection}
        for each in person["connections"]
    ]
    return {**person, "you": True, "connections": connections}


def _may_see(rules: Rules, onlooker: CameraViewers) -> bool:
    return rules.judge(Operation.VIEW, onlooker.camera).allowed


def _since(person: dict[str, Any]) -> float:
    """When the first of a user's connections came, or when it began to watch."""
    return float(min(each["since"] for each in (*person["connections"], *person["watching"])))
