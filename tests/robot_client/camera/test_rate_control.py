"""The rate control, and the parts of frames, on simulated uplinks: a pipe with one rate, a round trip, and
frames whose bytes follow from quality and size.
"""

from __future__ import annotations

import itertools
import random
import statistics
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import pytest

from relay_protocol.frames import FrameDecoder, VideoFrame, VideoFramePart
from relay_protocol.link import FrameAck, VideoSettings
from robot_client.camera.frame import Frame, FrameFormat
from robot_client.camera.packetizer import Packetizer
from robot_client.camera.rate_control import MAX_UNACKNOWLEDGED, TARGET, RateControl, RttProbe, steps

TICK = 0.001
ENCODING = 0.008
MBIT = 1e6 / 8
JPEG = {80: 1.0, 65: 0.72, 50: 0.57, 35: 0.45}
"""Bytes of the simulated JPEG by quality, measured on a street; not quite what the pace reckons with."""


class Taken(NamedTuple):
    at: float
    delay: float
    step: float


def shot(arrived: float) -> Frame:
    def unread() -> Any:
        raise AssertionError("nobody here reads pixels")

    return Frame(0, arrived, lambda: FrameFormat("rgb8", 640, 480), unread)


class Pipe:
    """Carries ``rate`` bytes per second and returns answers after ``trip`` seconds, in order."""

    def __init__(self, mbit: float, trip: float, stalls: float = 0.0) -> None:
        self.now = 0.0
        self.rate = mbit * MBIT
        self.trip = trip
        self._stalls = stalls
        self._random = random.Random(5)
        self._going: list[tuple[float, Callable[[], None]]] = []
        self._coming: list[tuple[float, Callable[[], None]]] = []

    def put(self, size: float, answered: Callable[[], None]) -> None:
        self._going.append((size, answered))

    def tick(self) -> None:
        self.now += TICK
        room = self.rate * TICK
        while self._going and room > 0:
            size, answered = self._going.pop(0)
            part = min(size, room)
            room -= part
            if part < size:
                self._going.insert(0, (size - part, answered))
                continue
            stalled = self._random.uniform(0.05, 0.35) if self._random.random() < self._stalls else 0.0
            self._coming.append((self.now + self.trip + stalled, answered))
        while self._coming and self._coming[0][0] <= self.now:
            self._coming.pop(0)[1]()


class Uplink:
    """A camera, its rate control, and its own or a shared pipe, with one ping a second."""

    def __init__(
        self,
        mbit: float = 10,
        trip: float = 0.02,
        fps: float = 15,
        full: int = 50_000,
        settings: VideoSettings | None = None,
        stalls: float = 0.0,
        beside: Uplink | None = None,
        target: float = TARGET,
    ) -> None:
        self.pipe: Pipe = beside.pipe if beside else Pipe(mbit, trip, stalls)
        self.way: RttProbe = beside.way if beside else RttProbe()
        self.pace = RateControl(settings or VideoSettings(), self.way, target)
        self.given_up = 0
        self.most_under_way = 0
        self.taken: list[Taken] = []
        self._fps = fps
        self._full = full
        self._random = random.Random(4)
        self._next = self._ping_at = self.pipe.now
        self._newest: float | None = None
        self._encoding: tuple[float, float] | None = None
        self._leaving = Packetizer(self.pace, self._write)
        self._decoder = FrameDecoder(2**25)
        self._under_way: dict[int, float] = {}
        self._unanswered: list[int] = []
        self._number = 0
        self._measured: float | None = None

    def run(self, seconds: float) -> list[Taken]:
        """Frames that the relay received meanwhile."""
        return together(seconds, self)[0]

    def tick(self) -> None:
        now = self.pipe.now
        if now >= self._ping_at:
            self._ping_at += 1.0
            self.pipe.put(0, partial(self._pong, now))  # its bytes are few beside a frame's
        if now >= self._next:
            self._next += 1 / self._fps
            self._newest = now
        self._make(now)

    def _write(self, data: list[bytes]) -> None:
        for frame in self._decoder.feed(b"".join(data)):
            assert isinstance(frame, (VideoFrame, VideoFramePart))
            upto = None
            if isinstance(frame, VideoFramePart) and frame.offset + len(frame.body) < frame.total:
                upto = frame.offset + len(frame.body)
            self._unanswered.append(frame.number)
            self.pipe.put(
                len(frame.body), partial(self._answer, FrameAck(number=frame.number, received=upto))
            )
        self.most_under_way = max(self.most_under_way, len(set(self._unanswered)))

    def _pong(self, sent: float) -> None:
        self._measured = self.pipe.now - sent

    def _answer(self, took: FrameAck) -> None:
        now = self.pipe.now
        self._unanswered.pop(0)
        self.given_up += self._leaving.on_ack(took, now, self._measured)
        if took.received is None:
            # Earlier frames without such an answer were discarded.
            self._under_way = {each: at for each, at in self._under_way.items() if each >= took.number}
            arrived = self._under_way.pop(took.number)
            self.taken.append(Taken(now, now - arrived, self.pace.reduced))

    def _make(self, now: float) -> None:
        if self._newest is not None and self._encoding is None and self.pace.may_send(now):
            self._encoding, self._newest = (now + ENCODING, self._newest), None
        if self._encoding is not None and now >= self._encoding[0]:
            arrived, self._encoding = self._encoding[1], None
            size = (
                self._full * JPEG[self.pace.quality] * self.pace.scale**1.8 * self._random.uniform(0.85, 1.15)
            )
            self._number += 1
            self._under_way[self._number] = arrived
            self._leaving.put(self._number, shot(arrived), bytes(int(size) + 600), now)


