"""Frames of the robot link (SPEC section 2.1): u32 big-endian length, u8 kind, body.

The length counts the kind and the body. It is checked against the limit before anything is allocated.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from relay_protocol.errors import FrameTooLarge, MalformedMessage

JSON = 0
SAMPLE = 1
VIDEO = 2
PART = 3

_LENGTH = struct.Struct("!I")
_HEAD = struct.Struct("!IB")
_SAMPLE_HEAD = struct.Struct("!IBIQ")
_NUMBERED = struct.Struct("!IQ")

MAX_U32 = 2**32 - 1
MAX_U64 = 2**64 - 1


class JsonFrame(NamedTuple):
    """Kind 0: one JSON message, not yet decoded."""

    body: bytes


class SampleFrame(NamedTuple):
    """Kind 1: one message of a topic.

    :param number: subscription (robot to relay) or publication (relay to robot) it belongs to
    :param stamp: nanoseconds; robot to relay: the robot's wall clock when the sample reached it; relay to
        robot: the relay's monotonic clock at the latest moment before which the command can't have been sent
    :param body: the message in the encoding agreed, CDR with its four-byte header from ROS 2
    """

    number: int
    stamp: int
    body: bytes


class VideoFrame(NamedTuple):
    """Kind 2: one JPEG picture of a stream; ``stamp`` is the robot's wall clock in nanoseconds."""

    number: int
    stamp: int
    body: bytes


Frame = JsonFrame | SampleFrame | VideoFrame


def encode_json(body: bytes) -> bytes:
    """The frame around one JSON message."""
    return _HEAD.pack(len(body) + 1, JSON) + body


def encode_sample(number: int, stamp: int, body: bytes) -> bytes:
    """The frame around one topic sample; see :class:`SampleFrame`."""
    return _SAMPLE_HEAD.pack(len(body) + 13, SAMPLE, number, stamp) + body


def encode_video(number: int, stamp: int, body: bytes) -> bytes:
    """The frame around one picture; see :class:`VideoFrame`."""
    return _SAMPLE_HEAD.pack(len(body) + 13, VIDEO, number, stamp) + body


class FrameDecoder:
    """Cuts a byte stream into frames.

    :param limit: largest length field accepted, bytes; it may be raised once the peer has proved itself
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._buffer = bytearray()

    @property
    def buffered(self) -> int:
        """Bytes of an unfinished frame held back."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes as they come off the wire; return the frames they complete.

        :raises FrameTooLarge: a length over :attr:`limit`, seen before its body is awaited
        :raises MalformedMessage: an empty frame, an unknown kind, a sample too short for its head
        """
        buffer = self._buffer
        buffer += data
        frames: list[Frame] = []
        start = 0
        have = len(buffer)
        while have - start >= 4:
            (length,) = _LENGTH.unpack_from(buffer, start)
            if length > self.limit:
                raise FrameTooLarge(
                    f"a frame of {length} bytes was announced; at most {self.limit} are taken here"
                )
            if length == 0:
                raise MalformedMessage("a frame of length 0 has no kind")
            end = start + 4 + length
            if end > have:
                break
            frames.append(_parse(buffer, start + 4, end))
            start = end
        if start:
            del buffer[:start]
        return frames


def _parse(buffer: bytearray, start: int, end: int) -> Frame:
    kind = buffer[start]
    if kind == JSON:
        return JsonFrame(bytes(buffer[start + 1 : end]))
    if kind in (SAMPLE, VIDEO):
        if end - start < 13:
            raise MalformedMessage(f"a frame of kind {kind} needs 12 bytes of number and stamp")
        number, stamp = _NUMBERED.unpack_from(buffer, start + 1)
        body = bytes(buffer[start + 13 : end])
        return SampleFrame(number, stamp, body) if kind == SAMPLE else VideoFrame(number, stamp, body)
    raise MalformedMessage(f"frame kind {kind} is not known; 0 is JSON, 1 a sample, 2 a picture")
