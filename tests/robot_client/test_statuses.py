"""What actions publish of their goals, in memory."""

from __future__ import annotations

import pytest
from twisted.internet.defer import CancelledError
from twisted.internet.task import Clock

from relay_protocol.errors import Unavailable
from robot_client.motion.goal_status_reader import AFTER, SETTLED, STATUS, WITHIN, GoalStatusReader, going
from robot_client.platforms.memory import MemoryPlatform
from tests.robot_client.goal_statuses import published

SPIN = "/spin"


def statuses(*codes: int) -> bytes:
    return published((bytes(16), code) for code in codes)


class Scene:
    def __init__(self) -> None:
        self.clock = Clock()
        self.platform = MemoryPlatform()
        self.statuses = GoalStatusReader(self.platform, self.clock)
        self.told: list[bool] = []

    def ask(self) -> None:
        self.statuses.going(SPIN).addCallback(lambda ids: self.told.append(bool(ids)))
        self.clock.advance(AFTER)


@pytest.mark.parametrize(
    ("codes", "found"),
    [
        ((), False),
        ((0,), False),
        ((1,), True),
        ((2,), True),
        ((3,), False),
        ((4, 5, 6, 3), False),
        ((4, 6, 2), True),
    ],
)
def test_goals_that_are_accepted_or_executing_go_on(codes: tuple[int, ...], found: bool) -> None:
    """Wherever in the list; those that are being cancelled, or have ended, do not."""
    assert bool(going(statuses(*codes))) is found


def test_goals_are_told_by_their_ids() -> None:
    """Of those alone that go on."""
    ids = [bytes(range(at, at + 16)) for at in (1, 50, 100)]
    assert going(published(zip(ids, (2, 4, 1), strict=True))) == {ids[0], ids[2]}


@pytest.mark.parametrize(
    "body",
    [b"", b"\0\1\0\0", b"\0\1\0\0\xff\xff\xff\xff", statuses(4, 2)[:-1]],
    # What ROS fills up with is not the same each time.
    ids=["empty", "no count", "too many", "half of two"],
)
def test_what_is_cut_short_tells_of_nothing(body: bytes) -> None:
    """However many goals it says it has."""
    assert going(body) == frozenset()


def test_a_goal_that_goes_on_is_told_at_once() -> None:
    """Who comes late gets the latest that was published; it is listened to for no longer than that takes."""
    scene = Scene()
    scene.ask()
    scene.platform.emit(SPIN + STATUS, statuses(2), statuses(4))
    scene.clock.advance(0)
    assert scene.told == [True]
    assert scene.platform.sources == []
    assert scene.clock.getDelayedCalls() == []


@pytest.mark.parametrize(("late", "found"), [((3, 1), True), ((4,), False)])
def test_a_goal_that_was_on_its_way_is_waited_for(late: tuple[int, ...], found: bool) -> None:
    """An action that has none, or cancels all it has, is listened to for half a second in all."""
    scene = Scene()
    scene.ask()
    scene.platform.emit(SPIN + STATUS, statuses(3))
    scene.clock.advance(SETTLED - AFTER - 0.01)
    assert scene.told == []
    scene.platform.emit(SPIN + STATUS, statuses(*late))
    scene.clock.advance(0.01)
    scene.clock.advance(0)
    assert scene.told == [found]
    assert scene.platform.sources == []
    assert scene.clock.getDelayedCalls() == []


def test_an_action_that_is_found_late_is_not_waited_for_again() -> None:
    """What was on its way has arrived by then."""
    scene = Scene()
    scene.ask()
    scene.clock.advance(WITHIN - 0.01)
    scene.platform.emit(SPIN + STATUS, statuses(3))
    assert scene.told == [False]


def test_an_action_that_publishes_nothing_has_no_goals() -> None:
    """For all one can know; after a moment it is left."""
    scene = Scene()
    scene.ask()
    scene.clock.advance(WITHIN)
    scene.clock.advance(0)
    assert scene.told == [False]
    assert scene.platform.sources == []


@pytest.mark.parametrize("passed", [0.0, AFTER])
def test_who_does_not_want_to_know_any_more_leaves_nothing(passed: float) -> None:
    """Before it is listened to, and meanwhile."""
    scene = Scene()
    asked = scene.statuses.going(SPIN)
    scene.clock.advance(passed)
    failures: list[object] = []
    asked.addErrback(lambda failure: failures.append(failure.check(CancelledError)))
    asked.cancel()
    scene.clock.advance(0)
    assert failures == [CancelledError]
    assert scene.platform.sources == []
    assert scene.clock.getDelayedCalls() == []


def test_an_action_that_can_not_be_listened_to_has_no_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing else fails by that."""
    scene = Scene()

    def broken(*args: object) -> None:
        raise Unavailable("no middleware")

    monkeypatch.setattr(scene.platform, "subscribe", broken)
    scene.ask()
    assert scene.told == [False]