def together(seconds: float, *uplinks: Uplink) -> list[list[Taken]]:
    """Frames that the relay received meanwhile from uplinks with one pipe."""
    pipe = uplinks[0].pipe
    until, before = pipe.now + seconds, [len(each.taken) for each in uplinks]
    while pipe.now < until:
        pipe.tick()
        for each in uplinks:
            each.tick()
    return [each.taken[since:] for each, since in zip(uplinks, before, strict=True)]


def changes(taken: list[Taken]) -> int:
    return sum(one.step != other.step for one, other in itertools.pairwise(taken))


def reversals(taken: list[Taken]) -> int:
    """The number of increases after a decrease."""
    ways = [other.step > one.step for one, other in itertools.pairwise(taken) if one.step != other.step]
    return sum(not lower and before for before, lower in itertools.pairwise(ways))


def test_steps_give_up_quality_then_size_then_rate() -> None:
    """Each step is smaller than the one before; the first is the requested one."""
    found = steps(VideoSettings(quality=80, fps=15))
    assert (found[0].quality, found[0].scale, found[0].fps) == (80, 1.0, 15)
    kinds = [
        "rate" if step.fps != 15 else "size" if step.scale < 1 else "quality" if step.quality < 80 else "all"
        for step in found
    ]
    assert kinds == sorted(kinds, key=["all", "quality", "size", "rate"].index)
    assert all(one.weight >= other.weight for one, other in itertools.pairwise(found))


def test_the_delay_to_stay_under_may_be_another() -> None:
    """A shorter target makes smaller frames on the same uplink."""
    reduced = []
    for target in (0.1, TARGET, 1.0):
        uplink = Uplink(1, target=target)
        uplink.run(20)
        taken = uplink.run(10)
        assert statistics.median(each.delay for each in taken) < target
        reduced.append(statistics.median(each.step for each in taken))
    assert reduced[0] > reduced[1] > reduced[2]


def test_png_has_no_quality_to_give_up() -> None:
    """A PNG can only be made smaller in size."""
    assert {step.quality for step in steps(VideoSettings(codec="png"))} == {80}


@pytest.mark.parametrize("trip", [0.002, 0.02])
def test_quick_uplink_carries_large_frames(trip: float) -> None:
    """At 1 Gbit/s frames of 126 KB are all sent as requested, soon after the round trip."""
    uplink = Uplink(1000, trip, fps=30, full=126_000)
    uplink.run(1)
    taken = uplink.run(10)
    assert {each.step for each in taken} == {0.0}
    assert len(taken) >= 10 * 30 - 3
    assert max(each.delay for each in taken) < ENCODING + 2 * trip + 0.02


@pytest.mark.parametrize("trip", [0.002, 0.05])
def test_wide_uplink_is_left_alone(trip: float) -> None:
    """At 10 Mbit/s frames of 50 KB are all sent as requested."""
    uplink = Uplink(10, trip)
    taken = uplink.run(20)
    assert {each.step for each in taken} == {0.0}
    assert len(taken) >= 20 * 15 - 3
    assert max(each.delay for each in taken) < TARGET


@pytest.mark.parametrize("trip", [0.002, 0.02, 0.05, 0.1])
@pytest.mark.parametrize("mbit", [1, 0.2])
def test_thin_uplink_is_in_time_within_5_s(mbit: float, trip: float) -> None:
    """After 5 s every frame arrives within the target, at three per second or more."""
    uplink = Uplink(mbit, trip)
    uplink.run(5)
    taken = uplink.run(20)
    assert max(each.delay for each in taken) < TARGET
    assert len(taken) >= 20 * 3
    assert min(each.step for each in taken) > 0


