"""How much of a picture the uplink bears: measured by what the relay took, decided step by step.

The link is taken for a pipe of one rate: a picture that leaves at once is there after the round trip and the time
its bytes take. From each ``took`` follows that rate, from the rate how many bytes a picture may have, and from the size
of the latest picture at its step the step at which the next one is as small as that.

A link that becomes thin while a large picture is on its way is noticed by the answers to its parts: two in a row by
which the picture would come far too late, and it is given up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from relay_protocol.limits import KIB
from relay_protocol.link import VideoSettings
from robot_client.camera.rtt_probe import RttProbe, longer

TARGET = 0.3
"""Unless another one is wanted: seconds from a picture's arrival at the robot to the relay's word that it is there."""

UNDER_WAY = 2
"""Most pictures the relay has not taken yet (SPEC 2.6)."""

SHARE = 0.4
"""Of the time that is left, what one picture's bytes may take: the one before it may still be on its way."""

ROOM = 0.7
"""How full the next better step may be as far as one can tell, for it to be tried."""

HOLD = (0.5, 16.0)
"""Seconds between two steps upwards; doubled up to the second when a step had to be taken back."""

PROVED = 4.0
"""Seconds after which a step upwards counts as good."""

SLACK = 0.05
"""Seconds by which a picture may be later than expected before another one is put behind it."""

QUICKEST = 0.001
"""Seconds; what is shorter says nothing of the link."""

_TELLING = 4096
"""Bytes; a smaller picture that is late says more of the processor than of the link, unless others are late too."""

HOPELESS = 3
"""Times the target; a picture that would be later is given up, if a smaller one can be made."""

WINDOW = 48 * KIB
"""Bytes without answer that may always be on their way. When a link becomes thin they must pass before the next picture
does: at 200 kbit/s in 2 s."""

PIPES = 1.5
"""Times what fits into the link in a round trip may be on its way, so that it is never empty and more can be tried."""

AGAIN = 0.05
"""Seconds after which a stream with nothing under way asks again whether the others still hold the link."""

DAWDLE = 0.04
"""Seconds; a link is not filled more than it takes to have a picture leave in that time."""

_UNMISTAKABLE = 2
"""Times the target; what is later than that needs no second one to be believed."""

_LEAST_QUALITY = 35
_QUALITIES = (65, 50, _LEAST_QUALITY)
_SCALES = (0.75, 0.56, 0.42, 0.32, 0.24, 0.18)
_RATES = (3.0, 2.0, 1.0)
_BUSY = 0.5
"""Of the time between two pictures at a lowered rate, what a picture may take."""


