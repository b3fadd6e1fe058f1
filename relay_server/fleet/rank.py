"""Many robots, a bounded number of them at a time."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable

from twisted.internet.defer import Deferred, FirstError, gatherResults

AT_ONCE = 32
"""Robots of one order that have their turn at a time."""


async def side_by_side(
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
