"""Who waits for a turn of the reactor of his own: one after the other, so that others come in between."""

from __future__ import annotations

from collections import deque

from twisted.internet.defer import Deferred, succeed

from relay_server.common.clock import Clock


class FairQueue:
    """A line in which nobody waits but for those before him."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._waiting: deque[Deferred[None]] = deque()
        self._taken = False

    def turn(self) -> Deferred[None]:
        """Fires at once if nobody has had this turn, else in a later one. Cancelled, it costs a turn."""
        if self._taken:
            mine: Deferred[None] = Deferred()
            self._waiting.append(mine)
            return mine
        self._taken = True
        self._clock.callLater(0, self._next)
        return succeed(None)

    def _next(self) -> None:
        if not self._waiting:
            self._taken = False
            return
        self._clock.callLater(0, self._next)
        self._waiting.popleft().callback(None)
