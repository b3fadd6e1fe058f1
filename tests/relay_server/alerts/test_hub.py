"""What happens to robots becomes alerts, rows, and what each person may see of them."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted
from twisted.internet.defer import Deferred
from twisted.logger import capturedLogs, formatEvent

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_server.access import Access, Principal
from relay_server.alerts import types as kinds
from relay_server.alerts.alerts import ABSENT_SECONDS, AGAIN_SECONDS, KEEP_SECONDS, TIDY_EVERY, AlertHub
from relay_server.alerts.message import NotificationMessage
from relay_server.alerts.monitors import Thresholds
from relay_server.alerts.rules import RuleRequest
from relay_server.alerts.service import PAGE, REFUSED, AlertCursor, AlertService, TooManyRuleChanges
from relay_server.alerts.transports import Transports
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.robots.registry import RobotState
from tests.relay_server.alerts.made_up import alert
from tests.relay_server.alerts.receiver import REACTOR
from tests.relay_server.edges.robot_ends import until
from tests.relay_server.memory import World, hangs


class Scene:
    """A relay's alerts on a real database; the robot rover, ann who operates it, vic who watches, eve who may not."""

    def __init__(self, world: World, store: AsyncDatabase) -> None:
        self.world = world
        self.store = store
        self.sent: list[NotificationMessage] = []
        self.step = 0.0
        self.access = Access(store, self.wall)
        self.journal = EventBus(store, self.wall)
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
        self.robot: RobotState = world.registry.presence(self.number, "rover", "default")
        world.robot = self.robot
        self.alerts = self.begin()
        ways = Transports(REACTOR, self.wall, (), ())
        self.desk = AlertService(
            self.alerts, ways, store, self.access, self.journal, world.clock.seconds, self.wall
        )

    def wall(self) -> float:
        """Unix time."""
        return 1.7e9 + self.world.clock.seconds() + self.step

    def begin(self) -> AlertHub:
        """A relay's alerts."""
        world = self.world
        thresholds = Thresholds(6.0, 0.2, 0.1)
        return AlertHub(
            world.clock, self.wall, self.store, self.access, world.registry, world.channels, world.desks,
            self.journal, thresholds, self._send,
        )  # fmt: skip

    async def _send(self, rule: Any, message: NotificationMessage) -> None:
        self.sent.append(message)

    def says(self, kind: str, **data: Any) -> None:
        """An event about the robot."""
        self.journal.event(kind, "test", cause="test", robot_id=self.number, **data)

    async def seen(self, name: str) -> list[str]:
        """Kinds of what somebody sees, by both ways."""
        listed = [each["kind"] for each in await self.desk.all(self.people[name])]
        assert sorted(listed) == sorted(each["kind"] for each in await self.desk.shown(self.people[name]))
        return sorted(listed)


@pytest.fixture
def scene(world: World, store: AsyncDatabase) -> Scene:
    """Nothing has happened yet."""
    return Scene(world, store)


@pytest_twisted.ensureDeferred
async def test_events_become_alerts_of_their_kind(scene: Scene) -> None:
    """What a robot tells is filed by what it may tell; to who lost control while nothing moved, nothing happened."""
    scene.says("robot.stopped", user="ann", why="smoke")
    scene.says("robot.stopped", user="vic", why="fire")
    scene.says("control.lost", user="ann", why="gone", moving=False)
    scene.says("robot.alert", level="error", text="x", alert_kind="diagnostics", about="motor", over=False)
    scene.says("robot.alert", level="odd", text="x", alert_kind="offline", about="", over=False)
    scene.says("other.event")
    assert await scene.seen("ann") == ["diagnostics", "robot", "stop"]
    assert await scene.seen("vic") == ["robot", "stop"]
    assert await scene.seen("eve") == []
    texts = {
        each["kind"]: (each["text"], each["level"]) for each in await scene.desk.all(scene.people["ann"])
    }
    assert texts["stop"] == ("stopped by ann: smoke", "warning")
    assert texts["robot"] == ("x", "warning")
    scene.says("robot.resumed")
    scene.says("control.lost", user="ann", why="gone", moving=True)
    scene.says("control.taken")
    lasting = await scene.desk.all(scene.people["ann"], open=True)
    assert sorted(each["kind"] for each in lasting) == ["diagnostics", "robot"]


