"""Samples on their way to the relay: throttled, bounded, newest first to survive, large ones in parts.

While the transport takes data, small samples pass in the order they came, and between them parts of the large ones, one
subscription after the other: a picture must not delay what is small. While it does not, each subscription keeps its
latest (small ones by the hundred, a big one alone), no older than a second, all together at most 4 MiB. A sample whose
parts have begun is finished.
"""

from __future__ import annotations

import time
from collections import OrderedDict, deque
from collections.abc import Callable

import msgspec

from relay_protocol import frames, link
from relay_protocol.limits import KIB, MIB, ROBOT_FRAME
from robot_client.channel.parts import ChannelWriter
from robot_client.twisted_types import DelayedCall, ReactorClock

TELL_SECONDS = 1.0
"""The relay is told no more often what was lost."""

AT_ONCE = 8
"""Chunks written before others have their turn on the reactor: a link that takes all is no reason to keep it."""


class WriteScheduler:
    """The uplink of one channel, with its timers.

    :param after: takes what is to be called when the samples that came together are all there; they share a write
    :param frame_limit: largest frame the relay takes, bytes
    :param wall: what samples are stamped by, nanoseconds
    :param sample_limit: largest sample that may go in parts, bytes; 0 for what fits into a frame
    :param lost: takes what is to be told of samples that were not sent
    """

    def __init__(
        self,
        wire: ChannelWriter,
        clock: ReactorClock,
        after: Callable[[Callable[[], None]], None],
        frame_limit: int,
        wall: Callable[[], int] = time.time_ns,
        *,
        sample_limit: int = 0,
        lost: Callable[[link.Lost], None] = lambda loss: None,
    ) -> None:
        self.uplink = Uplink(clock.seconds, frame_limit, sample_limit)
        self._lost = lost
        self._telling: DelayedCall | None = None
        self._wire = wire
        self._clock = clock
        self._after = after
        self._wall = wall
        self._awaited = False
        self._closed = False
        self._flush: DelayedCall | None = None
        self._release: DelayedCall | None = None

    def offer(self, number: int, body: bytes, stamp: int = 0) -> None:
        """Take one sample; see :meth:`robot_client.channel.uplink.Uplink.offer`.

        :param stamp: nanoseconds since 1970; 0 for now
        """
        taken = self.uplink.offer(number, stamp or self._wall(), body)
        if self.uplink.held:
            self.arm()
        if self.uplink.lost:
            self._tell_later()
        if taken and not self._awaited and not self.uplink.paused:
            self._awaited = True
            self._after(self.flush)

    def repeat(self, number: int, stamp: int, body: bytes) -> None:
        """Take a sample that publishers keep; see :meth:`robot_client.channel.uplink.Uplink.repeat`."""
        if self.uplink.repeat(number, stamp, body) and not self.uplink.paused:
            self.flush()
        if self.uplink.lost:
            self._tell_later()

    def unmute(self, number: int) -> None:
        """Let a subscription speak again; see :meth:`robot_client.channel.uplink.Uplink.unmute`."""
        if self.uplink.unmute(number):
            self.flush()

    def end(self, number: int) -> None:
        """End a subscription; see :meth:`robot_client.channel.uplink.Uplink.close`."""
        self.uplink.close(number)
        self.flush()

    def flush(self) -> None:
        """Write what waits, as far as the transport takes it."""
        self._awaited = False
        if self._closed:
            return
        if self._flush is not None and self._flush.active():
            self._flush.cancel()
        self._flush = None
        if self.uplink.lost:
            self._tell_later()
        for _ in range(AT_ONCE):
            room = self._wire.room
            chunk = self.uplink.take(room, room)
            if chunk:
                self._wire.write(chunk)
            if self.uplink.paused or not self.uplink.ready:
                return
        self._flush = self._clock.callLater(0, self.flush)

    def pause(self) -> None:
        """The transport is full."""
        self.uplink.paused = True
        self.uplink.trim()

    def resume(self) -> None:
        """The transport has room again."""
        self.uplink.paused = False
        self.flush()

    def close(self) -> None:
        """Write no more."""
        self._closed = True
        for timer in (self._flush, self._release, self._telling):
            if timer is not None and timer.active():
                timer.cancel()

    def arm(self) -> None:
        """See that the next sample held back by a throttle goes when it is due."""
        due = self.uplink.next_due()
        if self._release is not None and self._release.active():
            if due is not None and self._release.getTime() <= due:
                return
            self._release.cancel()
        self._release = None
        if due is not None:
            self._release = self._clock.callLater(max(0.0, due - self._clock.seconds()), self._let_go)

    def _tell_later(self) -> None:
        """Tell of what was lost in a moment: when a link is slow, much is lost at a time."""
        if not self._closed and (self._telling is None or not self._telling.active()):
            self._telling = self._clock.callLater(TELL_SECONDS, self._tell)

    def _tell(self) -> None:
        lost, self.uplink.lost = self.uplink.lost, {}
        for (number, reason), loss in lost.items():
            self._lost(link.Lost(number=number, reason=reason, count=loss.count, size=loss.size))

    def _let_go(self) -> None:
        self._release = None
        self.uplink.release()
        self.flush()
        self.arm()


