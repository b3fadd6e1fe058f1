"""Frames of the robot link (SPEC 2.1): u32 big-endian length, u8 kind, body.

The length counts the kind and the body. It is checked against the limit before anything is allocated.
"""

from __future__ import annotations

import struct

import msgspec

from relay_protocol.errors import FrameTooLarge, MalformedMessage
from relay_protocol.limits import INCOMPLETE_SAMPLE_BYTES, PART_SECONDS

JSON = 0
SAMPLE = 1
VIDEO = 2
PART = 3
VIDEO_PART = 4
COMMAND = 5
FILE_PART = 6

_LENGTH = struct.Struct("!I").unpack_from
_HEAD = struct.Struct("!IB")
pack_sample_head = struct.Struct("!IBIQ").pack
"""Length of the frame without this field, kind, number, stamp."""

_NUMBERED = struct.Struct("!IQ").unpack_from
pack_command_head = struct.Struct("!IBIQI").pack
"""As :data:`pack_sample_head`, with the source after the stamp."""

_COMMAND = struct.Struct("!IQI").unpack_from
_PART_HEAD = struct.Struct("!IBIQII")
_PART = struct.Struct("!IQII")

_FILE_HEAD = struct.Struct("!IBIQ")
_FILE = struct.Struct("!IQ")

MAX_U32 = 2**32 - 1
MAX_U64 = 2**64 - 1

SAMPLE_HEAD = 13
"""Bytes of kind, number and stamp of a sample; the length field of its frame counts them."""

COMMAND_HEAD = 17
"""Bytes of kind, number, stamp and source of a command."""

JSON_NUMBER = 0
"""Parts of this number make a JSON message. No subscription or publication has it."""

UNFINISHED = 1024
"""Most samples of one link of which some parts, but not all, have been received."""


class _Frame(msgspec.Struct, frozen=True):
    """A struct is made in a third of the time of a named tuple, and there is one for every sample."""


class JsonFrame(_Frame, frozen=True, order=True, gc=False):
    """Kind 0: one JSON message, not yet decoded."""

    body: bytes


class SampleFrame(_Frame, frozen=True, order=True, gc=False):
    """Kind 1: one message of a topic.

    :param number: subscription (robot to relay) or publication (relay to robot) it belongs to
    :param stamp: nanoseconds; robot to relay: the robot's wall clock when the sample reached it; relay to robot: as of
        :class:`CommandFrame`
    :param body: the message in the encoding agreed, CDR with its four-byte header from ROS 2
    """

    number: int
    stamp: int
    body: bytes


class CommandFrame(_Frame, frozen=True, order=True, gc=False):
    """Kind 5: one message to a topic that moves the robot.

    :param number: publication it belongs to
    :param stamp: nanoseconds of the relay's monotonic clock; the command can't have been sent before. The relay calls
        it ``earliest_sent``; the robot converts it to its own clock, and calls it ``earliest_sent`` as well
    :param source: the connection it came from, as the relay numbers them
    :param body: the message in the encoding agreed
    """

    number: int
    stamp: int
    source: int
    body: bytes


class VideoFrame(_Frame, frozen=True, order=True, gc=False):
    """Kind 2: one encoded image of a camera stream; ``stamp`` is the robot's wall clock in nanoseconds."""

    number: int
    stamp: int
    body: bytes


class VideoFramePart(_Frame, frozen=True, order=True, gc=False):
    """Kind 4: one part of the body of a :class:`VideoFrame`.

    The decoder does not join these parts, because the receiver acknowledges each one and joins them by
    :class:`VideoFrameJoiner`.

    :param number: the same for all parts of an image, like ``stamp``
    :param total: bytes of the whole image
    :param offset: bytes of the image before this part
    """

    number: int
    stamp: int
    total: int
    offset: int
    body: bytes


class FilePart(_Frame, frozen=True, order=True, gc=False):
    """Kind 6: a part of a file that a robot uploads.

    :param upload: number of the upload
    :param offset: bytes of the file before this part
    """

    upload: int
    offset: int
    body: bytes


Frame = JsonFrame | SampleFrame | CommandFrame | VideoFrame | VideoFramePart | FilePart
"""The frames that :class:`FrameDecoder` returns. It joins parts of kind 3 to a :class:`SampleFrame` or
:class:`JsonFrame`."""


