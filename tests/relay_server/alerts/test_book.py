"""What is told again joins what is there; floods and forgetting are bounded."""

from __future__ import annotations

import itertools

import pytest

from relay_db.queries import AlertRecord
from relay_server.alerts import types as kinds
from relay_server.alerts.store import AlertChange, AlertStore, Moment
from relay_server.alerts.types import AlertEvent

ROBOT = 1


class Scene:
    """A book about one robot, and its time."""

    def __init__(self) -> None:
        numbers = itertools.count(1)
        self.book = AlertStore(lambda: f"a{next(numbers)}")
        self.now = 1000.0
        """By the wall clock, and by the monotonic one but for what the first was set."""
        self.set = 0.0

    @property
    def moment(self) -> Moment:
        """By both clocks."""
        return Moment(self.now + self.set, self.now)

    def tell(
        self, kind: str = "offline", about: str = "", level: str = "error", text: str = "x"
    ) -> list[str]:
        """Something is wrong; what is worth telling of it."""
        return events(self.book.tell(ROBOT, "rover", "lab1", kind, about, level, text, self.moment))

    def over(self, kind: str = "offline", about: str = "") -> list[str]:
        """It is well again."""
        return events(self.book.over(ROBOT, kind, about, self.moment))

    def sweep(self) -> list[str]:
        """The book is tidied."""
        return events(self.book.sweep(self.moment))

    @property
    def only(self) -> AlertRecord:
        """The one alert there is."""
        (alert,) = self.book
        return alert


def events(changes: list[AlertChange]) -> list[str]:
    """Kinds and events."""
    return [f"{each.alert.kind} {each.event.value}" for each in changes]


@pytest.fixture
def scene() -> Scene:
    """Nothing has happened yet."""
    return Scene()


def test_the_same_told_again_is_one_alert_and_no_news(scene: Scene) -> None:
    """It counts, and keeps the latest words."""
    assert scene.tell(text="first") == ["offline begun"]
    scene.now += 5
    assert scene.tell(text="second") == []
    alert = scene.only
    assert (alert.times, alert.text, alert.first, alert.last, alert.news) == (2, "second", 1000, 1005, 1)


def test_another_part_or_kind_is_another_alert(scene: Scene) -> None:
    """Robots, kinds and parts don't mix."""
    scene.tell("diagnostics", "motor")
    scene.tell("diagnostics", "camera")
    scene.tell("module", "camera")
    scene.book.tell(2, "other", "default", "module", "camera", "error", "x", scene.moment)
    assert len(list(scene.book)) == 4


def test_what_becomes_worse_is_news_and_needs_looking_after_anew(scene: Scene) -> None:
    """And it does not become better by a milder word."""
    scene.tell("battery", level="warning")
    scene.book.acknowledge("a1", "ann", scene.now, scene.moment)
    assert scene.only.ack_by == "ann"
    assert scene.tell("battery", level="error") == ["battery worse"]
    assert (scene.only.level, scene.only.ack_by, scene.only.news) == ("error", None, 2)
    assert scene.tell("battery", level="info") == []
    assert scene.only.level == "error"


def test_what_is_over_is_told_once(scene: Scene) -> None:
    """Of what never began there is no end."""
    assert scene.over() == []
    scene.tell()
    assert scene.over() == ["offline over"]
    assert scene.over() == []
    assert scene.only.over == scene.now


def test_what_comes_back_soon_is_the_same_alert(scene: Scene) -> None:
    """After five minutes it is a new one."""
    scene.tell()
    scene.over()
    scene.now += kinds.REJOIN_SECONDS - 1
    assert scene.tell() == ["offline begun"]
    assert (scene.only.id, scene.only.times, scene.only.over) == ("a1", 2, None)
    scene.over()
    scene.now += kinds.REJOIN_SECONDS
    scene.tell()
    assert [each.id for each in scene.book] == ["a2"]


