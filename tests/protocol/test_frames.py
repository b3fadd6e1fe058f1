"""Frames of the robot link."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import frames
from relay_protocol.errors import FrameTooLarge, MalformedMessage, PeerError
from relay_protocol.frames import Frame, FrameDecoder, JsonFrame, SampleFrame, VideoFrame

U32 = st.integers(0, frames.MAX_U32)
U64 = st.integers(0, frames.MAX_U64)
BODIES = st.binary(max_size=60)
FRAMES = st.one_of(
    st.builds(JsonFrame, BODIES),
    st.builds(SampleFrame, U32, U64, BODIES),
    st.builds(VideoFrame, U32, U64, BODIES),
)


def encode(frame: Frame) -> bytes:
    """The frame as bytes."""
    if isinstance(frame, JsonFrame):
        return frames.encode_json(frame.body)
    if isinstance(frame, SampleFrame):
        return frames.encode_sample(*frame)
    return frames.encode_video(*frame)


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    """The bytes cut at these places."""
    places = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[start:end] for start, end in pairwise(places)]


@given(st.lists(FRAMES, max_size=6), st.lists(st.integers(0, 10_000), max_size=12))
def test_frames_come_out_as_they_went_in_however_the_stream_is_cut(
    sent: list[Frame], cuts: list[int]
) -> None:
    """Every frame survives, in order, whatever chunks the network makes."""
    data = b"".join(map(encode, sent))
    decoder = FrameDecoder(limit=1000)
    received = [frame for piece in pieces(data, cuts) for frame in decoder.feed(piece)]
    assert received == sent
    assert decoder.buffered == 0


@given(st.binary(max_size=300), st.lists(st.integers(0, 10_000), max_size=12))
def test_junk_ends_the_same_way_however_it_is_cut(data: bytes, cuts: list[int]) -> None:
    """Junk gives the same frames or the same error fed whole and in pieces, and never another exception."""

    def outcome(parts: list[bytes]) -> str | None:
        decoder = FrameDecoder(limit=64)
        try:
            for part in parts:
                decoder.feed(part)
        except PeerError as error:
            return type(error).__name__
        return None

    assert outcome([data]) == outcome(pieces(data, cuts))


def test_a_huge_length_is_refused_before_its_body_comes() -> None:
    """Four bytes that announce 4 GiB are enough to be refused, and nothing is held."""
    with pytest.raises(FrameTooLarge, match="4294967295 bytes was announced; at most 1000"):
        FrameDecoder(limit=1000).feed(b"\xff\xff\xff\xff")


def test_a_frame_of_exactly_the_limit_passes() -> None:
    """The limit counts kind and body."""
    assert FrameDecoder(limit=10).feed(frames.encode_json(b"123456789")) == [JsonFrame(b"123456789")]
    with pytest.raises(FrameTooLarge):
        FrameDecoder(limit=10).feed(frames.encode_json(b"1234567890"))


def test_the_limit_can_be_raised_between_frames() -> None:
    """A peer that has proved itself may send more on the same connection."""
    decoder = FrameDecoder(limit=10)
    decoder.limit = 100
    assert decoder.feed(frames.encode_json(b"x" * 50)) == [JsonFrame(b"x" * 50)]


@pytest.mark.parametrize(
    "data", [b"\0\0\0\0", b"\0\0\0\x01\x03", b"\0\0\0\x0c\x01" + bytes(11), b"\0\0\0\x01\x02"]
)
def test_malformed_frames_are_refused(data: bytes) -> None:
    """No kind, an unknown kind, and a sample or picture without number and stamp are faults of the peer."""
    with pytest.raises(MalformedMessage):
        FrameDecoder(limit=1000).feed(data)


def test_an_unfinished_frame_waits() -> None:
    """Bytes of a frame that is not whole yet are held and counted."""
    decoder = FrameDecoder(limit=1000)
    assert decoder.feed(b"\0\0\0\x05\0ab") == []
    assert decoder.buffered == 7
    assert decoder.feed(b"cd") == [JsonFrame(b"abcd")]
    assert decoder.buffered == 0
