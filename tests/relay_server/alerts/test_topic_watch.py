"""A topic is stale only if it was regular and has stopped."""

from __future__ import annotations

import itertools

import pytest

from relay_server.alerts.monitors import TopicWatch


class Scene:
    """A topic that is checked once a second."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.count = 0
        self.flow = TopicWatch(self.now, 0)

    def goes(self, hertz: float, seconds: float) -> bool:
        """Samples arrive at this rate; returns whether the topic was stale at any check."""
        begun, was = self.now, False
        before = self.count
        for second in itertools.count(1):
            if second > seconds:
                return was
            self.now = begun + second
            self.count = before + int(second * hertz)
            was = self.flow.update(self.now, self.count) or was
        return was

    def ceases(self, most: float = 60.0) -> float | None:
        """Samples stop; returns the seconds until the topic is stale."""
        for second in range(1, int(most) + 1):
            self.now += 1
            if self.flow.update(self.now, self.count):
                return second
        return None


@pytest.fixture
def scene() -> Scene:
    """A topic without samples."""
    return Scene()


@pytest.mark.parametrize(("hertz", "after"), [(1000, 4), (50, 4), (10, 4), (2, 4), (1, 6)])
def test_a_topic_is_stale_after_some_periods(scene: Scene, hertz: float, after: float) -> None:
    """Stale means more than five periods and more than 3 s; checks are 1 s apart."""
    assert not scene.goes(hertz, 30)
    assert scene.ceases() == after


def test_it_is_stale_until_it_comes_again_and_regular_before_it_is_stale_again(scene: Scene) -> None:
    """One sample ends the alert; after that the topic must be regular for 10 s."""
    scene.goes(10, 30)
    scene.ceases()
    scene.now += 100
    assert scene.flow.update(scene.now, scene.count)
    scene.count += 1
    scene.now += 1
    assert not scene.flow.update(scene.now, scene.count)
    assert scene.ceases() is None
    scene.goes(10, 30)
    assert scene.ceases() == 4


@pytest.mark.parametrize(("hertz", "seconds"), [(10, 8), (0.5, 300), (0.9, 300), (0, 300)])
def test_short_or_rare_topics_are_never_stale(scene: Scene, hertz: float, seconds: float) -> None:
    """They have no regular period."""
    scene.goes(hertz, seconds)
    assert scene.ceases() is None


def test_topics_in_bursts_are_never_stale(scene: Scene) -> None:
    for _ in range(20):
        assert not scene.goes(50, 5)
        assert not scene.goes(0, 5)
    assert scene.ceases() is None


def test_samples_since_the_beginning_are_known(scene: Scene) -> None:
    flow = TopicWatch(0.0, 7)
    assert not flow.has_samples
    flow.update(1.0, 8)
    assert flow.has_samples


def test_time_in_which_nothing_could_come_does_not_count(scene: Scene) -> None:
    scene.goes(1, 30)
    period = scene.flow.period
    for _ in range(60):
        scene.now += 1
        scene.flow.excuse(scene.now)
    assert (scene.flow.stale, scene.flow.period) == (False, period)
    assert scene.ceases() == 6


def test_a_stale_topic_stays_stale(scene: Scene) -> None:
    """Until the next sample."""
    scene.goes(10, 30)
    scene.ceases()
    scene.now += 10
    scene.flow.excuse(scene.now)
    assert scene.flow.stale
    assert scene.flow.has_new(scene.count + 1)
    assert not scene.flow.has_new(scene.count)
