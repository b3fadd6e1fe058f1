"""Many questions to one robot, so many of them at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from twisted.internet.defer import Deferred, DeferredList, FirstError

T = TypeVar("T")

AT_A_TIME = 16
"""Questions that one caller may have under way."""


async def side_by_side(items: deque[T], work: Callable[[T], Coroutine[Deferred[Any], Any, None]]) -> None:
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
