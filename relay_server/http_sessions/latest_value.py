"""The newest message of a topic, for those who ask now and then."""

from __future__ import annotations

from typing import NamedTuple

from twisted.internet.defer import Deferred

from relay_server.common.clock import Clock, cancel


class TimedMessage(NamedTuple):
    """A message.

    :param number: how many there were with it
    :param body: JSON
    :param at: the clock's seconds when it came
    """

    number: int
    body: bytes
    at: float


class LatestValue:
    """What comes on one topic."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._used = clock.seconds()
        self._waiting: dict[Deferred[TimedMessage | None], int] = {}
        self.newest: TimedMessage | None = None

    def heard(self, body: bytes) -> None:
        """There is one more."""
        number = 1 if self.newest is None else self.newest.number + 1
        self.newest = newest = TimedMessage(number, body, self._clock.seconds())
        for waiting, behind in list(self._waiting.items()):
            if number > behind:
                del self._waiting[waiting]
                waiting.callback(newest)

    def end(self) -> None:
        """Nothing more comes: who waits is told so."""
        waiting, self._waiting = self._waiting, {}
        for each in waiting:
            each.callback(None)

    def used(self) -> None:
        """Somebody asks for it."""
        self._used = self._clock.seconds()

    def idle(self, seconds: float) -> bool:
        """Whether nobody has asked for it for so long, or waits for it."""
        return not self._waiting and self._clock.seconds() - self._used >= seconds

    def _given_up(self, waiting: Deferred[TimedMessage | None]) -> None:
        self._waiting.pop(waiting, None)

    async def after(self, number: int, seconds: float) -> TimedMessage | None:
        """The first message behind that one, or ``None`` when there is none within so many seconds, or no more."""
        if self.newest is not None and self.newest.number > number:
            return self.newest
        waiting: Deferred[TimedMessage | None] = Deferred(self._given_up)
        self._waiting[waiting] = number

        def too_late() -> None:
            if self._waiting.pop(waiting, None) is not None:
                waiting.callback(None)

        timer = self._clock.callLater(seconds, too_late)
        try:
            return await waiting
        finally:
            cancel(timer)
            self.used()
