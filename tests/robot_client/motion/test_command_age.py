"""The age of commands, as a function of time."""

from __future__ import annotations

import pytest

from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.command_age import CommandAge, freshness

MS = 1_000_000


@pytest.fixture
def offset() -> ClockOffset:
    made = ClockOffset()
    # The relay's clock is 7 s ahead, known to 5 ms, and to 1 ms more after a second.
    made.add(0, 7000 * MS + 5 * MS, 10 * MS)
    return made


@pytest.mark.parametrize(
    ("age", "verdict"),
    [
        (0, CommandAge.FRESH),
        (493, CommandAge.FRESH),
        (496, CommandAge.STALE),
        (60_000, CommandAge.STALE),
        (-4, CommandAge.FRESH),
        (-7, CommandAge.AHEAD),
    ],
)
def test_age_classifies_a_command(offset: ClockOffset, age: int, verdict: CommandAge) -> None:
    """Older than 500 ms: stale; further ahead than the clocks can explain: refused too."""
    now = 1000 * MS
    assert freshness(now + 7000 * MS - age * MS, now, offset, 500) is verdict


def test_command_is_stale_while_the_clock_offset_is_unknown() -> None:
    assert freshness(0, 0, ClockOffset(), 500) is CommandAge.STALE
