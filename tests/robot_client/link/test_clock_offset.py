"""The offset between two monotonic clocks, and the age of commands by it."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from robot_client.link.clock_offset import DRIFT, ClockOffset
from robot_client.motion.command_age import CommandAge, freshness

MS = 1_000_000
SECOND = 1000 * MS
DEADLINE_MS = 500
DRIFT_PPM = 1_000_000 // DRIFT

delays = st.one_of(st.integers(0, 5 * MS), st.integers(0, 400 * MS), st.integers(0, 3 * SECOND))
"""One way through a network: mostly quick, at times slow, at times stalled."""


def age_at_most(offset: ClockOffset, stamp: int, now: int) -> int:
    """The greatest possible age."""
    found = offset.max_age(stamp, now)
    assert found is not None
    return found


@given(
    true=st.integers(-(10**15), 10**15),
    drift=st.integers(-DRIFT_PPM, DRIFT_PPM),
    exchanges=st.lists(st.tuples(delays, delays), min_size=1, max_size=40),
    since=st.integers(0, 3 * SECOND),
    over=st.one_of(st.integers(1, 10), st.integers(1, 3 * SECOND)),
)
def test_no_command_older_than_the_deadline_is_ever_fresh(
    true: int, drift: int, exchanges: list[tuple[int, int]], since: int, over: int
) -> None:
    """For any delays of pings and commands, and any drift."""
    start = 10**15

    def relay(own: int) -> int:
        return own + true + (own - start) * drift // 1_000_000

    offset = ClockOffset()
    now = start
    for there, back in exchanges:
        offset.add(now, relay(now + there), now + there + back)
        now += there + back + SECOND
    now += since
    assert freshness(relay(now) - DEADLINE_MS * MS - over, now, offset, DEADLINE_MS) is not CommandAge.FRESH


@given(st.integers(-(10**15), 10**15), st.integers(1, 60), st.integers(0, (DEADLINE_MS - 50) * MS))
def test_commands_in_time_pass_on_a_symmetric_link(true: int, count: int, age: int) -> None:
    """With 25 ms in each direction."""
    offset = ClockOffset()
    now = 10**15
    for _ in range(count):
        offset.add(now, now + 25 * MS + true, now + 50 * MS)
        now += SECOND
    assert freshness(now + true - age, now, offset, DEADLINE_MS) is CommandAge.FRESH


def test_asymmetric_delay_does_not_hide_the_age() -> None:
    offset = ClockOffset()
    for second in range(16):
        offset.add(second * SECOND, second * SECOND, second * SECOND + 400 * MS)
    now = 16 * SECOND
    assert freshness(now - 690 * MS, now, offset, DEADLINE_MS) is CommandAge.STALE


def test_stalled_join_does_not_hide_the_age() -> None:
    offset = ClockOffset()
    offset.add(0, 0, SECOND)
    assert freshness(10 * MS, SECOND, offset, DEADLINE_MS) is CommandAge.STALE


def test_the_tightest_exchange_counts() -> None:
    offset = ClockOffset()
    offset.add(0, 1090 * MS, 100 * MS)
    offset.add(200 * MS, 1201 * MS, 202 * MS)
    offset.add(300 * MS, 1385 * MS, 400 * MS)
    assert 1 * MS <= age_at_most(offset, 1400 * MS, 400 * MS) < 2 * MS


def test_suspended_clock_is_detected() -> None:
    """The first exchange replaces all before it."""
    offset = ClockOffset()
    for second in range(16):
        offset.add(second * SECOND, second * SECOND, second * SECOND + MS)
    offset.add(20 * SECOND, 30 * SECOND, 20 * SECOND + 10 * MS)
    assert 0 <= age_at_most(offset, 30 * SECOND, 20 * SECOND) <= 10 * MS


def test_pong_from_the_future_is_ignored() -> None:
    offset = ClockOffset()
    offset.add(500, 0, 400)
    assert not offset.known
    assert offset.max_age(0, 400) is None
