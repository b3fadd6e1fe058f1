"""Rate control: quality, size and rate of frames that the uplink carries within the target delay.

Model: the link is a pipe of one rate. A frame arrives after the round trip and the time that its bytes
take. Each acknowledgement gives that rate, and the rate gives the most bytes of a frame. The size of the
latest frame at its step gives the step at which the next one is small enough.

If the link gets slower while a large frame is on its way, the acknowledgements of its parts show it: when
two in a row predict that the frame arrives far too late, it is discarded.

The round trip (:class:`RttProbe`) is that of an idle link. On a slow link a ping measures how long frames
queue, so a measurement may always lower the estimate, but only a probe raises it: no frame is sent until
all are acknowledged, then a few bytes are sent alone. BBR finds its minimal round trip in the same way
(draft-cardwell-iccrg-bbr-congestion-control, ProbeRTT). A probe starts only when all measurements have been
longer for a while. It does not start while a frame is sent that is never discarded: that frame would hold
up all streams, and is the reason for the longer measurements.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from relay_protocol.limits import KIB
from relay_protocol.link import VideoSettings

TARGET = 0.3
"""Default target: seconds from a frame's arrival at the robot to its acknowledgement by the relay."""

MAX_UNACKNOWLEDGED = 2
"""Most unacknowledged frames (SPEC 2.6)."""

FRAME_SHARE = 0.4
"""Share of the remaining time that the bytes of one frame may take: the frame before may still be on its
way."""

STEP_UP_LOAD = 0.7
"""Highest predicted load at which the next better step is tried."""

STEP_UP_DELAY = (0.5, 16.0)
"""Seconds between two steps up; doubled up to the second value when a step up had to be reverted."""

STABLE = 4.0
"""Seconds after which a step up counts as successful."""

SLACK = 0.05
"""Seconds by which a frame may be later than expected before the next one waits for it."""

MIN_MEASURED = 0.001
"""Seconds; shorter times say nothing about the link."""

_MEANINGFUL_BYTES = 4096
"""A late frame of fewer bytes says more about the processor than about the link, unless others are late
too."""

DISCARD_DELAY = 3
"""Multiple of the target; a frame that would be later is discarded if a smaller one is possible."""

WINDOW = 48 * KIB
"""Unacknowledged bytes that are always allowed. When the link gets slower they delay the next frame: at 200
kbit/s by 2 s."""

WINDOW_GAIN = 1.5
"""Multiple of the bandwidth-delay product that may be unacknowledged, so that the link is never idle."""

PROBE_POLL = 0.05
"""Seconds after which an idle stream checks again whether a probe is still running."""

FRAME_SEND_TIME = 0.04
"""Seconds in which a frame should be sent; the window need not be larger."""

_CERTAINLY_LATE = 2
"""Multiple of the target; a frame later than that needs no second one as confirmation."""

_MIN_QUALITY = 35
_QUALITIES = (65, 50, _MIN_QUALITY)
_SCALES = (0.75, 0.56, 0.42, 0.32, 0.24, 0.18)
_RATES = (3.0, 2.0, 1.0)
_LOW_RATE_SHARE = 0.5
"""Share of the frame period, at a lowered rate, that a frame may take."""


class RateStep(NamedTuple):
    """Settings for frames.

    :param fps: most frames per second; 0 for no limit
    :param weight: bytes of a frame relative to the first step, measured with JPEG
    """

    quality: int
    scale: float
    fps: float
    weight: float


@dataclass
class _SentFrame:
    size: int
    step: int
    arrived: float
    at: float
    acknowledged: int = 0
    """Bytes that the relay has."""
    discarded: bool = False
    probing: bool = False
    """Whether only the few bytes of a probe were sent."""
    probe_time: float = 0.0
    """Seconds it waited for the answer to the probe."""


