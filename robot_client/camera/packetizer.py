"""Encoded frames on their way to the relay: large ones in parts, with few unacknowledged bytes.

Bytes in the kernel, a router or a tunnel can't be recalled. When the link gets slower, they all delay the
next frame. So no more is sent than keeps the link busy, and the rest of a frame that would arrive too late
is discarded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from relay_protocol import frames
from relay_protocol.limits import KIB
from relay_protocol.link import FrameAck
from robot_client.camera.frame import Frame
from robot_client.camera.rate_control import RateControl

PART = 16 * KIB
"""A larger frame is sent in parts of so many bytes."""

PROBE_BYTES = 1
"""Bytes of a frame that are sent alone to measure the round trip."""


class _OutgoingFrame:
    def __init__(self, number: int, stamp: int, body: bytes, probes: bool, key: bool) -> None:
        self.number = number
        self.key = key
        self._probes = probes
        self.sent = 0
        """Bytes that were sent."""
        self.total = len(body)
        self._stamp = stamp
        self._body = body

    def next_frame(self) -> bytes:
        if self.total <= PART and not self._probes:
            self.sent = self.total
            return frames.encode_video(self.number, self._stamp, self._body)
        piece = self._body[self.sent : self.sent + (PROBE_BYTES if self._probes and not self.sent else PART)]
        frame = frames.encode_video_part(self.number, self._stamp, self.total, self.sent, piece)
        self.sent += len(piece)
        return frame


class Packetizer:
    """The unsent and the unacknowledged frames of one stream.

    :param rate_control: limits the unacknowledged bytes, decides which frames are too late, and learns from
        both
    :param write: writes link frames
    """

    def __init__(self, rate_control: RateControl, write: Callable[[list[bytes]], None]) -> None:
        self._rate_control = rate_control
        self._write = write
        self._outgoing: dict[int, _OutgoingFrame] = {}
        self._unacknowledged: deque[tuple[int, int, int]] = deque()
        """For each unacknowledged link frame: the frame's number, bytes of it sent so far, bytes in this
        link frame."""
        self._unacknowledged_bytes = 0

    def put(self, number: int, frame: Frame, body: bytes, now: float, key: bool = True) -> None:
        """Queue an encoded frame.

        :param frame: the camera's frame
        :param key: whether it is decodable without the frames before it
        """
        self._rate_control.sent(number, len(body), now, frame.arrived)
        self._outgoing[number] = _OutgoingFrame(
            number, frame.stamp, body, self._rate_control.probes(number), key
        )
        self._send()

    def on_ack(self, ack: FrameAck, now: float, round_trip: float | None) -> bool:
        """The relay has a frame or a part of it, and all that was sent before; unknown numbers are ignored.

        :param round_trip: latest of the link, seconds; ``None`` if unknown
        :return: whether unsent or partly sent frames were discarded
        """
        confirmed = [
            at
            for at, (number, sent, _) in enumerate(self._unacknowledged)
            if number == ack.number and (ack.received is None or sent <= ack.received)
        ]
        for _ in range(confirmed[-1] + 1 if confirmed else 0):
            self._unacknowledged_bytes -= self._unacknowledged.popleft()[2]
        if ack.received is None:
            self._rate_control.frame_acknowledged(ack.number, now, round_trip)
        else:
            self._rate_control.part_acknowledged(ack.number, ack.received, now, round_trip)
        discarded = self._to_discard(self._rate_control.too_late(now))
        for number in discarded:
            self._rate_control.discard(number, self._outgoing.pop(number).sent, now)
        self._send()
        return bool(discarded)

    def _to_discard(self, too_late: set[int]) -> list[int]:
        """Numbers of unsent frames that are too late, or need one that is."""
        found: list[int] = []
        broken = False
        for number, outgoing in self._outgoing.items():
            broken = number in too_late or (broken and not outgoing.key)
            if broken:
                found.append(number)
        return found

    def _send(self) -> None:
        out = []
        while self._outgoing and self._unacknowledged_bytes < self._rate_control.window:
            outgoing = next(iter(self._outgoing.values()))
            before = outgoing.sent
            out.append(outgoing.next_frame())
            size = outgoing.sent - before
            self._unacknowledged.append((outgoing.number, outgoing.sent, size))
            self._unacknowledged_bytes += size
            if outgoing.sent == outgoing.total:
                del self._outgoing[outgoing.number]
        if out:
            self._write(out)