def encode_json(body: bytes) -> bytes:
    """The frame around one JSON message."""
    return _HEAD.pack(len(body) + 1, JSON) + body


def encode_sample(number: int, stamp: int, body: bytes) -> bytes:
    """The frame around one topic sample; see :class:`SampleFrame`."""
    return pack_sample_head(len(body) + 13, SAMPLE, number, stamp) + body


def encode_command(number: int, stamp: int, source: int, body: bytes) -> bytes:
    """The frame around one command; see :class:`CommandFrame`."""
    return pack_command_head(len(body) + COMMAND_HEAD, COMMAND, number, stamp, source) + body


def encode_video(number: int, stamp: int, body: bytes) -> bytes:
    """The frame around one image; see :class:`VideoFrame`."""
    return pack_sample_head(len(body) + 13, VIDEO, number, stamp) + body


def encode_part(number: int, stamp: int, total: int, offset: int, part: bytes) -> bytes:
    """The frame around one part of a sample; see :class:`SampleFrame`.

    :param number: :data:`JSON_NUMBER` for a part of a JSON message
    :param total: bytes of the whole message
    :param offset: bytes of the message before this part
    """
    return _PART_HEAD.pack(len(part) + 21, PART, number, stamp, total, offset) + part


def encode_video_part(number: int, stamp: int, total: int, offset: int, part: bytes | memoryview) -> bytes:
    """The frame around one part of an image; see :class:`VideoFramePart`."""
    return _PART_HEAD.pack(len(part) + 21, VIDEO_PART, number, stamp, total, offset) + part


def encode_file_part(upload: int, offset: int, body: bytes) -> bytes:
    """The frame around a part of a file; see :class:`FilePart`."""
    return _FILE_HEAD.pack(len(body) + 13, FILE_PART, upload, offset) + body


class FrameDecoder:
    """Decodes a byte stream into frames, and joins the parts of samples and of JSON messages.

    :param limit: largest length field accepted, bytes; it may be raised once the peer has proved itself
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.sample_limit = 0
        """Largest sample accepted in parts, bytes. A sample that fits into a frame is accepted in any case."""
        self._buffer = bytearray()
        self._bytes_needed = 0
        """Bytes that the buffer must hold before the next frame can be complete."""
        self._parts = _Parts()

    @property
    def buffered(self) -> int:
        """Bytes held of an incomplete frame and of incomplete samples."""
        return len(self._buffer) + self._parts.size

    def drop_idle(self, now: float) -> None:
        """Drop samples of which no part has come for :data:`relay_protocol.limits.PART_SECONDS`.

        Called often; parts that come between two calls have the time of the first.

        :param now: seconds of a monotonic clock
        :raises MalformedMessage: such parts are of a JSON message
        """
        self._parts.drop_idle(now)

    def clear(self) -> None:
        """Drop all that is incomplete, as the link has ended."""
        self._buffer = bytearray()
        self._parts = _Parts()

    def feed(self, data: bytes) -> list[Frame]:
        """Take received bytes; return the frames that they complete.

        :raises FrameTooLarge: a length field is over :attr:`limit` (found before the body is received), a sample in
            parts is over :attr:`sample_limit`, or too many bytes of incomplete samples are held
        :raises MalformedMessage: an empty frame, an unknown kind, a frame too short for its head, parts that don't
            follow each other
        """
        buffer = self._buffer
        if buffer:
            buffer += data
            if len(buffer) < self._bytes_needed:
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
            self._bytes_needed = 4 + length if have - start >= 4 else 4
        return frames


class _Unfinished:
    __slots__ = ("body", "stamp", "total", "touched")

    def __init__(self, stamp: int, total: int, body: bytearray, touched: float) -> None:
        self.stamp = stamp
        self.total = total
        self.body = body
        self.touched = touched


class _Parts:
    """Joins the parts of samples of one link. Memory grows with the bytes received, not with the sizes announced."""

    def __init__(self) -> None:
        self.size = 0
        self._unfinished: dict[int, _Unfinished] = {}
        self._dropped: dict[int, int] = {}
        """Stamps of samples that were dropped as idle. Further parts of them are passed over."""
        self._now = 0.0

    def drop_idle(self, now: float) -> None:
        self._now = now
        if not self._unfinished:
            return
        for number in [
            number for number, each in self._unfinished.items() if each.touched <= now - PART_SECONDS
        ]:
            if number == JSON_NUMBER:
                raise MalformedMessage(
                    f"no part of an unfinished JSON message has come for {PART_SECONDS:g} s"
                )
            self._dropped[number] = self._unfinished[number].stamp
            self._drop(number)
        while len(self._dropped) > UNFINISHED:
            del self._dropped[next(iter(self._dropped))]

    def join(self, buffer: bytes, start: int, end: int, limit: int, largest: int) -> SampleFrame | None:
        """Take one part; return the sample that it completes.

        :param start: index of the kind in the buffer
        :param end: index after the part
        :param limit: largest frame, bytes
        :param largest: largest sample, bytes
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
        if self._dropped and offset and self._dropped.get(number) == stamp:
            return None
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
        # One sample of the largest size, beside those that would fit into a frame.
        most = min(INCOMPLETE_SAMPLE_BYTES, 2 * limit) + (largest if largest > limit else 0)
        if self.size > most or len(self._unfinished) > UNFINISHED:
            raise FrameTooLarge(
                f"{len(self._unfinished)} samples of {self.size} bytes are unfinished; that is too much"
            )
        body += memoryview(buffer)[start + 21 : end]
        return None

    def _begin(self, number: int, stamp: int, total: int) -> bytearray:
        self._drop(number)
        self._dropped.pop(number, None)
        body = bytearray()
        self._unfinished[number] = _Unfinished(stamp, total, body, self._now)
        return body

    def _follow(self, number: int, stamp: int, total: int, offset: int) -> bytearray:
        known = self._unfinished.get(number)
        if known is None:
            raise MalformedMessage(f"the parts of sample {number} begin at byte {offset}, not at 0")
        if (known.stamp, known.total) != (stamp, total):
            raise MalformedMessage(f"the parts of sample {number} belong to different samples")
        if len(known.body) != offset:
            raise MalformedMessage(f"byte {len(known.body)} of sample {number} must be next, not {offset}")
        known.touched = self._now
        return known.body

    def _drop(self, number: int) -> None:
        known = self._unfinished.pop(number, None)
        if known is not None:
            self.size -= len(known.body)


