"""How much data may be on its way to a peer: a window that keeps the queue in front of a thin link short.

Kernels, proxies and modems queue megabytes, and a ping or a small message waits behind all of it. So a sender puts
probes (pings) into its stream. A probe's answer says that everything before it has arrived, end to end, whatever
buffers lie between, and how long it waited. A sender that has to wait for the window learns from it: while probes wait
no longer than on the empty link the window grows, as TCP's does in slow start; when they do, the window becomes what
the link carries in the round trip of the empty link and :data:`TARGET`. The rate is measured as BBR measures it
(draft-cardwell-iccrg-bbr-congestion-control, delivery rate).

A late answer alone says nothing about the link: a busy machine answers late too. So the window of a sender that never
has to wait for it stays as it is.

Used by the relay towards clients and robots, and by robots towards the relay. No I/O, no clock: times are given.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import NamedTuple

from relay_protocol.limits import KIB, MIB

TARGET = 0.1
"""Seconds that data may wait in the network before it leaves."""

FIRST = 32 * KIB
"""Window of a new connection, bytes. On a link of 100 kB/s its first large message delays others by 0.3 s."""

SMALL_FIRST = 128 * KIB
"""Window for small messages while the link has not proved to be thin, bytes."""

LATE_SECONDS = 1.0
"""While probes are late that window is what was carried in this time, and half of :data:`FIRST`: so long a machine may
stand still before a sender has to wait."""

LEAST = 4 * KIB
MOST = 16 * MIB
"""Bounds of the window, bytes."""

GAIN = 1.25
"""The window in parts of what the link carried: a faster link shows itself only to who sends more."""

RATE_SECONDS = 0.75
"""The best rate in this time counts."""

STALE_SECONDS = 4.0
"""After this long without a probe as quick as on an empty link, the link is emptied to measure that again."""

EMPTY = 2 * KIB
"""A probe with no more bytes than this before it measures the empty link."""

MARGIN = 0.01
"""Seconds by which round trips on an empty link vary; a quarter of the round trip, where that is more."""

QUICKEST = 0.001
"""Seconds; no rate is measured in less."""

LIMITED_SECONDS = 30.0
"""A link counts as thin for this long after a sender had to wait for it."""

PROBES = 256
"""Probes without an answer that are remembered."""


class _Probe(NamedTuple):
    key: Hashable
    position: int
    at: float
    full: bool
    arrived: int
    arrived_at: float
    arrived_sent: float


class SendWindow:
    """The window of one connection. Sizes are bytes, times are seconds of one monotonic clock.

    :param target: seconds that data may wait in the network
    """

    __slots__ = (
        "_arrived_at",
        "_arrived_sent",
        "_confirmed",
        "_late",
        "_probes",
        "_rates",
        "_slow_at",
        "_target",
        "arrived",
        "delay",
        "limited",
        "sent",
        "size",
        "trip",
    )

    def __init__(self, target: float = TARGET) -> None:
        self._target = target
        self.size: float = FIRST
        self.sent = 0
        """Bytes sent so far."""
        self.arrived = 0
        """Bytes of them that have arrived, as far as probes have shown."""
        self.trip: float | None = None
        """Round trip of the empty link; ``None`` before the first answer."""
        self.delay = 0.0
        """How much longer the latest probe took."""
        self.limited = False
        """Whether the link was slower than what was to be sent, in the last :data:`LIMITED_SECONDS`."""
        self._confirmed = self._slow_at = float("-inf")
        self._arrived_at = self._arrived_sent = float("-inf")
        """When the latest answer came, and when its probe was sent."""
        self._late = 0
        """Late answers in a row to probes of a sender that had to wait."""
        # A deque takes 600 bytes when it is empty, and most connections send little.
        self._probes: list[_Probe] = []
        self._rates: list[tuple[float, float]] = []
        """Times and rates, the rates falling: the first is the best."""

    @property
    def flight(self) -> int:
        """Bytes sent that may not have arrived."""
        return self.sent - self.arrived

    @property
    def rate(self) -> float | None:
        """Bytes per second the link carries; ``None`` while it is not known to be thin."""
        return self._rates[0][1] if self.limited and self._rates else None

    def room(self, now: float, *, small: bool = False) -> float:
        """Bytes that may be sent now.

        :param small: for small messages
        """
        if self.emptying(now):
            return 0
        return (self._small if small and not self.limited else self.size) - self.flight

    @property
    def _small(self) -> float:
        """The window for small messages on a link that has not proved to be thin."""
        if self.delay <= self._target:
            return max(self.size, SMALL_FIRST)
        return max(self.size, min(SMALL_FIRST, FIRST / 2 + LATE_SECONDS * self._rates[0][1]))

    def emptying(self, now: float) -> bool:
        """Whether nothing may be sent until the empty link has been measured."""
        return self.limited and now - self._confirmed > STALE_SECONDS

    @property
    def probed(self) -> bool:
        """Whether a probe is on its way behind everything that was sent."""
        return bool(self._probes) and self._probes[-1].position == self.sent

    def probe(self, key: Hashable, now: float, *, full: bool) -> None:
        """A probe is sent now, behind everything that was sent before.

        :param full: whether more is to be sent than the window allows
        """
        at, sent = self._arrived_at, self._arrived_sent
        self._probes.append(_Probe(key, self.sent, now, full, self.arrived, at, sent))
        if len(self._probes) > PROBES:
            del self._probes[0]

    def answered(self, key: Hashable, now: float) -> bool:
        """The answer to a probe has come; false when it is none. Answers keep the order of probes."""
        place = next((place for place, each in enumerate(self._probes) if each.key == key), None)
        if place is None:
            return False
        probe = self._probes[place]
        del self._probes[: place + 1]
        gained = max(0, probe.position - self.arrived)
        self.arrived += gained
        self._arrived_at, self._arrived_sent = now, probe.at
        self._learn(probe, gained, now)
        return True

    def all_arrived(self, *, but: int) -> int:
        """Everything sent has arrived except for the last bytes, as another source than a probe says.

        :returns: bytes that are now known to have arrived and were not before
        """
        gained = max(0, self.sent - but - self.arrived)
        self.arrived += gained
        return gained

    def _learn(self, probe: _Probe, gained: int, now: float) -> None:
        trip, flight, least = now - probe.at, probe.position - probe.arrived, self.trip
        if least is None or trip < least or (flight <= EMPTY and now - self._confirmed > STALE_SECONDS):
            self.trip = least = trip
        if trip <= least + max(MARGIN, least / 4):
            self._confirmed = now
        self.delay = delay = trip - least
        self._take_rate(
            flight / max(now - probe.arrived_at, probe.at - probe.arrived_sent, trip, QUICKEST), now
        )
        if probe.full:
            self._late = self._late + 1 if delay > self._target / 2 else 0
        if delay <= self._target / 2:
            if probe.full:
                self.size = min(MOST, self.size + gained)
            elif now - self._slow_at > LIMITED_SECONDS:
                self.limited = False
        elif probe.full and self._late > 1:
            self._slow_at = now
            self.limited = self.limited or delay > self._target
            carried = self._rates[0][1] * (least + self._target)
            self.size = max(LEAST, min(MOST, GAIN * min(carried, self.size)))

    def _take_rate(self, rate: float, now: float) -> None:
        """Note a measurement, which is never more than the link carries."""
        rates = [each for each in self._rates if each[0] >= now - RATE_SECONDS and each[1] > rate]
        self._rates = [*rates, (now, rate)]