def test_what_flaps_is_news_once_a_minute(scene: Scene) -> None:
    """Its end is told when its beginning was; what came back and stays is told when the minute is over."""
    told = [*scene.tell(), *scene.over()]
    for _ in range(20):
        scene.now += 1
        told += [*scene.tell(), *scene.over()]
    assert told == ["offline begun", "offline over"]
    scene.now += 1
    assert scene.tell() == []
    assert scene.sweep() == []
    scene.now += kinds.NEWS_SECONDS
    assert scene.sweep() == ["offline begun"]
    assert scene.sweep() == []
    assert scene.over() == ["offline over"]


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_a_wall_clock_that_is_set_holds_up_nothing(scene: Scene, step: float) -> None:
    """What came back is told in its time, and what is over, floods as well, is forgotten in its time."""
    scene.tell()
    scene.over()
    scene.tell("flood")
    scene.now += 1
    scene.set = step
    assert scene.tell() == []
    scene.now += kinds.NEWS_SECONDS
    assert sorted(scene.sweep()) == ["flood over", "offline begun"]
    assert scene.over() == ["offline over"]
    scene.now += kinds.REJOIN_SECONDS - 1
    assert scene.tell() == ["offline begun"]
    assert {each.id for each in scene.book if each.kind == "offline"} == {"a1"}
    scene.over()
    scene.now += kinds.SHOWN_SECONDS + 1
    scene.sweep()
    assert list(scene.book) == []


def test_what_was_kept_before_the_clock_was_set_back_is_of_now(scene: Scene) -> None:
    """It is forgotten as late as what is over now, not an hour later."""
    scene.tell()
    scene.over()
    later = Scene()
    later.set = -3600.0
    later.book.load(scene.book.take_changed(), later.moment)
    assert [each.id for each in later.book] == ["a1"]
    later.now += kinds.SHOWN_SECONDS + 1
    later.sweep()
    assert list(later.book) == []


def test_what_comes_back_worse_is_news_at_once(scene: Scene) -> None:
    """Than what people were told within the minute; but what changes to and fro is not."""
    scene.tell("diagnostics", level="warning")
    scene.over("diagnostics")
    scene.now += 1
    assert scene.tell("diagnostics", level="error") == ["diagnostics worse"]
    assert (scene.only.id, scene.only.level) == ("a1", "error")
    told = []
    for _ in range(20):
        scene.now += 1
        told += scene.over("diagnostics")
        told += scene.tell("diagnostics", level="warning")
        told += scene.tell("diagnostics", level="error")
    assert told == ["diagnostics over"]
    scene.now += kinds.NEWS_SECONDS
    assert scene.sweep() == ["diagnostics begun"]


def test_what_came_back_as_bad_and_gets_worse_is_news(scene: Scene) -> None:
    """Though its coming back was none."""
    scene.tell("diagnostics", level="warning")
    scene.over("diagnostics")
    assert scene.tell("diagnostics", level="warning") == []
    assert scene.tell("diagnostics", level="error") == ["diagnostics worse"]
    assert scene.over("diagnostics") == ["diagnostics over"]


def test_what_was_acknowledged_while_no_relay_ran_is_over_by_that(scene: Scene) -> None:
    """If nobody will tell its end; else it lasts, and its keeper is known."""
    scene.tell("robot")
    scene.tell("module", "arm")
    kept = [each._replace(ack_by="cli:root", ack_at=1001.0) for each in scene.book.take_changed()]
    later = Scene()
    later.book.load(kept, later.moment)
    ended = [later.book.acknowledge(each.id, "cli:root", 1001.0, later.moment)[1] for each in kept]
    assert [events(each) for each in ended] == [["robot over"], []]
    assert {each.kind: (each.ack_by, each.over) for each in later.book} == {
        "robot": ("cli:root", later.now),
        "module": ("cli:root", None),
    }


