"""Frames of the robot link."""

from __future__ import annotations

import tracemalloc
from itertools import pairwise
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import frames
from relay_protocol.errors import FrameTooLarge, MalformedMessage, PeerError
from relay_protocol.frames import (
    Frame,
    FrameDecoder,
    JsonFrame,
    SampleFrame,
    VideoFrame,
    VideoFrameJoiner,
    VideoFramePart,
)

U32 = st.integers(0, frames.MAX_U32)
U64 = st.integers(0, frames.MAX_U64)
NUMBER = st.integers(1, frames.MAX_U32)
BODIES = st.binary(max_size=60)
FRAMES = st.one_of(
    st.builds(JsonFrame, BODIES),
    st.builds(SampleFrame, U32, U64, BODIES),
    st.builds(VideoFrame, U32, U64, BODIES),
    st.builds(VideoFramePart, U32, U64, U32, U32, st.binary(min_size=1, max_size=60)),
)


def encode(frame: Frame) -> bytes:
    """The frame as bytes."""
    if isinstance(frame, JsonFrame):
        return frames.encode_json(frame.body)
    if isinstance(frame, SampleFrame):
        return frames.encode_sample(frame.number, frame.stamp, frame.body)
    if isinstance(frame, VideoFramePart):
        return frames.encode_video_part(frame.number, frame.stamp, frame.total, frame.offset, frame.body)
    return frames.encode_video(frame.number, frame.stamp, frame.body)


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    """The bytes cut at these places."""
    places = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[start:end] for start, end in pairwise(places)]


@given(st.lists(FRAMES, max_size=6), st.lists(st.integers(0, 10_000), max_size=12))
def test_frames_come_out_as_they_went_in_however_the_stream_is_cut(
    sent: list[Frame], cuts: list[int]
) -> None:
    """Every frame survives, in order, for any division by the network."""
    data = b"".join(map(encode, sent))
    decoder = FrameDecoder(limit=1000)
    received = [frame for piece in pieces(data, cuts) for frame in decoder.feed(piece)]
    assert received == sent
    assert decoder.buffered == 0


@given(st.binary(max_size=300), st.lists(st.integers(0, 10_000), max_size=12))
def test_junk_ends_the_same_way_however_it_is_cut(data: bytes, cuts: list[int]) -> None:
    """Invalid bytes give the same frames or the same error whole and in pieces, and never another exception."""

    def outcome(parts: list[bytes]) -> str | None:
        decoder = FrameDecoder(limit=64)
        try:
            for part in parts:
                decoder.feed(part)
        except PeerError as error:
            return type(error).__name__
        return None

    assert outcome([data]) == outcome(pieces(data, cuts))


