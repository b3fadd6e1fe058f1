"""How good a link is, told by round trips of pings over it (SPEC section 1.7, Links and people). Time is given."""

from __future__ import annotations

import itertools
import math
import statistics
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

WINDOW = 30.0
"""Seconds over which round trips are told."""

RECENT = 5.0
"""Seconds by which the word for the quality goes."""

LATE = 1.0
"""A round trip that takes longer, seconds, counts as lost."""

SILENCE = 3.0
"""A link on which nothing has come back for so long, seconds, counts as lost itself."""

SPACING = 0.5
"""Of more frequent round trips one in this time is kept, seconds: who drives is pinged ten times a second."""

FAIR = 0.1
BAD = 0.3
"""Median round trips, seconds, from which on a link is no better than fair, or bad."""

LOSSES = 256
"""Most losses that are counted."""

_WORDS = ("good", "fair", "bad", "lost")


@dataclass(frozen=True)
class LinkQuality:
    """What is known of a link now. Times are seconds, ``None`` when nobody knows yet.

    :param rtt: median round trip
    :param p95: 95th percentile of round trips
    :param jitter: mean difference of a round trip to the one before
    :param lost: round trips that took longer than :data:`LATE`, or have no answer for so long
    :param lately: median round trip of the last :data:`RECENT` seconds
    :param quality: ``good``, ``fair``, ``bad``, ``lost``; empty before the first round trip
    """

    rtt: float | None = None
    p95: float | None = None
    jitter: float | None = None
    lost: int = 0
    lately: float | None = None
    quality: str = ""

    def told(self) -> dict[str, Any]:
        """The fields as they are told, in milliseconds."""
        return {
            "rtt_ms": milliseconds(self.rtt),
            "p95_ms": milliseconds(self.p95),
            "jitter_ms": milliseconds(self.jitter),
            "lost": self.lost,
            "quality": self.quality,
        }


UNKNOWN = LinkQuality()
NO_LINK = LinkQuality(quality="lost")


class LinkQualityMeter:
    """Keeps the round trips of one link for as long as they are told."""

    __slots__ = ("_losses", "_trips")

    def __init__(self) -> None:
        self._trips: deque[tuple[float, float]] = deque()
        self._losses: deque[float] = deque(maxlen=LOSSES)

    def came_back(self, now: float, trip: float) -> None:
        """A ping was answered.

        :param now: monotonic seconds
        :param trip: seconds since the ping was sent
        """
        self.passed_over(now, trip)
        if self._trips and now - self._trips[-1][0] < SPACING and trip <= LATE:
            return
        self._trips.append((now, trip))
        self._forget(now)

    def passed_over(self, now: float, age: float) -> None:
        """A ping was not answered, since a later one was (RFC 6455 section 5.5.3); a loss only if it was late already.

        :param age: seconds since it was sent
        """
        if age > LATE:
            self._losses.append(now)

    def reading(self, now: float, out: Collection[float]) -> LinkQuality:
        """What is known now.

        :param out: seconds since each of the pings was sent that have no answer yet
        """
        self._forget(now)
        late = sum(age > LATE for age in out)
        trips = [trip for _, trip in self._trips]
        lost = len(self._losses) + late
        silent = max(out, default=0.0) > SILENCE
        if not trips:
            return LinkQuality(lost=lost, quality="lost" if silent else "")
        lately = statistics.median([trip for at, trip in self._trips if at > now - RECENT] or trips[-1:])
        lossy = late > 0 or any(at > now - RECENT for at in self._losses)
        return LinkQuality(
            rtt=statistics.median(trips),
            p95=sorted(trips)[math.ceil(0.95 * len(trips)) - 1],
            jitter=_jitter(trips),
            lost=lost,
            lately=lately,
            quality="lost" if silent else _worse(_word(lately), "bad" if lossy else "good"),
        )

    def _forget(self, now: float) -> None:
        while self._trips and self._trips[0][0] < now - WINDOW:
            self._trips.popleft()
        while self._losses and self._losses[0] < now - WINDOW:
            self._losses.popleft()


def joined(near: LinkQuality, far: LinkQuality) -> LinkQuality:
    """Two links one after the other: what is sent over both takes the time of both."""
    if "lost" in (near.quality, far.quality):
        return LinkQuality(lost=near.lost + far.lost, quality="lost")
    if not near.quality or not far.quality:
        return LinkQuality(lost=near.lost + far.lost)
    lately = _sum(near.lately, far.lately)
    halves = _worse(near.quality, far.quality)
    return LinkQuality(
        rtt=_sum(near.rtt, far.rtt),
        p95=_sum(near.p95, far.p95),
        jitter=_sum(near.jitter, far.jitter),
        lost=near.lost + far.lost,
        lately=lately,
        quality=halves if lately is None else _worse(halves, _word(lately)),
    )


def milliseconds(seconds: float | None) -> float | None:
    """Seconds as milliseconds with two decimals; ``None`` stays."""
    return None if seconds is None else round(seconds * 1000, 2)


def _word(rtt: float) -> str:
    if rtt < FAIR:
        return "good"
    return "fair" if rtt < BAD else "bad"


def _worse(one: str, other: str) -> str:
    return max(one, other, key=_WORDS.index)


def _sum(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else one + other


def _jitter(trips: list[float]) -> float | None:
    if len(trips) < 2:
        return None
    return statistics.fmean(abs(after - before) for before, after in itertools.pairwise(trips))