def steps(settings: VideoSettings) -> list[RateStep]:
    """Steps from the requested settings down: first quality, then size, then rate is reduced."""
    found = [RateStep(settings.quality, 1.0, settings.fps, 1.0)]
    if settings.codec != "png":
        for quality in (each for each in _QUALITIES if each < settings.quality):
            weight = _bytes_at(quality) / _bytes_at(settings.quality)
            found.append(RateStep(quality, 1.0, settings.fps, weight))
    quality, weight = found[-1].quality, found[-1].weight
    found += [RateStep(quality, scale, settings.fps, weight * scale**1.6) for scale in _SCALES]
    least = found[-1]
    found += [least._replace(fps=rate) for rate in _RATES if not settings.fps or rate < settings.fps]
    return found


def _bytes_at(quality: int) -> float:
    """Bytes of a JPEG by its quality, relative to quality 80 (measured with images of rooms and streets)."""
    return 0.25 + 0.25 * quality / 50 + (0.35 * ((quality - 50) / 30) if quality > 50 else 0.0)


class RateControl:
    """Decides when a stream encodes its next frame, and with which settings. All times are seconds of one
    clock.

    :param rtt_probe: shared by all streams to the same relay
    :param target: longest delay, seconds; if the round trip exceeds half of it, twice the round trip is used
    """

    def __init__(
        self, settings: VideoSettings, rtt_probe: RttProbe | None = None, target: float = TARGET
    ) -> None:
        self.delay: float | None = None
        """Smoothed seconds from arrival to acknowledgement; ``None`` before the first."""
        self.rate: float | None = None
        """Measured bytes per second of the uplink."""
        self._target = target
        # PNG is used for single images, and their client waits for them.
        self._discards = settings.codec != "png"
        self._steps = steps(settings)
        self._step = 0
        self._unacknowledged: dict[int, _SentFrame] = {}
        self._free_at = 0.0
        self._rtt_probe = rtt_probe or RttProbe()
        self._rate_round_trip = self._round_trip
        """Round trip with which the rate was measured."""
        self._processing = 0.0
        """Smoothed seconds from arrival to sending."""
        self._unit: float | None = None
        """Smoothed bytes of a frame at the first step."""
        self._due = float("-inf")
        self._last_frame_ack = self._last_ack = float("-inf")
        self._progress = self._latest = 0.0
        self._flowed = 0
        """Bytes acknowledged since the link was last idle; they show that it is as fast as before."""
        self._late_acks = 0
        self._late = False
        self._step_up_delay = STEP_UP_DELAY[0]
        self._raised = self._changed = float("-inf")

    @property
    def quality(self) -> int:
        """JPEG quality."""
        return self._steps[self._step].quality

    @property
    def scale(self) -> float:
        """Factor for width and height."""
        return self._steps[self._step].scale

    @property
    def fps(self) -> float:
        """Most frames per second; 0 for no limit."""
        return self._steps[self._step].fps

    @property
    def reduced(self) -> float:
        """Reduction below the requested settings: 0 none, 1 the most."""
        return self._step / (len(self._steps) - 1)

    @property
    def window(self) -> float:
        """Unacknowledged bytes at which sending pauses; after a late acknowledgement one part is sent at a
        time."""
        if self._late_acks or any(each.probing for each in self._unacknowledged.values()):
            return 1
        full = WINDOW_GAIN * self._round_trip * min(self._progress, self._bytes(self._step) / FRAME_SEND_TIME)
        return max(WINDOW, min(full, WINDOW + self._flowed))

    def may_send(self, now: float) -> bool:
        """Whether a frame that is encoded now is predicted to arrive in time."""
        if (
            len(self._unacknowledged) >= MAX_UNACKNOWLEDGED
            or self.wait(now) > 0
            or not self._rtt_probe.may_send(now)
        ):
            return False
        if not self._unacknowledged:
            return True
        if self.rate is None or self._unit is None:
            return False  # the first frame must measure the link first
        last = max(each.at for each in self._unacknowledged.values())
        if now > max(self._free_at, last) + self._round_trip + SLACK:
            return False  # the link has become slower
        ahead = max(0.0, self._free_at - now)
        return self._processing + ahead + self._bytes(self._step) / self.rate + self._round_trip <= self._goal

    def wait(self, now: float) -> float:
        """Seconds until another frame may be encoded, if that does not depend on an acknowledgement."""
        probing = not self._unacknowledged and not self._rtt_probe.may_send(now)
        return max(self._due - now if self.fps else 0.0, PROBE_POLL if probing else 0.0)

    def sent(self, number: int, size: int, now: float, arrived: float) -> None:
        """A frame starts being sent.

        :param size: bytes
        :param arrived: when the camera's frame arrived
        """
        if not self._unacknowledged:
            self._flowed = 0
        probing = self._rtt_probe.begin(self, now, undiscardable=not self._discards)
        self._unacknowledged[number] = _SentFrame(size, self._step, arrived, now, probing=probing)
        self._processing = _smooth(self._processing, now - arrived, 0.2)
        if self.fps:
            # A late frame does not delay those that follow, by up to half of the period.
            self._due = max(self._due, now - 0.5 / self.fps) + 1 / self.fps
        unit = size / self._steps[self._step].weight
        self._unit = unit if self._unit is None else _smooth(self._unit, unit, 0.5)
        if self.rate is not None:
            self._free_at = max(now, self._free_at) + size / self.rate
            self._fit(now)

    def probes(self, number: int) -> bool:
        """Whether a few bytes of this frame are sent first as a probe, and the rest after their
        acknowledgement."""
        return self._unacknowledged[number].probing

    def close(self, now: float) -> None:
        """The stream has ended."""
        self._unacknowledged.clear()
        self._rtt_probe.idle(self, now)

    def frame_acknowledged(self, number: int, now: float, round_trip: float | None = None) -> None:
        """The relay has a frame; unknown numbers are ignored.

        :param round_trip: latest of the link, seconds; ``None`` if unknown
        """
        sent = self._unacknowledged.pop(number, None)
        if sent is None:
            return
        seconds = self._learn(sent, sent.size, now, round_trip)
        delay = now - sent.arrived
        self.delay = delay if self.delay is None else _smooth(self.delay, delay, 0.3)
        self._measure(sent.size, seconds, delay - sent.probe_time)
        self._frame_complete(now)
        self._fit(now)

    def part_acknowledged(self, number: int, upto: int, now: float, round_trip: float | None = None) -> None:
        """The relay has a part of a frame; unknown numbers are ignored.

        :param upto: bytes of the frame that the relay has
        :param round_trip: as for :meth:`frame_acknowledged`
        """
        sent = self._unacknowledged.get(number)
        if sent is None or not sent.acknowledged < upto < sent.size + sent.discarded:
            return
        if sent.probing:
            self._probe_answered(sent, upto, now)
            return
        self._learn(sent, upto, now, round_trip)
        if sent.discarded and upto == sent.size:
            del self._unacknowledged[number]
            self._frame_complete(now)

    def too_late(self, now: float) -> set[int]:
        """Numbers of frames that two acknowledgements in a row predict to arrive far too late."""
        if self._late_acks < 2:
            return set()
        return self._late_ones(now)

    def discard(self, number: int, sent_bytes: int, now: float) -> None:
        """The rest of a frame is not sent; unknown numbers are ignored.

        :param sent_bytes: bytes of it that were sent
        """
        sent = self._unacknowledged.get(number)
        if sent is None:  # already acknowledged as a whole
            return
        sent.size, sent.discarded = sent_bytes, True
        if sent.acknowledged == sent_bytes:
            del self._unacknowledged[number]
            self._report_idle(now)
        self.rate = self._latest if self.rate is None else min(self.rate, self._latest)
        unacknowledged = sum(each.size - each.acknowledged for each in self._unacknowledged.values())
        self._free_at = max(now, now - self._round_trip + unacknowledged / self.rate)
        self._late_acks = 0
        self._fit(now)

    def _probe_answered(self, sent: _SentFrame, upto: int, now: float) -> None:
        """The probe was acknowledged; the rest of the frame is sent now."""
        self._rtt_probe.answered(self, now)
        sent.probing, sent.acknowledged = False, upto
        sent.probe_time, sent.at = now - sent.at, now
        self._last_ack = now
        self._free_at += sent.probe_time

    def _learn(self, sent: _SentFrame, upto: int, now: float, round_trip: float | None) -> float:
        """Update the estimates by an acknowledgement.

        :return: upper bound of the seconds that the bytes took
        """
        if round_trip is not None:
            self._rtt_probe.add_measurement(round_trip, now)
        if is_longer(self._round_trip, self._rate_round_trip):
            # The rate was measured with a wrong round trip, and steps up failed for that reason.
            self.rate, self._step_up_delay = None, STEP_UP_DELAY[0]
        self._rate_round_trip = self._round_trip
        # After another frame, its transmission began only when that one had arrived.
        began = max(sent.at, self._last_frame_ack - self._round_trip)
        seconds = max(now - began - self._round_trip, (now - began) / 8, MIN_MEASURED)
        self._progress = upto / seconds
        self._latest = (upto - sent.acknowledged) / max(now - self._last_ack, MIN_MEASURED)
        self._flowed += upto - sent.acknowledged
        sent.acknowledged, self._last_ack = upto, now
        self._late_acks = self._late_acks + 1 if self._late_ones(now) else 0
        return seconds

    def _late_ones(self, now: float) -> set[int]:
        """Frames that are too late even by the better of two rates: a busy processor delays
        acknowledgements, which then arrive together.
        """
        rate, ahead, late = max(self._progress, self._latest), 0, set()
        for number, each in self._unacknowledged.items():
            ahead += each.size - each.acknowledged
            discardable = self._discards and each.step < len(self._steps) - 1
            if (
                discardable
                and not each.discarded
                and now - each.arrived + ahead / rate > DISCARD_DELAY * self._goal
            ):
                late.add(number)
        return late

    def _frame_complete(self, now: float) -> None:
        """All sent bytes of a frame have arrived."""
        self._last_frame_ack = now
        if not self._unacknowledged:
            self._free_at = now
        self._report_idle(now)

    def _report_idle(self, now: float) -> None:
        """Notify the probe if this stream has nothing unacknowledged."""
        if not self._unacknowledged:
            self._rtt_probe.idle(self, now)

    def _measure(self, size: int, seconds: float, delay: float) -> None:
        """Update the rate by bytes and an upper bound of their time; a busy processor makes it longer."""
        rate = size / seconds
        late = delay / self._goal
        sure = size >= _MEANINGFUL_BYTES and late > (1 if self._late else _CERTAINLY_LATE)
        self._late = late > 1
        if self.rate is None or (rate < self.rate and sure):
            self.rate = rate
        elif rate < self.rate:
            self.rate = _smooth(self.rate, rate, 0.4 * min(late, 1.0) ** 2)
        else:
            self.rate = _smooth(self.rate, rate, 0.25)

    def _fit(self, now: float) -> None:
        """Step down at once as far as needed, step up by one at a time."""
        if self._too_large(self._step, 1.0):
            best = self._step
            while best < len(self._steps) - 1 and self._too_large(best, 0.9):
                best += 1
            if now - self._raised < STABLE:
                self._step_up_delay = min(self._step_up_delay * 2, STEP_UP_DELAY[1])
                self._raised = float("-inf")
            self._change(best, now)
        elif (
            self._step
            and now - self._changed >= self._step_up_delay
            and not self._too_large(self._step - 1, STEP_UP_LOAD)
        ):
            if now - self._raised >= STABLE and self._raised > float("-inf"):
                self._step_up_delay = max(STEP_UP_DELAY[0], self._step_up_delay / 2)
            self._change(self._step - 1, now)
            self._raised = now

    def _change(self, step: int, now: float) -> None:
        if step != self._step:
            self._step = step
            self._changed = now

    def _too_large(self, step: int, load: float) -> bool:
        """Whether a frame at this step would take more than this share of its time."""
        if self.rate is None:
            return False
        time = max(self._goal - self._round_trip - self._processing, self._goal / 3) * FRAME_SHARE
        fps = self._steps[step].fps
        if fps in _RATES:
            time = max(time, _LOW_RATE_SHARE / fps)
        return self._bytes(step) / self.rate > time * load

    def _bytes(self, step: int) -> float:
        return (self._unit or 0.0) * self._steps[step].weight

    @property
    def _round_trip(self) -> float:
        return self._rtt_probe.seconds

    @property
    def _goal(self) -> float:
        return max(self._target, 2 * self._round_trip)


