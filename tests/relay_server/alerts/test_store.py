"""Repeated reports join an open alert; the number of alerts is bounded, and old ones are removed."""

from __future__ import annotations

import itertools

import pytest

from relay_db.queries import AlertRecord
from relay_server.alerts import types as kinds
from relay_server.alerts.store import MAX_OVER, AlertChange, AlertStore, Moment
from relay_server.alerts.types import AlertEvent

ROBOT = 1


class Scene:
    """A store with one robot and a clock."""

    def __init__(self) -> None:
        numbers = itertools.count(1)
        self.store = AlertStore(lambda: f"a{next(numbers)}")
        self.now = 1000.0
        """By the wall clock, and by the monotonic one but for what the first was set."""
        self.set = 0.0

    @property
    def moment(self) -> Moment:
        """The current time of both clocks."""
        return Moment(self.now + self.set, self.now)

    def report(
        self, kind: str = "offline", about: str = "", level: str = "error", text: str = "x"
    ) -> list[str]:
        """Reports an alert; returns the events that are worth a notification."""
        return events(self.store.report(ROBOT, "rover", "lab1", kind, about, level, text, self.moment))

    def end(self, kind: str = "offline", about: str = "") -> list[str]:
        return events(self.store.end(ROBOT, kind, about, self.moment))

    def sweep(self) -> list[str]:
        """Removes old alerts."""
        return events(self.store.sweep(self.moment))

    @property
    def only(self) -> AlertRecord:
        """The only alert in the store."""
        (alert,) = self.store
        return alert


def events(changes: list[AlertChange]) -> list[str]:
    """Kinds and events."""
    return [f"{each.alert.kind} {each.event.value}" for each in changes]


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_a_repeated_report_is_one_alert_and_no_news(scene: Scene) -> None:
    """It counts the repetitions and keeps the latest text."""
    assert scene.report(text="first") == ["offline begun"]
    scene.now += 5
    assert scene.report(text="second") == []
    alert = scene.only
    assert (alert.report_count, alert.text, alert.first, alert.last, alert.notification_count) == (
        2,
        "second",
        1000,
        1005,
        1,
    )


def test_another_part_or_kind_is_another_alert(scene: Scene) -> None:
    scene.report("diagnostics", "motor")
    scene.report("diagnostics", "camera")
    scene.report("module", "camera")
    scene.store.report(2, "other", "default", "module", "camera", "error", "x", scene.moment)
    assert len(list(scene.store)) == 4


def test_becoming_worse_is_news_and_resets_the_acknowledgement(scene: Scene) -> None:
    scene.report("battery", level="warning")
    scene.store.acknowledge("a1", "ann", scene.now, scene.moment)
    assert scene.only.ack_by == "ann"
    assert scene.report("battery", level="error") == ["battery worse"]
    assert (scene.only.level, scene.only.ack_by, scene.only.notification_count) == ("error", None, 2)
    assert scene.report("battery", level="info") == []
    assert scene.only.level == "error"


def test_an_end_is_announced_once(scene: Scene) -> None:
    assert scene.end() == []
    scene.report()
    assert scene.end() == ["offline over"]
    assert scene.end() == []
    assert scene.only.over == scene.now


def test_an_alert_that_returns_soon_is_the_same_alert(scene: Scene) -> None:
    """After five minutes it is a new one."""
    scene.report()
    scene.end()
    scene.now += kinds.REJOIN_SECONDS - 1
    assert scene.report() == ["offline begun"]
    assert (scene.only.id, scene.only.report_count, scene.only.over) == ("a1", 2, None)
    scene.end()
    scene.now += kinds.REJOIN_SECONDS
    scene.report()
    assert [each.id for each in scene.store] == ["a2"]


def test_a_flapping_alert_is_news_once_a_minute(scene: Scene) -> None:
    reported = [*scene.report(), *scene.end()]
    for _ in range(20):
        scene.now += 1
        reported += [*scene.report(), *scene.end()]
    assert reported == ["offline begun", "offline over"]
    scene.now += 1
    assert scene.report() == []
    assert scene.sweep() == []
    scene.now += kinds.NEWS_SECONDS
    assert scene.sweep() == ["offline begun"]
    assert scene.sweep() == []
    assert scene.end() == ["offline over"]


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_a_wall_clock_that_is_set_holds_up_nothing(scene: Scene, step: float) -> None:
    scene.report()
    scene.end()
    scene.report("flood")
    scene.now += 1
    scene.set = step
    assert scene.report() == []
    scene.now += kinds.NEWS_SECONDS
    assert sorted(scene.sweep()) == ["flood over", "offline begun"]
    assert scene.end() == ["offline over"]
    scene.now += kinds.REJOIN_SECONDS - 1
    assert scene.report() == ["offline begun"]
    assert {each.id for each in scene.store if each.kind == "offline"} == {"a1"}
    scene.end()
    scene.now += kinds.SHOWN_SECONDS + 1
    scene.sweep()
    assert list(scene.store) == []


