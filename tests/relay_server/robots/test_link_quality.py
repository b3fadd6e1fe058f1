"""The quality of a link, from its round trips."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_server.robots.link_quality import (
    LOSSES,
    NO_LINK,
    SPACING,
    UNKNOWN,
    WINDOW,
    LinkQuality,
    LinkQualityMeter,
    joined,
)


def measured(*trips: float, every: float = 1.0, start: float = 100.0) -> LinkQualityMeter:
    """A meter with these round trips, one after the other."""
    meter = LinkQualityMeter()
    for turn, trip in enumerate(trips):
        meter.answered(start + turn * every, trip)
    return meter


def test_quality_is_unknown_before_the_first_round_trip() -> None:
    """There are neither numbers nor a rating."""
    assert LinkQualityMeter().link_quality(100.0, [0.2]) == UNKNOWN


def test_median_percentile_and_jitter_are_of_the_window() -> None:
    """Values older than 30 s do not count."""
    meter = measured(*[0.01] * 10, *[0.02] * 10, 0.03)
    reading = meter.link_quality(120.0, [])
    assert (reading.rtt, reading.p95) == (0.02, 0.02)
    assert reading.jitter == pytest.approx(0.02 / 20)
    later = meter.link_quality(100.0 + WINDOW + 19.5, [])
    assert (later.rtt, later.p95, later.jitter) == (0.03, 0.03, None)
    assert meter.link_quality(500.0, []).rtt is None


@pytest.mark.parametrize(
    ("trip", "word"),
    [(0.001, "good"), (0.0999, "good"), (0.1, "fair"), (0.2999, "fair"), (0.3, "bad"), (0.9, "bad")],
)
def test_the_word_goes_by_the_median(trip: float, word: str) -> None:
    """Good below 100 ms, fair below 300 ms."""
    assert measured(*[trip] * 5).link_quality(104.0, []).quality == word


def test_the_word_goes_by_the_last_seconds() -> None:
    """A link that becomes slow is rated so at once, and good again as soon as it is."""
    meter = measured(*[0.01] * 20)
    for turn in range(5):
        meter.answered(120.0 + turn, 0.4)
    reading = meter.link_quality(124.5, [])
    assert (reading.quality, reading.rtt) == ("bad", 0.01)
    for turn in range(5):
        meter.answered(125.0 + turn, 0.01)
    assert meter.link_quality(129.5, []).quality == "good"


def test_pong_after_a_second_counts_as_lost() -> None:
    """Once in total, during the wait and after the answer."""
    meter = measured(0.01, 0.01)
    assert meter.link_quality(102.5, [1.1]).lost == 1
    assert meter.link_quality(102.5, [1.1]).quality == "bad"
    meter.answered(103.0, 1.6)
    reading = meter.link_quality(103.0, [])
    assert (reading.lost, reading.quality) == (1, "bad")
    for turn in range(5):
        meter.answered(104.0 + turn, 0.01)
    reading = meter.link_quality(108.5, [])
    assert (reading.lost, reading.quality) == (1, "good")
    assert meter.link_quality(140.0, []).lost == 0


def test_pings_that_were_passed_over_are_lost_only_when_they_were_late() -> None:
    """A client may answer only the latest of several pings."""
    meter = measured(0.01)
    meter.unanswered(101.0, 0.3)
    assert meter.link_quality(101.0, []).lost == 0
    meter.unanswered(101.0, 1.3)
    assert meter.link_quality(101.0, []).lost == 1


def test_silence_is_a_lost_link() -> None:
    """No answer for 3 s, before or after the first one."""
    assert measured(0.01).link_quality(104.0, [3.1, 2.1]).quality == "lost"
    assert LinkQualityMeter().link_quality(104.0, [3.1]).quality == "lost"


def test_of_frequent_round_trips_a_few_are_kept() -> None:
    """Ten per second for a minute take no more memory than a few per second, and the number of losses is
    bounded.
    """
    meter = measured(*[0.01] * 600, every=0.1)
    assert len(meter._trips) <= WINDOW / SPACING + 1
    for turn in range(1000):
        meter.answered(160.0 + turn / 1000, 1.5)
    assert meter.link_quality(161.0, []).lost == LOSSES


def test_two_links_one_after_the_other_take_the_time_of_both() -> None:
    """The result is not better than the sum, nor than either of them."""
    near = measured(*[0.06] * 5).link_quality(104.0, [])
    far = measured(*[0.07] * 5).link_quality(104.0, [])
    whole = joined(near, far)
    assert whole.rtt == pytest.approx(0.13)
    assert (near.quality, far.quality, whole.quality) == ("good", "good", "fair")
    assert joined(near, LinkQuality(rtt=0.01, recent_rtt=0.01, quality="bad")).quality == "bad"
    assert joined(near, UNKNOWN) == UNKNOWN
    assert joined(NO_LINK, UNKNOWN) == NO_LINK == joined(near, NO_LINK)


def test_times_are_in_milliseconds() -> None:
    """Unknown values are null."""
    reported = measured(0.0123, 0.0123).link_quality(101.0, []).summary()
    assert reported == {"rtt_ms": 12.3, "p95_ms": 12.3, "jitter_ms": 0.0, "lost": 0, "quality": "good"}
    assert NO_LINK.summary() == {
        "rtt_ms": None,
        "p95_ms": None,
        "jitter_ms": None,
        "lost": 0,
        "quality": "lost",
    }


@given(st.lists(st.floats(0, 5), min_size=1, max_size=100), st.lists(st.floats(0, 10), max_size=5))
def test_a_reading_is_of_what_was_measured(trips: list[float], out: list[float]) -> None:
    """The median lies among the round trips, the percentile is not below it, and there is a rating."""
    reading = measured(*trips, every=0.3).link_quality(100.0 + 0.3 * len(trips), out)
    assert reading.rtt is not None
    assert reading.p95 is not None
    assert min(trips) <= reading.rtt <= max(trips)
    assert reading.rtt <= reading.p95 + 1e-9
    assert reading.quality in ("good", "fair", "bad", "lost")