def test_an_acknowledged_alert_names_who_looks_after_it(scene: Scene) -> None:
    """The first counts; it lasts until it is over."""
    scene.tell()
    found, changes = scene.book.acknowledge("a1", "ann", 1001.0, scene.moment)
    assert (found, changes) == (scene.only, [])
    scene.book.acknowledge("a1", "bob", 1002.0, scene.moment)
    assert (scene.only.ack_by, scene.only.ack_at, scene.only.over) == ("ann", 1001.0, None)
    assert scene.book.acknowledge("zz", "bob", 1002.0, scene.moment) == (None, [])


@pytest.mark.parametrize("kind", ["control", "robot", "gripper"])
def test_what_nobody_tells_the_end_of_is_over_when_it_is_acknowledged(scene: Scene, kind: str) -> None:
    """Or a day after it was told last."""
    scene.tell(kind)
    found, changes = scene.book.acknowledge("a1", "ann", scene.now, scene.moment)
    assert events(changes) == [f"{kind} over"]
    assert found is not None
    assert found.over == scene.now
    scene.now += kinds.REJOIN_SECONDS
    scene.tell(kind)
    scene.now += kinds.ENDLESS_SECONDS
    assert scene.sweep() == [f"{kind} over"]


def test_a_robot_has_a_bounded_number_of_alerts(scene: Scene) -> None:
    """The rest is counted in one, which is over when none comes any more."""
    for each in range(kinds.OPEN + 50):
        scene.tell("diagnostics", f"part {each}", text="the motor is hot")
    flood = scene.book.lasts(ROBOT, kinds.FLOOD)
    assert flood is not None
    assert flood.times == 50
    assert flood.text == "50 more alerts of rover are not kept one by one"
    assert len(scene.book.open_of(ROBOT)) == kinds.OPEN + 1
    scene.now += kinds.FLOOD_SECONDS
    assert scene.sweep() == ["flood over"]


@pytest.mark.parametrize("kind", [kinds.OFFLINE, kinds.BATTERY, kinds.STOP, kinds.CONTROL])
def test_a_flood_hides_nothing_the_relay_knows_itself(scene: Scene, kind: str) -> None:
    """Of which there is one of each."""
    for each in range(kinds.OPEN + 50):
        scene.tell("diagnostics", f"part {each}")
    assert scene.tell(kind) == [f"{kind} begun"]
    assert scene.book.lasts(ROBOT, kind) is not None


def test_a_flood_hides_no_process_that_died(scene: Scene) -> None:
    """Its camera's, its guard's: so many parts have a place of their own."""
    for each in range(kinds.OPEN + 50):
        scene.tell("diagnostics", f"part {each}", "warning")
    assert scene.tell("module", "guard") == ["module begun"]
    assert scene.tell("module", "camera") == ["module begun"]
    assert len(scene.book.open_of(ROBOT)) == kinds.OPEN + 3


def test_the_places_beside_a_flood_are_few(scene: Scene) -> None:
    """Whatever parts a robot makes up, and however soon each is well again; one that comes back keeps its place."""
    for each in range(kinds.OPEN):
        scene.tell("diagnostics", f"part {each}", "warning")
    for each in range(100):
        scene.now += 0.001
        scene.tell("module", f"made up {each}")
        scene.over("module", f"made up {each}")
    known = [each for each in scene.book if each.kind == kinds.MODULE]
    assert len(known) == kinds.RESERVE
    scene.now += kinds.REJOIN_SECONDS
    for each in range(kinds.OPEN):
        scene.tell("diagnostics", f"more {each}", "warning")
    assert scene.tell("module", "made up 0") == ["module begun"]


def test_a_flood_is_as_bad_as_the_worst_it_hides(scene: Scene) -> None:
    """A rule for errors, and one with quiet hours, must hear of it; it is a warning at least."""
    for each in range(kinds.OPEN + 1):
        scene.tell("diagnostics", f"part {each}", "info")
    flood = scene.book.lasts(ROBOT, kinds.FLOOD)
    assert flood is not None
    assert flood.level == "warning"
    assert scene.tell("diagnostics", "fire", "error") == ["flood worse"]
    assert scene.tell("diagnostics", "dust", "warning") == []
    flood = scene.book.lasts(ROBOT, kinds.FLOOD)
    assert flood is not None
    assert (flood.level, flood.times) == ("error", 3)