MAX_AGE = 1.0
MAX_BYTES = 4 * MIB
LANE_BYTES = 256 * KIB
WHOLE = 16 * KIB
"""A sample of more bytes goes in parts."""

PART = 32 * KIB
LEAST_PART = 2 * KIB
"""Bytes of a part; fewer than :data:`PART` where the link has no room for more."""
MISSED = 64
"""Latched samples of one subscription that wait while it is muted, one for each publisher; more than one only as far as
they are not larger than :data:`LANE_BYTES` together."""


TOO_LARGE = "too_large"
SLOW_LINK = "slow_link"
"""Why a sample was not sent: it is larger than may be, or newer ones took its place."""


class Loss(msgspec.Struct):
    """Samples of one subscription that were not sent for one reason: how many, and the bytes of the largest."""

    count: int = 0
    size: int = 0


class _Sample(msgspec.Struct, frozen=True, gc=False):
    number: int
    arrived: float
    stamp: int
    body: bytes
    repeat: bool = False
    """Whether it went before: it is not the latest of its topic."""


class _Lane:
    """One subscription's part of the queue."""

    def __init__(self, throttle: float, latched: bool) -> None:
        self.throttle = throttle
        self.latched = latched
        self.waiting: deque[int] = deque()
        self.size = 0
        self.next_at = 0.0
        self.held: _Sample | None = None
        self.large = 0
        self.begun: _Sample | None = None
        self.sent = 0
        """Bytes of :attr:`begun` that have gone."""
        self.last: bytes | None = None
        """What left last."""
        self.muted = False
        self.stamp = 0
        """The latest."""
        self.instead: bytes | None = None
        """What is sent in the place of each sample while it is muted."""
        self.missed: deque[_Sample] = deque(maxlen=MISSED)
        """Samples of publishers that keep theirs, which came while it was muted: there may be no others."""