class VideoFrameJoiner:
    """Joins the parts of one image at a time. Memory grows with the bytes received, not with the size announced.

    :param limit: most bytes of an image
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._head: tuple[int, int, int] | None = None
        self._body = bytearray()

    @property
    def size(self) -> int:
        """Bytes held of the incomplete image."""
        return len(self._body)

    def join(self, part: VideoFramePart) -> VideoFrame | None:
        """Take one part; return the image that it completes. The first part of an image drops an incomplete one.

        :raises FrameTooLarge: the image would be over the limit
        :raises MalformedMessage: the part does not follow the one before, or is longer than its image
        """
        if part.total > self._limit:
            raise FrameTooLarge(
                f"a video frame of {part.total} bytes was announced; at most {self._limit} are taken here"
            )
        head = (part.number, part.stamp, part.total)
        if part.offset == 0:
            self.drop()
            self._head = head
        elif head != self._head or part.offset != len(self._body):
            raise MalformedMessage(f"a part of video frame {part.number} does not follow the one before it")
        if part.offset + len(part.body) > part.total:
            raise MalformedMessage(
                f"parts of video frame {part.number} are longer than its {part.total} bytes"
            )
        self._body += part.body
        if len(self._body) < part.total:
            return None
        whole = VideoFrame(part.number, part.stamp, bytes(self._body))
        self.drop()
        return whole

    def drop(self) -> None:
        """Drop the incomplete image, as its sender has given it up."""
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
    if kind == VIDEO_PART:
        if end - start < 22:
            raise MalformedMessage(
                "a part of a video frame needs 20 bytes of head, and at least one byte of the frame"
            )
        number, stamp, total, offset = _PART.unpack_from(buffer, start + 1)
        return VideoFramePart(number, stamp, total, offset, buffer[start + 21 : end])
    if kind == FILE_PART:
        if end - start < 14:
            raise MalformedMessage("a part of a file needs 12 bytes of head, and at least one of the file")
        upload, at = _FILE.unpack_from(buffer, start + 1)
        return FilePart(upload, at, buffer[start + 13 : end])
    raise MalformedMessage(
        f"frame kind {kind} is not known; 0 is JSON, 1 a sample, 2 a video frame, 3 and 4 parts of these, "
        "5 a command, 6 a part of a file"
    )