def test_a_frame_that_trickles_in_costs_no_more_than_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Received bytes are not parsed again with each further byte."""
    read: list[int] = []
    real = frames._LENGTH
    monkeypatch.setattr(frames, "_LENGTH", lambda data, start: read.append(len(data)) or real(data, start))
    decoder = FrameDecoder(limit=1000)
    data = frames.encode_sample(1, 2, b"x" * 500)
    got = [frame for byte in data for frame in decoder.feed(bytes([byte]))]
    assert got == [SampleFrame(1, 2, b"x" * 500)]
    assert read == [4, len(data)]


def test_a_huge_length_is_refused_before_its_body_comes() -> None:
    """The four bytes of a length of 4 GiB are refused, and nothing is stored."""
    with pytest.raises(FrameTooLarge, match="4294967295 bytes was announced; at most 1000"):
        FrameDecoder(limit=1000).feed(b"\xff\xff\xff\xff")


def test_a_frame_of_exactly_the_limit_passes() -> None:
    """The limit includes kind and body."""
    assert FrameDecoder(limit=10).feed(frames.encode_json(b"123456789")) == [JsonFrame(b"123456789")]
    with pytest.raises(FrameTooLarge):
        FrameDecoder(limit=10).feed(frames.encode_json(b"1234567890"))


def test_the_limit_can_be_raised_between_frames() -> None:
    """A peer that has proved its key may send more on the same connection."""
    decoder = FrameDecoder(limit=10)
    decoder.limit = 100
    assert decoder.feed(frames.encode_json(b"x" * 50)) == [JsonFrame(b"x" * 50)]


@pytest.mark.parametrize(
    "data",
    [
        b"\0\0\0\0",
        b"\0\0\0\x01\x05",
        b"\0\0\0\x0c\x01" + bytes(11),
        b"\0\0\0\x01\x02",
        b"\0\0\0\x15\x04" + bytes(20),
    ],
)
def test_malformed_frames_are_refused(data: bytes) -> None:
    """No kind, an unknown kind, a sample or picture without number and stamp, and a part without a byte are
    errors of the peer.
    """
    with pytest.raises(MalformedMessage):
        FrameDecoder(limit=1000).feed(data)


def test_an_unfinished_frame_waits() -> None:
    """Bytes of an incomplete frame are stored and counted."""
    decoder = FrameDecoder(limit=1000)
    assert decoder.feed(b"\0\0\0\x05\0ab") == []
    assert decoder.buffered == 7
    assert decoder.feed(b"cd") == [JsonFrame(b"abcd")]
    assert decoder.buffered == 0


PARTED = st.tuples(NUMBER, U64, st.binary(min_size=1, max_size=60))


def in_parts(number: int, stamp: int, body: bytes, size: int) -> list[bytes]:
    """A sample as frames of parts."""
    return [
        frames.encode_part(number, stamp, len(body), start, body[start : start + size])
        for start in range(0, len(body), size)
    ]


@given(
    st.lists(PARTED, max_size=6, unique_by=lambda sample: sample[0]),
    st.integers(1, 70),
    st.randoms(use_true_random=False),
    st.lists(st.integers(0, 10_000), max_size=12),
)
def test_parts_make_the_samples_they_came_from(
    sent: list[tuple[int, int, bytes]], size: int, random: Random, cuts: list[int]
) -> None:
    """Samples in parts are joined, for any frames between their parts and any division of the stream."""
    waiting = [in_parts(*sample, size) for sample in sent]
    stream = b""
    while waiting:
        each = random.choice(waiting)
        stream += each.pop(0) + frames.encode_json(b"between")
        waiting = [each for each in waiting if each]
    decoder = FrameDecoder(limit=1000)
    got = [frame for piece in pieces(stream, cuts) for frame in decoder.feed(piece)]
    samples = [frame for frame in got if isinstance(frame, SampleFrame)]
    assert sorted(samples) == sorted(SampleFrame(*sample) for sample in sent)
    assert decoder.buffered == 0


def test_parts_of_number_zero_make_a_message() -> None:
    """They have the length limit of a whole frame."""
    decoder = FrameDecoder(limit=1000)
    decoder.sample_limit = 5000
    body = bytes(999)
    got = [frame for part in in_parts(frames.JSON_NUMBER, 0, body, 100) for frame in decoder.feed(part)]
    assert got == [JsonFrame(body)]
    with pytest.raises(FrameTooLarge, match="at most 999"):
        decoder.feed(frames.encode_part(frames.JSON_NUMBER, 0, 1000, 0, b"a"))


def test_memory_grows_with_what_came() -> None:
    """An announced large sample takes no memory before its bytes arrive."""
    decoder = FrameDecoder(limit=2**24)
    tracemalloc.start()
    decoder.feed(frames.encode_part(1, 0, 2**23, 0, b"a"))
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert used < 100_000
    assert decoder.buffered == 1


def test_unfinished_samples_are_bounded_in_number_and_size() -> None:
    """Many unfinished samples, or many bytes of a few, violate the contract."""
    decoder = FrameDecoder(limit=2**24)
    for number in range(frames.UNFINISHED):
        decoder.feed(frames.encode_part(number, 0, 9, 0, b"a"))
    with pytest.raises(FrameTooLarge, match="unfinished"):
        decoder.feed(frames.encode_part(5000, 0, 9, 0, b"a"))
    decoder = FrameDecoder(limit=2**24)
    part = bytes(2**23)
    for number in range(4):
        decoder.feed(frames.encode_part(number, 0, 2**23 + 1, 0, part))
    with pytest.raises(FrameTooLarge, match="33554433 bytes are unfinished"):
        decoder.feed(frames.encode_part(4, 0, 9, 0, b"a"))


def test_finished_samples_make_room() -> None:
    """Finished samples, and those that begin again, do not count."""
    decoder = FrameDecoder(limit=1000)
    for stamp in range(50):
        decoder.feed(frames.encode_part(1, stamp, 900, 0, bytes(800)))
        assert decoder.buffered == 800
    for number in range(50):
        for part in in_parts(number, 0, bytes(900), 800):
            decoder.feed(part)
    assert decoder.buffered == 0


@given(st.lists(PARTED, max_size=6), st.integers(1, 70), st.data())
def test_parts_make_the_images_they_came_from(
    sent: list[tuple[int, int, bytes]], size: int, data: st.DataObject
) -> None:
    """An interrupted picture is dropped when another begins; the others are complete."""
    joiner = VideoFrameJoiner(limit=60)
    for number, stamp, body in sent:
        starts = range(0, len(body), size)
        parts = [VideoFramePart(number, stamp, len(body), at, body[at : at + size]) for at in starts]
        kept = data.draw(st.integers(1, len(parts)))
        joined = [joiner.join(part) for part in parts[:kept]]
        assert joined[:-1] == [None] * (kept - 1)
        whole = kept == len(parts)
        assert joined[-1] == (VideoFrame(number, stamp, body) if whole else None)
        assert joiner.size == (0 if whole else kept * size)


@pytest.mark.parametrize(
    ("part", "error"),
    [
        (VideoFramePart(1, 2, 9, 4, b"x"), "does not follow"),
        (VideoFramePart(1, 2, 9, 2, b"x"), "does not follow"),
        (VideoFramePart(1, 3, 9, 3, b"x"), "does not follow"),
        (VideoFramePart(1, 2, 8, 3, b"x"), "does not follow"),
        (VideoFramePart(2, 2, 9, 3, b"x"), "does not follow"),
        (VideoFramePart(1, 2, 9, 3, bytes(7)), "longer than its 9 bytes"),
        (VideoFramePart(2, 2, 0, 0, b"x"), "longer than its 0 bytes"),
        (VideoFramePart(2, 2, 101, 0, b"x"), "at most 100 are taken"),
    ],
)
def test_parts_that_do_not_fit_are_refused(part: VideoFramePart, error: str) -> None:
    """A gap, a repetition, another head, more than announced, more than allowed."""
    joiner = VideoFrameJoiner(limit=100)
    assert joiner.join(VideoFramePart(1, 2, 9, 0, b"abc")) is None
    with pytest.raises(PeerError, match=error):
        joiner.join(part)


def test_abandoned_request_is_forgotten() -> None:
    """Its next part has no beginning."""
    joiner = VideoFrameJoiner(limit=100)
    joiner.join(VideoFramePart(1, 2, 9, 0, b"abc"))
    joiner.drop()
    assert joiner.size == 0
    with pytest.raises(MalformedMessage, match="does not follow"):
        joiner.join(VideoFramePart(1, 2, 9, 3, b"def"))


def test_an_image_takes_memory_as_it_comes() -> None:
    """Not as it was announced."""
    joiner = VideoFrameJoiner(limit=2**24)
    tracemalloc.start()
    joiner.join(VideoFramePart(1, 0, 2**23, 0, b"a"))
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert used < 100_000