@pytest_twisted.ensureDeferred
async def test_what_somebody_may_not_see_hides_nothing_from_him(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However much of it there is, and of whatever part: he gets what is older. One who may sees all."""
    rover = scene.number
    topics = REFUSED + 50
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
        found = await scene.desk.all(scene.people["vic"], "rover", lasts)
        assert [each["id"] for each in found] == ["m0", "m1", "m2", "gone"]
    # Two of each: of what is refused the database gives little.
    assert reads == 4
    assert len(await scene.desk.all(scene.people["ann"], limit=500)) == 500
    assert await scene.desk.all(scene.people["vic"], "rover", False) == []


@pytest_twisted.ensureDeferred
async def test_a_list_goes_on_with_what_is_older(scene: Scene) -> None:
    """For each by what he may see, though what the list ended with is there no more, or was told again meanwhile."""
    rows = [
        alert(f"{number:03}", robot_id=scene.number, kind=kind, last=2e9 - number // 2)
        for number, kind in enumerate(["module", "diagnostics"] * (PAGE // 2 + 10))
    ]
    with scene.store.database.begin() as s:
        queries.save_alerts(s, rows)
    ann, vic = scene.people["ann"], scene.people["vic"]
    listed: list[str] = []
    before: AlertCursor | None = None
    while page := await scene.desk.all(ann, limit=100, before=before):
        listed += [each["id"] for each in page]
        before = AlertCursor(page[-1]["last"], page[-1]["id"])
        with scene.store.database.begin() as s:
            queries.save_alerts(s, [alert(page[-1]["id"], robot_id=scene.number, last=3e9)])
    assert listed == [each.id for each in rows]
    (oldest,) = await scene.desk.all(vic, limit=100, before=AlertCursor(2e9 - len(rows) // 2 + 2, "z"))
    assert oldest["kind"] == "module"


@pytest_twisted.ensureDeferred
async def test_a_rule_that_was_written_is_made_though_it_counts_later(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its secret is not lost, and nobody makes it twice; one that is removed is gone."""

    async def fails() -> None:
        raise Unavailable("the database is locked")

    with monkeypatch.context() as patch:
        patch.setattr(scene.alerts, "refresh", fails)
        made = await scene.desk.add_rule(
            scene.people["ann"], RuleRequest("webhook", url="https://example.org/x"), "192.0.2.9"
        )
        assert len(made["secret"]) >= 32
        (listed,) = (await scene.desk.rules(scene.people["ann"]))["rules"]
        assert listed["id"] == made["id"]
        await scene.desk.remove_rule(scene.people["ann"], made["id"], "192.0.2.9")
    assert (await scene.desk.rules(scene.people["ann"]))["rules"] == []


@pytest_twisted.ensureDeferred
async def test_operators_acknowledge_and_others_are_refused(scene: Scene) -> None:
    """Who may not know of it hears that there is none."""
    scene.says("robot.alert", level="error", text="x", alert_kind="diagnostics", about="motor", over=False)
    ((alert),) = await scene.desk.all(scene.people["ann"])
    for name in ("vic", "eve"):
        with pytest.raises(NotFound):
            await scene.desk.acknowledge(scene.people[name], alert["id"])
    scene.says("robot.stopped", user="ann", why="")
    stop = next(each for each in await scene.desk.all(scene.people["vic"]) if each["kind"] == "stop")
    with pytest.raises(Refused, match="operator"):
        await scene.desk.acknowledge(scene.people["vic"], stop["id"])
    done = await scene.desk.acknowledge(scene.people["ann"], alert["id"])
    assert done["acknowledged"]["by"] == "ann"
    with pytest.raises(NotFound):
        await scene.desk.acknowledge(scene.people["ann"], "zz")


@pytest_twisted.ensureDeferred
async def test_a_page_gets_the_same_list_until_something_changes(scene: Scene) -> None:
    """So that nothing is sent twice."""
    scene.says("robot.stopped", user="ann", why="")
    first = await scene.desk.shown(scene.people["ann"])
    assert await scene.desk.shown(scene.people["ann"]) is first
    scene.alerts.version += 1
    assert await scene.desk.shown(scene.people["ann"]) is first
    scene.says("robot.resumed")
    assert (await scene.desk.shown(scene.people["ann"]))[0]["state"] == "over"


@pytest_twisted.ensureDeferred
async def test_a_page_is_told_what_is_over_however_much_lasts(scene: Scene) -> None:
    """The latest ends keep places in a full list; the rest are the latest of what lasts."""

    def part(number: int, over: bool) -> None:
        about = f"part {number}"
        scene.says("robot.alert", level="error", text="x", alert_kind="diagnostics", about=about, over=over)
        scene.step += 1.0

    for number in range(150):
        part(number, over=False)
    for number in range(30):
        part(number, over=True)
    shown = await scene.desk.shown(scene.people["ann"])
    over = {each["about"] for each in shown if each["state"] == "over"}
    assert len(shown) == 100
    assert over == {f"part {number}" for number in range(5, 30)}
    assert {each["about"] for each in shown} - over == {f"part {number}" for number in range(75, 150)}


@pytest_twisted.ensureDeferred
async def test_a_rule_tells_its_user_what_he_may_know(scene: Scene) -> None:
    """Rules of both; only who may hear diagnostics is told of them. Secrets are shown once."""
    ask = RuleRequest("webhook", url="https://example.org/hook")
    made = await scene.desk.add_rule(scene.people["ann"], ask, "192.0.2.9")
    assert len(made["secret"]) >= 32
    await scene.desk.add_rule(scene.people["vic"], ask, "192.0.2.9")
    (listed,) = (await scene.desk.rules(scene.people["ann"]))["rules"]
    assert "secret" not in listed
    assert listed["url"] == "https://example.org/…"
    scene.says("robot.alert", level="error", text="x", alert_kind="diagnostics", about="motor", over=False)
    scene.world.clock.advance(1)
    await scene.access.robots(scene.people["vic"])
    await until(lambda: len(scene.sent) >= 1)
    assert len(scene.sent) == 1
    with pytest.raises(NotFound):
        await scene.desk.remove_rule(scene.people["vic"], made["id"], "192.0.2.9")
    await scene.desk.remove_rule(scene.people["ann"], made["id"], "192.0.2.9")
    entries = await scene.store.read(queries.list_audit)
    assert [each.action for each in entries].count("alert_rule.add") == 2
    assert "/hook" not in str(entries)


@pytest_twisted.ensureDeferred
async def test_a_rule_tells_nothing_of_a_robot_its_user_has_lost(scene: Scene) -> None:
    """As soon as rights are taken up; of what is his again he is told."""
    await scene.desk.add_rule(
        scene.people["ann"], RuleRequest("webhook", url="https://example.org/hook"), "192.0.2.9"
    )
    scene.alerts.tell(scene.robot, "module", "one", "error", "x")
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
        scene.alerts.tell(scene.robot, "module", about, "error", "x")
        scene.world.clock.advance(1)
    await until(lambda: len(scene.sent) == 2)
    assert [[each.alert.about for each in message.notices] for message in scene.sent] == [["one"], ["three"]]


@pytest_twisted.ensureDeferred
async def test_what_is_told_of_a_robot_is_its_realms(scene: Scene) -> None:
    """By which it is offered to the rules there, and to no others; also after another relay has begun."""
    with scene.store.database.begin() as s:
        queries.add_realm(s, "lab1")
        number = queries.add_robot(s, "rover", realm="lab1").id
    robot = scene.world.registry.presence(number, "rover", "lab1")
    scene.alerts.tell(robot, "module", "arm", "error", "x")
    await scene.alerts.flush()
    later = scene.begin()
    await later.start()
    for book in (scene.alerts.book, later.book):
        assert [each.realm for each in book] == ["lab1"]
    later.hush()


@pytest_twisted.ensureDeferred
async def test_a_rule_of_robots_of_a_realm_is_refused(scene: Scene) -> None:
    """Names are those of one's own; nothing is kept."""
    with pytest.raises(Invalid, match="own realm"):
        await scene.desk.add_rule(
            scene.people["ann"], RuleRequest("portal", robots="rover@default"), "192.0.2.9"
        )
    assert (await scene.desk.rules(scene.people["ann"]))["rules"] == []


@pytest_twisted.ensureDeferred
async def test_rules_are_not_tested_without_end(scene: Scene) -> None:
    """Five at once, then one each twelve seconds."""
    made = await scene.desk.add_rule(scene.people["ann"], RuleRequest("portal"), "192.0.2.9")
    for _ in range(5):
        assert (await scene.desk.test_rule(scene.people["ann"], made["id"]))["ok"]
    with pytest.raises(TooManyRuleChanges):
        await scene.desk.test_rule(scene.people["ann"], made["id"])
    scene.world.clock.advance(13)
    assert (await scene.desk.test_rule(scene.people["ann"], made["id"]))["ok"]


@pytest_twisted.ensureDeferred
async def test_another_relay_goes_on_where_one_was_killed(scene: Scene) -> None:
    """What lasts lasts; a robot that does not come back is missed after a while."""
    scene.says("robot.stopped", user="ann", why="")
    await scene.alerts.flush()
    later = scene.begin()
    await later.start()
    assert later.lasts(scene.robot, "stop") == "warning"
    later._absent = {scene.number: ("rover", "default")}
    scene.world.clock.pump([0.25] * int(4 * ABSENT_SECONDS + 8))
    assert later.lasts(scene.robot, "offline") == "error"
    later.hush()
    await later.keep()


@pytest_twisted.ensureDeferred
async def test_control_lost_as_a_relay_was_killed_is_told_by_the_robot(scene: Scene) -> None:
    """In its words, and by each registration once more until that is heard; it is over when somebody takes control."""
    text = "ann lost control while the robot moved: its link to the relay was lost"
    for _ in range(2):
        scene.says("robot.alert", level="warning", text=text, alert_kind="control", about="", over=False)
    (told,) = await scene.desk.all(scene.people["vic"])
    assert (told["kind"], told["level"], told["text"], told["count"]) == ("control", "error", text, 2)
    scene.says("control.taken")
    assert await scene.desk.all(scene.people["vic"], open=True) == []


@pytest_twisted.ensureDeferred
async def test_of_a_loss_of_control_that_a_relay_has_seen_it_needs_no_word(scene: Scene) -> None:
    """What it told, and somebody acknowledged, does not come back when the robot does."""
    scene.says("control.taken")
    scene.says("control.lost", user="ann", why="the robot's link was lost", moving=True)
    (told,) = await scene.desk.all(scene.people["ann"])
    await scene.desk.acknowledge(scene.people["ann"], told["id"])
    scene.says("robot.alert", level="error", text="x", alert_kind="control", about="", over=False)
    assert await scene.desk.all(scene.people["ann"], open=True) == []
    scene.says("robot.alert", level="error", text="x", alert_kind="control", about="goals", over=False)
    (other,) = await scene.desk.all(scene.people["ann"], open=True)
    assert (other["kind"], other["about"]) == ("robot", "goals")


@pytest_twisted.ensureDeferred
async def test_a_daemon_that_began_anew_has_forgotten_what_it_told(scene: Scene) -> None:
    """What it told before is over; what it tells again lasts."""
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
    scene.world.clock.pump([0.25] * int(4 * AGAIN_SECONDS + 1))
    assert scene.alerts.lasting(scene.robot, "diagnostics") == ["arm"]
    scene.alerts.hush()
    await scene.alerts.keep()


@pytest.mark.parametrize("says_so", [False, True])
@pytest_twisted.ensureDeferred
async def test_a_daemon_that_begins_anew_while_a_part_is_in_error_is_no_news(
    scene: Scene, says_so: bool
) -> None:
    """It hears of it seconds later and tells it again: nobody is told that it was over, also if clocks are set."""
    told = {"level": "error", "text": "x", "alert_kind": "diagnostics", "about": "motor", "over": False}
    await scene.alerts.start()
    scene.world.robot_comes()
    scene.robot.description = link.Describe(started=1.0)
    scene.says("robot.online")
    scene.says("robot.alert", **told)
    scene.says("robot.alert", **{**told, "alert_kind": "gripper"})
    scene.world.clock.advance(1)
    scene.step = -3600.0
    scene.says("robot.online")
    scene.robot.description = link.Describe(started=2.0)
    scene.world.clock.pump([0.25] * 24)
    scene.says("robot.alert", **told)
    if says_so:
        scene.journal.tell("robot.alerts_told", scene.number)
    scene.world.clock.pump([0.25] * int(4 * AGAIN_SECONDS))
    (motor,) = [each for each in scene.alerts.book if each.kind == "diagnostics"]
    assert (motor.over, motor.news, motor.times) == (None, 1, 2)
    assert scene.alerts.lasting(scene.robot, "gripper") == []
    scene.alerts.hush()
    await scene.alerts.keep()


@pytest_twisted.ensureDeferred
async def test_a_robot_that_was_removed_leaves_no_alerts(scene: Scene) -> None:
    """Neither shown nor kept."""
    scene.says("robot.stopped", user="ann", why="")
    await scene.store.write(queries.remove_robot, scene.number)
    await scene.alerts.refresh()
    await scene.alerts.flush()
    assert list(scene.alerts.book) == []


@pytest_twisted.ensureDeferred
async def test_an_acknowledgement_in_the_database_is_taken_up(scene: Scene) -> None:
    """And lasts, whatever the robot says next; but one of before the alert became worse is not."""
    told = {"text": "x", "alert_kind": "module", "over": False}
    for about in ("arm", "leg"):
        scene.says("robot.alert", level="warning", about=about, **told)
    await scene.alerts.flush()
    for each in list(scene.alerts.book):
        await scene.store.write(queries.acknowledge_alert, each.id, "cli:root", scene.wall())
    scene.says("robot.alert", level="warning", about="arm", **told)
    scene.says("robot.alert", level="error", about="leg", **told)
    await scene.alerts.refresh()
    assert {each.about: each.ack_by for each in scene.alerts.book} == {"arm": "cli:root", "leg": None}
    await scene.alerts.flush()
    rows = await scene.store.read(queries.list_alerts)
    assert {each.about: each.ack_by for each in rows} == {"arm": "cli:root", "leg": None}


@pytest_twisted.ensureDeferred
async def test_pages_are_told_when_there_is_something_else_to_show(scene: Scene) -> None:
    """What is only told again waits for the tidying; in a flood as well."""
    await scene.alerts.start()
    told = {"level": "error", "text": "x", "alert_kind": "diagnostics", "over": False}
    for each in range(kinds.OPEN + 1):
        scene.says("robot.alert", about=f"part {each}", **told)
    before = scene.alerts.version
    for each in range(kinds.OPEN + 1):
        scene.says("robot.alert", about=f"part {each}", **told)
    assert scene.alerts.version == before
    scene.says("robot.stopped", user="ann", why="")
    assert scene.alerts.version == before + 1
    scene.says("robot.resumed")
    assert scene.alerts.version == before + 2
    scene.world.clock.pump([0.25] * TIDY_EVERY)
    assert scene.alerts.version > before + 2
    scene.alerts.hush()
    await scene.alerts.keep()


@pytest_twisted.ensureDeferred
async def test_what_a_robot_tells_no_more_is_over_also_for_another_relay(scene: Scene) -> None:
    """Once it says that it has told all; its words without an end last, and what the relay knows itself."""
    told = {"level": "error", "text": "x", "over": False}
    parts = (("diagnostics", "motor"), ("diagnostics", "arm"), ("module", "guard"), ("gripper", "left"))
    for kind, about in parts:
        scene.says("robot.alert", alert_kind=kind, about=about, **told)
    scene.says("robot.stopped", user="ann", why="")
    scene.alerts.hush()
    await scene.alerts.keep()
    scene.alerts = later = scene.begin()
    await later.start()
    scene.says("robot.online")
    scene.says("robot.alert", alert_kind="diagnostics", about="arm", **told)
    scene.says("robot.alert", alert_kind="diagnostics", about="lidar", **told)
    assert len(later.book.open_of(scene.number)) == 6
    for _ in range(2):
        scene.journal.tell("robot.alerts_told", scene.number)
        lasting = {(each.kind, each.about) for each in later.book.open_of(scene.number)}
        assert lasting == {
            ("diagnostics", "arm"),
            ("diagnostics", "lidar"),
            ("gripper", "left"),
            ("stop", ""),
        }
    later.hush()
    await later.keep()


@pytest_twisted.ensureDeferred
async def test_a_robot_that_was_removed_is_not_remembered(scene: Scene) -> None:
    """Whether it had alerts or not."""
    await scene.alerts.start()
    scene.world.robot_comes()
    scene.robot.description = link.Describe(started=1.0)
    scene.says("robot.online")
    scene.says("control.taken")
    scene.world.clock.pump([0.25] * 4)
    alerts = scene.alerts
    kept = (alerts._came, alerts._daemons, alerts._untold, alerts._steered)
    assert [list(each) for each in (alerts._came, alerts._daemons, alerts._steered)] == [[scene.number]] * 3
    scene.says("robot.online")
    await alerts.refresh()
    assert scene.number in alerts._steered
    await scene.store.write(queries.remove_robot, scene.number)
    await alerts.refresh()
    assert not any(kept)
    alerts.hush()
    await alerts.keep()


@pytest_twisted.ensureDeferred
async def test_a_robot_that_is_removed_before_it_is_missed_does_not_come_back(scene: Scene) -> None:
    """Neither in the registry nor with an alert."""
    await scene.alerts.start()
    scene.alerts._absent = {scene.number: ("rover", "default")}
    await scene.store.write(queries.remove_robot, scene.number)
    scene.world.registry.forget(scene.number)
    await scene.alerts.refresh()
    scene.world.clock.pump([0.25] * int(4 * ABSENT_SECONDS + 8))
    assert scene.world.registry.find(scene.number) is None
    assert list(scene.alerts.book) == []
    scene.alerts.hush()
    await scene.alerts.keep()


@pytest.mark.parametrize("by_robot", [True, False])
@pytest_twisted.ensureDeferred
async def test_control_lost_as_a_relay_ends_is_told_by_the_next_once(scene: Scene, by_robot: bool) -> None:
    """By the robot's word, or when it has lasted for a moment."""
    await scene.desk.add_rule(
        scene.people["ann"], RuleRequest("webhook", url="https://example.org/hook"), "192.0.2.9"
    )
    scene.says("control.taken")
    scene.alerts.hush()
    scene.says("control.lost", user="ann", why="the relay is going down", moving=True)
    scene.world.clock.advance(5)
    await scene.alerts.keep()
    assert scene.sent == []
    scene.alerts = later = scene.begin()
    await later.start()
    if by_robot:
        scene.says("robot.alert", level="error", text="x", alert_kind="control", about="", over=False)
    else:
        scene.world.clock.pump([0.25] * TIDY_EVERY)
    await until(lambda: later.tellers.unheard() != set())
    scene.world.clock.advance(1)
    await until(lambda: bool(scene.sent))
    scene.world.clock.pump([0.25] * TIDY_EVERY)
    told = [(each.alert.kind, each.event) for message in scene.sent for each in message.notices]
    assert told == [("control", "begun")]
    later.hush()
    await later.keep()


@pytest.mark.parametrize("arrived", [True, False])
@pytest_twisted.ensureDeferred
async def test_what_waited_when_a_relay_ended_is_told_by_the_next_if_it_lasts(
    scene: Scene, arrived: bool
) -> None:
    """Once, and not what had arrived."""
    await scene.desk.add_rule(
        scene.people["ann"], RuleRequest("webhook", url="https://example.org/hook"), "192.0.2.9"
    )
    scene.alerts.tell(scene.robot, "module", "arm", "warning", "x")
    scene.alerts.tell(scene.robot, "module", "leg", "warning", "x")
    await until(lambda: scene.alerts.tellers.unheard() != set())
    if arrived:

        def all_sent() -> bool:
            scene.world.clock.advance(1)
            return scene.alerts.tellers.unheard() == set()

        await until(all_sent)
        scene.sent.clear()
    scene.alerts.hush()
    await scene.alerts.keep()
    scene.alerts = later = scene.begin()
    await later.start()
    later.over(scene.robot, "module", "leg")
    scene.world.clock.pump([0.25] * TIDY_EVERY)
    await until(lambda: later.tellers.unheard() != set() or arrived)
    scene.world.clock.advance(61)
    await until(lambda: bool(scene.sent))
    told = [(each.alert.about, each.event) for message in scene.sent for each in message.notices]
    assert told == ([("leg", "over")] if arrived else [("arm", "begun")])
    later.hush()
    await later.keep()


@pytest_twisted.ensureDeferred
async def test_a_relay_that_goes_waits_a_moment_for_its_database(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not for as long as that hangs."""
    scene.says("robot.stopped", user="ann", why="")
    monkeypatch.setattr(scene.store, "write", hangs)
    scene.alerts.hush()
    kept = Deferred.fromCoroutine(scene.alerts.keep())
    scene.world.clock.advance(KEEP_SECONDS - 0.1)
    assert not kept.called
    with capturedLogs() as logs:
        scene.world.clock.advance(0.2)
    assert kept.called
    assert "not taken them within 3 s" in str(formatEvent(logs[-1]))


@pytest_twisted.ensureDeferred
async def test_an_alert_is_not_written_while_it_is_being_written(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever asks for it, what comes later is written later, and both wait until theirs is."""
    doors: list[Deferred[None]] = []
    write = scene.store.write

    async def slow(*what: Any) -> Any:
        doors.append(Deferred())
        await doors[-1]
        return await write(*what)

    monkeypatch.setattr(scene.store, "write", slow)
    scene.alerts.tell(scene.robot, "module", "arm", "warning", "first")
    first = Deferred.fromCoroutine(scene.alerts.flush())
    scene.alerts.tell(scene.robot, "module", "arm", "error", "second")
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
