"""The round trip without queues: decreases are accepted at once, increases by a probe."""

from __future__ import annotations

import pytest

from robot_client.camera.rate_control import (
    DRAIN_TIMEOUT,
    PROBE_AFTER,
    PROBE_INTERVAL,
    PROBE_TIMEOUT,
    RttProbe,
)

A, B, C = "one stream", "another stream", "a third stream"


def doubted(now: float = 100.0) -> RttProbe:
    """A probe with 10 ms, and longer measurements up to ``now``."""
    way = RttProbe()
    way.add_measurement(0.01, now - PROBE_AFTER - 1)
    for second in range(round(PROBE_AFTER) + 1):
        way.add_measurement(0.5, now - PROBE_AFTER + second)
    return way


def test_first_measurement_is_believed_and_shorter_ones_are() -> None:
    """A ping can be delayed, but not be early."""
    way = RttProbe()
    found = []
    for second, seconds in enumerate((0.05, 0.2, 0.03, 0.04)):
        way.add_measurement(seconds, second)
        found.append(way.seconds)
    assert found == [0.05, 0.05, 0.03, 0.03]


def test_longer_measurements_change_nothing_by_themselves() -> None:
    """A queue of frames causes them."""
    way = doubted()
    for second in range(100, 1000):
        way.add_measurement(0.5, second)
    assert way.seconds == 0.01


def test_wavering_measurements_ask_nothing() -> None:
    """As long as one in three seconds is about as short as before."""
    way = RttProbe()
    for second in range(60):
        way.add_measurement((0.05, 0.5, 0.4)[second % 3], second)
        assert way.may_send(second)
        assert not way.begin(A, second)
        way.idle(A, second)


def test_it_is_asked_for_when_nothing_is_under_way_any_more() -> None:
    """All streams hold back their frames, then one sends a few bytes, and its answer is accepted."""
    way = doubted()
    way.begin(A, 99)
    way.begin(B, 99)
    assert not way.may_send(100)
    way.idle(A, 100.1)
    assert not way.may_send(100.1)
    way.idle(B, 100.2)
    assert way.may_send(100.2)
    assert way.begin(B, 100.2)
    assert not way.may_send(100.3)
    way.answered(A, 100.3)
    assert way.seconds == 0.01
    way.answered(B, 100.55)
    assert way.seconds == pytest.approx(0.35)
    assert way.may_send(100.55)


def test_it_is_not_asked_for_all_the_time() -> None:
    """With a constant queue, every ten seconds."""
    way = doubted()
    asked = 0
    for tick in range(1000, 1600):
        now = tick / 10
        way.add_measurement(0.5, now)
        if way.may_send(now) and way.begin(A, now):
            asked += 1
            way.answered(A, now + 0.01)
        way.idle(A, now + 0.02)
    assert 60 / PROBE_INTERVAL - 2 <= asked <= 60 / PROBE_INTERVAL
    assert way.seconds == pytest.approx(0.01)


def test_no_probe_waits_for_long() -> None:
    """A late frame must not delay all streams: it is discarded within 0.9 s, or never."""
    assert DRAIN_TIMEOUT <= 1
    way = doubted()
    way.begin(A, 99)
    assert not way.may_send(100)
    assert not way.may_send(100 + DRAIN_TIMEOUT)
    assert way.may_send(100.01 + DRAIN_TIMEOUT)
    assert not way.begin(B, 100.01 + DRAIN_TIMEOUT)


def test_no_request_while_an_undiscardable_frame_is_in_flight() -> None:
    """All others send normally, and are asked again when it has arrived."""
    way = doubted()
    way.begin(B, 98)
    assert not way.begin(A, 99, undiscardable=True)
    for tick in range(1000, 1600):
        assert way.may_send(tick / 10)
        assert not way.begin(B, tick / 10)
    way.idle(A, 160)
    assert not way.may_send(160)
    way.idle(B, 160.1)
    assert way.begin(B, 160.1)


def test_asking_ends_when_something_begins_to_leave_that_is_never_discarded() -> None:
    """It was being encoded when all others began to hold back their frames."""
    way = doubted()
    way.begin(A, 99)
    assert not way.may_send(100)
    assert not way.begin(B, 100.1, undiscardable=True)
    assert way.may_send(100.1)
    way.idle(A, 100.2)
    assert not way.begin(A, 100.2)


def test_few_bytes_of_what_is_never_discarded_are_waited_for() -> None:
    """They probe like those of any other; after their answer no frame is held back."""
    way = doubted()
    assert way.may_send(100)
    assert way.begin(A, 100, undiscardable=True)
    assert not way.may_send(100.1)
    way.answered(A, 100.3)
    assert way.seconds == pytest.approx(0.3)
    assert way.may_send(200)
    assert not way.begin(C, 200)


def test_the_answer_may_take_longer_than_what_was_under_way() -> None:
    """A round trip of more than a second is found as well, counted from the probe."""
    way = doubted()
    way.begin(A, 99)
    assert not way.may_send(100)
    way.idle(A, 100 + DRAIN_TIMEOUT)
    assert way.begin(B, 100 + DRAIN_TIMEOUT)
    assert not way.may_send(100 + DRAIN_TIMEOUT + PROBE_TIMEOUT)
    way.answered(B, 100 + DRAIN_TIMEOUT + PROBE_TIMEOUT)
    assert way.seconds == pytest.approx(PROBE_TIMEOUT)


def test_answer_that_comes_too_late_is_not_believed() -> None:
    """Other frames were sent after it."""
    way = doubted()
    way.may_send(100)
    assert way.begin(A, 100)
    assert way.may_send(100.01 + PROBE_TIMEOUT)
    way.answered(A, 104)
    assert way.seconds == 0.01


def test_stream_that_ends_asks_no_more() -> None:
    """The others continue."""
    way = doubted()
    way.may_send(100)
    assert way.begin(A, 100)
    way.idle(A, 100.1)
    assert way.may_send(100.1)
