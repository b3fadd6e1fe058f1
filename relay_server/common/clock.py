"""Monotonic time and timers, injected everywhere so that tests can move the clock."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from typing import Any, Protocol, cast

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import LoopingCall
from twisted.logger import Logger


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
    """The clock typed as ``IReactorTime``, for Twisted functions that use only the methods of :class:`Clock`."""
    return cast(IReactorTime, clock)


def looping(clock: Clock, call: Callable[[], object]) -> LoopingCall:
    """A ``LoopingCall`` on this clock."""
    loop = LoopingCall(call)
    loop.clock = as_twisted(clock)
    return loop


async def sleep(clock: Clock, seconds: float) -> None:
    """Wait. Cancelling it cancels the timer."""
    done: Deferred[None] = Deferred()
    timer = clock.callLater(seconds, done.callback, None)
    try:
        await done
    finally:
        cancel(timer)


SLACK = 0.002
"""Calls due within this many seconds are made together: fewer timers, and rounding can't delay a call."""


class PeriodicTimer:
    """A repeated call.

    :param interval: seconds; a change takes effect after the next call
    """

    __slots__ = ("call", "interval", "stopped")

    def __init__(self, call: Callable[[], object], interval: float) -> None:
        self.call = call
        self.interval = interval
        self.stopped = False

    def stop(self) -> None:
        """Stop the calls."""
        self.stopped = True
        self.call = _nothing


def _nothing() -> None:
    """Releases what the call refers to before the queue does."""


class PeriodicTimers:
    """Runs many periodic calls with one timer. Calls that were missed while the clock stood still are skipped."""

    log = Logger()

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._due: list[tuple[float, int, PeriodicTimer]] = []
        self._serial = itertools.count()
        self._timer: Timer | None = None
        self._timer_at = 0.0

    def start(self, timer: PeriodicTimer) -> None:
        """Call now, and then every ``interval`` seconds."""
        now = self._clock.seconds()
        heapq.heappush(self._due, (now + timer.interval, next(self._serial), timer))
        self._schedule(self._due[0][0], now)
        self._call(timer)

    def _schedule(self, moment: float, now: float) -> None:
        if self._timer is not None and self._timer_at <= moment:
            return
        cancel(self._timer)
        self._timer_at = moment
        self._timer = self._clock.callLater(max(0.0, moment - now), self._run)

    def _run(self) -> None:
        self._timer = None
        due, now = self._due, self._clock.seconds()
        while due and due[0][0] <= now + SLACK:
            at, serial, each = due[0]
            if each.stopped:
                heapq.heappop(due)
                continue
            following = at + each.interval
            if following <= now:
                following = now + each.interval
            heapq.heapreplace(due, (following, serial, each))
            self._call(each)
        if due:
            self._schedule(due[0][0], self._clock.seconds())

    def _call(self, each: PeriodicTimer) -> None:
        try:
            each.call()
        except Exception:
            # A failure for one client must not stop the calls of others.
            self.log.failure("a periodic call failed")
