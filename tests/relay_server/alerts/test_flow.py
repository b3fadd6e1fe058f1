"""A topic that came regularly and ceases is stale; anything else is not."""

from __future__ import annotations

import itertools

import pytest

from relay_server.alerts.monitors import TopicWatch


class Scene:
    """A topic looked at once a second."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.count = 0
        self.flow = TopicWatch(self.now, 0)

    def goes(self, hertz: float, seconds: float) -> bool:
        """It comes at this rate; whether it was stale at any look."""
        begun, was = self.now, False
        before = self.count
        for second in itertools.count(1):
            if second > seconds:
                return was
            self.now = begun + second
            self.count = before + int(second * hertz)
            was = self.flow.look(self.now, self.count) or was
        return was

    def ceases(self, most: float = 60.0) -> float | None:
        """After how many seconds it is stale."""
        for second in range(1, int(most) + 1):
            self.now += 1
            if self.flow.look(self.now, self.count):
                return second
        return None


@pytest.fixture
def scene() -> Scene:
    """Nothing has come yet."""
    return Scene()


@pytest.mark.parametrize(("hertz", "after"), [(1000, 4), (50, 4), (10, 4), (2, 4), (1, 6)])
def test_what_ceases_is_stale_after_some_of_its_periods(scene: Scene, hertz: float, after: float) -> None:
    """More than five, and more than three seconds; looks are a second apart."""
    assert not scene.goes(hertz, 30)
    assert scene.ceases() == after


def test_it_is_stale_until_it_comes_again_and_regular_before_it_is_stale_again(scene: Scene) -> None:
    """One sample ends it; the next time it takes ten regular seconds more."""
    scene.goes(10, 30)
    scene.ceases()
    scene.now += 100
    assert scene.flow.look(scene.now, scene.count)
    scene.count += 1
    scene.now += 1
    assert not scene.flow.look(scene.now, scene.count)
    assert scene.ceases() is None
    scene.goes(10, 30)
    assert scene.ceases() == 4


@pytest.mark.parametrize(("hertz", "seconds"), [(10, 8), (0.5, 300), (0.9, 300), (0, 300)])
def test_what_came_too_short_or_too_seldom_is_never_stale(scene: Scene, hertz: float, seconds: float) -> None:
    """There is nothing to expect."""
    scene.goes(hertz, seconds)
    assert scene.ceases() is None


def test_what_comes_in_bursts_is_never_stale(scene: Scene) -> None:
    """Five seconds on, five seconds off."""
    for _ in range(20):
        assert not scene.goes(50, 5)
        assert not scene.goes(0, 5)
    assert scene.ceases() is None


def test_what_came_since_the_beginning_is_known(scene: Scene) -> None:
    """Not what came before."""
    flow = TopicWatch(0.0, 7)
    assert not flow.came
    flow.look(1.0, 8)
    assert flow.came


def test_time_in_which_nothing_could_come_does_not_count(scene: Scene) -> None:
    """Neither as a pause nor for the period; what does not come after it is stale in its time."""
    scene.goes(1, 30)
    period = scene.flow.period
    for _ in range(60):
        scene.now += 1
        scene.flow.excuse(scene.now)
    assert (scene.flow.stale, scene.flow.period) == (False, period)
    assert scene.ceases() == 6


def test_what_was_stale_before_stays_so(scene: Scene) -> None:
    """Until it comes."""
    scene.goes(10, 30)
    scene.ceases()
    scene.now += 10
    scene.flow.excuse(scene.now)
    assert scene.flow.stale
    assert scene.flow.grows(scene.count + 1)
    assert not scene.flow.grows(scene.count)