class Uplink:
    """The queue of one channel link.

    :param now: clock, seconds
    :param frame_limit: largest frame the relay takes, bytes
    :param sample_limit: largest sample it takes in parts, bytes; 0 for what fits into a frame
    """

    def __init__(
        self, now: Callable[[], float], frame_limit: int = ROBOT_FRAME, sample_limit: int = 0
    ) -> None:
        self.paused = False
        self.dropped = 0
        self.oversized = 0
        self.lost: dict[tuple[int, str], Loss] = {}
        """What was lost and not told yet, by subscription and reason."""
        self._now = now
        self._limit = frame_limit
        self._largest = max(sample_limit, frame_limit - frames.SAMPLE_HEAD)
        self._lanes: dict[int, _Lane] = {}
        self._small: OrderedDict[int, _Sample] = OrderedDict()
        self._large: OrderedDict[int, _Sample] = OrderedDict()
        """What must not overtake a large sample of its subscription is here too, however small."""
        self._turns: deque[int] = deque()
        """Subscriptions with something in :attr:`_large` or begun, in the order of their turns."""
        self._begun = 0
        """Bytes of all samples whose parts have begun, whole, without :attr:`_huge`."""
        self._huge: int | None = None
        """The subscription that has begun a sample which would not fit into a frame; the relay holds one at a time."""
        self._ends: list[bytes] = []
        self._serial = 0
        self._since = 0.0
        """Nothing that waits came before."""
        self._size = 0
        self.held = 0
        """Samples held back by a throttle."""

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
        """End a subscription; what waits of it is forgotten, what has begun is broken off."""
        lane = self._lanes.pop(number, None)
        if lane is None:
            return
        self.held -= lane.held is not None
        for serial in lane.waiting:
            self._size -= len(self._pop(serial).body)
        if lane.large or lane.begun:
            self._turns.remove(number)
        if lane.begun is not None:
            self._ended(number, len(lane.begun.body))
            # SPEC 2.1: what is unfinished would stay with the relay until the link ends.
            self._ends.append(frames.encode_part(number, lane.begun.stamp, 1, 0, b"\0"))

    def offer(self, number: int, stamp: int, body: bytes) -> bool:
        """Take one sample.

        :param stamp: the wall clock, nanoseconds
        :return: whether it may go now, as far as its throttle is concerned
        """
        lane = self._lanes.get(number)
        if lane is None:
            return False
        if self._too_large(number, body):
            return False
        now = self._now()
        if lane.muted:
            if lane.latched:
                lane.missed.append(_Sample(number, now, stamp, body))
                while len(lane.missed) > 1 and sum(len(each.body) for each in lane.missed) > LANE_BYTES:
                    lane.missed.popleft()
            if lane.instead is None:
                return False
            body = lane.instead
            if lane.latched:
                # The sample itself goes later, and has to be the newer one then (SPEC 2.5, what publishers keep).
                stamp = lane.stamp + 1
        lane.stamp = stamp
        sample = _Sample(number, now, stamp, body)
        if lane.throttle and now < lane.next_at:
            self.held += lane.held is None
            lane.held = sample
            return False
        self._admit(lane, sample, now)
        return True

    def repeat(self, number: int, stamp: int, body: bytes) -> bool:
        """Take a sample that publishers keep, without heed of the throttle (SPEC 2.5, ``kept`` of ``subscribe``).

        :param stamp: the one it went by before, 0 for the end
        :param body: empty where the relay has it
        :return: whether it goes
        """
        lane = self._lanes.get(number)
        if lane is None:
            return False
        if self._too_large(number, body):
            return False
        # Muted, what went before is all there is, and only where the last value is held.
        if stamp and lane.muted and (body or lane.instead is None):
            return False
        self._append(lane, _Sample(number, self._now(), stamp, body, True))
        return True

    def mute(self, number: int, hold: bool) -> None:
        """Send nothing more of a subscription, also not what waits; a sample whose parts have begun is finished.

        :param hold: what left last in the place of each sample, where there is that
        """
        lane = self._lanes.get(number)
        if lane is None:
            return
        lane.muted = True
        lane.instead = lane.last if hold else None
        self.held -= lane.held is not None
        lane.held = None
        for serial in lane.waiting:
            self._size -= len(self._pop(serial).body)
        if lane.large and lane.begun is None:
            self._turns.remove(number)
        lane.waiting.clear()
        lane.size = lane.large = 0

    def unmute(self, number: int) -> bool:
        """Send samples of a subscription again; whether there is one now."""
        lane = self._lanes.get(number)
        if lane is None or not lane.muted:
            return False
        lane.muted, lane.instead = False, None
        self.held -= lane.held is not None
        lane.held = None
        missed, lane.missed = lane.missed, deque(maxlen=MISSED)
        for sample in missed:
            self._admit(lane, sample, self._now())
        return bool(missed)

    def next_due(self) -> float | None:
        """When the next sample held back by a throttle may go, on the clock given; ``None`` for none."""
        if not self.held:
            return None
        return min((lane.next_at for lane in self._lanes.values() if lane.held), default=None)

    def release(self) -> None:
        """Let go the held samples whose time has come."""
        now = self._now()
        for lane in self._lanes.values():
            if lane.held is not None and lane.next_at <= now:
                self._admit(lane, lane.held, now)

    def take(self, at_least: int, part: int = PART) -> list[bytes]:
        """The next frames to write: small samples up to the one that makes ``at_least`` bytes, then one part of a large
        one. Empty when nothing waits.

        :param part: bytes the part should have at most
        """
        if self.paused:
            return []
        if self._now() - self._since > MAX_AGE:
            self._trim_old()
        out, self._ends = self._ends, []
        taken = 0
        while self._small and taken < at_least:
            serial, sample = self._small.popitem(last=False)
            lane, size = self._lanes[sample.number], len(sample.body)
            lane.waiting.remove(serial)
            lane.size -= size
            if not sample.repeat:
                lane.last = sample.body
            self._size -= size
            frame = frames.encode_sample(sample.number, sample.stamp, sample.body)
            taken += len(frame)
            out.append(frame)
        if self._turns:
            out += self._next_part(min(PART, max(LEAST_PART, part)))
        return out

    @property
    def waiting(self) -> int:
        """Bytes of samples that wait, without those begun."""
        return self._size

    @property
    def ready(self) -> bool:
        """Whether :meth:`take` has something, once the transport takes it."""
        return bool(self._small or self._turns or self._ends)

    def trim(self) -> None:
        """Drop what is over the bounds; called while the transport takes nothing."""
        for lane in self._lanes.values():
            self._trim_lane(lane)
        self._trim_all()

    def _admit(self, lane: _Lane, sample: _Sample, now: float) -> None:
        if lane.held is not None:
            lane.held = None
            self.held -= 1
        lane.next_at = now + lane.throttle
        self._append(lane, sample)

    def _append(self, lane: _Lane, sample: _Sample) -> None:
        if sample.arrived < self._since or not (self._small or self._large):
            self._since = sample.arrived
        self._serial += 1
        if lane.large or lane.begun or len(sample.body) > WHOLE:
            if not lane.large and lane.begun is None:
                self._turns.append(sample.number)
            lane.large += 1
            self._large[self._serial] = sample
        else:
            self._small[self._serial] = sample
        lane.waiting.append(self._serial)
        lane.size += len(sample.body)
        self._size += len(sample.body)
        if self.paused:
            self._trim_lane(lane)
            self._trim_all()

    def _next_part(self, size: int) -> list[bytes]:
        """A frame of the first subscription in turn that may send one."""
        for _ in range(len(self._turns)):
            number = self._turns[0]
            self._turns.rotate(-1)
            lane = self._lanes[number]
            if lane.begun is not None or self._begin(lane):
                return [self._part(number, lane, size)]
        return []

    def _begin(self, lane: _Lane) -> bool:
        serial = lane.waiting[0]
        if serial in self._small:
            return False  # it came before
        # The relay holds what is unfinished; what fits into one frame it takes together in any case.
        sample = self._large[serial]
        size = len(sample.body)
        if size + frames.SAMPLE_HEAD > self._limit:
            if self._huge is not None:
                return False
            self._huge = sample.number
        elif self._begun and self._begun + size > self._limit:
            return False
        else:
            self._begun += size
        lane.begun, lane.sent = self._remove(serial), 0
        if not lane.begun.repeat:
            lane.last = lane.begun.body
        return True

    def _ended(self, number: int, size: int) -> None:
        """A sample of this subscription that has begun is finished, or broken off."""
        if number == self._huge:
            self._huge = None
        else:
            self._begun -= size

    def _part(self, number: int, lane: _Lane, size: int) -> bytes:
        assert lane.begun is not None
        stamp, body = lane.begun.stamp, lane.begun.body
        total = len(body)
        if total <= WHOLE:
            frame, lane.sent = frames.encode_sample(number, stamp, body), total
        else:
            piece = body[lane.sent : lane.sent + size]
            frame = frames.encode_part(number, stamp, total, lane.sent, piece)
            lane.sent += len(piece)
        if lane.sent >= total:
            lane.begun = None
            self._ended(number, total)
            if not lane.large:
                self._turns.remove(number)
        return frame

    def _trim_lane(self, lane: _Lane) -> None:
        while len(lane.waiting) > 1 and lane.size > LANE_BYTES:
            self._drop(lane.waiting[0])

    def _trim_all(self) -> None:
        while self._size > MAX_BYTES and len(self._small) + len(self._large) > 1:
            self._drop(min(next(iter(queue)) for queue in (self._small, self._large) if queue))
        self._trim_old()

    def _trim_old(self) -> None:
        oldest = self._now() - MAX_AGE
        for queue in (self._small, self._large):
            old = []
            for serial, sample in queue.items():
                if sample.arrived >= oldest:
                    break
                # What publishers keep does not age, and each may be another publisher's only one.
                if not self._lanes[sample.number].latched:
                    old.append(serial)
            for serial in old:
                self._drop(serial)

    def _drop(self, serial: int) -> None:
        sample = self._remove(serial)
        lane = self._lanes[sample.number]
        if not lane.large and lane.begun is None and sample.number in self._turns:
            self._turns.remove(sample.number)
        self._lose(sample.number, SLOW_LINK, len(sample.body))

    def _too_large(self, number: int, body: bytes) -> bool:
        """Whether the relay would not take a sample; then it is lost."""
        if len(body) <= self._largest:
            return False
        self.oversized += 1
        self._lose(number, TOO_LARGE, len(body))
        return True

    def _lose(self, number: int, reason: str, size: int) -> None:
        self.dropped += 1
        loss = self.lost.setdefault((number, reason), Loss())
        loss.count += 1
        loss.size = max(loss.size, size)

    def _remove(self, serial: int) -> _Sample:
        large = serial in self._large
        sample = self._pop(serial)
        lane = self._lanes[sample.number]
        lane.waiting.remove(serial)
        lane.large -= large
        lane.size -= len(sample.body)
        self._size -= len(sample.body)
        return sample

    def _pop(self, serial: int) -> _Sample:
        return self._small.pop(serial) if serial in self._small else self._large.pop(serial)
