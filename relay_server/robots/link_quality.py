"""The quality of a link, measured by the round trips of its pings (SPEC 1.7). Time is injected."""

from __future__ import annotations

import itertools
import math
import statistics
from array import array
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, TypedDict

WINDOW = 30.0
"""Seconds over which round trips are summarised."""

RECENT = 5.0
"""Seconds that decide the quality."""

LATE = 1.0
"""A round trip that takes longer counts as lost, in seconds."""

SILENCE = 3.0
"""A link without an answer for longer counts as lost itself, in seconds."""

SPACING = 0.5
"""One round trip is kept per this many seconds: clients that drive are pinged ten times a second."""

FAIR = 0.1
BAD = 0.3
"""Median round trips from which a link is fair, or bad, in seconds."""

LOSSES = 256
"""Most losses that are counted."""

Quality = Literal["", "good", "fair", "bad", "lost"]

_WORDS: tuple[Quality, ...] = ("good", "fair", "bad", "lost")


class LinkQualityInfo(TypedDict):
    """How good a way is; milliseconds, of the last 30 s.

    :param lost: seconds of these without an answer
    :param quality: of the last 5 s; empty while it is unknown
    """

    rtt_ms: float | None
    p95_ms: float | None
    jitter_ms: float | None
    lost: int
    quality: Quality


@dataclass(frozen=True)
class LinkQuality:
    """The quality of a link now. Times are seconds, ``None`` before the first round trip.

    :param rtt: median round trip
    :param p95: 95th percentile of round trips
    :param jitter: mean difference of a round trip to the one before
    :param lost: pings answered later than :data:`LATE`, or without an answer for longer
    :param recent_rtt: median round trip of the last :data:`RECENT` seconds
    :param quality: ``good``, ``fair``, ``bad``, ``lost``; empty before the first round trip
    """

    rtt: float | None = None
    p95: float | None = None
    jitter: float | None = None
    lost: int = 0
    recent_rtt: float | None = None
    quality: Quality = ""

    def summary(self) -> LinkQualityInfo:
        """The fields that users see, in milliseconds."""
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
    """Keeps the round trips of one link for :data:`WINDOW` seconds."""

    __slots__ = ("_losses", "_times", "_trips")

    def __init__(self) -> None:
        # Every client has a meter, and an empty deque takes 700 bytes.
        self._times = array("d")
        self._trips = array("d")
        self._losses: list[float] = []

    def answered(self, now: float, trip: float) -> None:
        """A ping was answered.

        :param now: monotonic seconds
        :param trip: seconds since the ping was sent
        """
        self.unanswered(now, trip)
        if self._times and now - self._times[-1] < SPACING and trip <= LATE:
            return
        self._times.append(now)
        self._trips.append(trip)
        self._forget(now)

    def unanswered(self, now: float, age: float) -> None:
        """A ping was skipped because a later one was answered (RFC 6455 section 5.5.3).

        It is lost only if it was late already.

        :param age: seconds since it was sent
        """
        if age > LATE:
            self._losses.append(now)
            del self._losses[:-LOSSES]

    def link_quality(self, now: float, out: Collection[float]) -> LinkQuality:
        """The quality now.

        :param out: ages in seconds of the pings that have no answer yet
        """
        self._forget(now)
        late = sum(age > LATE for age in out)
        trips = self._trips.tolist()
        lost = len(self._losses) + late
        silent = max(out, default=0.0) > SILENCE
        if not trips:
            return LinkQuality(lost=lost, quality="lost" if silent else "")
        recent_rtt = statistics.median(
            [trip for at, trip in zip(self._times, trips, strict=True) if at > now - RECENT] or trips[-1:]
        )
        lossy = late > 0 or any(at > now - RECENT for at in self._losses)
        return LinkQuality(
            rtt=statistics.median(trips),
            p95=sorted(trips)[math.ceil(0.95 * len(trips)) - 1],
            jitter=_jitter(trips),
            lost=lost,
            recent_rtt=recent_rtt,
            quality="lost" if silent else _worse(_word(recent_rtt), "bad" if lossy else "good"),
        )

    def _forget(self, now: float) -> None:
        while self._times and self._times[0] < now - WINDOW:
            del self._times[0], self._trips[0]
        while self._losses and self._losses[0] < now - WINDOW:
            del self._losses[0]


def joined(near: LinkQuality, far: LinkQuality) -> LinkQuality:
    """The quality of two links in series: their round trips add up."""
    if "lost" in (near.quality, far.quality):
        return LinkQuality(lost=near.lost + far.lost, quality="lost")
    if not near.quality or not far.quality:
        return LinkQuality(lost=near.lost + far.lost)
    recent_rtt = _sum(near.recent_rtt, far.recent_rtt)
    halves = _worse(near.quality, far.quality)
    return LinkQuality(
        rtt=_sum(near.rtt, far.rtt),
        p95=_sum(near.p95, far.p95),
        jitter=_sum(near.jitter, far.jitter),
        lost=near.lost + far.lost,
        recent_rtt=recent_rtt,
        quality=halves if recent_rtt is None else _worse(halves, _word(recent_rtt)),
    )


def milliseconds(seconds: float | None) -> float | None:
    """Seconds as milliseconds with two decimals; ``None`` stays."""
    return None if seconds is None else round(seconds * 1000, 2)


def _word(rtt: float) -> Quality:
    if rtt < FAIR:
        return "good"
    return "fair" if rtt < BAD else "bad"


def _worse(one: Quality, other: Quality) -> Quality:
    return max(one, other, key=_WORDS.index)


def _sum(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else one + other


def _jitter(trips: list[float]) -> float | None:
    if len(trips) < 2:
        return None
    return statistics.fmean(abs(after - before) for before, after in itertools.pairwise(trips))
