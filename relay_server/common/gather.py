"""Many questions to one robot, so many of them at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from twisted.internet.defer import Deferred, DeferredList, FirstError, gatherResults

from relay_protocol.errors import Unavailable

AT_ONCE = 32
"""Robots of one order that have their turn at a time."""


async def bounded_gather(
    names: Iterable[str], do: Callable[[str], Awaitable[None]], at_once: int = AT_ONCE
) -> None:
    """Do something for each, some at a time. Who gives up waiting ends what has begun; the rest does not begin.

    :param do: does it for one; what it raises ends the others too
    """
    turns = iter(list(names))

    async def one_after_the_other() -> None:
        for name in turns:
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


T = TypeVar("T")

AT_A_TIME = 16
"""Questions that one caller may have under way."""


class PerKeySemaphore:
    """So many callers at a time for each robot, user or whatever they have in common.

    :param words: for who finds no place
    """

    def __init__(self, most: int, words: str) -> None:
        self._most = most
        self._words = words
        self._taken: WeakKeyDictionary[Any, int] = WeakKeyDictionary()

    @contextmanager
    def take(self, common: Any) -> Iterator[None]:
        """One place, for as long as the work takes.

        :raises Unavailable: all are taken
        """
        if self._taken.get(common, 0) >= self._most:
            raise Unavailable(self._words)
        self._taken[common] = self._taken.get(common, 0) + 1
        try:
            yield
        finally:
            # Where what they have in common has gone, so has the count.
            self._taken[common] = self._taken.get(common, 1) - 1


async def gather_per_key(items: deque[T], work: Callable[[T], Coroutine[Deferred[Any], Any, None]]) -> None:
    """Do the work of each item, the next one when one is done. What is left in ``items`` is not begun.

    :raises Exception: the first that any of them raises; cancelled, all of them are
    """

    async def one_after_the_other() -> None:
        while items:
            await work(items.popleft())

    workers = [Deferred.fromCoroutine(one_after_the_other()) for _ in range(min(AT_A_TIME, len(items)))]
    try:
        await DeferredList(workers, fireOnOneErrback=True, consumeErrors=True)
    except FirstError as error:
        error.subFailure.raiseException()
