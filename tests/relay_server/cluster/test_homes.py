"""Homes of robots, and links that end because the robot has a newer one at another relay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from twisted.internet.defer import Deferred, succeed
from twisted.internet.task import Clock

from relay_db.queries import HomeRelayRecord
from relay_protocol.errors import Unavailable
from relay_server.cluster.bus import LocalBus
from relay_server.cluster.homes import READ_SECONDS, ClusterHomes
from relay_server.cluster.relays import RelayInfo
from relay_server.robots.registry import RobotRegistry


class FakeDatabase:
    """The homes of robots that all relays share."""

    def __init__(self) -> None:
        self.homes: dict[int, HomeRelayRecord] = {}
        self.slow: Deferred[None] = succeed(None)
        """Delays the answer to the next claim."""

    async def read(self, query: Any) -> list[HomeRelayRecord]:
        assert query.__name__ == "home_relays"
        return list(self.homes.values())

    async def write(self, query: Any, robot: int, relay: str, *more: Any) -> int | None:
        known, epoch = self.homes.get(robot, HomeRelayRecord(robot, "", 0)), more
        if query.__name__ == "reclaim_home_relay":
            if (known.relay, known.epoch) != ("", *epoch):
                return None
            self.homes[robot] = HomeRelayRecord(robot, relay, known.epoch + 1)
            return known.epoch + 1
        if query.__name__ == "_claim":
            (connected,) = more
            if not connected():
                raise Unavailable("the robot has disconnected")
            self.homes[robot] = HomeRelayRecord(robot, relay, known.epoch + 1)
            slow, self.slow = self.slow, succeed(None)
            await slow
            return known.epoch + 1
        if (known.relay, known.epoch) == (relay, *epoch):
            self.homes[robot] = HomeRelayRecord(robot, "", known.epoch)
        return None


class FakeLink:
    """A robot's control link at one relay.

    :ivar answers: called if the robot still answers after the link was closed
    """

    answers: Callable[[], None] | None = None

    def close_replaced(self, reason: str, answers: Callable[[], None]) -> None:
        assert reason == "the robot has connected to another relay"
        self.answers = answers


class Relays:
    """All relays live."""

    def find(self, relay: str) -> RelayInfo:
        return RelayInfo(relay, f"{relay}.example.org", 9092, "1.0", 1.0)


class Member:
    """One relay of a cluster, with one robot."""

    def __init__(self, name: str, clock: Clock, database: Any, bus: LocalBus) -> None:
        relays: Any = Relays()
        robots = RobotRegistry(lambda: 1000.0)
        self.robot = robots.robot(1, "rover", "main")
        self.homes = ClusterHomes(clock, database, robots, bus, relays, name)
        self.reported: list[tuple[str, str, str]] = []
        """Robots whose key is used twice, with the newer and the older address."""
        self.homes.on_key_used_twice = lambda robot, newer, older: self.reported.append(
            (robot.name, newer, older)
        )
        Deferred.fromCoroutine(self.homes.start())

    def connect(self, address: str) -> Any:
        """The robot connects here."""
        link: Any = FakeLink()
        Deferred.fromCoroutine(self.homes.connecting(self.robot, address))
        self.robot.control_link, self.robot.address = link, address
        return link


@pytest.mark.parametrize(
    ("bus_works", "newer"), [(True, "192.0.2.2"), (False, "unknown address at relay two.example.org")]
)
def test_a_link_that_answers_after_the_robot_connected_to_another_relay_is_reported(
    bus_works: bool, newer: str
) -> None:
    """A link that ends without an answer is not. Without the bus, the database shows the new home later."""
    clock, database = Clock(), FakeDatabase()
    bus = LocalBus(clock)
    first = Member("one", clock, database, bus)
    second = Member("two", clock, database, bus if bus_works else LocalBus(clock))
    older = first.connect("192.0.2.1")
    clock.advance(0)
    link = second.connect("192.0.2.2")
    clock.advance(0 if bus_works else READ_SECONDS)
    assert older.answers is not None
    assert first.reported == []
    older.answers()
    assert first.reported == [("rover", newer, "192.0.2.1")]
    assert (link.answers, second.reported) == (None, [])
    elsewhere = first.homes.elsewhere(1)
    assert elsewhere is not None
    assert elsewhere.id == "two"
    assert [first.homes.other(each) for each in ("two", "one", "")] == [elsewhere, None, None]
    assert second.homes.elsewhere(1) is None
    for each in (first, second):
        each.homes.stop()


def test_a_relay_that_learns_late_that_it_was_the_home_does_not_register_the_robot() -> None:
    """The robot has connected to another relay meanwhile, which all know."""
    clock, database = Clock(), FakeDatabase()
    bus = LocalBus(clock)
    first, second = (Member(name, clock, database, bus) for name in ("one", "two"))
    slow = database.slow = Deferred()
    connecting = Deferred.fromCoroutine(first.homes.connecting(first.robot, "192.0.2.1"))
    second.connect("192.0.2.2")
    clock.advance(0)
    slow.callback(None)
    errors: list[Any] = []
    connecting.addErrback(errors.append)
    assert [each.type for each in errors] == [Unavailable]
    # Registered nevertheless, by another connection of that time: the next read closes it, once.
    link: Any = FakeLink()
    first.robot.control_link = link
    clock.advance(READ_SECONDS)
    assert link.answers is not None
    link.answers = None
    clock.advance(READ_SECONDS)
    assert link.answers is None
    for each in (first, second):
        each.homes.stop()


def test_a_robot_that_has_gone_is_not_taken_from_the_relay_that_it_is_connected_to() -> None:
    clock, database = Clock(), FakeDatabase()
    bus = LocalBus(clock)
    first, second = (Member(name, clock, database, bus) for name in ("one", "two"))
    link = first.connect("192.0.2.1")
    claimed = Deferred.fromCoroutine(second.homes.connecting(second.robot, "192.0.2.1", lambda: False))
    errors: list[Any] = []
    claimed.addErrback(errors.append)
    assert [each.type for each in errors] == [Unavailable]
    # The connection to the second relay was recorded, and ended before it was registered.
    database.homes[1] = HomeRelayRecord(1, "", 2)
    clock.advance(READ_SECONDS)
    assert (link.answers, database.homes[1]) == (None, HomeRelayRecord(1, "one", 3))
    clock.advance(0)
    elsewhere = second.homes.elsewhere(1)
    assert elsewhere is not None and elsewhere.id == "one"
    for each in (first, second):
        each.homes.stop()


def test_a_robot_keeps_its_home_while_it_is_being_registered() -> None:
    """Its stored stop is read after the home was recorded. One that is never registered is given up later."""
    clock, database = Clock(), FakeDatabase()
    member = Member("one", clock, database, LocalBus(clock))
    Deferred.fromCoroutine(member.homes.connecting(member.robot, "192.0.2.1"))
    clock.advance(READ_SECONDS)
    assert database.homes[1] == HomeRelayRecord(1, "one", 1)
    for _ in range(5):
        clock.advance(READ_SECONDS)
    assert database.homes[1] == HomeRelayRecord(1, "", 1)
    member.homes.stop()
