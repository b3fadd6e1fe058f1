"""The clock for the age of commands."""

from __future__ import annotations

import time

import pytest

from relay_protocol.clocks import now_ns

ASLEEP = 3_600_000_000_000


def test_a_suspend_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """After an hour of suspend, during which the monotonic clock stood still, an hour has passed."""
    before = time.monotonic_ns()
    monkeypatch.setattr(time, "CLOCK_BOOTTIME", 7, raising=False)
    slept = {7: ASLEEP}
    monkeypatch.setattr(
        time, "clock_gettime_ns", lambda which: time.monotonic_ns() + slept[which], raising=False
    )
    assert now_ns() - before >= ASLEEP


def test_without_such_a_clock_the_monotonic_one_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Systems that cannot measure suspends have the monotonic clock."""
    monkeypatch.delattr(time, "CLOCK_BOOTTIME", raising=False)
    before = time.monotonic_ns()
    assert before <= now_ns() <= time.monotonic_ns()
