"""Bounds for the offset between the relay's monotonic clock and ours, from pings on one link.

The relay reads its clock (``at``) after we send the ping and before its answer arrives. So the true offset
lies between ``at - received`` and ``at - sent`` of every exchange, even if the two directions take
different times. A command stamped ``stamp`` is ``now + offset - stamp`` old. Its age is therefore at most
``now - stamp`` plus the least ``at - sent`` of the window, where each exchange is widened by the possible
drift since then.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

WINDOW = 16
"""Number of exchanges kept: 16 s at one a second."""

DRIFT = 1000
"""Two clocks drift apart by at most one part in this many: each may be slewed by 500 ppm (adjtimex(2))."""


class Exchange(NamedTuple):
    """One ping and its pong; nanoseconds, ``at`` on the relay's clock, the others on the robot's."""

    sent: int
    at: int
    received: int

    def upper_bound(self, now: int) -> int:
        """Largest possible offset."""
        return self.at - self.sent + (now - self.sent) // DRIFT + 1

    def lower_bound(self, now: int) -> int:
        """Smallest possible offset."""
        return self.at - self.received - (now - self.sent) // DRIFT - 1


class ClockOffset:
    """Clock offset of one link: ``relay clock = own clock + offset``."""

    def __init__(self) -> None:
        self._window: deque[Exchange] = deque(maxlen=WINDOW)

    def add(self, sent: int, at: int, now: int) -> None:
        """Add one exchange.

        :param sent: own monotonic clock when the ping was sent, nanoseconds
        :param at: the relay's monotonic clock when it answered, nanoseconds
        :param now: own monotonic clock now, nanoseconds
        """
        if now < sent:
            return
        exchange = Exchange(sent, at, now)
        if any(_contradict(each, exchange, now) for each in self._window):
            self._window.clear()
        self._window.append(exchange)

    @property
    def known(self) -> bool:
        """Whether there was an exchange."""
        return bool(self._window)

    @property
    def round_trip(self) -> int | None:
        """Latest round trip, nanoseconds."""
        return self._window[-1].received - self._window[-1].sent if self._window else None

    @property
    def answered(self) -> int | None:
        """When the latest ping that was answered was sent, nanoseconds."""
        return max(each.sent for each in self._window) if self._window else None

    def max_age(self, stamp: int, now: int) -> int | None:
        """Upper bound of the time since the relay's clock showed ``stamp``, nanoseconds.

        Negative if ``stamp`` is certainly in the future; ``None`` if there was no exchange.
        """
        if not self._window:
            return None
        return now + min(each.upper_bound(now) for each in self._window) - stamp


def _contradict(one: Exchange, other: Exchange, now: int) -> bool:
    """Whether no offset fits both exchanges: a machine was suspended, or the relay is another one."""
    return one.upper_bound(now) < other.lower_bound(now) or other.upper_bound(now) < one.lower_bound(now)
