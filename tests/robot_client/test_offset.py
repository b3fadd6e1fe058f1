"""The offset between two monotonic clocks."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from robot_client.offset import Offset

MS = 1_000_000


@given(
    st.integers(-(10**15), 10**15),
    st.lists(st.tuples(st.integers(0, 400 * MS), st.integers(0, 400 * MS)), min_size=1, max_size=30),
)
def test_error_holds_the_true_offset(true: int, exchanges: list[tuple[int, int]]) -> None:
    """However unequal the two ways are, the true offset lies within the stated error."""
    offset = Offset()
    now = 10**15
    for there, back in exchanges:
        offset.add(now, now + there + true, now + there + back)
        now += there + back + 1000 * MS
    found = -offset.age(0, 0) * -1
    assert abs(found - true) <= offset.error + 1


def test_smallest_round_trip_wins() -> None:
    """One quick exchange among slow ones decides."""
    offset = Offset()
    offset.add(0, 1000 * MS + 90 * MS, 100 * MS)
    offset.add(200 * MS, 1200 * MS + 1 * MS, 202 * MS)
    offset.add(300 * MS, 1300 * MS + 5 * MS, 400 * MS)
    assert offset.error == 1 * MS
    assert offset.age(1000 * MS, 0) == 0


def test_stopped_clock_is_noticed() -> None:
    """After a suspend of ten seconds, which stops one clock only, the first exchange replaces all before it."""
    offset = Offset()
    for second in range(16):
        offset.add(second * 1000 * MS, second * 1000 * MS, second * 1000 * MS + MS)
    offset.add(20_000 * MS, 30_000 * MS, 20_010 * MS)
    assert abs(offset.age(30_000 * MS, 20_000 * MS)) <= 5 * MS


def test_pong_from_the_future_is_passed_over() -> None:
    """A pong for a ping that was not yet sent says nothing."""
    offset = Offset()
    offset.add(500, 0, 400)
    assert not offset.known
