"""Events of robots become alerts and rows; each user sees those they have rights to."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import pytest
import pytest_twisted
from msgspec import UNSET
from twisted.internet.defer import Deferred
from twisted.logger import capturedLogs, formatEvent

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_server import audit_log
from relay_server.access import Access, Principal
from relay_server.alerts import types as kinds
from relay_server.alerts.hub import ABSENT_SECONDS, REPORT_AGAIN_SECONDS, SAVE_SECONDS, SWEEP_EVERY, AlertHub
from relay_server.alerts.monitors import Thresholds
from relay_server.alerts.rules import RuleRequest
from relay_server.alerts.schemas import NotificationMessage
from relay_server.alerts.service import MAX_EXCLUDED, PAGE, AlertCursor, AlertService, TooManyRuleChanges
from relay_server.alerts.transports import Transports
from relay_server.audit_log import AuditLog, AuditLogEntry
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.robots.registry import RobotState
from tests.worlds.alert_receivers import REACTOR
from tests.worlds.alerts import alert
from tests.worlds.relay import World, hangs
from tests.worlds.robot_links import until


class Scene:
    """Alerts of a relay with a real database: robot rover, operator ann, viewer vic, and eve without rights."""

    def __init__(self, world: World, store: AsyncDatabase) -> None:
        self.world = world
        self.store = store
        self.sent: list[NotificationMessage] = []
        self.step = 0.0
        self.access = Access(store, self.wall)
        self.bus = EventBus()
        with store.database.begin() as s:
            self.number = queries.add_robot(s, "rover").id
            self.people = {
                name: Principal(queries.add_user(s, name, None).id, name, "default", False, 0, None)
                for name in ("ann", "vic", "eve")
            }
            queries.grant_right(s, self.number, "operator", user_id=self.people["ann"].user_id)
            queries.grant_right(
                s, self.number, "viewer", user_id=self.people["vic"].user_id, deny=["subscribe:/diagnostics"]
            )
        self.robot: RobotState = world.registry.robot(self.number, "rover", "default")
        world.robot = self.robot
        self.alerts = self.begin()
        ways = Transports(REACTOR, self.wall, (), ())
        self.service = AlertService(
            self.alerts, ways, store, self.access, self.bus, world.clock.seconds, self.wall
        )

    def wall(self) -> float:
        """Unix time."""
        return 1.7e9 + self.world.clock.seconds() + self.step

    def begin(self) -> AlertHub:
        """Builds the alert service of a relay."""
        world = self.world
        thresholds = Thresholds(6.0, 0.2, 0.1)
        return AlertHub(
            world.clock, self.wall, self.store, self.access, world.registry, world.channels, world.controllers,
            self.bus, thresholds, self._send,
        )  # fmt: skip

    async def _send(self, rule: Any, message: NotificationMessage) -> None:
        self.sent.append(message)

    def says(self, kind: str, **data: Any) -> None:
        """Publishes an event about the robot."""
        self.bus.publish(kind, self.number, "test", **data)

    async def seen(self, name: str) -> list[str]:
        """Kinds of alerts that a user sees, equal in the list and in the live updates."""
        listed = [each.kind for each in await self.service.all(self.people[name])]
        assert sorted(listed) == sorted(each["kind"] for each in await self.service.shown(self.people[name]))
        return sorted(listed)


@pytest.fixture
def scene(world: World, store: AsyncDatabase) -> Scene:
    return Scene(world, store)


@pytest_twisted.ensureDeferred
async def test_events_become_alerts_of_their_kind(scene: Scene) -> None:
    scene.says("robot.stopped", user="ann", why="smoke")
    scene.says("robot.stopped", user="vic", why="fire")
    scene.says("control.lost", user="ann", why="gone", moving=False)
    scene.says("robot.alert", level="error", text="x", alert_kind="diagnostics", about="motor", over=False)
    scene.says("robot.alert", level="odd", text="x", alert_kind="offline", about="", over=False)
    scene.says("other.event")
    assert await scene.seen("ann") == ["diagnostics", "robot", "stop"]
    assert await scene.seen("vic") == ["robot", "stop"]
    assert await scene.seen("eve") == []
    texts = {each.kind: (each.text, each.level) for each in await scene.service.all(scene.people["ann"])}
    assert texts["stop"] == ("stopped by ann: smoke", "warning")
    assert texts["robot"] == ("x", "warning")
    scene.says("robot.resumed")
    scene.says("control.lost", user="ann", why="gone", moving=True)
    scene.says("control.taken")
    lasting = await scene.service.all(scene.people["ann"], open=True)
    assert sorted(each.kind for each in lasting) == ["diagnostics", "robot"]


@pytest_twisted.ensureDeferred
async def test_lost_audit_entries_are_an_alert_until_that_is_on_record(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bound of entries that wait is reached while the database can't be written."""
    monkeypatch.setattr(audit_log, "WAITING", 1)
    audit = AuditLog(scene.world.clock, scene.store, tmp_path, scene.bus.publish)
    with monkeypatch.context() as broken:
        broken.setattr(scene.store, "write", AsyncMock(side_effect=Unavailable("locked")))
        for at in (1.0, 2.0, 3.0):
            audit.append(AuditLogEntry(at, "user:ann", "control.taken", "rover", robots=(scene.number,)))
    (lost,) = await scene.service.all(scene.people["vic"], open=True)
    assert (lost.kind, lost.level, lost.count) == ("audit", "error", 2)
    assert lost.text == (
        "audit entries about this robot are lost: the database could not be written for too long"
    )
    await audit.flush()
    assert await scene.service.all(scene.people["vic"], open=True) == []
    entries = await scene.store.read(queries.list_audit)
    assert [each.data for each in entries if each.action == "audit.lost"] == [{"count": 2, "until": 3.0}]


