"""The participant is made again after the addresses of the machine have changed."""

from __future__ import annotations

import pytest
from twisted.internet.defer import Deferred, succeed
from twisted.logger import formatEvent, globalLogPublisher

from robot_client.address_changes import AddressChanges
from robot_client.addresses import CHECK_SECONDS, AddressWatch, own_addresses
from robot_client.alerts import MODULE

HOME, AWAY, VPN = "wlan0 10.0.0.5", "wlan0 10.9.0.7", "tun0 10.8.0.2"


class Robot:
    """A machine with addresses, and a daemon on it."""

    def __init__(self) -> None:
        self.addresses = frozenset({HOME})
        self.is_idle = True
        self.nodes: frozenset[str] = frozenset()
        self.fails = False
        self.released: Deferred[object] | None = None
        self.renewals: list[str] = []
        self.alerts: list[tuple[str, str, bool]] = []
        self.changes = AddressChanges(self, lambda: self.addresses, self.alert)

    def alert(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        assert (kind, about) == (MODULE, "addresses")
        self.alerts.append((level, text, over))

    def release_platform(self, reason: str) -> Deferred[object]:
        return succeed(None) if self.released is None else self.released

    def renew_platform(self, reason: str) -> None:
        if self.fails:
            raise OSError("no network")
        self.renewals.append(reason)

    def has(self, *addresses: str, checks: int = 4) -> None:
        """The machine has these addresses, for so many checks."""
        self.addresses = frozenset(addresses)
        for _ in range(checks):
            self.changes.check()


@pytest.fixture
def robot() -> Robot:
    return Robot()


@pytest.mark.parametrize("addresses", [(AWAY,), (HOME, VPN)])
def test_another_address_makes_the_participant_again_once(robot: Robot, addresses: tuple[str, ...]) -> None:
    robot.has(HOME)
    assert robot.renewals == []
    robot.has(*addresses, checks=20)
    assert robot.renewals == ["the machine's addresses have changed"]
    robot.has(HOME)
    assert len(robot.renewals) == 2


def test_address_that_comes_back_changes_nothing(robot: Robot) -> None:
    """Nor does an address that is there for a moment, or a machine without any."""
    robot.has(checks=20)
    robot.has(HOME)
    robot.has(HOME, VPN, checks=1)
    robot.has(HOME)
    assert robot.renewals == []


def test_it_waits_until_the_robot_stands_still(robot: Robot) -> None:
    """Between two commands of a driver it does not stand still."""
    robot.is_idle = False
    robot.has(AWAY, checks=20)
    for idle in (True, False) * 5:
        robot.is_idle = idle
        robot.changes.check()
    assert robot.renewals == []
    robot.is_idle = True
    robot.has(AWAY, checks=2)
    assert len(robot.renewals) == 1


@pytest.mark.parametrize(
    ("addresses", "nodes", "renewals"),
    [
        ((AWAY,), {"/base"}, 0),
        ((AWAY,), {"/switchboard_sim", "/robot/gps"}, 0),
        ((AWAY,), {"/robot/gps", "/switchboard_1a2b", "/device_switchboard_1a2b"}, 1),
        ((HOME, VPN), {"/base"}, 1),
    ],
)
def test_nodes_that_it_would_lose_are_waited_for(
    robot: Robot, addresses: tuple[str, ...], nodes: set[str], renewals: int
) -> None:
    """It would if no former address is left. Services are made again too."""
    robot.nodes = frozenset(nodes)
    robot.has(*addresses, checks=20)
    assert len(robot.renewals) == renewals
    robot.nodes = frozenset()
    robot.has(*addresses)
    assert len(robot.renewals) == 1


def test_nothing_is_made_again_before_the_motion_has_ended(robot: Robot) -> None:
    robot.released = Deferred()
    robot.has(AWAY, checks=20)
    assert robot.renewals == []
    robot.released.callback(None)
    assert len(robot.renewals) == 1


def test_failure_is_tried_again(robot: Robot) -> None:
    robot.fails = True
    robot.has(AWAY, checks=8)
    robot.fails = False
    robot.has(AWAY)
    assert len(robot.renewals) == 1


def test_change_is_logged_in_words(robot: Robot) -> None:
    """Once when it is seen, and once when the participant is made again."""
    said: list[str] = []
    globalLogPublisher.addObserver(observer := lambda event: said.append(formatEvent(event)))
    try:
        robot.has(AWAY, VPN, checks=20)
        changed = f"the machine's addresses have changed (new: {VPN}, {AWAY}; gone: {HOME})."
        assert said[0].partition(" ROS ")[0] == changed
        assert "when the robot stands still" in said[0]
    finally:
        globalLogPublisher.removeObserver(observer)
    assert said[1:] == ["the daemon's ROS nodes were made again: the machine's addresses have changed"]
    assert robot.alerts == []


@pytest.mark.parametrize("end", ["nodes", "address"])
def test_nodes_that_have_to_be_started_again_are_an_alert(robot: Robot, end: str) -> None:
    """Until they were, or a former address is back."""
    robot.nodes = frozenset({"/base"})
    robot.has(AWAY, checks=20)
    ((level, text, over),) = robot.alerts
    assert (level, "Start the robot's ROS nodes again" in text, over) == ("error", True, False)
    if end == "nodes":
        robot.nodes = frozenset()
    robot.has(AWAY if end == "nodes" else HOME)
    assert [each[2] for each in robot.alerts] == [False, True]


def test_own_addresses_have_no_loopback() -> None:
    assert not [each for each in own_addresses() if " 127." in each]


def test_a_watch_needs_two_looks_that_agree() -> None:
    """It looks rarely. No address at all is no other address: the network comes back."""
    now, there = 0.0, {HOME}
    watch = AddressWatch(lambda: frozenset(there), lambda: now)
    found = []
    for each in ({HOME}, {AWAY}, {VPN}, set(), set(), {AWAY}, {AWAY}, {AWAY}):
        there = each
        assert not watch.changed()
        now += CHECK_SECONDS
        found.append(watch.changed())
    assert found == [False] * 6 + [True] * 2
