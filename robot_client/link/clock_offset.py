"""How far the relay's monotonic clock may be from ours, from pings on one link.

The relay read its clock (``at``) no earlier than we asked and no later than its answer came, so the true offset
lies between ``at - received`` and ``at - sent`` of every exchange, however unequal the two ways were. A command
stamped ``stamp`` is ``now + offset - stamp`` old, so its age is at most ``now - stamp`` plus the least of the
window's ``at - sent``, each widened by what two clocks can have drifted apart since.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

WINDOW = 16
"""Exchanges kept: some 16 s at one a second."""

DRIFT = 1000
"""Two clocks drift apart by at most one part in this many: each may be slewed by 500 ppm (adjtimex)."""


class Exchange(NamedTuple):
    """One ping and its pong; nanoseconds, ``at`` on the relay's clock, the others on our own."""

    sent: int
    at: int
    received: int

    def most(self, now: int) -> int:
        """The largest offset that is possible."""
        return self.at - self.sent + (now - self.sent) // DRIFT + 1

    def least(self, now: int) -> int:
        """The smallest offset that is possible."""
        return self.at - self.received - (now - self.sent) // DRIFT - 1


class ClockOffset:
    """Offset of one link: ``relay clock = own clock + offset``."""

    def __init__(self) -> None:
        self._window: deque[Exchange] = deque(maxlen=WINDOW)

    def add(self, sent: int, at: int, now: int) -> None:
        """Take one exchange.

        :param sent: own monotonic clock when asked, nanoseconds
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
        """Whether there was any exchange."""
        return bool(self._window)

    @property
    def round_trip(self) -> int | None:
        """Latest round trip, nanoseconds."""
        return self._window[-1].received - self._window[-1].sent if self._window else None

    @property
    def answered(self) -> int | None:
        """When the latest ping that was answered was sent, nanoseconds."""
        return max(each.sent for each in self._window) if self._window else None

    def oldest(self, stamp: int, now: int) -> int | None:
        """How long ago the relay's clock showed ``stamp``, at most, nanoseconds.

        Negative when it surely has yet to show it; ``None`` while there was no exchange.
        """
        if not self._window:
            return None
        return now + min(each.most(now) for each in self._window) - stamp


def _contradict(one: Exchange, other: Exchange, now: int) -> bool:
    """Whether no true offset fits both exchanges: a machine was suspended, or the relay is another one."""
    return one.most(now) < other.least(now) or other.most(now) < one.least(now)