@pytest_twisted.ensureDeferred
async def test_invisible_alerts_do_not_displace_visible_ones(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    rover = scene.number
    topics = MAX_EXCLUDED + 50
    stale = {"kind": "stale", "last": 8e9}
    rows = [
        *(alert(f"m{each}", robot_id=rover, kind="module", about=f"{each}", last=9.5e9) for each in range(3)),
        *(
            alert(f"d{each}", robot_id=rover, kind="diagnostics", about=f"part {each}", last=9e9)
            for each in range(3 * PAGE)
        ),
        *(
            alert(f"s{each}", robot_id=rover, about=f"/secret/{each % topics}", **stale)
            for each in range(2 * PAGE)
        ),
        alert("gone", robot_id=rover, last=7e9),
    ]
    with scene.store.database.begin() as s:
        denied = ["subscribe:/diagnostics", "subscribe:/secret/**"]
        queries.grant_right(s, rover, "viewer", user_id=scene.people["vic"].user_id, deny=denied)
        queries.save_alerts(s, rows)
    await scene.access.refresh()
    reads = 0
    read = scene.store.read

    async def counted(*what: Any, **how: Any) -> Any:
        nonlocal reads
        reads += what[0] is queries.list_alerts
        return await read(*what, **how)

    monkeypatch.setattr(scene.store, "read", counted)
    for lasts in (True, None):
        found = await scene.service.all(scene.people["vic"], "rover", lasts)
        assert [each.id for each in found] == ["m0", "m1", "m2", "gone"]
    # Two of each, because the database returns few of the refused ones.
    assert reads == 4
    assert len(await scene.service.all(scene.people["ann"], limit=500)) == 500
    assert await scene.service.all(scene.people["vic"], "rover", False) == []


@pytest_twisted.ensureDeferred
async def test_the_next_page_has_older_alerts(scene: Scene) -> None:
    rows = [
        alert(f"{number:03}", robot_id=scene.number, kind=kind, last=2e9 - number // 2)
        for number, kind in enumerate(["module", "diagnostics"] * (PAGE // 2 + 10))
    ]
    with scene.store.database.begin() as s:
        queries.save_alerts(s, rows)
    ann, vic = scene.people["ann"], scene.people["vic"]
    listed: list[str] = []
    before: AlertCursor | None = None
    while page := await scene.service.all(ann, limit=100, before=before):
        listed += [each.id for each in page]
        before = AlertCursor(page[-1].last, page[-1].id)
        with scene.store.database.begin() as s:
            queries.save_alerts(s, [alert(page[-1].id, robot_id=scene.number, last=3e9)])
    assert listed == [each.id for each in rows]
    (oldest,) = await scene.service.all(vic, limit=100, before=AlertCursor(2e9 - len(rows) // 2 + 2, "z"))
    assert oldest.kind == "module"


@pytest_twisted.ensureDeferred
async def test_a_rule_that_was_written_is_made_though_it_counts_later(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:

    async def fails() -> None:
        raise Unavailable("the database is locked")

    with monkeypatch.context() as patch:
        patch.setattr(scene.alerts, "refresh", fails)
        made = await scene.service.add_rule(
            scene.people["ann"], RuleRequest("webhook", url="https://example.org/x"), "192.0.2.9"
        )
        assert len(made.secret or "") >= 32
        (listed,) = (await scene.service.rules(scene.people["ann"])).rules
        assert listed.id == made.id
        await scene.service.remove_rule(scene.people["ann"], made.id, "192.0.2.9")
    assert (await scene.service.rules(scene.people["ann"])).rules == []


@pytest_twisted.ensureDeferred
async def test_operators_acknowledge_and_others_are_refused(scene: Scene) -> None:
    scene.says("robot.alert", level="error", text="x", alert_kind="diagnostics", about="motor", over=False)
    ((alert),) = await scene.service.all(scene.people["ann"])
    for name in ("vic", "eve"):
        with pytest.raises(NotFound):
            await scene.service.acknowledge(scene.people[name], alert.id)
    scene.says("robot.stopped", user="ann", why="")
    stop = next(each for each in await scene.service.all(scene.people["vic"]) if each.kind == "stop")
    with pytest.raises(Refused, match="operator"):
        await scene.service.acknowledge(scene.people["vic"], stop.id)
    done = await scene.service.acknowledge(scene.people["ann"], alert.id)
    assert done.acknowledged is not None and done.acknowledged.by == "ann"
    with pytest.raises(NotFound):
        await scene.service.acknowledge(scene.people["ann"], "zz")


@pytest_twisted.ensureDeferred
async def test_a_page_gets_the_same_list_until_something_changes(scene: Scene) -> None:
    """Nothing is sent twice."""
    scene.says("robot.stopped", user="ann", why="")
    first = await scene.service.shown(scene.people["ann"])
    assert await scene.service.shown(scene.people["ann"]) is first
    scene.alerts.version += 1
    assert await scene.service.shown(scene.people["ann"]) is first
    scene.says("robot.resumed")
    assert (await scene.service.shown(scene.people["ann"]))[0]["state"] == "over"


@pytest_twisted.ensureDeferred
async def test_ended_alerts_are_shown_however_many_are_open(scene: Scene) -> None:
    """The latest ended alerts keep places in a full list; open alerts fill the rest."""

    def part(number: int, over: bool) -> None:
        about = f"part {number}"
        scene.says("robot.alert", level="error", text="x", alert_kind="diagnostics", about=about, over=over)
        scene.step += 1.0

    for number in range(150):
        part(number, over=False)
    for number in range(30):
        part(number, over=True)
    shown = await scene.service.shown(scene.people["ann"])
    over = {each["about"] for each in shown if each["state"] == "over"}
    assert len(shown) == 100
    assert over == {f"part {number}" for number in range(5, 30)}
    assert {each["about"] for each in shown} - over == {f"part {number}" for number in range(75, 150)}


@pytest_twisted.ensureDeferred
async def test_a_rule_sends_only_alerts_that_its_user_may_see(scene: Scene) -> None:
    ask = RuleRequest("webhook", url="https://example.org/hook")
    made = await scene.service.add_rule(scene.people["ann"], ask, "192.0.2.9")
    assert len(made.secret or "") >= 32
    await scene.service.add_rule(scene.people["vic"], ask, "192.0.2.9")
    (listed,) = (await scene.service.rules(scene.people["ann"])).rules
    assert listed.secret is UNSET
    assert listed.url == "https://example.org/…"
    scene.says("robot.alert", level="error", text="x", alert_kind="diagnostics", about="motor", over=False)
    scene.world.clock.advance(1)
    await scene.access.robots(scene.people["vic"])
    await until(lambda: len(scene.sent) >= 1)
    assert len(scene.sent) == 1
    with pytest.raises(NotFound):
        await scene.service.remove_rule(scene.people["vic"], made.id, "192.0.2.9")
    await scene.service.remove_rule(scene.people["ann"], made.id, "192.0.2.9")
    entries = await scene.store.read(queries.list_audit)
    assert [each.action for each in entries].count("alert_rule.add") == 2
    assert "/hook" not in str(entries)


@pytest_twisted.ensureDeferred
async def test_a_rule_sends_nothing_about_a_robot_without_a_right(scene: Scene) -> None:
    await scene.service.add_rule(
        scene.people["ann"], RuleRequest("webhook", url="https://example.org/hook"), "192.0.2.9"
    )
    scene.alerts.raise_alert(scene.robot, "module", "one", "error", "x")
    scene.world.clock.advance(1)
    await until(lambda: len(scene.sent) == 1)
    for about, level in (("two", None), ("three", "operator")):
        with scene.store.database.begin() as s:
            if level is None:
                queries.revoke_right(s, scene.number, user_id=scene.people["ann"].user_id)
            else:
                queries.grant_right(s, scene.number, level, user_id=scene.people["ann"].user_id)
        await scene.access.refresh()
        await scene.access.robots(scene.people["ann"])
        scene.alerts.raise_alert(scene.robot, "module", about, "error", "x")
        scene.world.clock.advance(1)
    await until(lambda: len(scene.sent) == 2)
    assert [[each.alert.about for each in message.notices] for message in scene.sent] == [["one"], ["three"]]


@pytest_twisted.ensureDeferred
async def test_alerts_belong_to_the_realm_of_their_robot(scene: Scene) -> None:
    with scene.store.database.begin() as s:
        queries.add_realm(s, "lab1")
        number = queries.add_robot(s, "rover", realm="lab1").id
    robot = scene.world.registry.robot(number, "rover", "lab1")
    scene.alerts.raise_alert(robot, "module", "arm", "error", "x")
    await scene.alerts.flush()
    later = scene.begin()
    await later.start()
    for book in (scene.alerts.store, later.store):
        assert [each.realm for each in book] == ["lab1"]
    later.mute()


@pytest_twisted.ensureDeferred
async def test_a_rule_of_robots_of_a_realm_is_refused(scene: Scene) -> None:
    with pytest.raises(Invalid, match="own realm"):
        await scene.service.add_rule(
            scene.people["ann"], RuleRequest("portal", robots="rover@default"), "192.0.2.9"
        )
    assert (await scene.service.rules(scene.people["ann"])).rules == []


@pytest_twisted.ensureDeferred
async def test_rules_are_not_tested_without_end(scene: Scene) -> None:
    """Five at once, then one every 12 s."""
    made = await scene.service.add_rule(scene.people["ann"], RuleRequest("portal"), "192.0.2.9")
    for _ in range(5):
        assert (await scene.service.test_rule(scene.people["ann"], made.id)).ok
    with pytest.raises(TooManyRuleChanges):
        await scene.service.test_rule(scene.people["ann"], made.id)
    scene.world.clock.advance(13)
    assert (await scene.service.test_rule(scene.people["ann"], made.id)).ok


@pytest_twisted.ensureDeferred
async def test_another_relay_goes_on_where_one_was_killed(scene: Scene) -> None:
    scene.says("robot.stopped", user="ann", why="")
    await scene.alerts.flush()
    later = scene.begin()
    await later.start()
    assert later.level_of(scene.robot, "stop") == "warning"
    later._absent = {scene.number: ("rover", "default")}
    scene.world.clock.pump([0.25] * int(4 * ABSENT_SECONDS + 8))
    assert later.level_of(scene.robot, "offline") == "error"
    later.mute()
    await later.save()


@pytest_twisted.ensureDeferred
async def test_the_robot_reports_control_lost_when_a_relay_was_killed(scene: Scene) -> None:
    text = "ann lost control while the robot moved: its link to the relay was lost"
    for _ in range(2):
        scene.says("robot.alert", level="warning", text=text, alert_kind="control", about="", over=False)
    (reported,) = await scene.service.all(scene.people["vic"])
    assert (reported.kind, reported.level, reported.text, reported.count) == ("control", "error", text, 2)
    scene.says("control.taken")
    assert await scene.service.all(scene.people["vic"], open=True) == []


@pytest_twisted.ensureDeferred
async def test_of_a_loss_of_control_that_a_relay_has_seen_it_needs_no_word(scene: Scene) -> None:
    scene.says("control.taken")
    scene.says("control.lost", user="ann", why="the robot's link was lost", moving=True)
    (reported,) = await scene.service.all(scene.people["ann"])
    await scene.service.acknowledge(scene.people["ann"], reported.id)
    scene.says("robot.alert", level="error", text="x", alert_kind="control", about="", over=False)
    assert await scene.service.all(scene.people["ann"], open=True) == []
    scene.says("robot.alert", level="error", text="x", alert_kind="control", about="goals", over=False)
    (other,) = await scene.service.all(scene.people["ann"], open=True)
    assert (other.kind, other.about) == ("robot", "goals")


@pytest_twisted.ensureDeferred
async def test_a_restarted_daemon_ends_alerts_it_does_not_report_again(scene: Scene) -> None:
    await scene.alerts.start()
    scene.world.robot_comes()
    scene.robot.description = link.Describe(started=1.0)
    scene.says("robot.online")
    for about in ("motor", "arm"):
        scene.says("robot.alert", level="error", text="x", alert_kind="diagnostics", about=about, over=False)
    scene.world.clock.advance(1)
    scene.says("robot.online")
    scene.robot.description = link.Describe(started=2.0)
    scene.says("robot.alert", level="error", text="x", alert_kind="diagnostics", about="arm", over=False)
    scene.world.clock.pump([0.25] * int(4 * REPORT_AGAIN_SECONDS + 1))
    assert scene.alerts.parts_of(scene.robot, "diagnostics") == ["arm"]
    scene.alerts.mute()
    await scene.alerts.save()


@pytest.mark.parametrize("says_so", [False, True])
@pytest_twisted.ensureDeferred
async def test_a_restarted_daemon_that_reports_the_same_is_no_news(scene: Scene, says_so: bool) -> None:
    reported = {"level": "error", "text": "x", "alert_kind": "diagnostics", "about": "motor", "over": False}
    await scene.alerts.start()
    scene.world.robot_comes()
    scene.robot.description = link.Describe(started=1.0)
    scene.says("robot.online")
    scene.says("robot.alert", **reported)
    scene.says("robot.alert", **{**reported, "alert_kind": "gripper"})
    scene.world.clock.advance(1)
    scene.step = -3600.0
    scene.says("robot.online")
    scene.robot.description = link.Describe(started=2.0)
    scene.world.clock.pump([0.25] * 24)
    scene.says("robot.alert", **reported)
    if says_so:
        scene.bus.publish("robot.active_alerts_sent", scene.number)
    scene.world.clock.pump([0.25] * int(4 * REPORT_AGAIN_SECONDS))
    (motor,) = [each for each in scene.alerts.store if each.kind == "diagnostics"]
    assert (motor.over, motor.notification_count, motor.report_count) == (None, 1, 2)
    assert scene.alerts.parts_of(scene.robot, "gripper") == []
    scene.alerts.mute()
    await scene.alerts.save()


@pytest_twisted.ensureDeferred
async def test_a_robot_that_was_removed_leaves_no_alerts(scene: Scene) -> None:
    scene.says("robot.stopped", user="ann", why="")
    await scene.store.write(queries.remove_robot, scene.number)
    await scene.alerts.refresh()
    await scene.alerts.flush()
    assert list(scene.alerts.store) == []


@pytest_twisted.ensureDeferred
async def test_an_acknowledgement_in_the_database_is_taken_up(scene: Scene) -> None:
    reported = {"text": "x", "alert_kind": "module", "over": False}
    for about in ("arm", "leg"):
        scene.says("robot.alert", level="warning", about=about, **reported)
    await scene.alerts.flush()
    for each in list(scene.alerts.store):
        await scene.store.write(queries.acknowledge_alert, each.id, "cli:root", scene.wall())
    scene.says("robot.alert", level="warning", about="arm", **reported)
    scene.says("robot.alert", level="error", about="leg", **reported)
    await scene.alerts.refresh()
    assert {each.about: each.ack_by for each in scene.alerts.store} == {"arm": "cli:root", "leg": None}
    await scene.alerts.flush()
    rows = await scene.store.read(queries.list_alerts)
    assert {each.about: each.ack_by for each in rows} == {"arm": "cli:root", "leg": None}


@pytest_twisted.ensureDeferred
async def test_pages_are_notified_when_shown_alerts_change(scene: Scene) -> None:
    await scene.alerts.start()
    reported = {"level": "error", "text": "x", "alert_kind": "diagnostics", "over": False}
    for each in range(kinds.MAX_OPEN + 1):
        scene.says("robot.alert", about=f"part {each}", **reported)
    before = scene.alerts.version
    for each in range(kinds.MAX_OPEN + 1):
        scene.says("robot.alert", about=f"part {each}", **reported)
    assert scene.alerts.version == before
    scene.says("robot.stopped", user="ann", why="")
    assert scene.alerts.version == before + 1
    scene.says("robot.resumed")
    assert scene.alerts.version == before + 2
    scene.world.clock.pump([0.25] * SWEEP_EVERY)
    assert scene.alerts.version > before + 2
    scene.alerts.mute()
    await scene.alerts.save()


@pytest_twisted.ensureDeferred
async def test_alerts_not_reported_again_end_also_at_another_relay(scene: Scene) -> None:
    reported = {"level": "error", "text": "x", "over": False}
    parts = (("diagnostics", "motor"), ("diagnostics", "arm"), ("module", "guard"), ("gripper", "left"))
    for kind, about in parts:
        scene.says("robot.alert", alert_kind=kind, about=about, **reported)
    scene.says("robot.stopped", user="ann", why="")
    scene.alerts.mute()
    await scene.alerts.save()
    scene.alerts = later = scene.begin()
    await later.start()
    scene.says("robot.online")
    scene.says("robot.alert", alert_kind="diagnostics", about="arm", **reported)
    scene.says("robot.alert", alert_kind="diagnostics", about="lidar", **reported)
    assert len(later.store.open_of(scene.number)) == 6
    for _ in range(2):
        scene.bus.publish("robot.active_alerts_sent", scene.number)
        lasting = {(each.kind, each.about) for each in later.store.open_of(scene.number)}
        assert lasting == {
            ("diagnostics", "arm"),
            ("diagnostics", "lidar"),
            ("gripper", "left"),
            ("stop", ""),
        }
    later.mute()
    await later.save()


@pytest_twisted.ensureDeferred
async def test_a_robot_that_was_removed_is_not_remembered(scene: Scene) -> None:
    await scene.alerts.start()
    scene.world.robot_comes()
    scene.robot.description = link.Describe(started=1.0)
    scene.says("robot.online")
    scene.says("control.taken")
    scene.world.clock.pump([0.25] * 4)
    alerts = scene.alerts
    kept = (alerts._registered_at, alerts._daemon_started, alerts._unconfirmed, alerts._controlled)
    assert [list(each) for each in (alerts._registered_at, alerts._daemon_started, alerts._controlled)] == [
        [scene.number]
    ] * 3
    scene.says("robot.online")
    await alerts.refresh()
    assert scene.number in alerts._controlled
    await scene.store.write(queries.remove_robot, scene.number)
    await alerts.refresh()
    assert not any(kept)
    alerts.mute()
    await alerts.save()


@pytest_twisted.ensureDeferred
async def test_a_robot_that_is_removed_before_it_is_missed_does_not_come_back(scene: Scene) -> None:
    await scene.alerts.start()
    scene.alerts._absent = {scene.number: ("rover", "default")}
    await scene.store.write(queries.remove_robot, scene.number)
    scene.world.registry.forget(scene.number)
    await scene.alerts.refresh()
    scene.world.clock.pump([0.25] * int(4 * ABSENT_SECONDS + 8))
    assert scene.world.registry.find(scene.number) is None
    assert list(scene.alerts.store) == []
    scene.alerts.mute()
    await scene.alerts.save()


@pytest.mark.parametrize("by_robot", [True, False])
@pytest_twisted.ensureDeferred
async def test_control_lost_as_a_relay_ends_is_sent_once_by_the_next(scene: Scene, by_robot: bool) -> None:
    await scene.service.add_rule(
        scene.people["ann"], RuleRequest("webhook", url="https://example.org/hook"), "192.0.2.9"
    )
    scene.says("control.taken")
    scene.alerts.mute()
    scene.says("control.lost", user="ann", why="the relay is going down", moving=True)
    scene.world.clock.advance(5)
    await scene.alerts.save()
    assert scene.sent == []
    scene.alerts = later = scene.begin()
    await later.start()
    if by_robot:
        scene.says("robot.alert", level="error", text="x", alert_kind="control", about="", over=False)
    else:
        scene.world.clock.pump([0.25] * SWEEP_EVERY)
    await until(lambda: later.dispatcher.undelivered() != set())
    scene.world.clock.advance(1)
    await until(lambda: bool(scene.sent))
    scene.world.clock.pump([0.25] * SWEEP_EVERY)
    reported = [(each.alert.kind, each.event) for message in scene.sent for each in message.notices]
    assert reported == [("control", "begun")]
    later.mute()
    await later.save()


@pytest.mark.parametrize("arrived", [True, False])
@pytest_twisted.ensureDeferred
async def test_undelivered_alerts_are_sent_by_the_next_relay_if_they_last(
    scene: Scene, arrived: bool
) -> None:
    """Each once, without those that had arrived."""
    await scene.service.add_rule(
        scene.people["ann"], RuleRequest("webhook", url="https://example.org/hook"), "192.0.2.9"
    )
    scene.alerts.raise_alert(scene.robot, "module", "arm", "warning", "x")
    scene.alerts.raise_alert(scene.robot, "module", "leg", "warning", "x")
    await until(lambda: scene.alerts.dispatcher.undelivered() != set())
    if arrived:

        def all_sent() -> bool:
            scene.world.clock.advance(1)
            return scene.alerts.dispatcher.undelivered() == set()

        await until(all_sent)
        scene.sent.clear()
    scene.alerts.mute()
    await scene.alerts.save()
    scene.alerts = later = scene.begin()
    await later.start()
    later.end(scene.robot, "module", "leg")
    scene.world.clock.pump([0.25] * SWEEP_EVERY)
    await until(lambda: later.dispatcher.undelivered() != set() or arrived)
    scene.world.clock.advance(61)
    await until(lambda: bool(scene.sent))
    reported = [(each.alert.about, each.event) for message in scene.sent for each in message.notices]
    assert reported == ([("leg", "over")] if arrived else [("arm", "begun")])
    later.mute()
    await later.save()


@pytest_twisted.ensureDeferred
async def test_a_relay_that_goes_waits_a_moment_for_its_database(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene.says("robot.stopped", user="ann", why="")
    monkeypatch.setattr(scene.store, "write", hangs)
    scene.alerts.mute()
    kept = Deferred.fromCoroutine(scene.alerts.save())
    scene.world.clock.advance(SAVE_SECONDS - 0.1)
    assert not kept.called
    with capturedLogs() as logs:
        scene.world.clock.advance(0.2)
    assert kept.called
    assert "not taken them within 3 s" in str(formatEvent(logs[-1]))


@pytest_twisted.ensureDeferred
async def test_an_alert_is_not_written_while_it_is_being_written(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    doors: list[Deferred[None]] = []
    write = scene.store.write

    async def slow(*what: Any) -> Any:
        doors.append(Deferred())
        await doors[-1]
        return await write(*what)

    monkeypatch.setattr(scene.store, "write", slow)
    scene.alerts.raise_alert(scene.robot, "module", "arm", "warning", "first")
    first = Deferred.fromCoroutine(scene.alerts.flush())
    scene.alerts.raise_alert(scene.robot, "module", "arm", "error", "second")
    second = Deferred.fromCoroutine(scene.alerts.flush())
    assert len(doors) == 1
    doors[0].callback(None)
    await until(lambda: len(doors) == 2)
    assert not second.called
    doors[1].callback(None)
    await first
    await second
    (row,) = await scene.store.read(queries.list_alerts)
    assert (row.level, row.text) == ("error", "second")
