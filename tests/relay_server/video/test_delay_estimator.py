"""The delay of frames by two clocks, one of which may be set."""

from __future__ import annotations

import pytest

from relay_server.video.frames import (
    SPAN_SECONDS,
    STALE_SECONDS,
    STEADY_DELAY_SECONDS,
    STEADY_RANGE_SECONDS,
    DelayEstimator,
)
from tests.worlds.relay import World
from tests.worlds.viewers import Watcher, robot_comes, robot_joins, shows

FPS = 10


def seen(delays: list[float], lateness: DelayEstimator, began: float = 0.0) -> list[bool]:
    """Whether each of the frames, ten per second, may be shown.

    :param delays: of each, by the two clocks, seconds
    """
    times = [began + number / FPS for number in range(len(delays))]
    return [
        lateness.delay_of(now - delay, now) <= STALE_SECONDS for now, delay in zip(times, delays, strict=True)
    ]


@pytest.mark.parametrize("by", [0.6, 5.0, 3600.0])
def test_after_a_clock_was_set_back_frames_are_shown_within_two_seconds(by: float) -> None:
    """Their even delay shows that no frame was held up."""
    lateness = DelayEstimator()
    wavering = [0.02 * (number % 5) for number in range(100)]
    assert all(seen(wavering, lateness))
    shown = seen([by + each for each in wavering], lateness, 10.0)
    dark = shown.index(True) / FPS
    assert dark == pytest.approx(STEADY_DELAY_SECONDS, abs=2 / FPS)
    assert all(shown[shown.index(True) :])


def test_a_clock_that_is_set_forward_hides_nothing() -> None:
    """A smaller delay than before is accepted at once."""
    lateness = DelayEstimator()
    assert all(seen([3.0] * 20, lateness))
    assert all(seen([-3.0] * 20, lateness, 2.0))


def test_uneven_delay_counts_as_congestion() -> None:
    """No late frame is shown as long as recent frames were on time."""
    lateness = DelayEstimator()
    assert all(seen([0.0] * 20, lateness))
    uneven = [
        1.0 + 2 * STEADY_RANGE_SECONDS * (number % 2) for number in range(int(FPS * (SPAN_SECONDS - 3)))
    ]
    assert not any(seen(uneven, lateness, 2.0))


def test_a_heap_after_a_stall_is_not_shown() -> None:
    """Frames of several seconds arrive at once, each less late than the one before."""
    lateness = DelayEstimator()
    assert all(seen([0.0] * 20, lateness))
    late = [lateness.delay_of(2.0 + number / FPS, 8.0 + number / 1000) for number in range(60)]
    assert late[0] == pytest.approx(6.0)
    assert [each > STALE_SECONDS for each in late] == [True] * 56 + [False] * 4


def test_two_late_frames_are_too_few_to_learn_from() -> None:
    """A slow stream has two old frames in a row as well."""
    lateness = DelayEstimator()
    assert lateness.delay_of(0.0, 0.0) == 0
    assert lateness.delay_of(1.0, 4.0) == pytest.approx(3.0)
    assert lateness.delay_of(4.0, 7.0) == pytest.approx(3.0)
    assert lateness.delay_of(6.0, 9.0) == 0


def test_a_robot_that_reconnects_may_have_another_clock(world: World) -> None:
    """Its first frame is shown, whatever the former delay was."""
    robot_comes(world)
    watcher = Watcher()
    stream = watcher.watch(world)
    robot_joins(world)
    shows(world, stream, 1)
    world.robot_goes()
    robot_comes(world)
    robot_joins(world)
    shows(world, stream, 1, late=5.0)
    assert watcher.pictures[-1].good_until == world.clock.seconds() + STALE_SECONDS
