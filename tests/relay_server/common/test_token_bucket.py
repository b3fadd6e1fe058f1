"""A token bucket allows bursts and then a rate."""

from __future__ import annotations

from twisted.internet.task import Clock

from relay_server.common.token_bucket import Buckets, TokenBucket


def test_tokens_refill_with_time() -> None:
    """Until then it returns the waiting time."""
    clock = Clock()
    bucket = TokenBucket(0.5, 2, clock.seconds)
    assert [bucket.take() for _ in range(3)] == [True, True, False]
    assert bucket.wait == 2
    clock.advance(0.5)
    assert bucket.wait == 1.5
    clock.advance(1.5)
    assert bucket.wait == 0
    assert [bucket.take(), bucket.take()] == [True, False]
    clock.advance(1000)
    assert [bucket.take() for _ in range(3)] == [True, True, False]


def test_users_have_their_own_buckets() -> None:
    """Their number is limited; a user who was idle longest starts with a new bucket."""
    clock = Clock()
    buckets = Buckets(1, 1, 2, clock.seconds)
    assert [buckets.take(who) for who in ("ann", "ann", "bob", "ann")] == [True, False, True, False]
    assert buckets.take("eve")
    assert [buckets.take("ann"), buckets.take("bob")] == [False, True]
    clock.advance(1)
    assert buckets.take("ann")


def test_some_take_more_than_one() -> None:
    """Without enough tokens none is taken, and the waiting time is returned."""
    bucket = TokenBucket(0.5, 3, Clock().seconds)
    taken = [bucket.take(cost) for cost in (2, 2, 0.5, 0, 0.5, 0.1)]
    assert taken == [True, False, True, True, True, False]
    assert bucket.wait_for(2) == 4


def test_remaining_entries_are_listed() -> None:
    """A single user's remaining tokens can be read without taking any."""
    clock = Clock()
    buckets = Buckets(0.5, 3, 10, clock.seconds)
    assert buckets.of("ann").left == 3
    assert buckets.take("ann")
    clock.advance(1)
    assert buckets.of("ann").left == 2.5
    assert buckets.of("bob").left == 3
