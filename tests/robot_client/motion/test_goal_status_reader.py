"""The status of goals as actions publish it, in memory."""

from __future__ import annotations

import pytest
from twisted.internet.defer import CancelledError
from twisted.internet.task import Clock

from relay_protocol.errors import Unavailable
from robot_client.motion.goal_status_reader import (
    NEW_GOAL_SECONDS,
    READ_AFTER,
    STATUS,
    STATUS_SECONDS,
    GoalStatusReader,
    active_goals,
)
from tests.worlds.goal_statuses import published
from tests.worlds.memory_platform import MemoryPlatform

SPIN = "/spin"


def statuses(*codes: int) -> bytes:
    return published((bytes(16), code) for code in codes)


class Scene:
    def __init__(self) -> None:
        self.clock = Clock()
        self.platform = MemoryPlatform()
        self.statuses = GoalStatusReader(self.platform, self.clock)
        self.results: list[bool] = []

    def ask(self) -> None:
        self.statuses.active_goals(SPIN).addCallback(lambda ids: self.results.append(bool(ids)))
        self.clock.advance(READ_AFTER)


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
def test_accepted_and_executing_goals_are_active(codes: tuple[int, ...], found: bool) -> None:
    """At any place in the list; cancelling and ended goals are not."""
    assert bool(active_goals(statuses(*codes))) is found


def test_active_goals_are_returned_by_id() -> None:
    ids = [bytes(range(at, at + 16)) for at in (1, 50, 100)]
    assert active_goals(published(zip(ids, (2, 4, 1), strict=True))) == {ids[0], ids[2]}


@pytest.mark.parametrize(
    "body",
    [b"", b"\0\1\0\0", b"\0\1\0\0\xff\xff\xff\xff", statuses(4, 2)[:-1]],
    # The padding of ROS varies.
    ids=["empty", "no count", "too many", "half of two"],
)
def test_truncated_status_has_only_complete_entries(body: bytes) -> None:
    assert active_goals(body) == frozenset()


def test_active_goal_is_returned_at_once() -> None:
    """A late subscriber gets the latest status; the subscription ends then."""
    scene = Scene()
    scene.ask()
    scene.platform.emit(SPIN + STATUS, statuses(2), statuses(4))
    scene.clock.advance(0)
    assert scene.results == [True]
    assert scene.platform.subscriptions == []
    assert scene.clock.getDelayedCalls() == []


@pytest.mark.parametrize(("late", "found"), [((3, 1), True), ((4,), False)])
def test_goals_are_awaited_for_half_a_second(late: tuple[int, ...], found: bool) -> None:
    scene = Scene()
    scene.ask()
    scene.platform.emit(SPIN + STATUS, statuses(3))
    scene.clock.advance(NEW_GOAL_SECONDS - READ_AFTER - 0.01)
    assert scene.results == []
    scene.platform.emit(SPIN + STATUS, statuses(*late))
    scene.clock.advance(0.01)
    scene.clock.advance(0)
    assert scene.results == [found]
    assert scene.platform.subscriptions == []
    assert scene.clock.getDelayedCalls() == []


def test_late_status_is_not_awaited_again() -> None:
    scene = Scene()
    scene.ask()
    scene.clock.advance(STATUS_SECONDS - 0.01)
    scene.platform.emit(SPIN + STATUS, statuses(3))
    assert scene.results == [False]


def test_action_without_a_status_has_no_goals() -> None:
    scene = Scene()
    scene.ask()
    scene.clock.advance(STATUS_SECONDS)
    scene.clock.advance(0)
    assert scene.results == [False]
    assert scene.platform.subscriptions == []


@pytest.mark.parametrize("passed", [0.0, READ_AFTER])
def test_cancelled_read_leaves_no_subscription(passed: float) -> None:
    """Before and after it was made."""
    scene = Scene()
    asked = scene.statuses.active_goals(SPIN)
    scene.clock.advance(passed)
    failures: list[object] = []
    asked.addErrback(lambda failure: failures.append(failure.check(CancelledError)))
    asked.cancel()
    scene.clock.advance(0)
    assert failures == [CancelledError]
    assert scene.platform.subscriptions == []
    assert scene.clock.getDelayedCalls() == []


def test_action_whose_status_can_not_be_subscribed_has_no_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()

    def broken(*args: object) -> None:
        raise Unavailable("no middleware")

    monkeypatch.setattr(scene.platform, "subscribe", broken)
    scene.ask()
    assert scene.results == [False]