def test_stored_times_in_the_future_count_as_now(scene: Scene) -> None:
    """It is removed as late as an alert that ends now, not an hour later."""
    scene.report()
    scene.end()
    later = Scene()
    later.set = -3600.0
    later.store.load(scene.store.take_changed(), later.moment)
    assert [each.id for each in later.store] == ["a1"]
    later.now += kinds.SHOWN_SECONDS + 1
    later.sweep()
    assert list(later.store) == []


def test_returning_worse_is_news_at_once(scene: Scene) -> None:
    scene.report("diagnostics", level="warning")
    scene.end("diagnostics")
    scene.now += 1
    assert scene.report("diagnostics", level="error") == ["diagnostics worse"]
    assert (scene.only.id, scene.only.level) == ("a1", "error")
    reported = []
    for _ in range(20):
        scene.now += 1
        reported += scene.end("diagnostics")
        reported += scene.report("diagnostics", level="warning")
        reported += scene.report("diagnostics", level="error")
    assert reported == ["diagnostics over"]
    scene.now += kinds.NEWS_SECONDS
    assert scene.sweep() == ["diagnostics begun"]


def test_becoming_worse_after_returning_is_news(scene: Scene) -> None:
    scene.report("diagnostics", level="warning")
    scene.end("diagnostics")
    assert scene.report("diagnostics", level="warning") == []
    assert scene.report("diagnostics", level="error") == ["diagnostics worse"]
    assert scene.end("diagnostics") == ["diagnostics over"]


def test_an_acknowledgement_without_a_relay_ends_endless_alerts(scene: Scene) -> None:
    scene.report("robot")
    scene.report("module", "arm")
    kept = [each._replace(ack_by="cli:root", ack_at=1001.0) for each in scene.store.take_changed()]
    later = Scene()
    later.store.load(kept, later.moment)
    ended = [later.store.acknowledge(each.id, "cli:root", 1001.0, later.moment)[1] for each in kept]
    assert [events(each) for each in ended] == [["robot over"], []]
    assert {each.kind: (each.ack_by, each.over) for each in later.store} == {
        "robot": ("cli:root", later.now),
        "module": ("cli:root", None),
    }


def test_an_acknowledged_alert_names_the_user(scene: Scene) -> None:
    """The first acknowledgement counts, until the alert ends."""
    scene.report()
    found, changes = scene.store.acknowledge("a1", "ann", 1001.0, scene.moment)
    assert (found, changes) == (scene.only, [])
    scene.store.acknowledge("a1", "bob", 1002.0, scene.moment)
    assert (scene.only.ack_by, scene.only.ack_at, scene.only.over) == ("ann", 1001.0, None)
    assert scene.store.acknowledge("zz", "bob", 1002.0, scene.moment) == (None, [])


@pytest.mark.parametrize("kind", ["control", "robot", "gripper"])
def test_endless_alerts_end_when_acknowledged(scene: Scene, kind: str) -> None:
    scene.report(kind)
    found, changes = scene.store.acknowledge("a1", "ann", scene.now, scene.moment)
    assert events(changes) == [f"{kind} over"]
    assert found is not None
    assert found.over == scene.now
    scene.now += kinds.REJOIN_SECONDS
    scene.report(kind)
    scene.now += kinds.ENDLESS_SECONDS
    assert scene.sweep() == [f"{kind} over"]


def test_a_robot_has_a_bounded_number_of_alerts(scene: Scene) -> None:
    """Further alerts are counted in one alert, which ends when no more of them arrive."""
    for each in range(kinds.MAX_OPEN + 50):
        scene.report("diagnostics", f"part {each}", text="the motor is hot")
    flood = scene.store.find_open(ROBOT, kinds.FLOOD)
    assert flood is not None
    assert flood.report_count == 50
    assert flood.text == "50 more alerts of rover are not listed one by one"
    assert len(scene.store.open_of(ROBOT)) == kinds.MAX_OPEN + 1
    scene.now += kinds.FLOOD_SECONDS
    assert scene.sweep() == ["flood over"]


