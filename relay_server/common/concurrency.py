"""Concurrent work on the reactor: timeouts, sharing one run, bounded parallelism, a fair lock and a fair queue."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from twisted.internet.defer import CancelledError, Deferred, DeferredList, FirstError, gatherResults, succeed
from twisted.python.failure import Failure

from relay_protocol.errors import Unavailable
from relay_server.common.clock import Clock, as_twisted

T = TypeVar("T")


async def with_timeout(
    clock: Clock, seconds: float, work: Coroutine[Deferred[Any], Any, T] | Deferred[T], words: str
) -> T:
    """Wait for work for a limited time, then cancel it.

    :param words: message of the error
    :raises Unavailable: the time is over
    """

    def late(result: Any, _: float) -> Any:
        if isinstance(result, Failure) and result.check(CancelledError):
            raise Unavailable(words)
        return result

    running = work if isinstance(work, Deferred) else Deferred.fromCoroutine(work)
    running.addTimeout(seconds, as_twisted(clock), late)
    return await running


class SingleFlight:
    """Runs work for many callers, never twice at the same time. Callers that come during a run share the next one.

    :param work: must not call :meth:`run` itself, which would wait for ever
    """

    def __init__(self, work: Callable[[], Coroutine[Deferred[Any], Any, None]]) -> None:
        self._work = work
        self._running = False
        self._waiting: list[Deferred[None]] = []
        """Callers that share the next run."""

    async def run(self) -> None:
        """Wait for a run that begins from now on. Cancelling the wait does not cancel the run.

        :raises Exception: what the work raises
        """
        waiting: Deferred[None] = Deferred()
        self._waiting.append(waiting)
        if not self._running:
            self._begin()
        await waiting

    def _begin(self) -> None:
        callers, self._waiting = self._waiting, []
        self._running = True
        Deferred.fromCoroutine(self._work()).addBoth(self._done, callers)

    def _done(self, result: Failure | None, callers: list[Deferred[None]]) -> Failure | None:
        self._running = False
        if self._waiting:
            self._begin()
        left = [each for each in callers if not each.called]
        for each in left:
            each.callback(result)
        # Without a waiter Twisted logs the error.
        return None if left else result


def shield(work: Deferred[T]) -> Deferred[T]:
    """A Deferred that fires with the result of ``work``; cancelling it does not cancel ``work``."""
    waiting: Deferred[T] = Deferred()

    def done(result: Any) -> Any:
        # Without a waiter Twisted logs the error.
        return result if waiting.called else waiting.callback(result)

    work.addBoth(done)
    return waiting


def detached(work: Coroutine[Deferred[Any], Any, T]) -> Deferred[T]:
    """Start work. The returned Deferred fires with its result; cancelling it does not cancel the work."""
    waiting: Deferred[T] = Deferred()
    # A cancelled Deferred ignores the one result that still comes.
    Deferred.fromCoroutine(work).addCallbacks(waiting.callback, waiting.errback)
    return waiting


AT_ONCE = 32
"""Items of :func:`bounded_gather` under way at a time."""


async def bounded_gather(
    names: Iterable[str], do: Callable[[str], Awaitable[None]], at_once: int = AT_ONCE
) -> None:
    """Call ``do`` for each name, ``at_once`` at a time. Cancelling it cancels what has begun; the rest does not begin.

    :param do: an exception cancels the others
    :raises Exception: the first that ``do`` raises
    """
    remaining = iter(list(names))

    async def one_after_the_other() -> None:
        for name in remaining:
            await do(name)

    running = [Deferred.fromCoroutine(one_after_the_other()) for _ in range(at_once)]
    all_of_them = gatherResults(running, consumeErrors=True)
    try:
        await all_of_them
    except FirstError as error:
        error.subFailure.raiseException()
    finally:
        for each in running:
            each.cancel()


AT_A_TIME = 16
"""Items of :func:`gather_per_key` under way at a time."""


class PerKeySemaphore:
    """Bounds the number of callers per key, such as a robot or a user.

    :param most: callers of one key at a time
    :param words: message for callers over the limit
    """

    def __init__(self, most: int, words: str) -> None:
        self._most = most
        self._words = words
        self._taken: WeakKeyDictionary[Any, int] = WeakKeyDictionary()

    @contextmanager
    def take(self, key: Any) -> Iterator[None]:
        """Count one caller during the block.

        :raises Unavailable: the limit is reached
        """
        if self._taken.get(key, 0) >= self._most:
            raise Unavailable(self._words)
        self._taken[key] = self._taken.get(key, 0) + 1
        try:
            yield
        finally:
            # The count disappears with its key.
            self._taken[key] = self._taken.get(key, 1) - 1


async def gather_per_key(items: deque[T], work: Callable[[T], Coroutine[Deferred[Any], Any, None]]) -> None:
    """Call ``work`` for each item, :data:`AT_A_TIME` at a time. Items are removed from ``items`` as they begin.

    Cancelling it cancels what has begun.

    :raises Exception: the first that ``work`` raises
    """

    async def one_after_the_other() -> None:
        while items:
            await work(items.popleft())

    workers = [Deferred.fromCoroutine(one_after_the_other()) for _ in range(min(AT_A_TIME, len(items)))]
    try:
        await DeferredList(workers, fireOnOneErrback=True, consumeErrors=True)
    except FirstError as error:
        error.subFailure.raiseException()


MAX_OF_USER = 2
"""Most callers of one user that hold the lock or wait for it; further ones are refused."""

MAX_WAITING = 64
"""Most callers of all users."""


class FairLock:
    """A lock for costly work: one holder at a time, first come first served, with a bounded number of callers."""

    def __init__(self) -> None:
        self._callers: Counter[int] = Counter()
        self._waiting: deque[Deferred[None]] = deque()
        self._taken = False
        self._passing_on = False

    @asynccontextmanager
    async def hold(self, user: int) -> AsyncIterator[None]:
        """Wait for the lock, and hold it during the block.

        :param user: the user's id
        :raises Unavailable: the user has :data:`MAX_OF_USER` callers already, or all users have :data:`MAX_WAITING`
        """
        if self._callers[user] >= MAX_OF_USER:
            raise Unavailable(
                f"{MAX_OF_USER} of your resources are being converted already; wait for one of them"
            )
        if self._callers.total() >= MAX_WAITING:
            raise Unavailable("too much is being converted; try again in a moment")
        self._callers[user] += 1
        try:
            waiting: Deferred[None] = Deferred()
            self._waiting.append(waiting)
            self._pass_on()
            await waiting
            self._taken = True
            try:
                yield
            finally:
                self._taken = False
        finally:
            self._callers -= Counter({user: 1})
            self._pass_on()

    def _pass_on(self) -> None:
        """Give the lock to the caller that waits longest. A loop: recursion could exceed the stack."""
        if self._passing_on:
            return
        self._passing_on = True
        try:
            while self._waiting and not self._taken:
                self._waiting.popleft().callback(None)
        finally:
            self._passing_on = False


class FairQueue:
    """Gives each caller a reactor turn of its own, so that other work runs in between."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._waiting: deque[Deferred[None]] = deque()
        self._taken = False

    def wait(self) -> Deferred[None]:
        """Fires at once if this reactor turn is free, else in a later one, also if the caller has cancelled."""
        if self._taken:
            waiting: Deferred[None] = Deferred()
            self._waiting.append(waiting)
            return waiting
        self._taken = True
        self._clock.callLater(0, self._next)
        return succeed(None)

    def _next(self) -> None:
        if not self._waiting:
            self._taken = False
            return
        self._clock.callLater(0, self._next)
        self._waiting.popleft().callback(None)
