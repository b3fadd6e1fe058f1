"""The newest message of a topic, for readers that poll."""

from __future__ import annotations

import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_server.in_process_sessions.pool import LatestValue, TimedMessage


@pytest.fixture
def clock() -> Clock:
    """A clock of the test."""
    return Clock()


@pytest.fixture
def feed(clock: Clock) -> LatestValue:
    """Messages of a topic."""
    return LatestValue(clock)


def asks(feed: LatestValue, number: int, seconds: float) -> tuple[list[TimedMessage | None], Deferred[None]]:
    """Waits for the message after that one; the list gets it."""
    got: list[TimedMessage | None] = []
    return got, Deferred.fromCoroutine(feed.after(number, seconds)).addCallback(got.append)


def test_request_gets_the_newest_at_once(feed: LatestValue, clock: Clock) -> None:
    """If it is newer than the reader's last; it has its time of arrival."""
    feed.update(b"1")
    clock.advance(3)
    feed.update(b"2")
    got, _ = asks(feed, 0, 1)
    assert got == [TimedMessage(2, b"2", 3.0)]


def test_reader_of_the_newest_waits_for_the_next(feed: LatestValue, clock: Clock) -> None:
    """Each reader waits by itself, until its timeout."""
    feed.update(b"1")
    (first, _), (second, _) = asks(feed, 1, 1), asks(feed, 1, 5)
    clock.advance(1)
    assert (first, second) == ([None], [])
    feed.update(b"2")
    assert second == [TimedMessage(2, b"2", 1.0)]
    clock.advance(10)
    assert not clock.getDelayedCalls()


def test_gone_client_is_not_waited_for(feed: LatestValue, clock: Clock) -> None:
    """No state of it is left."""
    _, running = asks(feed, 0, 100)
    running.addErrback(lambda failure: None)
    clock.advance(50)
    assert not feed.idle(10)
    running.cancel()
    assert not clock.getDelayedCalls()
    assert not feed.idle(10)
    clock.advance(10)
    assert feed.idle(10)


def test_waiting_ends_when_no_message_can_come(feed: LatestValue, clock: Clock) -> None:
    """All waiting readers get the error at once."""
    got, _ = asks(feed, 0, 100)
    feed.end()
    assert got == [None]
    assert not clock.getDelayedCalls()


def test_a_poll_waits_for_a_message_from_now_on(feed: LatestValue, clock: Clock) -> None:
    feed.update(b"1")
    polled: list[int] = []
    Deferred.fromCoroutine(feed.wait_for_next(5)).addCallback(polled.append)
    feed.update(b"2")
    feed.update(b"3")
    assert not polled
    clock.advance(0.1)
    assert polled == [2]
    Deferred.fromCoroutine(feed.wait_for_next(5)).addCallback(polled.append)
    clock.advance(5)
    clock.advance(0)
    assert polled == [2, 2]
    assert not clock.getDelayedCalls()