def test_new_alerts_of_a_robot_come_at_a_bounded_rate(scene: Scene) -> None:
    """Also when each is over at once: what is remembered of a robot stays small."""
    for each in range(5000):
        scene.now += 0.01
        scene.tell("diagnostics", f"part {each}")
        scene.over("diagnostics", f"part {each}")
    assert len(list(scene.book)) <= kinds.OPEN + 52
    other = scene.book.tell(2, "other", "default", "offline", "", "error", "x", scene.moment)
    assert events(other) == ["offline begun"]


def test_what_was_over_long_ago_is_forgotten(scene: Scene) -> None:
    """And with the last of it the robot."""
    scene.tell()
    scene.over()
    scene.now += kinds.SHOWN_SECONDS + 1
    assert scene.sweep() == []
    assert list(scene.book) == []
    assert scene.book._robots == {}


def test_what_changed_is_to_be_written_once(scene: Scene) -> None:
    """What could not be written comes again, but not over what has changed since."""
    scene.tell("offline")
    scene.tell("battery")
    first = scene.book.take_changed()
    assert [each.kind for each in first] == ["offline", "battery"]
    assert scene.book.take_changed() == []
    scene.over("offline")
    scene.book.put_back(first)
    again = {each.kind: each.over for each in scene.book.take_changed()}
    assert again == {"offline": scene.now, "battery": None}


def test_an_earlier_relays_alerts_go_on(scene: Scene) -> None:
    """What lasts is joined; its end is told."""
    scene.tell()
    kept = scene.book.take_changed()
    later = Scene()
    later.book.load(kept, later.moment)
    later.now += 60
    assert later.tell() == []
    assert later.only.id == "a1"
    assert later.over() == ["offline over"]


@pytest.mark.parametrize("set_back", [0.0, 3600.0])
def test_what_was_over_before_it_came_again_does_not_outlive_a_restart(scene: Scene, set_back: float) -> None:
    """Nor does its being forgotten touch what lasts, whatever the clock was set to in between."""
    scene.tell()
    scene.over()
    scene.now += kinds.REJOIN_SECONDS
    scene.set = -set_back
    scene.tell()
    later = Scene()
    later.now, later.set = scene.now, scene.set
    later.book.load(scene.book.take_changed(), later.moment)
    assert (later.only.id, later.only.over) == ("a2", None)
    later.now += kinds.SHOWN_SECONDS + 1
    assert later.sweep() == []
    assert later.tell() == []
    assert later.over() == ["offline over"]


def test_a_removed_robot_leaves_nothing(scene: Scene) -> None:
    """Not even something to write."""
    scene.tell()
    scene.book.forget(ROBOT)
    assert list(scene.book) == scene.book.take_changed() == []


def test_text_is_cut(scene: Scene) -> None:
    """Whatever a robot says."""
    scene.tell(text="x" * 10_000)
    assert len(scene.only.text) == kinds.TEXT


@pytest.mark.parametrize(
    ("told", "filed"),
    [
        (("battery", "left"), ("robot", "left")),
        (("offline", ""), ("robot", "offline")),
        (("", ""), ("robot", "")),
        (("Motor!", "x"), ("robot", "x")),
        (("module", "camera"), ("module", "camera")),
        (("gripper", "left"), ("gripper", "left")),
    ],
)
def test_a_robot_can_not_tell_what_only_the_relay_knows(
    told: tuple[str, str], filed: tuple[str, str]
) -> None:
    """It is filed as the robot's own word."""
    assert kinds.from_robot(*told) == filed


def test_an_unknown_level_is_a_warning() -> None:
    """No word of a robot makes an alert disappear."""
    assert kinds.known_level("disaster") == "warning"
    assert kinds.known_level("error") == "error"
    assert AlertEvent.WORSE.value == "worse"
