"""The round trip without what waits in the link: what lowers it, and how it is found to be longer."""

from __future__ import annotations

import pytest

from robot_client.camera.rtt_probe import DOUBT, EVERY, LONGEST, PATIENCE, RttProbe

A, B, C = "one stream", "another stream", "a third stream"


def doubted(now: float = 100.0) -> RttProbe:
    """One of 10 ms, with longer measurements up to ``now``."""
    way = RttProbe()
    way.measured(0.01, now - DOUBT - 1)
    for second in range(round(DOUBT) + 1):
        way.measured(0.5, now - DOUBT + second)
    return way


def test_first_measurement_is_believed_and_shorter_ones_are() -> None:
    """A ping can wait for something, but not come early."""
    way = RttProbe()
    found = []
    for second, seconds in enumerate((0.05, 0.2, 0.03, 0.04)):
        way.measured(seconds, second)
        found.append(way.seconds)
    assert found == [0.05, 0.05, 0.03, 0.03]


def test_longer_measurements_change_nothing_by_themselves() -> None:
    """A queue of pictures makes such."""
    way = doubted()
    for second in range(100, 1000):
        way.measured(0.5, second)
    assert way.seconds == 0.01


def test_wavering_measurements_ask_nothing() -> None:
    """As long as one in three seconds is about as short as it was."""
    way = RttProbe()
    for second in range(60):
        way.measured((0.05, 0.5, 0.4)[second % 3], second)
        assert way.may_leave(second)
        assert not way.leaves(A, second)
        way.idle(A, second)


def test_it_is_asked_for_when_nothing_is_under_way_any_more() -> None:
    """All streams hold back their pictures, then one sends a few bytes, and its answer is believed."""
    way = doubted()
    way.leaves(A, 99)
    way.leaves(B, 99)
    assert not way.may_leave(100)
    way.idle(A, 100.1)
    assert not way.may_leave(100.1)
    way.idle(B, 100.2)
    assert way.may_leave(100.2)
    assert way.leaves(B, 100.2)
    assert not way.may_leave(100.3)
    way.answered(A, 100.3)
    assert way.seconds == 0.01
    way.answered(B, 100.55)
    assert way.seconds == pytest.approx(0.35)
    assert way.may_leave(100.55)


def test_it_is_not_asked_for_all_the_time() -> None:
    """Where a queue is always there, once in ten seconds."""
    way = doubted()
    asked = 0
    for tick in range(1000, 1600):
        now = tick / 10
        way.measured(0.5, now)
        if way.may_leave(now) and way.leaves(A, now):
            asked += 1
            way.answered(A, now + 0.01)
        way.idle(A, now + 0.02)
    assert 60 / EVERY - 2 <= asked <= 60 / EVERY
    assert way.seconds == pytest.approx(0.01)


def test_nobody_is_waited_for_for_long() -> None:
    """One picture that is late must not hold up all streams: it is given up after 0.9 s, or it never is."""
    assert PATIENCE <= 1
    way = doubted()
    way.leaves(A, 99)
    assert not way.may_leave(100)
    assert not way.may_leave(100 + PATIENCE)
    assert way.may_leave(100.01 + PATIENCE)
    assert not way.leaves(B, 100.01 + PATIENCE)


def test_nothing_is_asked_while_what_is_never_given_up_is_under_way() -> None:
    """All others send as if there were no doubt, and when it is there they are asked as ever."""
    way = doubted()
    way.leaves(B, 98)
    assert not way.leaves(A, 99, patient=True)
    for tick in range(1000, 1600):
        assert way.may_leave(tick / 10)
        assert not way.leaves(B, tick / 10)
    way.idle(A, 160)
    assert not way.may_leave(160)
    way.idle(B, 160.1)
    assert way.leaves(B, 160.1)


def test_asking_ends_when_something_begins_to_leave_that_is_never_given_up() -> None:
    """It was being made when all others began to hold back their pictures."""
    way = doubted()
    way.leaves(A, 99)
    assert not way.may_leave(100)
    assert not way.leaves(B, 100.1, patient=True)
    assert way.may_leave(100.1)
    way.idle(A, 100.2)
    assert not way.leaves(A, 100.2)


def test_few_bytes_of_what_is_never_given_up_are_waited_for() -> None:
    """They ask like those of any other; from their answer on nothing is held back."""
    way = doubted()
    assert way.may_leave(100)
    assert way.leaves(A, 100, patient=True)
    assert not way.may_leave(100.1)
    way.answered(A, 100.3)
    assert way.seconds == pytest.approx(0.3)
    assert way.may_leave(200)
    assert not way.leaves(C, 200)


def test_the_answer_may_take_longer_than_what_was_under_way() -> None:
    """A way of more than a second is found as well, and counted from when it was asked."""
    way = doubted()
    way.leaves(A, 99)
    assert not way.may_leave(100)
    way.idle(A, 100 + PATIENCE)
    assert way.leaves(B, 100 + PATIENCE)
    assert not way.may_leave(100 + PATIENCE + LONGEST)
    way.answered(B, 100 + PATIENCE + LONGEST)
    assert way.seconds == pytest.approx(LONGEST)


def test_answer_that_comes_too_late_is_not_believed() -> None:
    """Pictures went behind it."""
    way = doubted()
    way.may_leave(100)
    assert way.leaves(A, 100)
    assert way.may_leave(100.01 + LONGEST)
    way.answered(A, 104)
    assert way.seconds == 0.01


def test_stream_that_ends_asks_no_more() -> None:
    """The others go on."""
    way = doubted()
    way.may_leave(100)
    assert way.leaves(A, 100)
    way.idle(A, 100.1)
    assert way.may_leave(100.1)