MARGIN = (0.02, 0.25)
"""Seconds, and relative to the round trip: the larger is the variation of measurements on an unchanged
link."""

PROBE_AFTER = 3.0
"""Seconds of longer measurements only, after which a probe starts: three pings."""

PROBE_INTERVAL = 10.0
"""Least seconds between two probes; each costs a frame or two."""

DRAIN_TIMEOUT = 1.0
"""Seconds to wait for acknowledgements before a probe; then it is given up."""

PROBE_TIMEOUT = 3.0
"""Longest seconds for the answer to a probe."""


class RttProbe:
    """Round trip of the idle path to one relay, shared by all streams to it. All times are seconds of one
    clock."""

    def __init__(self) -> None:
        self.seconds = 0.0
        """The round trip, 0 before it is known."""
        self._known = False
        self._longer_since: float | None = None
        self._sending: set[object] = set()
        """Streams with unacknowledged frames."""
        self._undiscardable: set[object] = set()
        """Those of them whose frame is never discarded."""
        self._requested_at: float | None = None
        """Since when frames are held back for a probe, or when it was sent."""
        self._probing_stream: object | None = None
        """The stream whose few bytes are on their way alone."""
        self._sent_at = self._ended_at = float("-inf")

    def add_measurement(self, seconds: float, now: float) -> None:
        """A ping was answered; it may have queued behind frames."""
        if not self._known or seconds < self.seconds:
            self.seconds, self._known = seconds, True
        if not is_longer(seconds, self.seconds):
            self._longer_since = None
        elif self._longer_since is None:
            self._longer_since = now

    def may_send(self, now: float) -> bool:
        """Whether a frame may be sent now, as far as probes are concerned."""
        if self._undiscardable and self._probing_stream is None:
            if self._requested_at is not None:
                self._end(now)
            return True
        if self._requested_at is None:
            longer_since, ended_at = self._longer_since, self._ended_at
            if longer_since is None or now - longer_since < PROBE_AFTER or now - ended_at < PROBE_INTERVAL:
                return True
            self._requested_at = now
        elif now - self._requested_at > (DRAIN_TIMEOUT if self._probing_stream is None else PROBE_TIMEOUT):
            self._end(now)
            return True
        return self._is_idle()

    def begin(self, stream: object, now: float, undiscardable: bool = False) -> bool:
        """A stream starts sending a frame.

        :param undiscardable: whether the frame is never discarded, however long it takes
        :return: whether it is a probe: only a few bytes may be sent before their acknowledgement
        """
        probes = self._requested_at is not None and self._is_idle()
        self._sending.add(stream)
        if undiscardable:
            self._undiscardable.add(stream)
        if probes:
            self._probing_stream, self._requested_at, self._sent_at = stream, now, now
        return probes

    def answered(self, stream: object, now: float) -> None:
        """The few bytes of a stream were acknowledged."""
        if self._probing_stream is stream:
            self.seconds, self._known = now - self._sent_at, True
            self._longer_since = None
            self._end(now)

    def idle(self, stream: object, now: float) -> None:
        """A stream has no unacknowledged frames."""
        self._sending.discard(stream)
        self._undiscardable.discard(stream)
        if self._probing_stream is stream:
            self._end(now)

    def _is_idle(self) -> bool:
        return self._probing_stream is None and not self._sending

    def _end(self, now: float) -> None:
        self._requested_at = self._probing_stream = None
        self._ended_at = now


def is_longer(seconds: float, than: float) -> bool:
    """Whether a round trip is longer than another one by more than the usual variation."""
    absolute, relative = MARGIN
    return seconds > than + max(absolute, relative * than)


def _smooth(old: float, new: float, share: float) -> float:
    return old + share * (new - old)
