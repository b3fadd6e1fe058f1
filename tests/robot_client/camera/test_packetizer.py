"""Frames in parts on a simulated link: sent, waiting and discarded ones."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol.frames import FrameDecoder, VideoFrame, VideoFrameJoiner, VideoFramePart
from relay_protocol.link import Codec, FrameAck, VideoSettings
from robot_client.camera.frame import Frame, FrameFormat
from robot_client.camera.packetizer import PART, Packetizer
from robot_client.camera.rate_control import WINDOW, RateControl

LARGE = 10 * PART
STAMP = 7


def unread() -> Any:
    raise AssertionError("nobody here reads pixels")


class SlowPath:
    """Frames of a stream under way, and the relay's answers."""

    def __init__(self, codec: Codec = "jpeg") -> None:
        self.now = 100.0
        self.pace = RateControl(VideoSettings(codec=codec))
        self.leaving = Packetizer(
            self.pace, lambda data: self.wire.extend(self._decoder.feed(b"".join(data)))
        )
        self.wire: list[Any] = []
        """Frames without answer."""
        self._decoder = FrameDecoder(2**25)

    def put(self, number: int, size: int, alone: bool = True) -> bytes:
        body = bytes([number]) * size
        shot = Frame(STAMP, self.now, lambda: FrameFormat("rgb8", 640, 480), unread)
        self.leaving.put(number, shot, body, self.now, alone)
        return body

    def answer(self, after: float) -> bool:
        """Answers the oldest unanswered frame, some seconds later."""
        self.now += after
        return self.leaving.on_ack(took(self.wire.pop(0)), self.now, 0.0)

    @property
    def unanswered(self) -> int:
        return sum(len(frame.body) for frame in self.wire)


def took(frame: VideoFrame | VideoFramePart) -> FrameAck:
    if isinstance(frame, VideoFramePart) and frame.offset + len(frame.body) < frame.total:
        return FrameAck(number=frame.number, received=frame.offset + len(frame.body))
    return FrameAck(number=frame.number)


def test_a_small_frame_leaves_whole_and_a_large_one_in_parts() -> None:
    """The parts join to the frame, and have the stamp of its arrival."""
    path = SlowPath()
    small = path.put(1, PART)
    assert path.wire == [VideoFrame(1, STAMP, small)]
    path.answer(0.001)
    large = path.put(2, LARGE + 5)
    joiner = VideoFrameJoiner(2**22)
    parts = []
    while path.wire:
        parts.append(path.wire[0])
        path.answer(0.001)
    assert len(parts) == 11
    assert [joiner.join(part) for part in parts] == [None] * 10 + [VideoFrame(2, STAMP, large)]


def test_no_more_is_without_answer_than_may_be() -> None:
    """Each answer releases as many bytes as it acknowledges."""
    path = SlowPath()
    path.put(1, LARGE)
    while path.wire[-1].number == 1 and path.wire[-1].offset + PART < LARGE:
        assert path.unanswered == WINDOW
        path.answer(0.001)
    path.put(2, LARGE)
    assert path.unanswered == WINDOW


def test_an_answer_is_for_all_that_left_before() -> None:
    """An answer to an unsent frame has no effect."""
    path = SlowPath()
    path.put(1, LARGE)
    for nothing in (FrameAck(number=2), FrameAck(number=1, received=1), FrameAck(number=0, received=PART)):
        assert not path.leaving.on_ack(nothing, path.now, 0.0)
        assert len(path.wire) == 3
    path.now += 0.001
    path.leaving.on_ack(FrameAck(number=1, received=3 * PART), path.now, 0.0)
    assert [frame.offset // PART for frame in path.wire] == [0, 1, 2, 3, 4, 5]


def test_a_frame_that_would_come_far_too_late_is_discarded() -> None:
    """At 25 KB/s two answers show it; no more of it is sent, and the next one is much smaller."""
    path = SlowPath()
    path.put(1, LARGE)
    assert not path.answer(0.65)
    assert len(path.wire) == 2
    assert path.answer(0.65)
    assert len(path.wire) == 1
    assert path.pace.rate == pytest.approx(PART / 0.65)
    assert path.pace.scale < 1
    assert not path.pace.may_send(path.now)
    path.answer(0.65)
    assert path.wire == []
    assert path.pace.may_send(path.now)
    assert path.pace.delay is None


def test_frame_waiting_behind_it_is_discarded_too() -> None:
    """It would be even later."""
    path = SlowPath()
    path.put(1, PART)
    path.answer(0.01)
    path.put(2, LARGE)
    path.put(3, LARGE)
    path.answer(0.65)
    assert path.answer(0.65)
    path.answer(0.65)
    assert path.wire == []
    path.put(4, PART)
    assert [frame.number for frame in path.wire] == [4]


@pytest.mark.parametrize(("alone", "leave"), [(False, []), (True, [3, 4])])
def test_dependent_frame_behind_it_is_discarded_too(alone: bool, leave: list[int]) -> None:
    """Even if it would be on time; a key frame is sent, and frames that depend only on it."""
    path = SlowPath("h264")
    path.put(2, 5 * PART)
    assert not path.answer(0.8)
    path.put(3, PART, alone)
    path.put(4, 10, alone=False)
    assert path.answer(0.05)
    while path.wire and path.wire[0].number == 2:
        path.answer(0.001)
    assert [frame.number for frame in path.wire] == leave


def test_acknowledged_frame_behind_it_does_no_harm() -> None:
    """It has not been sent yet, and is discarded with the frame that it needs."""
    path = SlowPath("h264")
    path.put(2, 5 * PART)
    assert not path.answer(0.8)
    path.put(3, PART, alone=False)
    path.leaving.on_ack(FrameAck(number=3), path.now, 0.0)
    answers = [path.answer(0.85) for _ in range(len(path.wire))]
    assert any(answers)
    assert path.wire == []
    path.put(4, 10)
    assert [frame.number for frame in path.wire] == [4]


def test_frames_delayed_by_a_busy_cpu_are_not_discarded() -> None:
    """Its answers arrive together."""
    path = SlowPath()
    path.put(1, LARGE)
    assert not path.answer(0.5)
    while path.wire:
        assert not path.answer(0.001)
    assert path.pace.delay is not None


def test_frame_sent_completely_is_not_discarded() -> None:
    """It has no unsent bytes."""
    path = SlowPath()
    path.put(1, WINDOW)
    assert not any(path.answer(2.0) for _ in range(3))
    assert path.pace.delay == 6.0


def test_a_png_is_waited_for() -> None:
    """A single requested image is delivered, for any duration."""
    path = SlowPath("png")
    path.put(1, LARGE)
    assert not any(path.answer(2.0) for _ in range(10))
    assert path.pace.delay == 20.0


def test_the_least_frame_is_waited_for() -> None:
    """Otherwise no frame would ever arrive."""
    path = SlowPath()
    number = 0
    while path.pace.reduced < 1:
        number += 1
        path.put(number, LARGE)
        while path.wire:
            path.answer(5.0)
    path.put(number + 1, LARGE)
    assert not any(path.answer(5.0) for _ in range(10))
    assert path.wire == []


def test_answers_of_a_relay_that_lies_do_no_harm() -> None:
    """For any false acknowledgement."""
    path = SlowPath()
    path.put(1, LARGE)
    path.put(2, LARGE)
    for upto in (LARGE, 0, -5, 2**40, PART, PART, None, 3):
        for number in (1, 2, 3, -1):
            path.now += 1.0
            path.leaving.on_ack(FrameAck(number=number, received=upto), path.now, 0.0)
    path.put(3, 5)
    assert path.wire[-1].number in (2, 3)
