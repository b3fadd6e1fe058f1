"""One timer for many periodic calls."""

from __future__ import annotations

import functools

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.internet.task import Clock

from relay_server.common.clock import PeriodicTimer, PeriodicTimers


def test_streams_keep_their_own_rate() -> None:
    """From the first call on, for any number of streams."""
    clock = Clock()
    rounds = PeriodicTimers(clock)
    calls: list[tuple[str, float]] = []
    rounds.start(PeriodicTimer(lambda: calls.append(("slow", clock.seconds())), 2.0))
    clock.advance(0.05)
    rounds.start(PeriodicTimer(lambda: calls.append(("fast", clock.seconds())), 0.1))
    assert len(clock.getDelayedCalls()) == 1
    clock.pump([0.01] * 400)
    fast = [at for name, at in calls if name == "fast"]
    slow = [at for name, at in calls if name == "slow"]
    assert len(fast) in (40, 41)
    assert all(abs(at - (0.05 + 0.1 * number)) < 0.011 for number, at in enumerate(fast))
    assert [round(at) for at in slow] == [0, 2, 4]
    assert len(clock.getDelayedCalls()) == 1


def test_a_round_that_is_stopped_is_not_called_again() -> None:
    """It may stop itself, and the timer ends with the last."""
    clock = Clock()
    rounds = PeriodicTimers(clock)
    calls: list[int] = []

    def once_more() -> None:
        calls.append(1)
        if len(calls) == 3:
            begun.stop()

    begun = PeriodicTimer(once_more, 1.0)
    rounds.start(begun)
    clock.pump([1.0] * 10)
    assert len(calls) == 3
    assert not clock.getDelayedCalls()


def test_a_round_may_end_in_its_first_call() -> None:
    clock = Clock()
    calls: list[int] = []
    begun = PeriodicTimer(lambda: (calls.append(1), begun.stop()), 1.0)
    PeriodicTimers(clock).start(begun)
    clock.pump([1.0] * 3)
    assert calls == [1]


def test_a_new_interval_counts_after_the_next_call() -> None:
    """For example when a client's rights change."""
    clock = Clock()
    calls: list[float] = []
    begun = PeriodicTimer(lambda: calls.append(clock.seconds()), 0.5)
    PeriodicTimers(clock).start(begun)
    begun.interval = 2.0
    clock.pump([0.25] * 20)
    assert calls == [0.0, 0.5, 2.5, 4.5]


def test_missed_ticks_are_skipped() -> None:
    """A relay that was frozen sends one ping, not a hundred."""
    clock = Clock()
    calls: list[float] = []
    PeriodicTimers(clock).start(PeriodicTimer(lambda: calls.append(clock.seconds()), 0.1))
    clock.advance(10)
    assert len(calls) == 2
    clock.advance(0.1)
    assert len(calls) == 3


def test_a_failure_of_one_stops_no_other() -> None:
    """The error is logged, and the failing call is repeated too."""
    clock = Clock()
    rounds = PeriodicTimers(clock)
    failures: list[str] = []
    rounds.log = type("Log", (), {"failure": lambda self, text: failures.append(text)})()  # type: ignore[assignment]
    calls: list[int] = []

    def broken() -> None:
        raise RuntimeError("a fault")

    rounds.start(PeriodicTimer(broken, 1.0))
    rounds.start(PeriodicTimer(lambda: calls.append(1), 1.0))
    clock.pump([1.0] * 3)
    assert len(failures) == 4
    assert len(calls) == 4


@given(st.lists(st.sampled_from([0.1, 0.25, 1.0, 2.0]), min_size=1, max_size=8), st.integers(1, 30))
@settings(deadline=None, max_examples=50)
def test_each_timer_is_called_at_its_own_rate(intervals: list[float], seconds: int) -> None:
    """The rates of others do not matter."""
    clock = Clock()
    rounds = PeriodicTimers(clock)
    counts = [0] * len(intervals)

    def count(number: int) -> None:
        counts[number] += 1

    for number, interval in enumerate(intervals):
        rounds.start(PeriodicTimer(functools.partial(count, number), interval))
    clock.pump([0.05] * (20 * seconds))
    for found, interval in zip(counts, intervals, strict=True):
        assert abs(found - (1 + seconds / interval)) <= 1
