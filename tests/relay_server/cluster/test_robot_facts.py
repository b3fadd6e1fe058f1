"""What lists show of robots that are connected to another relay."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from twisted.internet.task import Clock

from relay_server.cluster.bus import LocalBus
from relay_server.cluster.relays import RelayInfo
from relay_server.cluster.robot_facts import (
    FORGET_SECONDS,
    MOST_BYTES,
    PERIOD,
    ROUNDS,
    SUBJECT,
    RobotFactsNotice,
    RobotFactsNotices,
)
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.sessions.presence import RobotFacts

LINK: Any = object()


def facts(**fields: Any) -> RobotFacts:
    """Facts of a robot that is connected and idle."""
    found: Any = {
        "state": "online",
        "clients": [],
        "holder": None,
        "stopped": None,
        "suppressed": [],
        "inhibited": [],
        "battery": None,
        "rtt_ms": 1.5,
        "quality": "good",
        "host": "",
        "platform": "",
        "distro": "",
        "last_seen": 1.0,
        **fields,
    }
    return found


class Relays:
    """Two relays on one bus: robots are connected to the first.

    :ivar homes: the relay of each robot, as the second knows it
    :ivar facts: of each robot
    :ivar changes: how often the second's pages were to look again
    """

    def __init__(self) -> None:
        self.clock = Clock()
        self.bus = LocalBus(self.clock)
        self.robots = RobotRegistry(self.clock.seconds)
        self.facts: dict[int, RobotFacts] = {}
        self.homes: dict[int, str] = {}
        self.changes = 0
        others: Any = RobotRegistry(self.clock.seconds)
        others.on_change(self._changed)
        homes: Any = self
        self.first = RobotFactsNotices(self.clock, self.bus, self.robots, homes, "a")
        self.first.facts_of = lambda robot: self.facts[robot.robot_id]
        self.second = RobotFactsNotices(self.clock, self.bus, others, homes, "b")
        self.second.facts_of = lambda robot: facts()
        self.first.start()
        self.second.start()
        self.notices: list[RobotFactsNotice] = []
        self.sizes: list[int] = []
        self.bus.subscribe(SUBJECT, self._note)

    def _changed(self) -> None:
        self.changes += 1

    def _note(self, subject: str, body: bytes) -> None:
        self.sizes.append(len(body))
        self.notices.append(msgspec.json.decode(body, type=RobotFactsNotice))

    def elsewhere(self, robot_id: int) -> RelayInfo | None:
        relay = self.homes.get(robot_id, "")
        return RelayInfo(relay, "10.0.0.1", 9092, "1", 0.0) if relay else None

    def has(self, number: int, **fields: Any) -> RobotState:
        """The first relay has a robot, or something of it has changed."""
        robot = self.robots.robot(number, f"robot{number}", "")
        robot.control_link = LINK
        self.homes[number] = "a"
        self.facts[number] = facts(**fields)
        self.robots.changed()
        return robot

    def passes(self, seconds: float) -> None:
        """Time passes."""
        self.clock.pump([PERIOD] * round(seconds / PERIOD))


@pytest.fixture
def relays() -> Relays:
    return Relays()


def test_facts_of_a_robot_are_known_at_the_other_relay(relays: Relays) -> None:
    relays.has(3, battery=0.5)
    assert relays.second.find(3) is None
    relays.passes(1)
    assert relays.second.find(3) == facts(battery=0.5)
    assert relays.changes == 1
    relays.has(3, battery=0.4)
    relays.passes(1)
    assert relays.second.find(3) == facts(battery=0.4)
    assert relays.changes == 2


def test_what_passes_is_sent_with_the_next_round_and_is_no_change(relays: Relays) -> None:
    """Also if something else changes: a reader who may not see that must not learn when it did."""
    relays.has(3)
    relays.passes(2)
    relays.has(3, rtt_ms=7.0, last_seen=9.0)
    sent = len(relays.notices)
    relays.has(3, rtt_ms=7.0, last_seen=9.0, holder="ann")
    relays.passes(2)
    assert relays.second.find(3) == facts(holder="ann")
    relays.passes(PERIOD * ROUNDS - 2)
    assert len(relays.notices) == sent + 2
    assert relays.second.find(3) == facts(rtt_ms=7.0, last_seen=9.0, holder="ann")
    assert relays.changes == 2


def test_facts_count_only_from_the_relay_that_has_the_robot(relays: Relays) -> None:
    """Those of the one that it has left may come later."""
    relays.has(3)
    relays.passes(1)
    relays.homes[3] = "c"
    assert relays.second.find(3) is None
    there = RobotFactsNotice("c", [(3, facts(holder="ann"))])
    relays.bus.publish(SUBJECT, msgspec.json.encode(there))
    relays.passes(10)
    assert relays.second.find(3) == facts(holder="ann")
    del relays.homes[3]
    assert relays.second.find(3) is None


def test_without_the_bus_nothing_is_known_and_all_is_sent_after_it(relays: Relays) -> None:
    """What is published meanwhile is lost."""
    relays.has(3)
    relays.passes(2)
    relays.bus.connected = False
    assert relays.second.find(3) is None
    relays.has(3, holder="ann")
    publish, relays.bus.publish = relays.bus.publish, lambda subject, body: None  # type: ignore[method-assign]
    relays.passes(1)
    relays.bus.connected, relays.bus.publish = True, publish  # type: ignore[method-assign]
    for each in (relays.first, relays.second):
        each._bus_state(True)
    relays.passes(1)
    assert relays.second.find(3) == facts(holder="ann")


def test_facts_that_are_not_sent_again_are_forgotten(relays: Relays) -> None:
    relays.has(3).control_link = None
    robot = relays.has(4)
    relays.passes(FORGET_SECONDS * 2)
    assert (relays.second.find(3), relays.second.find(4)) == (None, facts())
    robot.control_link = None
    relays.passes(FORGET_SECONDS * 2)
    assert relays.second.find(4) is None
    assert not relays.second._known


def test_a_relay_that_comes_gets_all_soon(relays: Relays) -> None:
    relays.has(3)
    relays.passes(2)
    third: Any = RobotFactsNotices(relays.clock, relays.bus, relays.robots, relays, "c")  # type: ignore[arg-type]
    third.start()
    relays.first.send_all()
    relays.passes(PERIOD * 2)
    assert third.find(3) == facts()
    third.stop()


def test_notices_are_bounded(relays: Relays) -> None:
    clients = [{"user": f"user{number}", "since": 1.0, "camera": "\0" * 200} for number in range(2000)]
    for number in range(100):
        relays.has(number, clients=clients[:20])
    relays.has(100, clients=clients)
    relays.passes(1)
    assert max(relays.sizes) <= 2 * MOST_BYTES
    assert len(relays.notices) > 2
    assert len({number for each in relays.notices for number, _ in each.robots}) == 101
    known = relays.second.find(100)
    assert known is not None
    assert 20 < len(known["clients"]) < 2000
    assert known["clients"] == clients[: len(known["clients"])]


def test_a_robot_whose_facts_can_not_be_had_ends_nothing(
    relays: Relays, caplog: pytest.LogCaptureFixture
) -> None:
    relays.has(3)
    facts_of, relays.first.facts_of = relays.first.facts_of, None
    relays.first.facts_of = lambda robot: 1 // 0  # type: ignore[assignment, return-value]
    relays.passes(2)
    relays.first.facts_of = facts_of
    relays.passes(PERIOD * ROUNDS)
    assert relays.second.find(3) == facts()


@pytest.mark.parametrize("body", [b"", b"{}", b'["a",[[1,{}]]]', b'["a",[["x",null]]]'])
def test_a_notice_that_can_not_be_read_changes_nothing(relays: Relays, body: bytes) -> None:
    relays.has(3)
    relays.passes(1)
    relays.notices.clear()
    relays.second._received(SUBJECT, body)
    assert relays.second.find(3) == facts()
    assert relays.changes == 1


def test_a_relay_that_leaves_sends_nothing(relays: Relays) -> None:
    relays.first.stop()
    relays.second.stop()
    relays.has(3)
    relays.passes(10)
    assert not relays.notices
    assert not relays.clock.getDelayedCalls()
