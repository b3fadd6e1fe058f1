"""A sender's window on links of all kinds, in simulated time."""

from __future__ import annotations

import heapq
import itertools
import statistics

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relay_protocol.pacing import LEAST, SMALL_FIRST, TARGET, SendWindow

STEP = 0.002
"""Seconds."""


class Link:
    """A link with one rate and an endless queue, as of a proxy and a kernel, and its sender.

    :param rate: bytes per second
    :param round_trip: seconds
    :param stalls: (begin, end): nothing arrives in between; delayed bytes arrive at the end
    """

    def __init__(self, rate: float, round_trip: float, stalls: tuple[tuple[float, float], ...] = ()) -> None:
        self.rate, self.round_trip, self.stalls = rate, round_trip, stalls
        self.window = SendWindow()
        self.chunk = min(16_000, max(500, int(rate * STEP)))
        """Bytes the sender writes at a time."""
        self.now = self.free_at = 0.0
        self.delays: list[tuple[float, float]] = []
        """When each probe was answered, and how long it took."""
        self.passed = 0
        self._answers: list[tuple[float, int, float]] = []
        self._serial = itertools.count()
        self._probed = 0

    def run(self, seconds: float, offered: float) -> None:
        """Sends this many bytes per second, within the window; the rest is dropped."""
        end, owed = self.now + seconds, 0.0
        pinged = self.now
        while self.now < end:
            self.now += STEP
            while self._answers and self._answers[0][0] <= self.now:
                at, key, sent = heapq.heappop(self._answers)
                self.window.answered(key, self.now)
                self.delays.append((self.now, at - sent))
            owed = min(owed + offered * STEP, 200_000.0)
            while owed >= self.chunk and self.window.room(self.now, small=True) >= self.chunk:
                self._write(self.chunk)
                owed -= self.chunk
                if self.window.sent - self._probed >= max(1000, self.window.size / 4):
                    self._probe(owed >= self.chunk)
            full = owed >= self.chunk
            if (full and not self.window.probed) or self.now - pinged >= 0.1:
                pinged = self.now
                self._probe(full)

    def _write(self, size: int) -> None:
        self.free_at = max(self.now, self.free_at) + size / self.rate
        self.window.sent += size
        self.passed += size

    def _probe(self, full: bool) -> None:
        key = next(self._serial)
        self.window.probe(key, self.now, full=full)
        self._probed = self.window.sent
        at = max(self.now, self.free_at) + self.round_trip
        for begin, end in self.stalls:
            if begin <= at < end:
                at = end
        heapq.heappush(self._answers, (at, key, self.now))

    def late(self, since: float) -> list[float]:
        """The additional delay of each probe over the empty link, from a given time on."""
        return [trip - self.round_trip for at, trip in self.delays if at >= since]


@given(rate=st.floats(20_000, 20_000_000), round_trip=st.floats(0.0005, 0.3), more=st.floats(1.2, 30))
@settings(deadline=None, max_examples=25)
def test_a_probe_waits_little_on_any_link_and_the_link_stays_busy(
    rate: float, round_trip: float, more: float
) -> None:
    """For any rate and round trip, and any excess of offered data."""
    link = Link(rate, round_trip)
    link.run(16, more * rate)
    late = link.late(since=10)
    # The minimum window takes long on a very slow link.
    assert statistics.median(late) <= 1.6 * TARGET + 0.3 * round_trip + 2 * LEAST / rate
    assert link.passed >= 0.6 * 16 * rate


def test_a_link_that_becomes_thin_and_free_again_is_followed() -> None:
    """Within two seconds in each direction."""
    link = Link(5_000_000, 0.02)
    link.run(5, 2_000_000)
    link.rate = 100_000
    link.run(10, 2_000_000)
    assert statistics.median(link.late(since=9)) <= 2 * TARGET
    assert link.window.rate == pytest.approx(100_000, rel=0.3)
    link.rate = 5_000_000
    link.run(2, 2_000_000)
    before = link.passed
    link.run(5, 2_000_000)
    assert link.passed - before >= 0.9 * 5 * 2_000_000


def test_a_machine_that_answers_late_does_not_make_a_link_thin() -> None:
    """Half of the time there are no answers; the sent data needs only the window, so that stays."""
    stalls = tuple((1 + number / 2, 1.25 + number / 2) for number in range(20))
    link = Link(50_000_000, 0.001, stalls)
    link.run(10, 100_000)
    assert not link.window.limited
    assert link.window.room(link.now, small=True) >= SMALL_FIRST / 2
    assert link.passed >= 0.99 * 10 * 100_000


def test_a_link_that_becomes_longer_is_measured_again() -> None:
    """From then on the window fits the longer round trip."""
    link = Link(1_000_000, 0.01)
    link.run(5, 3_000_000)
    link.round_trip = 0.3
    link.run(8, 3_000_000)
    before = link.passed
    link.run(5, 3_000_000)
    assert link.passed - before >= 0.6 * 5 * 1_000_000


def test_an_answer_to_no_probe_changes_nothing() -> None:
    """A peer may send unsolicited pongs (RFC 6455 section 5.5.3)."""
    window = SendWindow()
    window.sent = 1000
    window.probe(b"a", 0.0, full=False)
    assert not window.answered(b"b", 1.0)
    assert window.flight == 1000
    assert window.answered(b"a", 1.0)
    assert window.flight == 0
    assert not window.answered(b"a", 1.0)