class RateStep(NamedTuple):
    """One way to make pictures.

    :param fps: most pictures per second; 0 for all
    :param weight: bytes of a picture, as a part of those at the first step, by experience with JPEG
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
    there: int = 0
    """Bytes the relay has."""
    given_up: bool = False
    asks: bool = False
    """Whether only a few bytes have left, which ask for the round trip."""
    held: float = 0.0
    """Seconds it waited for their answer."""


def steps(settings: VideoSettings) -> list[RateStep]:
    """From what was asked for down to the least there is: first quality goes, then size, then rate."""
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
    """Bytes of a JPEG by its quality, those at 80 being 1 (pictures of rooms and streets)."""
    return 0.25 + 0.25 * quality / 50 + (0.35 * ((quality - 50) / 30) if quality > 50 else 0.0)


class RateControl:
    """Decides for one stream when a picture is made, and how. Pure: times are given, in seconds of one clock.

    :param way: what is known of the way to the relay, with all other streams that take it
    :param target: delay to stay under; with a round trip of more than half of it, twice the round trip
    """

    def __init__(self, settings: VideoSettings, way: RttProbe | None = None, target: float = TARGET) -> None:
        self.delay: float | None = None
        """Seconds from arrival to ``took``, smoothed; ``None`` before the first."""
        self.rate: float | None = None
        """Bytes per second the uplink carries, as measured."""
        self._target = target
        # Nobody looks at a stream of PNG: who asks for one picture waits for it.
        self._gives_up = settings.codec != "png"
        self._steps = steps(settings)
        self._step = 0
        self._under_way: dict[int, _SentFrame] = {}
        self._free_at = 0.0
        self._way = way or RttProbe()
        self._reckoned = self._trip
        """The round trip by which the rate was measured."""
        self._own = 0.0
        self._unit: float | None = None
        self._due = float("-inf")
        self._last_took = self._last_answer = float("-inf")
        self._progress = self._latest = 0.0
        self._flowed = 0
        """Bytes answered since the link was last empty: what shows that it is as quick as it was."""
        self._doubts = 0
        self._late = False
        self._hold = HOLD[0]
        self._raised = self._changed = float("-inf")

    @property
    def quality(self) -> int:
        """Of JPEG."""
        return self._steps[self._step].quality

    @property
    def scale(self) -> float:
        """Of width and height."""
        return self._steps[self._step].scale

    @property
    def fps(self) -> float:
        """Most pictures per second; 0 for all."""
        return self._steps[self._step].fps

    @property
    def reduced(self) -> float:
        """How far below what was asked for: 0 as asked, 1 the least there is."""
        return self._step / (len(self._steps) - 1)

    @property
    def window(self) -> float:
        """Bytes without answer from which on no more should leave; while in doubt they leave one part at a time."""
        if self._doubts or any(each.asks for each in self._under_way.values()):
            return 1
        full = PIPES * self._trip * min(self._progress, self._bytes(self._step) / DAWDLE)
        return max(WINDOW, min(full, WINDOW + self._flowed))

    def may_send(self, now: float) -> bool:
        """Whether a picture made now would be there in time, as far as one can tell."""
        if len(self._under_way) >= UNDER_WAY or self.wait(now) > 0 or not self._way.may_leave(now):
            return False
        if not self._under_way:
            return True
        if self.rate is None or self._unit is None:
            return False  # the first picture alone shows what the link is like
        last = max(each.at for each in self._under_way.values())
        if now > max(self._free_at, last) + self._trip + SLACK:
            return False  # it is slower than it was
        ahead = max(0.0, self._free_at - now)
        return self._own + ahead + self._bytes(self._step) / self.rate + self._trip <= self._goal

    def wait(self, now: float) -> float:
        """Seconds until another picture may be made, where no answer tells that."""
        held = not self._under_way and not self._way.may_leave(now)
        return max(self._due - now if self.fps else 0.0, AGAIN if held else 0.0)

    def sent(self, number: int, size: int, now: float, arrived: float) -> None:
        """A picture begins to leave.

        :param size: bytes
        :param arrived: when the camera's picture reached us
        """
        if not self._under_way:
            self._flowed = 0
        asks = self._way.leaves(self, now, patient=not self._gives_up)
        self._under_way[number] = _SentFrame(size, self._step, arrived, now, asks=asks)
        self._own = _smooth(self._own, now - arrived, 0.2)
        if self.fps:
            # One that is late does not put off those that follow, by up to half of their distance.
            self._due = max(self._due, now - 0.5 / self.fps) + 1 / self.fps
        unit = size / self._steps[self._step].weight
        self._unit = unit if self._unit is None else _smooth(self._unit, unit, 0.5)
        if self.rate is not None:
            self._free_at = max(now, self._free_at) + size / self.rate
            self._fit(now)

    def asks(self, number: int) -> bool:
        """Whether of this picture a few bytes leave first, and the rest when they have an answer."""
        return self._under_way[number].asks

    def close(self, now: float) -> None:
        """No more pictures leave, and no more answers come."""
        self._under_way.clear()
        self._way.idle(self, now)

    def took(self, number: int, now: float, round_trip: float | None = None) -> None:
        """The relay has a picture; a number that is not under way is passed over.

        :param round_trip: latest of the link, where known
        """
        sent = self._under_way.pop(number, None)
        if sent is None:
            return
        seconds = self._learn(sent, sent.size, now, round_trip)
        delay = now - sent.arrived
        self.delay = delay if self.delay is None else _smooth(self.delay, delay, 0.3)
        self._measure(sent.size, seconds, delay - sent.held)
        self._passed(now)
        self._fit(now)

    def came(self, number: int, upto: int, now: float, round_trip: float | None = None) -> None:
        """The relay has a part of a picture; what is not under way is passed over.

        :param upto: bytes of the picture that are there
        :param round_trip: as with :meth:`took`
        """
        sent = self._under_way.get(number)
        if sent is None or not sent.there < upto < sent.size + sent.given_up:
            return
        if sent.asks:
            self._replied(sent, upto, now)
            return
        self._learn(sent, upto, now, round_trip)
        if sent.given_up and upto == sent.size:
            del self._under_way[number]
            self._passed(now)

    def hopeless(self, now: float) -> set[int]:
        """Numbers of the pictures that would come far too late, by two answers in a row."""
        if self._doubts < 2:
            return set()
        return self._late_ones(now)

    def gave_up(self, number: int, left: int, now: float) -> None:
        """No more of a picture leaves; one that is not under way is passed over.

        :param left: bytes of it that have left
        """
        sent = self._under_way.get(number)
        if sent is None:  # the relay has said that it has it, whatever of it has left
            return
        sent.size, sent.given_up = left, True
        if sent.there == left:
            del self._under_way[number]
            self._rest(now)
        self.rate = self._latest if self.rate is None else min(self.rate, self._latest)
        coming = sum(each.size - each.there for each in self._under_way.values())
        self._free_at = max(now, now - self._trip + coming / self.rate)
        self._doubts = 0
        self._fit(now)

    def _replied(self, sent: _SentFrame, upto: int, now: float) -> None:
        """The answer to what asked for the round trip; all else of the picture leaves now."""
        self._way.answered(self, now)
        sent.asks, sent.there = False, upto
        sent.held, sent.at = now - sent.at, now
        self._last_answer = now
        self._free_at += sent.held

    def _learn(self, sent: _SentFrame, upto: int, now: float, round_trip: float | None) -> float:
        """Take an answer: how quick this picture has been so far, and whether those under way will come in time.

        :return: seconds its bytes took, at most
        """
        if round_trip is not None:
            self._way.measured(round_trip, now)
        if longer(self._trip, self._reckoned):
            # The rate was measured by a wrong one, and so much was tried in vain.
            self.rate, self._hold = None, HOLD[0]
        self._reckoned = self._trip
        # Behind another picture it began to go only when that one was there.
        began = max(sent.at, self._last_took - self._trip)
        seconds = max(now - began - self._trip, (now - began) / 8, QUICKEST)
        self._progress = upto / seconds
        self._latest = (upto - sent.there) / max(now - self._last_answer, QUICKEST)
        self._flowed += upto - sent.there
        sent.there, self._last_answer = upto, now
        self._doubts = self._doubts + 1 if self._late_ones(now) else 0
        return seconds

    def _late_ones(self, now: float) -> set[int]:
        """Pictures too late even by the better of two rates: answers a busy processor held up come at once then."""
        rate, ahead, late = max(self._progress, self._latest), 0, set()
        for number, each in self._under_way.items():
            ahead += each.size - each.there
            smaller = self._gives_up and each.step < len(self._steps) - 1
            if smaller and not each.given_up and now - each.arrived + ahead / rate > HOPELESS * self._goal:
                late.add(number)
        return late

    def _passed(self, now: float) -> None:
        """All of a picture that left is there."""
        self._last_took = now
        if not self._under_way:
            self._free_at = now
        self._rest(now)

    def _rest(self, now: float) -> None:
        """Let others know when nothing is under way."""
        if not self._under_way:
            self._way.idle(self, now)

    def _measure(self, size: int, seconds: float, delay: float) -> None:
        """Take one measurement: so many bytes took so long, at most; a busy processor makes it longer."""
        rate = size / seconds
        late = delay / self._goal
        sure = size >= _TELLING and late > (1 if self._late else _UNMISTAKABLE)
        self._late = late > 1
        if self.rate is None or (rate < self.rate and sure):
            self.rate = rate
        elif rate < self.rate:
            self.rate = _smooth(self.rate, rate, 0.4 * min(late, 1.0) ** 2)
        else:
            self.rate = _smooth(self.rate, rate, 0.25)

    def _fit(self, now: float) -> None:
        """Go down to where a picture is small enough at once, up by one step at a time."""
        if self._too_large(self._step, 1.0):
            best = self._step
            while best < len(self._steps) - 1 and self._too_large(best, 0.9):
                best += 1
            if now - self._raised < PROVED:
                self._hold = min(self._hold * 2, HOLD[1])
                self._raised = float("-inf")
            self._change(best, now)
        elif self._step and now - self._changed >= self._hold and not self._too_large(self._step - 1, ROOM):
            if now - self._raised >= PROVED and self._raised > float("-inf"):
                self._hold = max(HOLD[0], self._hold / 2)
            self._change(self._step - 1, now)
            self._raised = now

    def _change(self, step: int, now: float) -> None:
        if step != self._step:
            self._step = step
            self._changed = now

    def _too_large(self, step: int, full: float) -> bool:
        """Whether a picture of this step would take more than a part of the time it may take."""
        if self.rate is None:
            return False
        time = max(self._goal - self._trip - self._own, self._goal / 3) * SHARE
        fps = self._steps[step].fps
        if fps in _RATES:
            time = max(time, _BUSY / fps)
        return self._bytes(step) / self.rate > time * full

    def _bytes(self, step: int) -> float:
        return (self._unit or 0.0) * self._steps[step].weight

    @property
    def _trip(self) -> float:
        return self._way.seconds

    @property
    def _goal(self) -> float:
        return max(self._target, 2 * self._trip)


def _smooth(old: float, new: float, share: float) -> float:
    return old + share * (new - old)
