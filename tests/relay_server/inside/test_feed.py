"""The newest message of a topic, for those who ask now and then."""

from __future__ import annotations

import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_server.http_sessions.latest_value import LatestValue, TimedMessage


@pytest.fixture
def clock() -> Clock:
    """Time that a test lets pass."""
    return Clock()


@pytest.fixture
def feed(clock: Clock) -> LatestValue:
    """What comes on a topic."""
    return LatestValue(clock)


def asks(feed: LatestValue, number: int, seconds: float) -> tuple[list[TimedMessage | None], Deferred[None]]:
    """Wait for the message behind that one; where it will be."""
    got: list[TimedMessage | None] = []
    return got, Deferred.fromCoroutine(feed.after(number, seconds)).addCallback(got.append)


def test_who_asks_gets_the_newest_at_once(feed: LatestValue, clock: Clock) -> None:
    """As long as it is behind the one he knows; with when it came."""
    feed.heard(b"1")
    clock.advance(3)
    feed.heard(b"2")
    got, _ = asks(feed, 0, 1)
    assert got == [TimedMessage(2, b"2", 3.0)]


def test_who_knows_the_newest_waits_for_the_next(feed: LatestValue, clock: Clock) -> None:
    """Or until his time is over; each by himself."""
    feed.heard(b"1")
    (first, _), (second, _) = asks(feed, 1, 1), asks(feed, 1, 5)
    clock.advance(1)
    assert (first, second) == ([None], [])
    feed.heard(b"2")
    assert second == [TimedMessage(2, b"2", 1.0)]
    clock.advance(10)
    assert not clock.getDelayedCalls()


def test_who_leaves_is_waited_for_no_more(feed: LatestValue, clock: Clock) -> None:
    """Nothing is left of him."""
    _, running = asks(feed, 0, 100)
    running.addErrback(lambda failure: None)
    clock.advance(50)
    assert not feed.idle(10)
    running.cancel()
    assert not clock.getDelayedCalls()
    assert not feed.idle(10)
    clock.advance(10)
    assert feed.idle(10)


def test_where_nothing_more_comes_nobody_waits(feed: LatestValue, clock: Clock) -> None:
    """All are told so at once."""
    got, _ = asks(feed, 0, 100)
    feed.end()
    assert got == [None]
    assert not clock.getDelayedCalls()
