"""Pictures in parts, on a link that the test is: what leaves, what waits for answers, what is given up."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol.frames import FrameDecoder, PictureJoiner, PicturePart, VideoFrame
from relay_protocol.link import Codec, Took, VideoSettings
from robot_client.camera.frame import Frame, FrameFormat
from robot_client.camera.packetizer import PART, Packetizer
from robot_client.camera.rate_control import WINDOW, RateControl

LARGE = 10 * PART
STAMP = 7


def unread() -> Any:
    raise AssertionError("nobody here reads pixels")


class Road:
    """A stream's pictures on their way, and the relay's answers."""

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
        """The oldest frame without answer gets one, some seconds later."""
        self.now += after
        return self.leaving.answered(took(self.wire.pop(0)), self.now, 0.0)

    @property
    def unanswered(self) -> int:
        return sum(len(frame.body) for frame in self.wire)


def took(frame: VideoFrame | PicturePart) -> Took:
    if isinstance(frame, PicturePart) and frame.offset + len(frame.body) < frame.total:
        return Took(number=frame.number, upto=frame.offset + len(frame.body))
    return Took(number=frame.number)


def test_a_small_picture_leaves_whole_and_a_large_one_in_parts() -> None:
    """The parts make the picture, and carry the stamp of its arrival."""
    road = Road()
    small = road.put(1, PART)
    assert road.wire == [VideoFrame(1, STAMP, small)]
    road.answer(0.001)
    large = road.put(2, LARGE + 5)
    joiner = PictureJoiner(2**22)
    parts = []
    while road.wire:
        parts.append(road.wire[0])
        road.answer(0.001)
    assert len(parts) == 11
    assert [joiner.join(part) for part in parts] == [None] * 10 + [VideoFrame(2, STAMP, large)]


def test_no_more_is_without_answer_than_may_be() -> None:
    """Each answer lets as much leave as it is for."""
    road = Road()
    road.put(1, LARGE)
    while road.wire[-1].number == 1 and road.wire[-1].offset + PART < LARGE:
        assert road.unanswered == WINDOW
        road.answer(0.001)
    road.put(2, LARGE)
    assert road.unanswered == WINDOW


def test_an_answer_is_for_all_that_left_before() -> None:
    """And one to what never left is for nothing."""
    road = Road()
    road.put(1, LARGE)
    for nothing in (Took(number=2), Took(number=1, upto=1), Took(number=0, upto=PART)):
        assert not road.leaving.answered(nothing, road.now, 0.0)
        assert len(road.wire) == 3
    road.now += 0.001
    road.leaving.answered(Took(number=1, upto=3 * PART), road.now, 0.0)
    assert [frame.offset // PART for frame in road.wire] == [0, 1, 2, 3, 4, 5]


def test_a_picture_that_would_come_far_too_late_is_given_up() -> None:
    """At 25 KB/s two answers say so; nothing more of it leaves, and the next one is made much smaller."""
    road = Road()
    road.put(1, LARGE)
    assert not road.answer(0.65)
    assert len(road.wire) == 2
    assert road.answer(0.65)
    assert len(road.wire) == 1
    assert road.pace.rate == pytest.approx(PART / 0.65)
    assert road.pace.scale < 1
    assert not road.pace.may_send(road.now)
    road.answer(0.65)
    assert road.wire == []
    assert road.pace.may_send(road.now)
    assert road.pace.delay is None


def test_one_that_waits_behind_it_is_given_up_too() -> None:
    """It would be later still."""
    road = Road()
    road.put(1, PART)
    road.answer(0.01)
    road.put(2, LARGE)
    road.put(3, LARGE)
    road.answer(0.65)
    assert road.answer(0.65)
    road.answer(0.65)
    assert road.wire == []
    road.put(4, PART)
    assert [frame.number for frame in road.wire] == [4]


@pytest.mark.parametrize(("alone", "leave"), [(False, []), (True, [3, 4])])
def test_one_behind_it_that_needs_it_is_given_up_too(alone: bool, leave: list[int]) -> None:
    """Also if it would be in time itself; one that stands alone leaves, and what needs but that."""
    road = Road("h264")
    road.put(2, 5 * PART)
    assert not road.answer(0.8)
    road.put(3, PART, alone)
    road.put(4, 10, alone=False)
    assert road.answer(0.05)
    while road.wire and road.wire[0].number == 2:
        road.answer(0.001)
    assert [frame.number for frame in road.wire] == leave


def test_one_behind_it_that_the_relay_says_it_has_does_no_harm() -> None:
    """Though it has not left yet, it is given up with the one it needs."""
    road = Road("h264")
    road.put(2, 5 * PART)
    assert not road.answer(0.8)
    road.put(3, PART, alone=False)
    road.leaving.answered(Took(number=3), road.now, 0.0)
    answers = [road.answer(0.85) for _ in range(len(road.wire))]
    assert any(answers)
    assert road.wire == []
    road.put(4, 10)
    assert [frame.number for frame in road.wire] == [4]


def test_what_a_busy_processor_held_up_is_not_given_up() -> None:
    """Its answers come together."""
    road = Road()
    road.put(1, LARGE)
    assert not road.answer(0.5)
    while road.wire:
        assert not road.answer(0.001)
    assert road.pace.delay is not None


def test_what_is_wholly_on_its_way_is_not_given_up() -> None:
    """There is nothing to keep back."""
    road = Road()
    road.put(1, WINDOW)
    assert not any(road.answer(2.0) for _ in range(3))
    assert road.pace.delay == 6.0


def test_a_png_is_waited_for() -> None:
    """Who asked for one picture gets it, however long it takes."""
    road = Road("png")
    road.put(1, LARGE)
    assert not any(road.answer(2.0) for _ in range(10))
    assert road.pace.delay == 20.0


def test_the_least_picture_is_waited_for() -> None:
    """Or there would never be one."""
    road = Road()
    number = 0
    while road.pace.reduced < 1:
        number += 1
        road.put(number, LARGE)
        while road.wire:
            road.answer(5.0)
    road.put(number + 1, LARGE)
    assert not any(road.answer(5.0) for _ in range(10))
    assert road.wire == []


def test_answers_of_a_relay_that_lies_do_no_harm() -> None:
    """Whatever it has not got."""
    road = Road()
    road.put(1, LARGE)
    road.put(2, LARGE)
    for upto in (LARGE, 0, -5, 2**40, PART, PART, None, 3):
        for number in (1, 2, 3, -1):
            road.now += 1.0
            road.leaving.answered(Took(number=number, upto=upto), road.now, 0.0)
    road.put(3, 5)
    assert road.wire[-1].number in (2, 3)
