"""Whether a topic that came regularly has ceased. Pure: looks at a count, now and then."""

from __future__ import annotations

REGULAR_SECONDS = 10.0
"""What has come for so long without a gap is expected to go on."""

SAMPLES = 5
"""Fewest samples from which the usual period is known."""

PERIOD = 1.0
"""Longest usual period of what is watched, seconds: what comes more seldom may be meant to."""

GAP_SECONDS = 2.5
"""A pause that is no gap yet: looks are a second apart."""

PERIODS = 5.0
LEAST_SECONDS = 3.0
"""A topic has ceased when for so many of its periods, and for so long, nothing came."""


class Flow:
    """One subscription of a topic.

    :param now: seconds of any clock
    :param count: samples that have come so far
    """

    __slots__ = ("_base", "_count", "_grown", "_since", "stale")

    def __init__(self, now: float, count: int) -> None:
        self.stale = False
        self._count = self._base = count
        self._since = self._grown = now

    @property
    def came(self) -> bool:
        """Whether anything has come since this began."""
        return self._count > self._base

    def grows(self, count: int) -> bool:
        """Whether something has come since the last look.

        :param count: samples that have come so far
        """
        return count != self._count

    @property
    def period(self) -> float | None:
        """Seconds from one sample to the next, where that is known and regular."""
        lasted, samples = self._grown - self._since, self._count - self._base
        if lasted < REGULAR_SECONDS or samples < SAMPLES or lasted > samples * PERIOD:
            return None
        return lasted / samples

    def excuse(self, now: float) -> None:
        """Nothing could have come since the last look: that time does not count.

        :param now: not before the last look
        """
        if not self.stale:
            self._since += now - self._grown
            self._grown = now

    def look(self, now: float, count: int) -> bool:
        """See how many samples have come; whether the topic is stale.

        :param now: not before the last look
        """
        if count != self._count:
            if self.stale or now - self._grown > GAP_SECONDS:
                self._since, self._base = now, self._count
            self._count, self._grown, self.stale = count, now, False
        elif not self.stale:
            period = self.period
            self.stale = period is not None and now - self._grown > max(LEAST_SECONDS, PERIODS * period)
        return self.stale