@pytest.mark.parametrize("kind", [kinds.OFFLINE, kinds.BATTERY, kinds.STOP, kinds.CONTROL])
def test_a_flood_hides_nothing_the_relay_knows_itself(scene: Scene, kind: str) -> None:
    for each in range(kinds.MAX_OPEN + 50):
        scene.report("diagnostics", f"part {each}")
    assert scene.report(kind) == [f"{kind} begun"]
    assert scene.store.find_open(ROBOT, kind) is not None


def test_a_flood_hides_no_process_that_died(scene: Scene) -> None:
    """Alerts of the robot's own processes, such as camera and guard, have places of their own."""
    for each in range(kinds.MAX_OPEN + 50):
        scene.report("diagnostics", f"part {each}", "warning")
    assert scene.report("module", "guard") == ["module begun"]
    assert scene.report("module", "camera") == ["module begun"]
    assert len(scene.store.open_of(ROBOT)) == kinds.MAX_OPEN + 3


def test_the_places_beside_a_flood_are_few(scene: Scene) -> None:
    """The number of parts a robot invents, and how soon each ends, do not matter. An alert that returns keeps
    its place.
    """
    for each in range(kinds.MAX_OPEN):
        scene.report("diagnostics", f"part {each}", "warning")
    for each in range(100):
        scene.now += 0.001
        scene.report("module", f"made up {each}")
        scene.end("module", f"made up {each}")
    known = [each for each in scene.store if each.kind == kinds.MODULE]
    assert len(known) == kinds.RESERVE
    scene.now += kinds.REJOIN_SECONDS
    for each in range(kinds.MAX_OPEN):
        scene.report("diagnostics", f"more {each}", "warning")
    assert scene.report("module", "made up 0") == ["module begun"]


def test_a_flood_is_as_bad_as_the_worst_it_hides(scene: Scene) -> None:
    for each in range(kinds.MAX_OPEN + 1):
        scene.report("diagnostics", f"part {each}", "info")
    flood = scene.store.find_open(ROBOT, kinds.FLOOD)
    assert flood is not None
    assert flood.level == "warning"
    assert scene.report("diagnostics", "fire", "error") == ["flood worse"]
    assert scene.report("diagnostics", "dust", "warning") == []
    flood = scene.store.find_open(ROBOT, kinds.FLOOD)
    assert flood is not None
    assert (flood.level, flood.report_count) == ("error", 3)


def test_new_alerts_of_a_robot_come_at_a_bounded_rate(scene: Scene) -> None:
    for each in range(5000):
        scene.now += 0.01
        scene.report("diagnostics", f"part {each}")
        scene.end("diagnostics", f"part {each}")
    assert len(list(scene.store)) <= kinds.MAX_OPEN + 52
    other = scene.store.report(2, "other", "default", "offline", "", "error", "x", scene.moment)
    assert events(other) == ["offline begun"]


def test_old_ended_alerts_are_dropped(scene: Scene) -> None:
    scene.report()
    scene.end()
    scene.now += kinds.SHOWN_SECONDS + 1
    assert scene.sweep() == []
    assert list(scene.store) == []
    assert scene.store._robots == {}


def test_changed_alerts_are_written_once(scene: Scene) -> None:
    scene.report("offline")
    scene.report("battery")
    first = scene.store.take_changed()
    assert [each.kind for each in first] == ["offline", "battery"]
    assert scene.store.take_changed() == []
    scene.end("offline")
    scene.store.put_back(first)
    again = {each.kind: each.over for each in scene.store.take_changed()}
    assert again == {"offline": scene.now, "battery": None}


def test_an_earlier_relays_alerts_go_on(scene: Scene) -> None:
    scene.report()
    kept = scene.store.take_changed()
    later = Scene()
    later.store.load(kept, later.moment)
    later.now += 60
    assert later.report() == []
    assert later.only.id == "a1"
    assert later.end() == ["offline over"]


@pytest.mark.parametrize("set_back", [0.0, 3600.0])
def test_an_ended_version_does_not_replace_the_open_one_after_a_restart(
    scene: Scene, set_back: float
) -> None:
    scene.report()
    scene.end()
    scene.now += kinds.REJOIN_SECONDS
    scene.set = -set_back
    scene.report()
    later = Scene()
    later.now, later.set = scene.now, scene.set
    later.store.load(scene.store.take_changed(), later.moment)
    assert (later.only.id, later.only.over) == ("a2", None)
    later.now += kinds.SHOWN_SECONDS + 1
    assert later.sweep() == []
    assert later.report() == []
    assert later.end() == ["offline over"]


def test_a_removed_robot_leaves_nothing(scene: Scene) -> None:
    scene.report()
    scene.store.forget_robot(ROBOT)
    assert list(scene.store) == scene.store.take_changed() == []