@pytest.mark.parametrize("trip", [0.002, 0.05])
@pytest.mark.parametrize("mbit", [1, 0.2])
def test_squeezed_uplink_is_in_time_within_5_s_and_recovers(mbit: float, trip: float) -> None:
    """After the rate drops, the delay is below the target within 5 s; after it recovers, all is as requested
    within 10 s.
    """
    uplink = Uplink(10, trip)
    uplink.run(10)
    uplink.pipe.rate = mbit * MBIT
    uplink.run(5)
    taken = uplink.run(20)
    assert max(each.delay for each in taken) < TARGET
    assert uplink.pace.delay is not None
    assert uplink.pace.delay < TARGET
    uplink.pipe.rate = 10 * MBIT
    uplink.run(10)
    assert uplink.pace.reduced == 0.0
    assert {each.step for each in uplink.run(10)} == {0.0}


@pytest.mark.parametrize("trip", [0.002, 0.02])
@pytest.mark.parametrize("mbit", [1, 0.2])
@pytest.mark.parametrize("before", [10, 1000])
def test_large_frames_do_not_stand_before_small_ones(before: float, mbit: float, trip: float) -> None:
    """Frames of 126 KB on a link that becomes slow are discarded, and 5 s later it is on time, at any time of
    the change.
    """
    for phase in range(3):
        uplink = Uplink(before, trip, fps=30, full=126_000)
        uplink.run(10 + phase * 0.02)
        assert uplink.given_up == 0
        uplink.pipe.rate = mbit * MBIT
        uplink.run(5)
        assert uplink.given_up
        taken = uplink.run(10)
        assert max(each.delay for each in taken) < TARGET
        assert len(taken) >= 10 * 2
        uplink.pipe.rate = before * MBIT
        uplink.run(10)
        assert uplink.pace.reduced < 0.2


@pytest.mark.parametrize("mbit", [0.2, 0.5, 1, 2, 4])
def test_steady_uplink_hardly_changes_the_frame(mbit: float) -> None:
    """On a constant link quality changes back and forth at most twice a minute."""
    uplink = Uplink(mbit)
    uplink.run(10)
    taken = uplink.run(60)
    assert reversals(taken) <= 2
    assert changes(taken) <= 5


def test_wavering_uplink_stays_in_time() -> None:
    """With a rate that changes by half every second, 19 of 20 frames are on time."""
    uplink = Uplink(1)
    uplink.run(5)
    taken: list[Taken] = []
    for second in range(60):
        uplink.pipe.rate = (1.0, 0.5, 1.5)[second % 3] * MBIT
        taken += uplink.run(1)
    late = [each for each in taken if each.delay >= TARGET]
    assert len(late) <= len(taken) / 20


def test_two_frames_are_under_way_at_most() -> None:
    """For any frame size and any link (SPEC 2.6)."""
    for mbit in (10, 2, 0.2):
        uplink = Uplink(mbit, fps=60, full=120_000)
        uplink.run(10)
        assert 1 <= uplink.most_under_way <= MAX_UNACKNOWLEDGED


def test_first_frame_goes_alone() -> None:
    """Before the first answer the link is unknown, so no frame follows it."""
    pace = RateControl(VideoSettings())
    assert pace.may_send(1.0)
    pace.sent(1, 50_000, 1.0, 0.99)
    assert not pace.may_send(1.1)
    pace.frame_acknowledged(1, 1.05)
    assert pace.may_send(1.1)


def test_rate_asked_for_is_kept() -> None:
    """Of 30 frames a second five are made when five were requested."""
    uplink = Uplink(10, fps=30, settings=VideoSettings(fps=5))
    assert 48 <= len(uplink.run(10)) <= 51


def test_very_thin_uplink_gets_few_frames_and_never_none() -> None:
    """At 30 kbit/s the rate is lowered too; one frame a second still arrives."""
    uplink = Uplink(0.03)
    uplink.run(30)
    taken = uplink.run(20)
    assert uplink.pace.reduced > 0.8
    assert uplink.pace.fps > 0
    assert len(taken) >= 15


def test_long_round_trip_is_not_taken_for_a_thin_link() -> None:
    """By satellite (600 ms) no frame can be on time; the frames keep their quality."""
    uplink = Uplink(10, trip=0.6)
    uplink.run(20)
    assert uplink.pace.reduced == 0.0


