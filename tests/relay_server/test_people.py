"""Who is at a robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from relay_protocol.rights import Grant, Level, Rules
from relay_server.robots.link_quality import UNKNOWN, LinkQuality
from relay_server.robots.registry import RobotState
from relay_server.sessions.presence import FRESH_SECONDS, TOLD, PresenceReader, PresenceService, client_rows
from tests.relay_server.memory import Time


@dataclass
class Client:
    """One connection."""

    number: int
    name: str
    since: float
    address: str = "192.0.2.1"
    drops: int = 0
    asked: int = 0

    def reading(self) -> LinkQuality:
        """Fifty milliseconds."""
        self.asked += 1
        return LinkQuality(rtt=0.05, lately=0.05, quality="good")


@dataclass(frozen=True)
class Viewer:
    """Somebody who watches a camera."""

    name: str
    camera: str
    address: str = "192.0.2.2"


class Far:
    """A robot's link."""

    def send(self, message: object) -> None:
        """Nobody looks."""

    def close(self, reason: str) -> None:
        """Nobody looks."""

    def reading(self) -> LinkQuality:
        """A quarter of a second."""
        return LinkQuality(rtt=0.25, lately=0.25, quality="fair")


class Place:
    """A robot with people at it."""

    def __init__(self, time: Time) -> None:
        self.robot = RobotState(1, "rover", "default", control=Far())
        self.clients: list[Client] = []
        self.holder = 0
        self.people = PresenceService(lambda robot_id: self.clients, lambda robot: self.holder, time)

    def told(self, asker: PresenceReader) -> list[dict[str, Any]]:
        """The people, where none is left out."""
        people, more = self.people.told(self.robot, asker)
        assert more == 0
        return people


@pytest.fixture
def place(time: Time) -> Place:
    """Nobody is there yet."""
    return Place(time)


def asker(
    level: Level = Level.VIEWER, *deny: str, user: str = "ann", connection: int | None = None
) -> PresenceReader:
    """Somebody with a right on the robot."""
    return PresenceReader(user, Rules([Grant(level, (), deny)]), connection)


def test_people_come_by_user_with_their_connections(place: Place) -> None:
    """Who came first stands first; each connection with how far it is, and how far the robot is from there."""
    place.clients = [Client(3, "bob", 30.0), Client(5, "ann", 40.0, drops=7), Client(6, "bob", 50.0)]
    place.holder = 5
    bob, ann = place.told(asker(connection=5))
    assert (bob["user"], bob["you"], bob["control"]) == ("bob", False, False)
    assert [each["client"] for each in bob["connections"]] == [3, 6]
    assert (ann["user"], ann["you"], ann["control"]) == ("ann", True, True)
    assert ann["connections"] == [
        {
            "client": 5,
            "since": 40.0,
            "you": True,
            "control": True,
            "rtt_ms": 50.0,
            "robot_rtt_ms": 300.0,
            "quality": "good",
            "drops": 7,
            "address": "",
        }
    ]


def test_by_http_all_connections_of_the_asker_are_its_own(place: Place) -> None:
    """A connection knows which one it is."""
    place.clients = [Client(1, "ann", 1.0), Client(2, "ann", 2.0)]
    (ann,) = place.told(asker())
    assert [each["you"] for each in ann["connections"]] == [True, True]
    (ann,) = place.told(asker(connection=2))
    assert [each["you"] for each in ann["connections"]] == [False, True]


def test_addresses_are_for_owners(place: Place) -> None:
    """Of connections and of those who watch."""
    place.clients = [Client(1, "bob", 1.0)]
    place.robot.onlookers[Viewer("bob", "/camera")] = 2.0
    for level, shown in ((Level.VIEWER, ("", "")), (Level.OWNER, ("192.0.2.1", "192.0.2.2"))):
        (bob,) = place.told(asker(level))
        assert (bob["connections"][0]["address"], bob["watching"][0]["address"]) == shown


def test_who_watches_is_told_where_the_camera_may_be_seen(place: Place) -> None:
    """Nobody learns of a camera he may not view, neither by name nor by number."""
    place.robot.onlookers |= {Viewer("bob", "/camera"): 2.0, Viewer("eve", "/vault"): 1.0}
    may_not = asker(Level.VIEWER, "view:/vault")
    assert [(each["user"], each["watching"][0]["camera"]) for each in place.told(may_not)] == [
        ("bob", "/camera")
    ]
    assert [each["user"] for each in place.told(asker())] == ["eve", "bob"]
    assert place.people.count(place.robot, may_not.rules) == 1
    assert place.people.count(place.robot, asker().rules) == 2
    assert [each["camera"] for each in client_rows(place.robot, [], may_not.rules)] == ["/camera"]


def test_a_crowd_is_told_in_part(place: Place) -> None:
    """How many there are beside it, and always who holds control."""
    place.clients = [Client(number, f"user{number}", float(number)) for number in range(1, 2 * TOLD + 1)]
    place.robot.onlookers[Viewer("ann", "/camera")] = 0.0
    place.holder = 2 * TOLD
    people, more = place.people.told(place.robot, asker())
    assert sum(len(each["connections"]) for each in people) == TOLD
    assert more == TOLD + 1
    assert [each["user"] for each in people if each["control"]] == [f"user{2 * TOLD}"]
    assert place.people.count(place.robot, asker().rules) == 2 * TOLD + 1


def test_what_was_found_out_serves_all_who_ask_at_a_time(place: Place, time: Time) -> None:
    """Connections are measured once for many askers, and anew when time has gone by or somebody came."""
    one = Client(1, "ann", 1.0)
    place.clients = [one]
    for _ in range(10):
        place.told(asker())
    assert one.asked == 1
    time.now += FRESH_SECONDS
    place.told(asker())
    assert one.asked == 2
    place.clients = [one, Client(2, "bob", 2.0)]
    assert len(place.told(asker())) == 2
    place.clients = []
    assert place.told(asker()) == []


def test_a_robot_without_a_link_is_no_way_to(place: Place) -> None:
    """Then nobody knows how far it is from a connection."""
    place.clients = [Client(1, "ann", 1.0)]
    place.robot.control = None
    (ann,) = place.told(asker())
    assert ann["connections"][0]["robot_rtt_ms"] is None
    assert place.robot.reading().quality == "lost"
    assert UNKNOWN.quality == ""
