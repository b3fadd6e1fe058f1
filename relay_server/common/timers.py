"""What is done again and again for each of many clients, by one timer for all."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable

from twisted.logger import Logger

from relay_server.common.clock import Clock, Timer, cancel

SLACK = 0.002
"""What is due within so many seconds is done along: fewer timers, and rounding can't delay a call."""


class PeriodicTimer:
    """Something that is called again and again.

    :param interval: seconds; another one counts after the next call
    """

    __slots__ = ("call", "interval", "stopped")

    def __init__(self, call: Callable[[], object], interval: float) -> None:
        self.call = call
        self.interval = interval
        self.stopped = False

    def stop(self) -> None:
        """Don't call any more."""
        self.stopped = True
        self.call = _nothing


def _nothing() -> None:
    """What was called may go before its place in the queue does."""


class PeriodicTimers:
    """Keeps every round at its own pace. A clock that stood still is not caught up with: missed calls are left out."""

    log = Logger()

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._due: list[tuple[float, int, PeriodicTimer]] = []
        self._serial = itertools.count()
        self._timer: Timer | None = None
        self._timer_at = 0.0

    def start(self, begun: PeriodicTimer) -> None:
        """Call now, and then every ``interval`` seconds."""
        now = self._clock.seconds()
        heapq.heappush(self._due, (now + begun.interval, next(self._serial), begun))
        self._look_at(self._due[0][0], now)
        self._call(begun)

    def _look_at(self, moment: float, now: float) -> None:
        if self._timer is not None and self._timer_at <= moment:
            return
        cancel(self._timer)
        self._timer_at = moment
        self._timer = self._clock.callLater(max(0.0, moment - now), self._look)

    def _look(self) -> None:
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
            self._look_at(due[0][0], self._clock.seconds())

    def _call(self, each: PeriodicTimer) -> None:
        try:
            each.call()
        except Exception:
            # One client's fault is no reason to stop pinging the others.
            self.log.failure("what is done in rounds failed")