@pytest.mark.parametrize("mbit", [20, 40])
@pytest.mark.parametrize("longer", [0.35, 0.25])
def test_longer_round_trip_is_not_taken_for_a_slow_link(mbit: float, longer: float) -> None:
    """When the round trip grows from 5 ms during a stream, frames are as requested within 20 s, and stay so
    when it becomes short again.
    """
    uplink = Uplink(mbit, trip=0.005)
    uplink.run(10)
    uplink.pipe.trip = longer
    uplink.run(20)
    taken = uplink.run(20)
    assert {each.step for each in taken} == {0.0}
    assert max(each.delay for each in taken) < 2 * longer
    uplink.pipe.trip = 0.005
    uplink.run(5)
    taken = uplink.run(20)
    assert {each.step for each in taken} == {0.0}
    assert max(each.delay for each in taken) < 0.1
    assert len(taken) >= 20 * 15 - 3


@pytest.mark.parametrize("mbit", [1, 0.2])
@pytest.mark.parametrize("trip", [0.005, 0.05])
def test_queue_is_not_taken_for_a_longer_round_trip(mbit: float, trip: float) -> None:
    """For any delay of pings behind frames on a slow link, frames stay within the target for minutes."""
    uplink = Uplink(10, trip=trip, fps=30, full=126_000)
    uplink.run(10)
    uplink.pipe.rate = mbit * MBIT
    uplink.run(6)
    for _ in range(6):
        taken = uplink.run(20)
        assert sum(each.delay >= TARGET for each in taken) <= len(taken) / 50
        assert min(each.step for each in taken) > 0


def test_queue_of_other_streams_is_not_taken_for_a_longer_round_trip() -> None:
    """Three streams on 1 Mbit/s, one of which begins while the others fill the link, stay small and on time."""
    one = Uplink(20, trip=0.01, full=100_000)
    one.run(5)
    other = Uplink(beside=one, full=100_000)
    one.pipe.rate = MBIT
    together(10, one, other)
    third = Uplink(beside=one, full=100_000)
    together(10, one, other, third)
    for _ in range(6):
        for taken in together(20, one, other, third):
            assert sum(each.delay >= TARGET for each in taken) <= len(taken) / 20
            assert min(each.step for each in taken) > 0
            assert len(taken) >= 20


@pytest.mark.parametrize(("mbit", "size", "apart"), [(2, 2_000_000, 0.8), (1, 3_000_000, 1.3)])
def test_large_png_does_not_stop_other_streams(mbit: float, size: int, apart: float) -> None:
    """During a snapshot of 9 s and more a stream continues with frames, and is as before afterwards."""
    uplink = Uplink(mbit)
    uplink.run(10)
    before = uplink.run(10)
    snapshot = Uplink(beside=uplink, fps=0.001, full=size, settings=VideoSettings(codec="png"))
    taken = before[-1:]
    while not snapshot.taken:
        taken += together(1, uplink, snapshot)[0]
    assert len(taken) > 9
    assert max(other.at - one.at for one, other in itertools.pairwise(taken)) < apart
    uplink.run(20)
    assert len(uplink.run(10)) >= 0.9 * len(before)


def test_longer_round_trip_over_a_slow_link() -> None:
    """At 300 ms and 1 Mbit/s frames are smaller than requested, and within twice the round trip."""
    uplink = Uplink(10, trip=0.005)
    uplink.run(10)
    uplink.pipe.trip, uplink.pipe.rate = 0.3, MBIT
    uplink.run(20)
    taken = uplink.run(40)
    assert sum(each.delay >= 2 * 0.3 for each in taken) <= len(taken) / 50
    assert min(each.step for each in taken) > 0
    assert max(each.step for each in taken) < 0.8


@pytest.mark.parametrize(("mbit", "full", "stalls"), [(10, 50_000, 0.05), (0.2, 1_500, 0.1)])
def test_busy_processor_is_not_taken_for_a_thin_link(mbit: float, full: int, stalls: float) -> None:
    """With occasional answers up to 0.33 s late, the frames that the link carries stay nearly as requested."""
    uplink = Uplink(mbit, full=full, stalls=stalls)
    taken = uplink.run(60)
    assert uplink.given_up <= len(taken) / 50
    assert sum(each.step for each in taken) / len(taken) < 0.2


def test_unknown_number_is_passed_over() -> None:
    """An answer to an unknown frame has no effect."""
    pace = RateControl(VideoSettings())
    pace.frame_acknowledged(7, 1.0)
    assert pace.delay is None
