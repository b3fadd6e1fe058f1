"""Frames of the robot link (SPEC section 2.1): u32 big-endian length, u8 kind, body.

The length counts the kind and the body. It is checked against the limit before anything is allocated.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import msgspec

from relay_protocol.errors import FrameTooLarge, MalformedMessage
from relay_protocol.limits import PARTS_BYTES

JSON = 0
SAMPLE = 1
VIDEO = 2
PART = 3
PICTURE_PART = 4
COMMAND = 5

_LENGTH = struct.Struct("!I").unpack_from
_HEAD = struct.Struct("!IB")
_SAMPLE_HEAD = struct.Struct("!IBIQ").pack
_NUMBERED = struct.Struct("!IQ").unpack_from
_COMMAND_HEAD = struct.Struct("!IBIQI").pack
_COMMAND = struct.Struct("!IQI").unpack_from
_PART_HEAD = struct.Struct("!IBIQII")
_PART = struct.Struct("!IQII")

MAX_U32 = 2**32 - 1
MAX_U64 = 2**64 - 1

SAMPLE_HEAD = 13
"""Kind, number and stamp of a sample, counted by the length of its frame."""

COMMAND_HEAD = 17
"""The same of a command, which has a source too."""

JSON_NUMBER = 0
"""Parts of this number make a JSON message. No subscription or publication has it."""

UNFINISHED = 1024
"""Most samples that have come in part only, over one link."""


class _Frame(msgspec.Struct, frozen=True):
    """A struct is made in a third of the time of a named tuple, and there is one for every sample."""


class JsonFrame(_Frame, frozen=True, order=True, gc=False):
    """Kind 0: one JSON message, not yet decoded."""

    body: bytes


class SampleFrame(_Frame, frozen=True, order=True, gc=False):
    """Kind 1: one message of a topic.

    :param number: subscription (robot to relay) or publication (relay to robot) it belongs to
    :param stamp: nanoseconds; robot to relay: the robot's wall clock when the sample reached it; relay to
        robot: the relay's monotonic clock at the latest moment before which the command can't have been sent
    :param body: the message in the encoding agreed, CDR with its four-byte header from ROS 2
    """

    number: int
    stamp: int
    body: bytes


class CommandFrame(_Frame, frozen=True, order=True, gc=False):
    """Kind 5: one message to a topic that moves the robot.

    :param number: publication it belongs to
    :param stamp: nanoseconds of the relay's monotonic clock; the command can't have been sent before
    :param source: the connection it came from, as the relay numbers them
    :param body: the message in the encoding agreed
    """

    number: int
    stamp: int
    source: int
    body: bytes


class VideoFrame(_Frame, frozen=True, order=True, gc=False):
    """Kind 2: one picture of a stream; ``stamp`` is the robot's wall clock in nanoseconds."""

    number: int
    stamp: int
    body: bytes


class PicturePart(_Frame, frozen=True, order=True, gc=False):
    """Kind 4: one part of a picture; who takes it answers each, so :class:`PictureJoiner` is not the decoder's.

    :param number: of the picture, like ``stamp``
    :param total: bytes of the whole picture
    :param offset: bytes of it that went before
    """

    number: int
    stamp: int
    total: int
    offset: int
    body: bytes


Frame = JsonFrame | SampleFrame | CommandFrame | VideoFrame | PicturePart
"""What a stream is cut into; parts (kind 3) come out as the sample or the JSON message they make."""


def encode_json(body: bytes) -> bytes:
    """The frame around one JSON message."""
    return _HEAD.pack(len(body) + 1, JSON) + body


def encode_sample(number: int, stamp: int, body: bytes) -> bytes:
    """The frame around one topic sample; see :class:`SampleFrame`."""
    return _SAMPLE_HEAD(len(body) + 13, SAMPLE, number, stamp) + body


def encode_command(number: int, stamp: int, source: int, body: bytes) -> bytes:
    """The frame around one command; see :class:`CommandFrame`."""
    return _COMMAND_HEAD(len(body) + COMMAND_HEAD, COMMAND, number, stamp, source) + body


def encode_video(number: int, stamp: int, body: bytes) -> bytes:
    """The frame around one picture; see :class:`VideoFrame`."""
    return _SAMPLE_HEAD(len(body) + 13, VIDEO, number, stamp) + body


