"""Users and connections on a robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from relay_protocol.rights import Grant, Level, Rules
from relay_server.robots.link_quality import UNKNOWN, LinkQuality
from relay_server.robots.registry import RobotState
from relay_server.sessions.presence import (
    CACHE_SECONDS,
    MAX_LISTED,
    PresenceReader,
    PresenceService,
    client_rows,
    visible_clients,
)
from tests.worlds.relay import Time


@dataclass
class Client:
    """A connection."""

    number: int
    name: str
    since: float
    address: str = "192.0.2.1"
    drops: int = 0
    asked: int = 0

    def link_quality(self) -> LinkQuality:
        """50 ms."""
        self.asked += 1
        return LinkQuality(rtt=0.05, recent_rtt=0.05, quality="good")


@dataclass(frozen=True)
class Viewer:
    """A camera viewer."""

    name: str
    camera: str
    address: str = "192.0.2.2"


class MemoryRobotLink:
    """A robot's link."""

    def send(self, message: object) -> None:
        """Not used."""

    def close(self, reason: str) -> None:
        """Not used."""

    def link_quality(self) -> LinkQuality:
        """250 ms."""
        return LinkQuality(rtt=0.25, recent_rtt=0.25, quality="fair")


class ControlWorld:
    """A robot with connected users."""

    def __init__(self, time: Time) -> None:
        self.robot = RobotState(1, "rover", "default", control_link=MemoryRobotLink())
        self.clients: list[Client] = []
        self.holder = 0
        self.people = PresenceService(lambda robot_id: self.clients, lambda robot: self.holder, time)

    def reported(self, asker: PresenceReader) -> list[dict[str, Any]]:
        """The users; the list must be complete."""
        people, more = self.people.users(self.robot, asker)
        assert more == 0
        return people


@pytest.fixture
def scene(time: Time) -> ControlWorld:
    """A robot without clients."""
    return ControlWorld(time)


def asker(
    level: Level = Level.VIEWER, *deny: str, user: str = "ann", connection: int | None = None
) -> PresenceReader:
    """A user with a right on the robot."""
    return PresenceReader(user, Rules([Grant(level, (), deny)]), connection)


def test_users_are_listed_with_their_connections(scene: ControlWorld) -> None:
    """Ordered by arrival; each connection has its round trip, and that to the robot."""
    scene.clients = [Client(3, "bob", 30.0), Client(5, "ann", 40.0, drops=7), Client(6, "bob", 50.0)]
    scene.holder = 5
    bob, ann = scene.reported(asker(connection=5))
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


def test_by_http_all_connections_of_the_asker_are_its_own(scene: ControlWorld) -> None:
    """A websocket knows which one it is."""
    scene.clients = [Client(1, "ann", 1.0), Client(2, "ann", 2.0)]
    (ann,) = scene.reported(asker())
    assert [each["you"] for each in ann["connections"]] == [True, True]
    (ann,) = scene.reported(asker(connection=2))
    assert [each["you"] for each in ann["connections"]] == [False, True]


def test_addresses_are_for_owners(scene: ControlWorld) -> None:
    """This applies to connections and to camera viewers."""
    scene.clients = [Client(1, "bob", 1.0)]
    scene.robot.viewers[Viewer("bob", "/camera")] = 2.0
    for level, shown in ((Level.VIEWER, ("", "")), (Level.OWNER, ("192.0.2.1", "192.0.2.2"))):
        (bob,) = scene.reported(asker(level))
        assert (bob["connections"][0]["address"], bob["watching"][0]["address"]) == shown


def test_viewer_gets_the_addresses_of_the_camera(scene: ControlWorld) -> None:
    """A camera without the right to view is hidden by name and by number."""
    scene.robot.viewers |= {Viewer("bob", "/camera"): 2.0, Viewer("eve", "/vault"): 1.0}
    may_not = asker(Level.VIEWER, "view:/vault")
    assert [(each["user"], each["watching"][0]["camera"]) for each in scene.reported(may_not)] == [
        ("bob", "/camera")
    ]
    assert [each["user"] for each in scene.reported(asker())] == ["eve", "bob"]
    rows = client_rows(scene.robot, [])
    assert [each["camera"] for each in visible_clients(rows, may_not.rules)] == ["/camera"]
    assert [each["camera"] for each in visible_clients(rows, asker().rules)] == ["/camera", "/vault"]


def test_a_long_list_of_connected_users_is_cut(scene: ControlWorld) -> None:
    """The rest is counted, and the controller is always listed."""
    scene.clients = [
        Client(number, f"user{number}", float(number)) for number in range(1, 2 * MAX_LISTED + 1)
    ]
    scene.robot.viewers[Viewer("ann", "/camera")] = 0.0
    scene.holder = 2 * MAX_LISTED
    people, more = scene.people.users(scene.robot, asker())
    assert sum(len(each["connections"]) for each in people) == MAX_LISTED
    assert more == MAX_LISTED + 1
    assert [each["user"] for each in people if each["control"]] == [f"user{2 * MAX_LISTED}"]


def test_concurrent_callers_share_a_result(scene: ControlWorld, time: Time) -> None:
    """Connections are measured once for many callers, and again after some time or when a user joins."""
    one = Client(1, "ann", 1.0)
    scene.clients = [one]
    for _ in range(10):
        scene.reported(asker())
    assert one.asked == 1
    time.now += CACHE_SECONDS
    scene.reported(asker())
    assert one.asked == 2
    scene.clients = [one, Client(2, "bob", 2.0)]
    assert len(scene.reported(asker())) == 2
    scene.clients = []
    assert scene.reported(asker()) == []


def test_a_robot_without_a_link_has_no_round_trip(scene: ControlWorld) -> None:
    """Its round trip is unknown then."""
    scene.clients = [Client(1, "ann", 1.0)]
    scene.robot.control_link = None
    (ann,) = scene.reported(asker())
    assert ann["connections"][0]["robot_rtt_ms"] is None
    assert scene.robot.link_quality().quality == "lost"
    assert UNKNOWN.quality == ""
