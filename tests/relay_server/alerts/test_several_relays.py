"""Alerts of a cluster: relays with one database, and a bus that may be down."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import AlertRecord
from relay_protocol import link
from relay_protocol.errors import Unavailable
from relay_server.access import Access, Principal
from relay_server.alerts.hub import AlertHub
from relay_server.alerts.monitors import Thresholds
from relay_server.alerts.service import AlertService
from relay_server.alerts.transports import Transports
from relay_server.events.bus import EventBus
from tests.worlds.alert_receivers import REACTOR
from tests.worlds.empty_database import write_empty_database
from tests.worlds.relay import World

STEP = 0.25


class Store:
    """The database, as one relay reaches it.

    :ivar down: whether it does not answer
    """

    def __init__(self, database: Database) -> None:
        self.down = False
        self._database = database

    async def read(self, query: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        self._check()
        with self._database.reading() as s:
            return query(s, *arguments, **options)

    async def write(self, change: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        self._check()
        with self._database.begin() as s:
            return change(s, *arguments, **options)

    def _check(self) -> None:
        if self.down:
            raise Unavailable("the database does not answer")


class Member:
    """One relay.

    :ivar notified: events of alerts that users were notified of here
    """

    def __init__(self, cluster: Cluster) -> None:
        self.cluster = cluster
        self.world = World()
        self.store: Any = Store(cluster.database)
        self.bus = EventBus()
        self.leads = False
        self.notified: list[str] = []
        world, access = self.world, Access(self.store, self.wall)
        self.hub = AlertHub(
            world.clock, self.wall, self.store, access, world.registry, world.channels, world.controllers,
            self.bus, Thresholds(6.0, 0.2, 0.1), self._send, leads=lambda: self.leads,
        )  # fmt: skip
        ways = Transports(REACTOR, self.wall, (), ())
        self.service = AlertService(
            self.hub, ways, self.store, access, self.bus, world.clock.seconds, self.wall
        )
        self.hub.on_written = lambda alerts: cluster.written(self, alerts)
        self.hub.subscribe(self._notify)
        done(self.hub.start())

    def wall(self) -> float:
        return 1.7e9 + self.world.clock.seconds()

    async def _send(self, *message: Any) -> None: ...

    def _notify(self, event: str, alert: AlertRecord) -> None:
        self.notified.append(f"{alert.kind} {event}")

    @property
    def robot(self) -> Any:
        """The robot, as this relay knows it."""
        robot = self.world.registry.robot(self.cluster.number, "rover", "default")
        self.world.robot = robot
        return robot

    def says(self, kind: str, **data: Any) -> None:
        """An event of the robot happens here."""
        self.bus.publish(kind, self.cluster.number, "test", **data)

    def reports(self, *, over: bool = False, text: str = "hot") -> None:
        """The robot reports an alert, or its end."""
        data = {"level": "error", "text": text, "alert_kind": "diagnostics", "about": "motor", "over": over}
        self.says("robot.alert", **data)

    @property
    def shown(self) -> list[tuple[str, bool]]:
        """Kinds of alerts in memory, and whether they are open."""
        return sorted((each.kind, each.over is None) for each in self.hub.store)


class Cluster:
    """Two relays, of which the second leads.

    :ivar answers: whether the bus does
    """

    def __init__(self, folder: Path) -> None:
        path = folder / "relay.db"
        write_empty_database(path)
        self.database = Database(f"sqlite:///{path}")
        with self.database.begin() as s:
            self.number = queries.add_robot(s, "rover").id
            user = queries.add_user(s, "ann", None)
            queries.grant_right(s, self.number, "operator", user_id=user.id)
            self.ann = Principal.of_user(user)
        self.answers = True
        self._notices: list[tuple[Member, list[AlertRecord]]] = []
        self.members = [Member(self), Member(self)]
        self.first, self.second = self.members
        self.second.leads = True
        for each in self.members:
            assert each.robot

    def written(self, member: Member, alerts: Collection[AlertRecord]) -> None:
        if self.answers:
            self._notices.append((member, list(alerts)))

    def passes(self, seconds: float) -> None:
        """Time passes, and notices come with it."""
        for _ in range(round(seconds / STEP)):
            for each in self.members:
                if each.robot.control_link is not None:
                    each.world.registry.seen(each.robot)
                each.world.clock.advance(STEP)
            notices, self._notices = self._notices, []
            for sender, alerts in notices:
                for each in self.members:
                    if each is not sender:
                        each.hub.mirror(alerts)

    def comes(self, member: Member) -> None:
        """The robot connects to a relay."""
        assert member.robot
        member.world.robot_comes()
        member.says("robot.online")
        for each in self.members:
            each.world.registry.set_elsewhere(self.number, elsewhere=each is not member)
            if each is not member:
                each.world.controllers.of(each.robot).robot_moved()

    def goes(self, member: Member) -> None:
        """The robot leaves a relay."""
        assert member.robot
        member.world.robot_goes()
        for each in self.members:
            each.world.registry.set_elsewhere(self.number, elsewhere=False)

    @property
    def stored(self) -> list[tuple[str, bool]]:
        """Kinds of stored alerts, and whether they are open."""
        with self.database.reading() as s:
            return sorted((each.kind, each.over is None) for each in queries.list_alerts(s))

    @property
    def notified(self) -> list[str]:
        """What users were notified of, by any relay."""
        return [each for member in self.members for each in member.notified]


def done(work: Any) -> Any:
    """The result of work that waits for nothing."""
    results: list[Any] = []
    Deferred.fromCoroutine(work).addCallback(results.append)
    (result,) = results
    return result


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    made = Cluster(tmp_path)
    yield made
    made.database.close()


def test_an_alert_goes_with_its_robot(cluster: Cluster) -> None:
    """It is continued and ended at the relay that the robot moves to, and nobody is notified twice."""
    first, second = cluster.members
    cluster.comes(first)
    first.robot.motion_state = link.MotionState(stopped=link.Stopped(by="ann", since=1.0, why="smoke"))
    cluster.passes(10)
    assert first.shown == second.shown == [("stop", True)]
    stopped = first.robot.motion_state
    cluster.goes(first)
    cluster.comes(second)
    second.robot.motion_state = stopped
    cluster.passes(20)
    assert first.shown == second.shown == [("stop", True)]
    second.robot.motion_state = link.MotionState()
    second.says("robot.resumed")
    cluster.passes(1)
    assert first.shown == second.shown == cluster.stored == [("stop", False)]
    cluster.goes(second)
    cluster.passes(3)
    assert cluster.notified == ["stop begun", "stop over"]


def test_relays_do_not_quarrel_about_a_robot_that_is_away(cluster: Cluster) -> None:
    """What a relay knew of it before it moved does not count."""
    first, second = cluster.members
    cluster.comes(first)
    first.robot.health = link.Health(battery=0.9)
    cluster.passes(5)
    cluster.goes(first)
    cluster.comes(second)
    second.robot.health = link.Health(battery=0.05)
    cluster.passes(5)
    cluster.goes(second)
    cluster.passes(60)
    assert first.shown == second.shown == [("battery", True), ("offline", True)]
    assert sorted(cluster.notified) == ["battery begun", "offline begun"]
    cluster.comes(first)
    first.robot.health = link.Health(battery=0.9)
    cluster.passes(5)
    assert sorted(cluster.notified) == ["battery begun", "battery over", "offline begun", "offline over"]


def test_one_relay_raises_the_alert_of_a_stop_that_waits(cluster: Cluster) -> None:
    """Each relay reads the stop. When one withdraws it, another may not have read that yet."""
    stop = queries.StopRecord(cluster.number, "ann", "smoke", cluster.first.wall(), "")
    for each in cluster.members:
        each.world.controllers.of(each.robot).stopping.add_stored(stop, 1, 1)
    cluster.first.says("robot.stopped", user="ann", why="smoke")
    cluster.passes(2)
    assert cluster.notified == ["stop begun"]
    cluster.first.world.controllers.of(cluster.first.robot).stopping.add_stored(None, 1, 2)
    cluster.first.says("robot.resumed")
    cluster.passes(5)
    assert sorted(cluster.notified) == ["stop begun", "stop over"]
    assert cluster.first.shown == cluster.second.shown == cluster.stored == [("stop", False)]


@pytest.mark.parametrize("bus", [True, False])
def test_an_acknowledgement_at_another_relay_writes_nothing_else(cluster: Cluster, bus: bool) -> None:
    """The alert may have ended meanwhile."""
    first, second = cluster.members
    cluster.comes(first)
    first.reports()
    cluster.passes(35)
    (alert,) = second.hub.store
    cluster.answers = bus
    done(second.service.acknowledge(cluster.ann, alert.id))
    first.reports(text="hotter")
    cluster.passes(1)
    done(first.hub.refresh())
    first.reports(over=True)
    cluster.passes(35)
    assert cluster.stored == first.shown == second.shown == [("diagnostics", False)]
    for member in cluster.members:
        assert [each.ack_by for each in member.hub.store] == ["ann"]
    assert cluster.notified == ["diagnostics begun", "diagnostics over"]


def test_an_older_state_that_waits_to_be_written_is_given_up(cluster: Cluster) -> None:
    first, second = cluster.members
    cluster.comes(first)
    first.reports()
    cluster.passes(1)
    first.store.down = True
    first.reports()
    cluster.passes(1)
    cluster.goes(first)
    cluster.comes(second)
    second.reports()
    second.reports(over=True)
    cluster.passes(1)
    first.store.down = False
    cluster.passes(60)
    assert cluster.stored == first.shown == second.shown == [("diagnostics", False)]


@pytest.mark.parametrize("bus", [True, False])
def test_an_alert_that_becomes_known_after_its_robot_came_ends(cluster: Cluster, bus: bool) -> None:
    """The robot is well again, and did not report it to the relay that it has connected to."""
    first, second = cluster.members
    cluster.answers = bus
    cluster.comes(first)
    cluster.passes(1)
    first.store.down = bus
    first.reports()
    cluster.passes(1)
    cluster.goes(first)
    cluster.passes(1)
    cluster.comes(second)
    second.says("robot.active_alerts_sent")
    cluster.passes(1)
    first.store.down = False
    cluster.passes(70)
    assert first.shown == second.shown == cluster.stored == [("diagnostics", False)]


def test_a_notification_that_a_relay_could_not_deliver_is_repeated_by_the_next(cluster: Cluster) -> None:
    first, second = cluster.members
    cluster.comes(first)
    first.reports()
    cluster.passes(1)
    cluster.goes(first)
    cluster.comes(second)
    second.reports()
    cluster.passes(1)
    first.hub.mute()
    first.hub.store.mark_unreported([each.id for each in first.hub.store])
    done(first.hub.flush())
    assert second.notified == []
    cluster.passes(30)
    assert second.notified == ["diagnostics begun"]


def test_a_notification_that_was_not_delivered_is_not_lost_among_new_reports(cluster: Cluster) -> None:
    """The relay that the robot has moved to is about to write its own state."""
    first, second = cluster.members
    cluster.comes(first)
    first.reports()
    cluster.passes(1)
    cluster.goes(first)
    cluster.comes(second)
    (alert,) = second.hub.store
    second.reports()
    second.hub.mirror([alert._replace(notification_count=0)])
    cluster.passes(30)
    assert second.notified == ["diagnostics begun"]
    # What was read before that was announced does not announce it again.
    second.hub.mirror([alert._replace(notification_count=0)])
    cluster.passes(60)
    assert second.notified == ["diagnostics begun"]


def test_a_stop_alert_ends_where_its_stop_was_withdrawn_before_it_was_known(cluster: Cluster) -> None:
    """The leading relay raises it late, and reads then that the stop is gone."""
    stop = queries.StopRecord(cluster.number, "ann", "smoke", cluster.first.wall(), "")
    stopping = cluster.second.world.controllers.of(cluster.second.robot).stopping
    cluster.first.says("robot.stopped", user="ann", why="smoke")
    cluster.first.says("robot.resumed")
    stopping.add_stored(stop, 1, 1)
    cluster.passes(2)
    stopping.add_stored(None, 1, 2)
    cluster.passes(2)
    assert cluster.first.shown == cluster.second.shown == cluster.stored == [("stop", False)]


def test_a_robot_that_is_stopped_again_while_it_is_resumed_has_an_alert(cluster: Cluster) -> None:
    """With one relay too."""
    second = cluster.second
    stopping = second.world.controllers.of(second.robot).stopping
    for at in (1, 2):
        at_time = second.wall() + at
        stopping.add_stored(queries.StopRecord(cluster.number, "bob", "fire", at_time, ""), at, at)
        cluster.passes(2)
    second.says("robot.resumed")
    cluster.passes(5)
    assert second.shown == [("stop", True)]


def test_an_acknowledgement_that_came_while_no_relay_led_ends_what_has_no_end(cluster: Cluster) -> None:
    first, second = cluster.members
    second.says("control.lost", user="ann", why="gone", moving=True)
    cluster.passes(1)
    (alert,) = first.hub.store
    second.leads = False
    done(first.service.acknowledge(cluster.ann, alert.id))
    for member in cluster.members:
        done(member.hub.refresh())
    first.leads = True
    cluster.passes(15)
    assert first.shown == second.shown == cluster.stored == [("control", False)]


def test_a_part_that_fails_again_and_again_is_one_alert(cluster: Cluster) -> None:
    """As with one relay: stored states that are older than what is known change nothing."""
    first, _ = cluster.members
    cluster.comes(first)
    for _ in range(10):
        first.reports()
        cluster.passes(20)
        first.reports(over=True)
        cluster.passes(50)
    cluster.passes(320)
    for _ in range(5):
        first.reports()
        cluster.passes(20)
        first.reports(over=True)
        cluster.passes(50)
    assert len(cluster.stored) == 2
    assert sum(each == "diagnostics begun" for each in cluster.notified) == 15


def test_a_robot_that_was_enrolled_since_and_goes_is_missed(cluster: Cluster) -> None:
    """It has never connected to the relay that leads."""
    with cluster.database.begin() as s:
        cluster.number = queries.add_robot(s, "second").id
    assert cluster.second.world.registry.find(cluster.number) is None
    first = cluster.first.world
    robot = first.registry.robot(cluster.number, "second", "default")
    first.robot = robot
    first.robot_comes()
    cluster.second.world.registry.set_elsewhere(cluster.number, elsewhere=True)
    for _ in range(160):
        first.registry.seen(robot)
        for each in cluster.members:
            each.world.clock.advance(STEP)
    first.robot_goes()
    cluster.second.world.registry.set_elsewhere(cluster.number, elsewhere=False)
    for _ in range(100):
        for each in cluster.members:
            each.world.clock.advance(STEP)
    assert cluster.second.notified == ["offline begun"]