def encode_part(number: int, stamp: int, total: int, offset: int, piece: bytes) -> bytes:
    """The frame around one part of a sample; see :class:`SampleFrame`.

    :param number: :data:`JSON_NUMBER` for a part of a JSON message
    :param total: bytes of the whole message
    :param offset: bytes of it that went before
    """
    return _PART_HEAD.pack(len(piece) + 21, PART, number, stamp, total, offset) + piece


def encode_picture_part(number: int, stamp: int, total: int, offset: int, piece: bytes | memoryview) -> bytes:
    """The frame around one part of a picture; see :class:`PicturePart`."""
    return _PART_HEAD.pack(len(piece) + 21, PICTURE_PART, number, stamp, total, offset) + piece


class FrameDecoder:
    """Cuts a byte stream into frames, and joins parts of samples.

    :param limit: largest length field accepted, bytes; it may be raised once the peer has proved itself
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.sample_limit = 0
        """Largest sample accepted in parts, bytes; what fits into a frame is accepted in any case."""
        self._buffer = bytearray()
        self._enough = 0
        """With fewer bytes in the buffer nothing new can be said."""
        self._parts = _Parts()

    @property
    def buffered(self) -> int:
        """Bytes of an unfinished frame and of unfinished samples held back."""
        return len(self._buffer) + self._parts.size

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes as they come off the wire; return the frames they complete.

        :raises FrameTooLarge: a length over :attr:`limit`, seen before its body is awaited; a sample in parts that
            would be over it, or too much of such samples
        :raises MalformedMessage: an empty frame, an unknown kind, a sample too short for its head, parts that don't
            follow each other
        """
        buffer = self._buffer
        if buffer:
            buffer += data
            if len(buffer) < self._enough:
                return []
            # Bytes, because a slice of them is a body; one of a bytearray has to be copied once more.
            data = bytes(buffer)
            buffer.clear()
        frames: list[Frame] = []
        start, have, limit = 0, len(data), self.limit
        largest = max(self.sample_limit, limit - SAMPLE_HEAD)
        while have - start >= 4:
            (length,) = _LENGTH(data, start)
            if length > limit:
                raise FrameTooLarge(
                    f"a frame of {length} bytes was announced; at most {limit} are taken here"
                )
            if length == 0:
                raise MalformedMessage("a frame of length 0 has no kind")
            end = start + 4 + length
            if end > have:
                break
            kind = data[start + 4]
            if kind == SAMPLE and length >= SAMPLE_HEAD:
                number, stamp = _NUMBERED(data, start + 5)
                frames.append(SampleFrame(number, stamp, data[start + 17 : end]))
            elif kind == PART:
                sample = self._parts.join(data, start + 4, end, limit, largest)
                if sample is not None:
                    frames.append(JsonFrame(sample.body) if sample.number == JSON_NUMBER else sample)
            else:
                frames.append(_parse(data, start + 4, end))
            start = end
        if start < have:
            buffer += memoryview(data)[start:]
            self._enough = 4 + length if have - start >= 4 else 4
        return frames


class _Unfinished(NamedTuple):
    stamp: int
    total: int
    body: bytearray


