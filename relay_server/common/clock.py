"""Work that is finished whoever stops waiting for it: who asked may hang up, what was ordered may not be forgotten."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, Protocol, TypeVar, cast

from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import LoopingCall
from twisted.python.failure import Failure

from relay_protocol.errors import Unavailable

T = TypeVar("T")


class Timer(Protocol):
    """A call that is due later."""

    def active(self) -> bool:
        """Neither called nor cancelled yet."""

    def cancel(self) -> None:
        """Don't call."""


class Clock(Protocol):
    """Monotonic time."""

    def seconds(self) -> float:
        """Now, from an arbitrary start."""

    def callLater(self, delay: float, call: Callable[..., object], *args: Any) -> Timer:
        """Call after ``delay`` seconds."""


def cancel(timer: Timer | None) -> None:
    """Cancel a timer that may be absent, due already or cancelled."""
    if timer is not None and timer.active():
        timer.cancel()


def as_twisted(clock: Clock) -> IReactorTime:
    """The clock where Twisted's types want a whole ``IReactorTime``; it uses no more of one than ours has."""
    return cast(IReactorTime, clock)


def looping(clock: Clock, call: Callable[[], object]) -> LoopingCall:
    """A call to be repeated on this clock."""
    loop = LoopingCall(call)
    loop.clock = as_twisted(clock)
    return loop


async def sleep(clock: Clock, seconds: float) -> None:
    """Wait so long; who gives up waiting leaves no timer."""
    done: Deferred[None] = Deferred()
    timer = clock.callLater(seconds, done.callback, None)
    try:
        await done
    finally:
        cancel(timer)


async def with_timeout(
    clock: Clock, seconds: float, work: Coroutine[Deferred[Any], Any, T] | Deferred[T], words: str
) -> T:
    """Do something that must not be waited for long; what is not done by then is given up.

    :raises Unavailable: it is given up, in these words
    """

    def late(result: Any, _: float) -> Any:
        if isinstance(result, Failure) and result.check(CancelledError):
            raise Unavailable(words)
        return result

    running = work if isinstance(work, Deferred) else Deferred.fromCoroutine(work)
    running.addTimeout(seconds, as_twisted(clock), late)
    return await running


class SingleFlight:
    """Work that many ask for: it is never under way twice, and all who ask while it is share the next time.

    :param work: what is done; were it to ask itself, it would wait for ever
    """

    def __init__(self, work: Callable[[], Coroutine[Deferred[Any], Any, None]]) -> None:
        self._work = work
        self._under_way = False
        self._asked: list[Deferred[None]] = []

    async def ask(self) -> None:
        """Have it done once more, from now on; it goes on when who waits gives up. Raises what the work raises."""
        waiting: Deferred[None] = Deferred()
        self._asked.append(waiting)
        if not self._under_way:
            self._begin()
        await waiting

    def _begin(self) -> None:
        asked, self._asked = self._asked, []
        self._under_way = True
        Deferred.fromCoroutine(self._work()).addBoth(self._done, asked)

    def _done(self, result: Failure | None, asked: list[Deferred[None]]) -> Failure | None:
        self._under_way = False
        if self._asked:
            self._begin()
        left = [each for each in asked if not each.called]
        for each in left:
            each.callback(result)
        # An error that nobody waits for any more is left to Twisted, which logs it.
        return None if left else result


def shield(work: Deferred[T]) -> Deferred[T]:
    """What is waited for in place of work that goes on when who waits gives up."""
    waiting: Deferred[T] = Deferred()

    def done(result: Any) -> Any:
        # An error that nobody waits for any more is left to Twisted, which logs it.
        return result if waiting.called else waiting.callback(result)

    work.addBoth(done)
    return waiting


def detached(work: Coroutine[Deferred[Any], Any, T]) -> Deferred[T]:
    """Start a piece of work; what comes back fires with its result, and may be cancelled without ending it."""
    waiting: Deferred[T] = Deferred()
    # A Deferred that was cancelled passes over the one result that still comes.
    Deferred.fromCoroutine(work).addCallbacks(waiting.callback, waiting.errback)
    return waiting
