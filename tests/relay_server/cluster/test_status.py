"""The relays of a cluster and their load."""

from __future__ import annotations

from typing import Any

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from twisted.internet.defer import Deferred, succeed
from twisted.internet.task import Clock

from relay_protocol.errors import NotFound, Unavailable
from relay_server.cluster.admin import ClusterAdmin
from relay_server.cluster.bus import LocalBus
from relay_server.cluster.drain import Drain
from relay_server.cluster.relays import RelayDirectory, RelayInfo, check_compatible
from relay_server.cluster.status import ANSWER_SECONDS, ClusterState, ClusterStatus, LoadMeter


def info(relay: str, protocol: int = 1, oldest: int = 1) -> RelayInfo:
    return RelayInfo(relay, f"{relay}.example.org", 9092, "1.0", float(ord(relay[0])), protocol, oldest)


class Homes:
    """Each relay has one robot."""

    def count(self, relay: str) -> int:
        return 1


class Member:
    """One relay of a cluster on a shared bus."""

    def __init__(self, clock: Clock, bus: LocalBus, own: RelayInfo) -> None:
        homes: Any = Homes()
        self.relays = RelayDirectory(clock, bus, lambda: own)
        self.drain = Drain(clock, [], lambda: succeed(True))
        meter = LoadMeter(self.drain, lambda: 3, lambda: 4, lambda: 5, lambda: float("inf"))
        self.status = ClusterStatus(bus, self.relays, homes, meter, own.id)
        Deferred.fromCoroutine(self.relays.start())
        self.status.start()


def read(member: Member) -> Deferred[ClusterState]:
    return Deferred.fromCoroutine(member.status.read())


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_each_relay_answers_for_itself(clock: Clock) -> None:
    """A drained relay answers too; relays of another version and silent relays are marked."""
    bus = LocalBus(clock)
    a, b, c, d = (Member(clock, bus, each) for each in (info("a"), info("b"), info("c", 9, 9), info("d")))
    d.status.stop()
    bus.subscribe("relays.d.load", lambda *_: Deferred())
    clock.advance(2)
    b.drain.begun = True
    reading = read(a)
    clock.advance(ANSWER_SECONDS)
    state: Any = reading.result
    found = {each.id: (each.state, each.own, each.homes) for each in state.relays}
    assert found == {
        "a": ("ready", True, 1),
        "b": ("draining", False, 1),
        "c": ("incompatible", False, 1),
        "d": ("silent", False, 1),
    }
    load = state.relays[1].load
    assert (load.robots, load.clients, load.forwarded, load.lag_s) == (3, 4, 5, 1e6)
    assert state.relays[3].load is None
    assert c.relays.find("a") == info("a")


@pytest.mark.parametrize(
    ("relay", "works"),
    [
        (info("a"), True),
        (info("a", 1, 1), True),
        (info("a", 2, 1), True),
        (info("a", 3, 2), True),
        (info("a", 3, 3), False),
        (info("a", 0, 0), False),
    ],
)
def test_relays_of_neighbouring_versions_work_together(relay: RelayInfo, works: bool) -> None:
    assert relay.compatible is works
    if not works:
        with pytest.raises(Unavailable, match="one version at a time"):
            check_compatible(relay)


def test_metrics_count_relays(clock: Clock) -> None:
    """Each relay shows the figures of all; of a silent one, that it is silent."""
    bus = LocalBus(clock)
    member, other = (Member(clock, bus, info(each)) for each in "ab")
    clock.advance(2)
    other.status.stop()
    registry = CollectorRegistry(auto_describe=False)
    registry.register(member.status)
    Deferred.fromCoroutine(member.status.refresh())
    lines = generate_latest(registry).decode().splitlines()
    a, b = '{relay="a.example.org:9092"}', '{relay="b.example.org:9092"}'
    assert {
        "switchboard_cluster_relays 2.0",
        f"switchboard_cluster_answers{a} 1.0",
        f"switchboard_cluster_answers{b} 0.0",
        f"switchboard_cluster_robots{a} 3.0",
        f"switchboard_cluster_forwarded_websockets{a} 5.0",
    } <= set(lines)
    assert f"switchboard_cluster_robots{b}" not in "".join(lines)


def test_the_only_relay_has_no_cluster() -> None:
    reading = Deferred.fromCoroutine(ClusterAdmin(None).status())
    failure: Any = reading.result
    assert failure.check(NotFound)
    reading.addErrback(lambda _: None)
