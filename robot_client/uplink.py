"""Samples on their way to the relay: throttled, bounded, newest first to survive.

While the transport takes data, samples pass in the order they came. While it does not, each subscription
keeps its latest (small ones by the hundred, a big one alone), no older than a second, all together at most 4 MiB.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from typing import NamedTuple

from relay_protocol import frames
from relay_protocol.limits import KIB, MIB, ROBOT_FRAME

MAX_AGE = 1.0
MAX_BYTES = 4 * MIB
LANE_BYTES = 256 * KIB
_HEAD = 13
"""Kind, number and stamp, counted by a frame's length."""


class _Sample(NamedTuple):
    number: int
    arrived: float
    stamp: int
    body: bytes


class _Lane:
    """One subscription's part of the queue."""

    def __init__(self, throttle: float, latched: bool) -> None:
        self.throttle = throttle
        self.latched = latched
        self.waiting: deque[int] = deque()
        self.size = 0
        self.next_at = 0.0
        self.held: _Sample | None = None


class Uplink:
    """The queue of one channel link.

    :param now: clock, seconds
    :param frame_limit: largest frame the relay takes, bytes
    """

    def __init__(self, now: Callable[[], float], frame_limit: int = ROBOT_FRAME) -> None:
        self.paused = False
        self.dropped = 0
        self.oversized = 0
        self._now = now
        self._limit = frame_limit
        self._lanes: dict[int, _Lane] = {}
        self._queue: OrderedDict[int, _Sample] = OrderedDict()
        self._serial = 0
        self._size = 0

    def open(self, number: int, throttle: float = 0.0, latched: bool = False) -> None:
        """Begin a subscription, or change the throttle (seconds) of one."""
        lane = self._lanes.get(number)
        if lane is None:
            self._lanes[number] = _Lane(throttle, latched)
            return
        lane.next_at += throttle - lane.throttle
        lane.throttle = throttle
        lane.latched = latched

    def close(self, number: int) -> None:
        """End a subscription; what waits of it is forgotten."""
        lane = self._lanes.pop(number, None)
        if lane is not None:
            for serial in lane.waiting:
                self._size -= len(self._queue.pop(serial).body)

    def offer(self, number: int, stamp: int, body: bytes) -> None:
        """Take one sample; ``stamp`` is the wall clock in nanoseconds."""
        lane = self._lanes.get(number)
        if lane is None:
            return
        if len(body) + _HEAD > self._limit:
            self.oversized += 1
            self.dropped += 1
            return
        now = self._now()
        sample = _Sample(number, now, stamp, body)
        if lane.throttle and now < lane.next_at:
            lane.held = sample
            return
        self._admit(lane, sample, now)

    def next_due(self) -> float | None:
        """When the next sample held back by a throttle may go, on the clock given; ``None`` for none."""
        return min((lane.next_at for lane in self._lanes.values() if lane.held), default=None)

    def release(self) -> None:
        """Let go the held samples whose time has come."""
        now = self._now()
        for lane in self._lanes.values():
            if lane.held is not None and lane.next_at <= now:
                self._admit(lane, lane.held, now)

    def take(self, at_least: int) -> list[bytes]:
        """The next frames to write: up to the one that makes ``at_least`` bytes. Empty when nothing waits."""
        if self.paused:
            return []
        out: list[bytes] = []
        taken = 0
        while self._queue and taken < at_least:
            sample = self._remove(next(iter(self._queue)))
            frame = frames.encode_sample(sample.number, sample.stamp, sample.body)
            taken += len(frame)
            out.append(frame)
        return out

    @property
    def waiting(self) -> int:
        """Bytes of samples that wait."""
        return self._size

    def trim(self) -> None:
        """Drop what is over the bounds; called while the transport takes nothing."""
        for lane in self._lanes.values():
            self._trim_lane(lane)
        while self._size > MAX_BYTES and len(self._queue) > 1:
            self._drop(next(iter(self._queue)))
        oldest = self._now() - MAX_AGE
        for serial, sample in list(self._queue.items()):
            if sample.arrived >= oldest:
                break
            lane = self._lanes[sample.number]
            if not (lane.latched and lane.waiting[-1] == serial):
                self._drop(serial)

    def _admit(self, lane: _Lane, sample: _Sample, now: float) -> None:
        lane.held = None
        lane.next_at = now + lane.throttle
        self._serial += 1
        self._queue[self._serial] = sample
        lane.waiting.append(self._serial)
        lane.size += len(sample.body)
        self._size += len(sample.body)
        if self.paused:
            self.trim()

    def _trim_lane(self, lane: _Lane) -> None:
        while len(lane.waiting) > 1 and lane.size > LANE_BYTES:
            self._drop(lane.waiting[0])

    def _drop(self, serial: int) -> None:
        self._remove(serial)
        self.dropped += 1

    def _remove(self, serial: int) -> _Sample:
        sample = self._queue.pop(serial)
        lane = self._lanes[sample.number]
        lane.waiting.remove(serial)
        lane.size -= len(sample.body)
        self._size -= len(sample.body)
        return sample
