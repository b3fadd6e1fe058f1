"""How far the relay's monotonic clock is from ours, from pings on one link.

The estimate of Cristian (1989): of an exchange with the round trip ``r``, the true offset lies within ``r/2``
of the one computed from its middle. So the exchange with the smallest round trip is the best.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

WINDOW = 16
_CONTRADICTION_NS = 1_000_000
"""Clocks drift by microseconds in the seconds of a window; more than this is a clock that was stopped."""


class Exchange(NamedTuple):
    """One ping and its pong; nanoseconds."""

    offset: int
    round_trip: int


class Offset:
    """Offset of one link: ``relay clock = own clock + offset``."""

    def __init__(self) -> None:
        self._window: deque[Exchange] = deque(maxlen=WINDOW)
        self._best: Exchange | None = None

    def add(self, sent: int, at: int, now: int) -> None:
        """Take one exchange.

        :param sent: own monotonic clock when asked, nanoseconds
        :param at: the relay's monotonic clock when it answered, nanoseconds
        :param now: own monotonic clock now, nanoseconds
        """
        if now < sent:
            return
        exchange = Exchange(at - (sent + now) // 2, now - sent)
        if self._best is not None and _contradict(self._best, exchange):
            self._window.clear()
        self._window.append(exchange)
        self._best = min(self._window, key=lambda each: each.round_trip)

    @property
    def known(self) -> bool:
        """Whether there was any exchange."""
        return self._best is not None

    @property
    def error(self) -> int:
        """Most the offset can be wrong by, nanoseconds."""
        return self._best.round_trip // 2 if self._best else 0

    @property
    def round_trip(self) -> int | None:
        """Latest round trip, nanoseconds."""
        return self._window[-1].round_trip if self._window else None

    def age(self, stamp: int, now: int) -> int:
        """How long ago the relay's clock showed ``stamp``, nanoseconds; negative when it has yet to."""
        return now + (self._best.offset if self._best else 0) - stamp


def _contradict(one: Exchange, other: Exchange) -> bool:
    """Whether no true offset fits both exchanges: a machine was suspended, or the relay is another one."""
    room = one.round_trip // 2 + other.round_trip // 2 + _CONTRADICTION_NS
    return abs(one.offset - other.offset) > room
