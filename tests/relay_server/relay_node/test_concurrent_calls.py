"""Many calls, a limited number of them at a time."""

from __future__ import annotations

from collections import deque

import pytest
from twisted.internet.defer import CancelledError, Deferred

from relay_server.common.concurrency import AT_A_TIME, gather_per_key


class Work:
    """Calls that the test answers."""

    def __init__(self) -> None:
        self.waiting: list[Deferred[None]] = []

    async def ask(self, item: int) -> None:
        """Waits for the answer."""
        waiting: Deferred[None] = Deferred()
        self.waiting.append(waiting)
        await waiting


def test_the_next_begins_when_one_is_done() -> None:
    """All are done in the end."""
    work = Work()
    done = Deferred.fromCoroutine(gather_per_key(deque(range(50)), work.ask))
    for number in range(50):
        assert len(work.waiting) == min(50, AT_A_TIME + number)
        work.waiting[number].callback(None)
    assert done.called


def test_empty_order_succeeds() -> None:
    """At once."""
    assert Deferred.fromCoroutine(gather_per_key(deque(), Work().ask)).called


def test_thousands_that_are_done_at_once_are_no_recursion() -> None:
    """A lost robot ends all calls at the same time."""

    async def ask(item: int) -> None:
        """Is done at once."""

    assert Deferred.fromCoroutine(gather_per_key(deque(range(50_000)), ask)).called


def test_errors_are_reported() -> None:
    """The original error is raised."""
    work = Work()
    done = Deferred.fromCoroutine(gather_per_key(deque(range(3)), work.ask))
    work.waiting[1].errback(RuntimeError("broken"))
    errors: list[BaseException] = []
    done.addErrback(lambda failure: errors.append(failure.value))
    assert str(errors[0]) == "broken"


def test_cancelling_ends_all_goals() -> None:
    """No waiting call begins after that."""
    work = Work()
    items = deque(range(50))
    done = Deferred.fromCoroutine(gather_per_key(items, work.ask))
    done.cancel()
    with pytest.raises(CancelledError):
        done.result.raiseException()  # type: ignore[attr-defined]
    done.addErrback(lambda failure: None)
    assert len(work.waiting) == AT_A_TIME
    assert all(each.called for each in work.waiting)