def test_text_is_cut(scene: Scene) -> None:
    scene.report(text="x" * 10_000)
    assert len(scene.only.text) == kinds.MAX_TEXT


@pytest.mark.parametrize(
    ("reported", "filed"),
    [
        (("battery", "left"), ("robot", "left")),
        (("offline", ""), ("robot", "offline")),
        (("", ""), ("robot", "")),
        (("Motor!", "x"), ("robot", "x")),
        (("module", "camera"), ("module", "camera")),
        (("gripper", "left"), ("gripper", "left")),
    ],
)
def test_a_robot_cannot_report_kinds_of_the_relay(reported: tuple[str, str], filed: tuple[str, str]) -> None:
    """It is stored as a report of the robot."""
    assert kinds.from_robot(*reported) == filed


def test_an_unknown_level_is_a_warning() -> None:
    """A robot cannot hide an alert by an unknown level."""
    assert kinds.known_level("disaster") == "warning"
    assert kinds.known_level("error") == "error"
    assert AlertEvent.WORSE.value == "worse"


def mirrored(scene: Scene, *others: Scene) -> None:
    """What one relay has written comes to the others."""
    for record in scene.store.take_changed():
        for each in others:
            each.store.mirror(record, each.moment)


def test_alerts_of_another_relay_are_shown_here_and_change_nothing(scene: Scene) -> None:
    """They are continued here if their robot comes, and nobody is notified twice."""
    other = Scene()
    other.store._new_id = lambda: "b"
    scene.report(text="low", level="warning")
    mirrored(scene, other)
    assert other.only == scene.only
    assert (other.store.take_changed(), other.sweep()) == ([], [])
    assert other.report(text="low", level="warning") == []
    assert other.report(text="lower", level="error") == ["offline worse"]
    assert other.end() == ["offline over"]
    mirrored(other, scene)
    assert scene.only == other.only
    assert (scene.end(), scene.sweep(), scene.store.take_changed()) == ([], [], [])


def test_an_older_state_of_an_alert_is_not_taken_over(scene: Scene) -> None:
    """The database or a late notice may have one."""
    other = Scene()
    scene.report()
    (before,) = scene.store.take_changed()
    other.store.mirror(before, other.moment)
    scene.now += 10
    scene.store.acknowledge(before.id, "ann", scene.now, scene.moment)
    (acknowledged,) = scene.store.take_changed()
    scene.now += 10
    scene.end()
    (ended,) = scene.store.take_changed()
    for record in (ended, acknowledged, before, ended):
        other.store.mirror(record, other.moment)
        assert other.only == ended
    states = other.store.states
    other.store.mirror(ended, other.moment)
    assert other.store.states == states


def test_of_the_same_alert_of_two_relays_the_first_stays(scene: Scene) -> None:
    """Both have raised it before they knew of the other's. Each of them writes that the other one is over."""
    other = Scene()
    other.now += 0.5
    other.store._new_id = lambda: "b"
    scene.report()
    other.report()
    first, second = scene.store.take_changed(), other.store.take_changed()
    scene.store.mirror(second[0], scene.moment)
    other.store.mirror(first[0], other.moment)
    assert scene.only == other.only == first[0]
    for each in (scene, other):
        (written,) = each.store.take_changed()
        assert (written.id, written.over) == ("b", each.now)
        scene.store.mirror(written, scene.moment)
        other.store.mirror(written, other.moment)
    assert scene.only == other.only == first[0]
    assert scene.end() == ["offline over"]


def test_only_the_owner_of_a_robot_ends_and_announces_its_alerts_by_time(scene: Scene) -> None:
    other = Scene()
    scene.report("robot")
    mirrored(scene, other)
    for each in (scene, other):
        each.now += kinds.ENDLESS_SECONDS + 1
    assert events(other.store.sweep(other.moment, lambda robot_id: False)) == []
    assert events(scene.store.sweep(scene.moment, lambda robot_id: robot_id == ROBOT)) == ["robot over"]
    mirrored(scene, other)
    assert other.only.over is not None
    other.now += kinds.SHOWN_SECONDS + 1
    other.store.sweep(other.moment, lambda robot_id: False)
    assert list(other.store) == []


def test_ended_alerts_of_other_relays_are_bounded(scene: Scene) -> None:
    other = Scene()
    for number in range(MAX_OVER + 10):
        scene.report("diagnostics", f"part {number}")
        scene.now += 1
        scene.end("diagnostics", f"part {number}")
        mirrored(scene, other)
    assert len(list(other.store)) == MAX_OVER