class _Parts:
    """Samples of one link that have come in part only; memory grows with what came, not with what was announced."""

    def __init__(self) -> None:
        self.size = 0
        self._unfinished: dict[int, _Unfinished] = {}

    def join(self, buffer: bytes, start: int, end: int, limit: int, largest: int) -> SampleFrame | None:
        """Take one part; return the sample it completes.

        :param limit: largest frame
        :param largest: largest sample
        """
        if end - start < 22:
            raise MalformedMessage(
                "a part of a sample needs 20 bytes of head, and at least one of the sample"
            )
        number, stamp, total, offset = _PART.unpack_from(buffer, start + 1)
        if number == JSON_NUMBER:
            largest = limit - 1
        if total > largest:
            raise FrameTooLarge(f"a sample of {total} bytes was announced; at most {largest} are taken here")
        size = end - start - 21
        body = (
            self._begin(number, stamp, total) if offset == 0 else self._follow(number, stamp, total, offset)
        )
        if offset + size > total:
            raise MalformedMessage(f"parts of sample {number} are longer than its {total} bytes")
        if offset + size == total:
            self._drop(number)
            body += memoryview(buffer)[start + 21 : end]
            return SampleFrame(number, stamp, bytes(body))
        self.size += size
        # One of the largest, beside those that would fit into a frame.
        most = min(PARTS_BYTES, 2 * limit) + (largest if largest > limit else 0)
        if self.size > most or len(self._unfinished) > UNFINISHED:
            raise FrameTooLarge(
                f"{len(self._unfinished)} samples of {self.size} bytes are unfinished; that is too much"
            )
        body += memoryview(buffer)[start + 21 : end]
        return None

    def _begin(self, number: int, stamp: int, total: int) -> bytearray:
        self._drop(number)
        body = bytearray()
        self._unfinished[number] = _Unfinished(stamp, total, body)
        return body

    def _follow(self, number: int, stamp: int, total: int, offset: int) -> bytearray:
        known = self._unfinished.get(number)
        if known is None:
            raise MalformedMessage(f"the parts of sample {number} begin at byte {offset}, not at 0")
        if (known.stamp, known.total) != (stamp, total):
            raise MalformedMessage(f"the parts of sample {number} belong to different samples")
        if len(known.body) != offset:
            raise MalformedMessage(f"byte {len(known.body)} of sample {number} must be next, not {offset}")
        return known.body

    def _drop(self, number: int) -> None:
        known = self._unfinished.pop(number, None)
        if known is not None:
            self.size -= len(known.body)


class PictureJoiner:
    """Makes a picture of its parts; memory grows with what came, not with what was announced.

    :param limit: most bytes of a picture
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._head: tuple[int, int, int] | None = None
        self._body = bytearray()

    @property
    def size(self) -> int:
        """Bytes of the picture that is not whole."""
        return len(self._body)

    def join(self, part: PicturePart) -> VideoFrame | None:
        """Take one part; return the picture it completes. One that begins ends what was not whole.

        :raises FrameTooLarge: the picture would be over the limit
        :raises MalformedMessage: the part does not follow the one before, or is longer than its picture
        """
        if part.total > self._limit:
            raise FrameTooLarge(
                f"a picture of {part.total} bytes was announced; at most {self._limit} are taken here"
            )
        head = (part.number, part.stamp, part.total)
        if part.offset == 0:
            self.drop()
            self._head = head
        elif head != self._head or part.offset != len(self._body):
            raise MalformedMessage(f"a part of picture {part.number} does not follow the one before it")
        if part.offset + len(part.body) > part.total:
            raise MalformedMessage(f"parts of picture {part.number} are longer than its {part.total} bytes")
        self._body += part.body
        if len(self._body) < part.total:
            return None
        whole = VideoFrame(part.number, part.stamp, bytes(self._body))
        self.drop()
        return whole

    def drop(self) -> None:
        """Forget what is not whole: it was given up."""
        self._head = None
        self._body = bytearray()


def _parse(buffer: bytes, start: int, end: int) -> Frame:
    kind = buffer[start]
    if kind == JSON:
        return JsonFrame(buffer[start + 1 : end])
    if kind in (SAMPLE, VIDEO):
        if end - start < SAMPLE_HEAD:
            raise MalformedMessage(f"a frame of kind {kind} needs 12 bytes of number and stamp")
        number, stamp = _NUMBERED(buffer, start + 1)
        body = buffer[start + 13 : end]
        return SampleFrame(number, stamp, body) if kind == SAMPLE else VideoFrame(number, stamp, body)
    if kind == COMMAND:
        if end - start < COMMAND_HEAD:
            raise MalformedMessage("a command needs 16 bytes of number, stamp and source")
        number, stamp, source = _COMMAND(buffer, start + 1)
        return CommandFrame(number, stamp, source, buffer[start + 17 : end])
    if kind == PICTURE_PART:
        if end - start < 22:
            raise MalformedMessage(
                "a part of a picture needs 20 bytes of head, and at least one of the picture"
            )
        number, stamp, total, offset = _PART.unpack_from(buffer, start + 1)
        return PicturePart(number, stamp, total, offset, buffer[start + 21 : end])
    raise MalformedMessage(
        f"frame kind {kind} is not known; 0 is JSON, 1 a sample, 2 a picture, 3 and 4 parts of these, "
        "5 a command"
    )
