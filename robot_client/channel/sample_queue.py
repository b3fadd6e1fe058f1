"""Queues samples for the relay: throttled, bounded, the newest kept, large ones in parts.

While the transport has room, small samples pass in order of arrival. Middling ones follow, and between them go
parts of large samples, one subscription after the other, so that neither delays small samples. While the
transport is full, each subscription keeps its latest samples (:data:`SUBSCRIPTION_BYTES`), at most 1 s old
and at most 4 MiB in all. A sample of which a part was sent is always completed.

Of a latched topic the newest samples are kept, as many as it has publishers or as came together at first: each
may be the only one of its publisher, or one of several that it keeps. So are samples that are repeated for late joiners
(:data:`LATCHED_BYTES`).
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict, deque
from collections.abc import Callable

import msgspec

from relay_protocol import frames, link
from relay_protocol.limits import KIB, MIB, ROBOT_FRAME
from robot_client.channel.handler import ChannelWriter
from robot_client.twisted_types import DelayedCall, ReactorClock

LOSS_REPORT_SECONDS = 1.0
"""Seconds between the first loss and its report: on a slow link many samples are lost at a time."""

CHUNKS_PER_TURN = 8
"""Chunks that are written in one turn of the reactor, even if the link has room for more."""

MAX_AGE = 1.0
MAX_BYTES = 4 * MIB
SUBSCRIPTION_BYTES = 256 * KIB
"""While the transport is full: most seconds a sample waits, most bytes in all, and most bytes of a subscription."""

LATCHED_BYTES = ROBOT_FRAME
"""Most bytes of latched samples that wait and are not replaced by newer ones; the relay stores no more."""

MIDDLING = 2 * KIB
"""A sample of more bytes is sent after smaller ones of other subscriptions."""

LARGE = 16 * KIB
"""A sample of more bytes is sent in parts."""

TOGETHER_SECONDS = 0.5
"""Samples of a latched topic that come within so long after the first one are those that its publishers keep."""

PART = 32 * KIB
LEAST_PART = 2 * KIB
"""Bytes of a part; fewer than :data:`PART` if the link has no room for more."""

MAX_MISSED = 64
"""Most latched samples of one inhibited subscription that are kept. More than its publishers have at most
:data:`SUBSCRIPTION_BYTES` together, one for each at most :data:`LATCHED_BYTES`."""

TOO_LARGE = "too_large"
SLOW_LINK = "slow_link"
SLOW_ROBOT = "slow_robot"
"""Reasons for a loss: the sample exceeds the limit, newer samples replaced it, or the daemon could not handle it in
time."""


class WriteScheduler:
    """Writes the queued samples of one channel to its link: the queue with its timers.

    :param after_samples: calls its argument once all samples that arrived together are queued; they share
        one write
    :param frame_limit: largest frame the relay accepts, bytes
    :param wall: wall clock for stamps, nanoseconds since 1970
    :param sample_limit: largest sample that may be sent in parts, bytes; 0 if each must fit into a frame
    :param on_loss: called with each report of lost samples
    """

    def __init__(
        self,
        writer: ChannelWriter,
        clock: ReactorClock,
        after_samples: Callable[[Callable[[], None]], None],
        frame_limit: int,
        wall: Callable[[], int] = time.time_ns,
        *,
        sample_limit: int = 0,
        on_loss: Callable[[link.SamplesDropped], None] = lambda loss: None,
    ) -> None:
        self.queue = SampleQueue(clock.seconds, frame_limit, sample_limit)
        self._on_loss = on_loss
        self._loss_timer: DelayedCall | None = None
        self._writer = writer
        self._clock = clock
        self._after_samples = after_samples
        self._wall = wall
        self._flush_requested = False
        self._closed = False
        self._flush_timer: DelayedCall | None = None
        self._throttle_timer: DelayedCall | None = None

    def enqueue(self, number: int, body: bytes, stamp: int = 0) -> None:
        """Queue a sample, see :meth:`SampleQueue.enqueue`.

        :param stamp: nanoseconds since 1970; 0 for now
        """
        may_be_sent = self.queue.enqueue(number, stamp or self._wall(), body)
        if self.queue.throttled:
            self.set_throttle_timer()
        if self.queue.losses:
            self._report_losses_later()
        if may_be_sent and not self._flush_requested and not self.queue.paused:
            self._flush_requested = True
            self._after_samples(self.flush)

    def dropped_before(self, number: int, count: int = 1) -> None:
        """Report samples that were dropped before they came here."""
        self.queue.losses.setdefault((number, SLOW_ROBOT), Loss()).count += count
        self._report_losses_later()

    def enqueue_latched(self, number: int, stamp: int, body: bytes) -> None:
        """Queue a latched sample, see :meth:`SampleQueue.enqueue_latched`."""
        if self.queue.enqueue_latched(number, stamp, body) and not self.queue.paused:
            self.flush()
        if self.queue.losses:
            self._report_losses_later()

    def end_inhibition(self, number: int) -> None:
        """End an inhibition, see :meth:`SampleQueue.end_inhibition`."""
        if self.queue.end_inhibition(number):
            self.flush()

    def close_subscription(self, number: int) -> None:
        """End a subscription, see :meth:`SampleQueue.close`."""
        self.queue.close(number)
        self.flush()

    def flush(self) -> None:
        """Write queued samples, as far as the transport has room."""
        self._flush_requested = False
        if self._closed:
            return
        if self._flush_timer is not None and self._flush_timer.active():
            self._flush_timer.cancel()
        self._flush_timer = None
        if self.queue.losses:
            self._report_losses_later()
        for _ in range(CHUNKS_PER_TURN):
            room = self._writer.room
            chunk = self.queue.next_frames(room, room)
            if chunk:
                self._writer.write(chunk)
            if self.queue.paused or not self.queue.ready:
                return
        self._flush_timer = self._clock.callLater(0, self.flush)

    def pause(self) -> None:
        """Stop writing, as the transport is full."""
        self.queue.paused = True
        self.queue.trim()

    def resume(self) -> None:
        """Write again, as the transport has room."""
        self.queue.paused = False
        self.flush()

    def close(self) -> None:
        """Stop writing for good."""
        self._closed = True
        for timer in (self._flush_timer, self._throttle_timer, self._loss_timer):
            if timer is not None and timer.active():
                timer.cancel()

    def set_throttle_timer(self) -> None:
        """Set the timer for the next throttled sample."""
        due = self.queue.next_due()
        if self._throttle_timer is not None and self._throttle_timer.active():
            if due is not None and self._throttle_timer.getTime() <= due:
                return
            self._throttle_timer.cancel()
        self._throttle_timer = None
        if due is not None:
            delay = max(0.0, due - self._clock.seconds())
            self._throttle_timer = self._clock.callLater(delay, self._release)

    def _release(self) -> None:
        self._throttle_timer = None
        self.queue.release_throttled()
        self.flush()
        self.set_throttle_timer()

    def _report_losses_later(self) -> None:
        if not self._closed and (self._loss_timer is None or not self._loss_timer.active()):
            self._loss_timer = self._clock.callLater(LOSS_REPORT_SECONDS, self._report_losses)

    def _report_losses(self) -> None:
        losses, self.queue.losses = self.queue.losses, {}
        for (number, reason), loss in losses.items():
            self._on_loss(link.SamplesDropped(number=number, reason=reason, count=loss.count, size=loss.size))


class Loss(msgspec.Struct):
    """Samples of one subscription that were lost for one reason: their count, and the bytes of the
    largest."""

    count: int = 0
    size: int = 0


class _Sample(msgspec.Struct, frozen=True, gc=False):
    number: int
    arrived: float
    stamp: int
    body: bytes
    repeated: bool = False
    """Whether it was sent before, so that it is not the latest of its topic."""


class _SubscriptionQueue:
    """The queued samples of one subscription."""

    def __init__(self, throttle: float, latched: bool) -> None:
        self.throttle = throttle
        """Least seconds between two samples; 0 for no limit."""
        self.latched = latched
        self.publishers = 1
        """Of the topic; see :attr:`kept`."""
        self.first = 0
        """Number of latched samples that came together when the subscription had just begun."""
        self.first_until = math.inf
        """Until when they come, seconds; infinite until one has come."""
        self.waiting: deque[int] = deque()
        """Serial numbers of its samples, oldest first."""
        self.size = 0
        """Bytes of these samples."""
        self.next_at = 0.0
        """When the throttle lets the next sample pass, seconds."""
        self.throttled: _Sample | None = None
        self.middling = 0
        """Number of its samples that are sent after small ones of other subscriptions."""
        self.large = 0
        """Number of its samples that are sent in turn with those of other subscriptions."""
        self.begun: _Sample | None = None
        """The sample of which parts were sent."""
        self.sent = 0
        """Bytes of :attr:`begun` that were sent."""
        self.last: bytes | None = None
        """Body of the latest sample that was sent."""
        self.stamp = 0
        """Latest stamp."""
        self.inhibited = False
        self.held_value: bytes | None = None
        """Body that replaces each sample while it is inhibited; ``None`` to send nothing."""
        self.missed: deque[_Sample] = deque(maxlen=MAX_MISSED)
        """Latched samples that arrived while it was inhibited: their publishers may not send another."""

    @property
    def kept(self) -> int:
        """Number of its newest samples that are kept beyond :data:`SUBSCRIPTION_BYTES`.

        One for each publisher; one publisher may keep several, which it sends at the beginning.
        """
        return max(1, self.publishers, self.first) if self.latched else 1

    def count_first(self, now: float) -> None:
        """Count a sample that has come, if it is one of the first."""
        if not self.first:
            self.first_until = now + TOGETHER_SECONDS
        if now < self.first_until:
            self.first += 1


class SampleQueue:
    """The queue of one channel, without timers and sockets; :class:`WriteScheduler` adds the timers.

    :param now: clock, seconds
    :param frame_limit: largest frame the relay accepts, bytes
    :param sample_limit: largest sample it accepts in parts, bytes; 0 if each must fit into a frame
    """

    def __init__(
        self, now: Callable[[], float], frame_limit: int = ROBOT_FRAME, sample_limit: int = 0
    ) -> None:
        self.paused = False
        self.dropped = 0
        self.oversized = 0
        self.losses: dict[tuple[int, str], Loss] = {}
        """Losses that were not reported yet, by subscription and reason."""
        self.throttled = 0
        """Number of samples that wait for a throttle."""
        self._now = now
        self._frame_limit = frame_limit
        self._largest = max(sample_limit, frame_limit - frames.SAMPLE_HEAD)
        self._queues: dict[int, _SubscriptionQueue] = {}
        self._small: OrderedDict[int, _Sample] = OrderedDict()
        """Samples sent in order of arrival, by serial number."""
        self._middling: OrderedDict[int, _Sample] = OrderedDict()
        """Samples sent after these. Small ones that must not overtake a middling one are here too."""
        self._large: OrderedDict[int, _Sample] = OrderedDict()
        """Samples sent in turns of subscriptions. Small ones that must not overtake a large one are here
        too."""
        self._turns: deque[int] = deque()
        """Subscriptions with a sample in :attr:`_large` or begun, in the order of their turns."""
        self._begun_bytes = 0
        """Bytes of all begun samples, each whole, without :attr:`_oversized_number`."""
        self._oversized_number: int | None = None
        """The subscription with a begun sample that exceeds a frame; the relay assembles one such sample at
        a time."""
        self._cancellations: list[bytes] = []
        """Frames that end begun samples of closed subscriptions."""
        self._serial = 0
        self._since = 0.0
        """No queued sample arrived before."""
        self._size = 0

    def open(self, number: int, throttle: float = 0.0, latched: bool = False, publishers: int = 1) -> None:
        """Add a subscription, or change it.

        :param throttle: seconds
        :param publishers: how many the topic has
        """
        queue = self._queues.get(number)
        if queue is None:
            queue = self._queues[number] = _SubscriptionQueue(throttle, latched)
        queue.next_at += throttle - queue.throttle
        queue.throttle = throttle
        queue.latched = latched
        queue.publishers = publishers

    def close(self, number: int) -> None:
        """Remove a subscription and its samples; a begun sample is cancelled."""
        queue = self._queues.pop(number, None)
        if queue is None:
            return
        self.throttled -= queue.throttled is not None
        for serial in queue.waiting:
            self._size -= len(self._pop(serial).body)
        if queue.large or queue.begun:
            self._turns.remove(number)
        if queue.begun is not None:
            self._large_sample_ended(number, len(queue.begun.body))
            # SPEC 2.1: the relay would keep an unfinished sample until the link ends.
            self._cancellations.append(frames.encode_part(number, queue.begun.stamp, 1, 0, b"\0"))

    def enqueue(self, number: int, stamp: int, body: bytes) -> bool:
        """Queue one sample.

        :param stamp: wall clock, nanoseconds
        :return: whether it may be sent now, as far as its throttle is concerned
        """
        queue = self._queues.get(number)
        if queue is None:
            return False
        if self._too_large(number, body):
            return False
        now = self._now()
        if queue.inhibited:
            if queue.latched:
                queue.missed.append(_Sample(number, now, stamp, body))
                self._trim_missed(queue)
            if queue.held_value is None:
                return False
            body = queue.held_value
            if queue.latched:
                # The sample itself is sent later, and must have the greater stamp then (SPEC 2.5, latched samples).
                stamp = queue.stamp + 1
        queue.stamp = stamp
        if queue.latched:
            queue.count_first(now)
        sample = _Sample(number, now, stamp, body)
        if queue.throttle and now < queue.next_at:
            self.throttled += queue.throttled is None
            queue.throttled = sample
            return False
        self._enqueue_now(queue, sample, now)
        return True

    def enqueue_latched(self, number: int, stamp: int, body: bytes) -> bool:
        """Queue a latched sample, whatever the throttle (SPEC 2.5, ``known_stamps`` of ``subscribe``).

        :param stamp: the stamp it was first sent with, 0 for the end of these samples
        :param body: empty if the relay has it
        :return: whether it will be sent
        """
        queue = self._queues.get(number)
        if queue is None:
            return False
        if self._too_large(number, body):
            return False
        # While inhibited, only samples that were sent before may be repeated, and only if the last value is held.
        if stamp and queue.inhibited and (body or queue.held_value is None):
            return False
        self._append(queue, _Sample(number, self._now(), stamp, body, True))
        return True

    def inhibit(self, number: int, hold: bool) -> None:
        """Discard the samples of a subscription, queued ones too; a begun sample is completed.

        :param hold: whether the last value that was sent replaces each sample
        """
        queue = self._queues.get(number)
        if queue is None:
            return
        queue.inhibited = True
        queue.held_value = queue.last if hold else None
        self.throttled -= queue.throttled is not None
        queue.throttled = None
        for serial in queue.waiting:
            self._size -= len(self._pop(serial).body)
        if queue.large and queue.begun is None:
            self._turns.remove(number)
        queue.waiting.clear()
        queue.size = queue.middling = queue.large = 0

    def end_inhibition(self, number: int) -> bool:
        """End the inhibition of a subscription; returns whether a sample was queued by that."""
        queue = self._queues.get(number)
        if queue is None or not queue.inhibited:
            return False
        queue.inhibited, queue.held_value = False, None
        self.throttled -= queue.throttled is not None
        queue.throttled = None
        missed, queue.missed = queue.missed, deque(maxlen=MAX_MISSED)
        for sample in missed:
            self._enqueue_now(queue, sample, self._now())
        return bool(missed)

    def next_due(self) -> float | None:
        """When the next throttled sample may be sent, on the clock given; ``None`` if there is none."""
        if not self.throttled:
            return None
        return min((queue.next_at for queue in self._queues.values() if queue.throttled), default=None)

    def release_throttled(self) -> None:
        """Queue the throttled samples that are due."""
        now = self._now()
        for queue in self._queues.values():
            if queue.throttled is not None and queue.next_at <= now:
                self._enqueue_now(queue, queue.throttled, now)

    def next_frames(self, at_least: int, part: int = PART) -> list[bytes]:
        """The next frames to write: small samples until there are ``at_least`` bytes, then middling ones, at least
        one, then one part of a large sample. Empty if nothing is queued.

        :param part: most bytes of the part
        """
        if self.paused:
            return []
        if self._now() - self._since > MAX_AGE:
            self._trim_old()
        out, self._cancellations = self._cancellations, []
        taken = 0
        while self._small and taken < at_least:
            frame = self._take_whole(self._small)
            taken += len(frame)
            out.append(frame)
        first = True
        while self._middling and (first or taken < at_least):
            first = False
            frame = self._take_whole(self._middling)
            taken += len(frame)
            out.append(frame)
        if self._turns:
            out += self._next_part(min(PART, max(LEAST_PART, part)))
        return out

    def _take_whole(self, samples: OrderedDict[int, _Sample]) -> bytes:
        """The frame of the first of these samples, which is removed."""
        serial, sample = samples.popitem(last=False)
        queue, size = self._queues[sample.number], len(sample.body)
        queue.waiting.remove(serial)
        queue.middling -= samples is self._middling
        queue.size -= size
        self._size -= size
        if not sample.repeated:
            queue.last = sample.body
        return frames.encode_sample(sample.number, sample.stamp, sample.body)

    @property
    def waiting(self) -> int:
        """Bytes of queued samples, without begun ones."""
        return self._size

    @property
    def ready(self) -> bool:
        """Whether :meth:`next_frames` returns frames once the transport has room."""
        return bool(self._small or self._middling or self._turns or self._cancellations)

    def trim(self) -> None:
        """Drop samples that exceed the bounds; to be called while the transport is full."""
        for queue in self._queues.values():
            self._trim_queue(queue)
        self._trim_all()

    def _enqueue_now(self, queue: _SubscriptionQueue, sample: _Sample, now: float) -> None:
        if queue.throttled is not None:
            queue.throttled = None
            self.throttled -= 1
        queue.next_at = now + queue.throttle
        self._append(queue, sample)

    def _append(self, queue: _SubscriptionQueue, sample: _Sample) -> None:
        if sample.arrived < self._since or not (self._small or self._middling or self._large):
            self._since = sample.arrived
        self._serial += 1
        if queue.large or queue.begun or len(sample.body) > LARGE:
            if not queue.large and queue.begun is None:
                self._turns.append(sample.number)
            queue.large += 1
            self._large[self._serial] = sample
        elif queue.middling or len(sample.body) > MIDDLING:
            queue.middling += 1
            self._middling[self._serial] = sample
        else:
            self._small[self._serial] = sample
        queue.waiting.append(self._serial)
        queue.size += len(sample.body)
        self._size += len(sample.body)
        if self.paused:
            self._trim_queue(queue)
            self._trim_all()

    def _next_part(self, size: int) -> list[bytes]:
        """A frame of the first subscription in turn that may send one."""
        for _ in range(len(self._turns)):
            number = self._turns[0]
            self._turns.rotate(-1)
            queue = self._queues[number]
            if queue.begun is not None or self._begin_large_sample(queue):
                return [self._encode_part(number, queue, size)]
        return []

    def _begin_large_sample(self, queue: _SubscriptionQueue) -> bool:
        serial = queue.waiting[0]
        if serial not in self._large:
            return False  # it arrived earlier
        # The relay stores unfinished samples; it must accept them while together they fit into one frame.
        sample = self._large[serial]
        size = len(sample.body)
        if size + frames.SAMPLE_HEAD > self._frame_limit:
            if self._oversized_number is not None:
                return False
            self._oversized_number = sample.number
        elif self._begun_bytes and self._begun_bytes + size > self._frame_limit:
            return False
        else:
            self._begun_bytes += size
        queue.begun, queue.sent = self._remove(serial), 0
        if not queue.begun.repeated:
            queue.last = queue.begun.body
        return True

    def _large_sample_ended(self, number: int, size: int) -> None:
        """Note that a begun sample was completed or cancelled."""
        if number == self._oversized_number:
            self._oversized_number = None
        else:
            self._begun_bytes -= size

    def _encode_part(self, number: int, queue: _SubscriptionQueue, size: int) -> bytes:
        assert queue.begun is not None
        stamp, body = queue.begun.stamp, queue.begun.body
        total = len(body)
        if total <= LARGE:
            frame, queue.sent = frames.encode_sample(number, stamp, body), total
        else:
            piece = body[queue.sent : queue.sent + size]
            frame = frames.encode_part(number, stamp, total, queue.sent, piece)
            queue.sent += len(piece)
        if queue.sent >= total:
            queue.begun = None
            self._large_sample_ended(number, total)
            if not queue.large:
                self._turns.remove(number)
        return frame

    def _trim_queue(self, queue: _SubscriptionQueue) -> None:
        if queue.size <= SUBSCRIPTION_BYTES:
            return
        for serial in self._replaceable(queue):
            if queue.size <= SUBSCRIPTION_BYTES:
                return
            self._drop(serial)

    def _replaceable(self, queue: _SubscriptionQueue) -> list[int]:
        """Serial numbers of the waiting samples of a subscription that newer ones replace, oldest first."""
        if not queue.latched:
            return list(queue.waiting)[:-1]
        return [serial for serial in queue.waiting if not self._sample(serial).repeated][: -queue.kept]

    def _trim_missed(self, queue: _SubscriptionQueue) -> None:
        size = sum(len(each.body) for each in queue.missed)
        while len(queue.missed) > 1 and (
            size > LATCHED_BYTES or (size > SUBSCRIPTION_BYTES and len(queue.missed) > queue.kept)
        ):
            dropped = queue.missed.popleft()
            size -= len(dropped.body)
            self._count_loss(dropped.number, SLOW_LINK, len(dropped.body))

    def _trim_all(self) -> None:
        if self._size > MAX_BYTES:
            kept = self._kept()
            size = sum(len(self._sample(serial).body) for serial in kept)
            others = sorted({*self._small, *self._middling, *self._large} - kept)
            while self._size - size > MAX_BYTES and len(others) > 1:
                self._drop(others.pop(0))
            for serial in sorted(kept)[:-1]:
                if size <= LATCHED_BYTES:
                    break
                size -= len(self._sample(serial).body)
                self._drop(serial)
        self._trim_old()

    def _kept(self) -> set[int]:
        """Serial numbers of latched samples that newer ones do not replace."""
        latched = (queue for queue in self._queues.values() if queue.latched and queue.waiting)
        return {serial for queue in latched for serial in set(queue.waiting) - set(self._replaceable(queue))}

    def _trim_old(self) -> None:
        oldest = self._now() - MAX_AGE
        for samples in (self._small, self._middling, self._large):
            old = []
            for serial, sample in samples.items():
                if sample.arrived >= oldest:
                    break
                # Latched samples do not expire: each may be the only one of its publisher.
                if not self._queues[sample.number].latched:
                    old.append(serial)
            for serial in old:
                self._drop(serial)

    def _drop(self, serial: int) -> None:
        sample = self._remove(serial)
        queue = self._queues[sample.number]
        if not queue.large and queue.begun is None and sample.number in self._turns:
            self._turns.remove(sample.number)
        self._count_loss(sample.number, SLOW_LINK, len(sample.body))

    def _too_large(self, number: int, body: bytes) -> bool:
        """Whether the relay would not accept a sample; then it is counted as lost."""
        if len(body) <= self._largest:
            return False
        self.oversized += 1
        self._count_loss(number, TOO_LARGE, len(body))
        return True

    def _count_loss(self, number: int, reason: str, size: int) -> None:
        self.dropped += 1
        loss = self.losses.setdefault((number, reason), Loss())
        loss.count += 1
        loss.size = max(loss.size, size)

    def _remove(self, serial: int) -> _Sample:
        middling, large = serial in self._middling, serial in self._large
        sample = self._pop(serial)
        queue = self._queues[sample.number]
        queue.waiting.remove(serial)
        queue.middling -= middling
        queue.large -= large
        queue.size -= len(sample.body)
        self._size -= len(sample.body)
        return sample

    def _group(self, serial: int) -> OrderedDict[int, _Sample]:
        if serial in self._small:
            return self._small
        return self._middling if serial in self._middling else self._large

    def _sample(self, serial: int) -> _Sample:
        return self._group(serial)[serial]

    def _pop(self, serial: int) -> _Sample:
        return self._group(serial).pop(serial)
