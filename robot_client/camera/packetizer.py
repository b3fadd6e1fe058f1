"""Pictures on their way to the relay: large ones in parts, with little of them unanswered.

What the kernel, a router or a tunnel has taken can't be had back, and when a link becomes thin all of it stands before
the next picture. So no more leaves than keeps the link busy, and what is left of a picture that would come too late
stays here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from relay_protocol import frames
from relay_protocol.limits import KIB
from relay_protocol.link import Took
from robot_client.camera.frame import Frame
from robot_client.camera.rate_control import RateControl

PART = 16 * KIB
"""A larger picture goes in parts of so many bytes."""

QUESTION = 1
"""Bytes of a picture that leave alone to ask for the round trip."""


class _OutgoingFrame:
    def __init__(self, number: int, stamp: int, body: bytes, asks: bool, alone: bool) -> None:
        self.number = number
        self.alone = alone
        self._asks = asks
        self.left = 0
        """Bytes that have left."""
        self.total = len(body)
        self._stamp = stamp
        self._body = body

    def next_frame(self) -> bytes:
        if self.total <= PART and not self._asks:
            self.left = self.total
            return frames.encode_video(self.number, self._stamp, self._body)
        piece = self._body[self.left : self.left + (QUESTION if self._asks and not self.left else PART)]
        frame = frames.encode_picture_part(self.number, self._stamp, self.total, self.left, piece)
        self.left += len(piece)
        return frame


class Packetizer:
    """What has not left yet of the pictures of one stream, and what has no answer yet.

    :param pace: knows how much may be without answer, and what comes too late; it is told what leaves and arrives
    :param write: takes frames
    """

    def __init__(self, pace: RateControl, write: Callable[[list[bytes]], None]) -> None:
        self._pace = pace
        self._write = write
        self._pictures: dict[int, _OutgoingFrame] = {}
        self._answers: deque[tuple[int, int, int]] = deque()
        """Of each frame without answer: the picture's number, how much of it has left with this one, and its bytes."""
        self._unanswered = 0

    def put(self, number: int, shot: Frame, body: bytes, now: float, alone: bool = True) -> None:
        """Have a picture leave, behind those that are here.

        :param shot: what it was made of
        :param alone: whether it needs none of those before it
        """
        self._pace.sent(number, len(body), now, shot.arrived)
        self._pictures[number] = _OutgoingFrame(number, shot.stamp, body, self._pace.asks(number), alone)
        self._go()

    def answered(self, took: Took, now: float, round_trip: float | None) -> bool:
        """The relay has a picture or part of it, and so all that left before; an answer to nothing is passed over.

        :param round_trip: latest of the link, seconds, where known
        :return: whether pictures were given up that had begun to leave, or should have
        """
        met = [
            at
            for at, (number, left, _) in enumerate(self._answers)
            if number == took.number and (took.upto is None or left <= took.upto)
        ]
        for _ in range(met[-1] + 1 if met else 0):
            self._unanswered -= self._answers.popleft()[2]
        if took.upto is None:
            self._pace.took(took.number, now, round_trip)
        else:
            self._pace.came(took.number, took.upto, now, round_trip)
        lost = self._lost(self._pace.hopeless(now))
        for number in lost:
            self._pace.gave_up(number, self._pictures.pop(number).left, now)
        self._go()
        return bool(lost)

    def _lost(self, hopeless: set[int]) -> list[int]:
        """Numbers of the pictures here that are hopeless, or no use without one that is."""
        lost: list[int] = []
        broken = False
        for number, picture in self._pictures.items():
            broken = number in hopeless or (broken and not picture.alone)
            if broken:
                lost.append(number)
        return lost

    def _go(self) -> None:
        out = []
        while self._pictures and self._unanswered < self._pace.window:
            picture = next(iter(self._pictures.values()))
            before = picture.left
            out.append(picture.next_frame())
            size = picture.left - before
            self._answers.append((picture.number, picture.left, size))
            self._unanswered += size
            if picture.left == picture.total:
                del self._pictures[picture.number]
        if out:
            self._write(out)
