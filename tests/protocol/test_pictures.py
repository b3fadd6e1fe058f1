"""Pictures looked at: real ones of every kind pass, and nothing else does."""

from __future__ import annotations

import io
import struct
import time
import zlib
from collections.abc import Callable
from typing import Any

import av
import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from relay_protocol import limits
from relay_protocol.errors import MalformedMessage
from relay_protocol.image_check import PARTS, Seen, look_at
from tests.relay_server.video.watching import IDR, PPS, SLICE, SPS, jpeg, png, units

WIDTH, HEIGHT = 61, 37
NOISE = np.random.default_rng(7).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def by_pillow(kind: str, mode: str = "RGB", **options: Any) -> bytes:
    """A picture written by Pillow."""
    file = io.BytesIO()
    Image.fromarray(NOISE).convert(mode).save(file, kind, **options)
    return file.getvalue()


def by_opencv(kind: str, pixels: Any, *options: int) -> bytes:
    """A picture written by OpenCV."""
    return cv2.imencode(kind, pixels, options)[1].tobytes()


def _exif() -> Image.Exif:
    exif = Image.Exif()
    exif[0x010E] = "a shed, with \xff\xd9 in its words"
    return exif


JPEGS = {
    "plain": by_pillow("JPEG"),
    "gray": by_pillow("JPEG", "L"),
    "cmyk": by_pillow("JPEG", "CMYK"),
    "progressive": by_pillow("JPEG", progressive=True),
    "optimised": by_pillow("JPEG", optimize=True, quality=100, subsampling=0),
    "thumbnail and comment": by_pillow(
        "JPEG", exif=_exif(), comment=b"<html>\xff\xd9</html>", dpi=(300, 300)
    ),
    "colour profile": by_pillow("JPEG", icc_profile=bytes(200_000)),
    "restart markers": by_pillow("JPEG", restart_marker_blocks=1),
    "opencv": by_opencv(".jpg", NOISE),
    "opencv gray": by_opencv(".jpg", NOISE[:, :, 0]),
    "opencv progressive": by_opencv(".jpg", NOISE, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "opencv restarts": by_opencv(".jpg", NOISE, cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
}
PNGS = {
    "plain": by_pillow("PNG"),
    "gray": by_pillow("PNG", "L"),
    "sixteen bits": by_opencv(".png", NOISE[:, :, 0].astype(np.uint16) * 257),
    "one bit": by_pillow("PNG", "1"),
    "palette": by_pillow("PNG", "P"),
    "alpha": by_pillow("PNG", "RGBA"),
    "gray and alpha": by_pillow("PNG", "LA"),
    "resolution and profile": by_pillow("PNG", dpi=(300, 300), icc_profile=bytes(1000)),
    "opencv": by_opencv(".png", NOISE),
    "many chunks": by_opencv(".png", np.random.default_rng(1).integers(0, 256, (600, 800, 3), np.uint8)),
}


@pytest.mark.parametrize(
    ("codec", "body"),
    [("jpeg", body) for body in JPEGS.values()] + [("png", body) for body in PNGS.values()],
    ids=[f"jpeg, {name}" for name in JPEGS] + [f"png, {name}" for name in PNGS],
)
def test_real_pictures_tell_their_size(codec: str, body: bytes) -> None:
    """Whoever wrote them and however."""
    size = Image.open(io.BytesIO(body)).size
    assert look_at(codec, body) == Seen(*size, True)


REAL = [("jpeg", body) for body in JPEGS.values()] + [("png", body) for body in PNGS.values()]


@settings(deadline=None)
@given(real=st.sampled_from(REAL), data=st.data())
def test_a_picture_of_which_an_end_is_missing_is_none(real: tuple[str, bytes], data: st.DataObject) -> None:
    """Wherever it is cut."""
    codec, body = real
    cut = data.draw(st.integers(0, len(body) - 1))
    for rest in (body[:cut], body[cut + 1 :]):
        with pytest.raises(MalformedMessage):
            look_at(codec, rest)


@settings(deadline=None)
@given(real=st.sampled_from(REAL), more=st.binary(min_size=1, max_size=100))
@example(real=REAL[0], more=b"<html>")
@example(real=REAL[0], more=REAL[0][1])
@example(real=REAL[-1], more=b"\x00")
def test_nothing_comes_before_or_after_a_picture(real: tuple[str, bytes], more: bytes) -> None:
    """Not even another one."""
    codec, body = real
    for bad in (body + more, more + body):
        with pytest.raises(MalformedMessage):
            look_at(codec, bad)


@settings(deadline=None)
@given(body=st.binary(max_size=300))
@example(b"")
@example(b"<!doctype html><script>alert(1)</script>")
@example(b"\xff\xd8\xff")
@example(b"\xff\xd8\xff\xd9")
@example(b"\x89PNG\r\n\x1a\n")
@example(b"GIF89a")
@example(b"\x00\x00\x01")
def test_other_bytes_are_no_picture(body: bytes) -> None:
    """In no form, and it is said in words."""
    for codec in ("jpeg", "png"):
        with pytest.raises(MalformedMessage):
            look_at(codec, body)
    if not body.startswith((b"\x00\x00\x01", b"\x00\x00\x00\x01")):
        with pytest.raises(MalformedMessage):
            look_at("h264", body)


@settings(deadline=None)
@given(real=st.sampled_from(REAL), data=st.data())
def test_damage_is_an_answer_in_words_or_still_a_picture(
    real: tuple[str, bytes], data: st.DataObject
) -> None:
    """Whatever bytes are changed or left out, nothing else comes of it than the one or the other."""
    codec, body = real[0], bytearray(real[1])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(body) - 1))
        body[at : at + data.draw(st.integers(0, 2))] = data.draw(st.binary(max_size=2))
    try:
        seen = look_at(codec, bytes(body))
    except MalformedMessage as error:
        assert str(error)
    else:
        assert 0 < seen.width <= limits.PICTURE_SIDE
        assert 0 < seen.height <= limits.PICTURE_SIDE


@pytest.mark.parametrize(
    "options",
    [
        {"tune": "zerolatency"},
        {"preset": "slow", "tune": "zerolatency", "x264-params": "slices=4:aud=1:repeat-headers=1"},
        {
            "tune": "zerolatency",
            "x264-params": "interlaced=1:filler=1:nal-hrd=cbr:vbv-maxrate=900:vbv-bufsize=90",
        },
    ],
    ids=["plain", "slices and delimiters", "fields and filler"],
)
def test_real_h264_tells_what_stands_alone(options: dict[str, str]) -> None:
    """However the encoder is set; the first picture has its parameter sets."""
    context = av.VideoCodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt, context.framerate = 64, 48, "yuv420p", 15
    context.bit_rate = 900_000
    context.options = options
    kinds = []
    for number in range(6):
        pixels = np.random.default_rng(number).integers(0, 256, (72, 64), np.uint8)
        frame = av.VideoFrame.from_ndarray(pixels, "yuv420p")
        frame.pts = number
        kinds += [look_at("h264", bytes(packet)) for packet in context.encode(frame)]
    assert [seen.key for seen in kinds[:3]] == [True, False, False]


def test_one_form_is_not_taken_for_another() -> None:
    """A stream shows what it was asked for."""
    bodies = {"jpeg": jpeg(), "png": png(), "h264": units(SPS, PPS, IDR)}
    for codec in bodies:
        for other, body in bodies.items():
            if other != codec:
                with pytest.raises(MalformedMessage, match="this is no"):
                    look_at(codec, body)


def _segment(marker: int, content: bytes) -> bytes:
    return bytes((0xFF, marker)) + (len(content) + 2).to_bytes(2, "big") + content


_SOI, _EOI = b"\xff\xd8", b"\xff\xd9"
_SOF = _segment(0xC0, struct.pack("!BHHB", 8, 2, 3, 1) + b"\x01\x11\x00")
_SOS = _segment(0xDA, b"\x01\x01\x00\x00\x3f\x00") + b"\x12\xff\x00\x34"


def test_a_jpeg_of_the_least_parts() -> None:
    """Also with bytes that fill before its markers."""
    assert look_at("jpeg", _SOI + _SOF + _SOS + _EOI) == Seen(3, 2, True)
    assert look_at("jpeg", _SOI + b"\xff\xff" + _SOF + _SOS + b"\xff" + _EOI) == Seen(3, 2, True)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (_SOI + _EOI, "before it has shown anything"),
        (_SOI + _SOF + _EOI, "before it has shown anything"),
        (_SOI + _SOS + _EOI, "before its size is told"),
        (_SOI + _SOF + _SOF + _SOS + _EOI, "its size twice"),
        (_SOI + _SOF + _SOS, "in the middle"),
        (_SOI + _SOF + _SOS + _SOI + _EOI, "breaks off|longer than"),
        (_SOI + _SOF + _SOS + _EOI + _SOI, "2 bytes come after"),
        (_SOI + b"<html>" + _SOF + _SOS + _EOI, "something between"),
        (_SOI + _segment(0xC3, _SOF[4:]) + _SOS + _EOI, "marker 0xc3"),
        (_SOI + _segment(0xC0, _SOF[4:-1]) + _SOS + _EOI, "a head that can't be"),
        (_SOI + _SOF.replace(b"\x00\x02\x00\x03", b"\x00\x00\x00\x03") + _SOS + _EOI, "0 pixels"),
        (_SOI + _SOF.replace(b"\x00\x02\x00\x03", b"\xff\xff\x00\x03") + _SOS + _EOI, "65535 pixels"),
        (_SOI + _SOF + _segment(0xDA, b"\x02\x01\x00\x00\x3f\x00") + _EOI, "a head of the wrong length"),
        (_SOI + b"\xff\xe0\x00\x01" + _SOF + _SOS + _EOI, "longer than"),
    ],
)
def test_a_jpeg_that_is_put_together_wrongly(body: bytes, words: str) -> None:
    """The words say what is wrong."""
    with pytest.raises(MalformedMessage, match=words):
        look_at("jpeg", body)


def _chunk(kind: bytes, content: bytes) -> bytes:
    return len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")


_PNG = b"\x89PNG\r\n\x1a\n"
_IHDR = _chunk(b"IHDR", struct.pack("!IIBBBBB", 3, 2, 8, 2, 0, 0, 0))
_INDEXED = _chunk(b"IHDR", struct.pack("!IIBBBBB", 3, 2, 8, 3, 0, 0, 0))
_PLTE = _chunk(b"PLTE", bytes(6))
_IDAT = _chunk(b"IDAT", zlib.compress(bytes(20)))
_TEXT = _chunk(b"tEXt", b"Title\x00shed")
_IEND = _chunk(b"IEND", b"")


@pytest.mark.parametrize(
    "body",
    [_IHDR + _IDAT + _IEND, _IHDR + _TEXT + _IDAT + _IDAT + _TEXT + _IEND, _INDEXED + _PLTE + _IDAT + _IEND],
)
def test_a_png_of_the_least_parts(body: bytes) -> None:
    """With and without what is not necessary."""
    assert look_at("png", _PNG + body) == Seen(3, 2, True)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (_IDAT + _IHDR + _IEND, "begin with its head"),
        (_IHDR + _IEND, "before it has shown anything"),
        (_IHDR + _IDAT + _IEND + b"\n", "1 bytes come after"),
        (_IHDR + _IDAT, "breaks off"),
        (_IHDR + _IDAT + _TEXT + _IDAT + _IEND, "out of order"),
        (_INDEXED + _IDAT + _IEND, "out of order"),
        (_IHDR + _IDAT + _PLTE + _IEND, "palette"),
        (_IHDR + _PLTE + _PLTE + _IDAT + _IEND, "palette"),
        (_IHDR + _chunk(b"HTML", b"<html>") + _IDAT + _IEND, "no PNG has"),
        (_IHDR + _IHDR + _IDAT + _IEND, "no PNG has"),
        (_IHDR + _IDAT[:-1] + b"\x00" + _IEND, "damaged"),
        (_chunk(b"IHDR", bytes(12)) + _IDAT + _IEND, "a length that can't be"),
        (_chunk(b"IHDR", struct.pack("!IIBBBBB", 3, 2, 4, 2, 0, 0, 0)) + _IDAT + _IEND, "says what can't be"),
        (_chunk(b"IHDR", struct.pack("!IIBBBBB", 2**31, 2, 8, 2, 0, 0, 0)) + _IDAT + _IEND, "pixels"),
    ],
)
def test_a_png_that_is_put_together_wrongly(body: bytes, words: str) -> None:
    """The words say what is wrong."""
    with pytest.raises(MalformedMessage, match=words):
        look_at("png", _PNG + body)


@pytest.mark.parametrize(
    ("body", "key"),
    [
        (units(SPS, PPS, IDR), True),
        (units(SPS, PPS, IDR, IDR), True),
        (b"\x00\x00\x01" + SPS + units(PPS, IDR) + bytes(3), True),
        (units(SLICE), False),
        (units(IDR), False),
        (units(b"\x09\x30", SLICE), False),
    ],
)
def test_h264_stands_alone_with_its_parameter_sets(body: bytes, key: bool) -> None:
    """A key frame without them is of no use to who joins by it."""
    assert look_at("h264", body) == Seen(0, 0, key)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"<html>" + units(SPS, PPS, IDR), "does not begin"),
        (b"\x00\x00\x00" + units(IDR), "does not begin"),
        (units(SPS, PPS), "no picture"),
        (units(b"\xe5abc"), "can't be"),
        (units(b""), "can't be"),
        (units(b"\x65a\x00\x00\x02b"), "can't be"),
        (units(b"\x05abc"), r"of a kind \(5\)"),
        (units(b"\x7fabc"), r"of a kind \(31\)"),
    ],
)
def test_h264_that_is_put_together_wrongly(body: bytes, words: str) -> None:
    """The words say what is wrong."""
    with pytest.raises(MalformedMessage, match=words):
        look_at("h264", body)


FULL = limits.PICTURE_FRAME
HOSTILE: dict[str, tuple[str, Callable[[], bytes]]] = {
    "empty segments": ("jpeg", lambda: _SOI + b"\xff\xe0\x00\x02" * (FULL // 4)),
    "nothing but filling": ("jpeg", lambda: _SOI + b"\xff" * FULL),
    "filling in a scan": ("jpeg", lambda: _SOI + _SOF + _SOS + b"\xff" * FULL + b"\x00"),
    "scans": ("jpeg", lambda: _SOI + _SOF + _SOS * (FULL // len(_SOS))),
    "empty chunks": ("png", lambda: _PNG + _IHDR + _TEXT * (FULL // len(_TEXT))),
    "small units": ("h264", lambda: units(IDR) * (FULL // 8)),
    "zeros": ("h264", lambda: units(IDR) + bytes(FULL)),
    "zeros before": ("h264", lambda: bytes(FULL)),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_no_picture_holds_up_the_others(case: str) -> None:
    """The largest frame of the worst kind is judged in a moment."""
    codec, make = HOSTILE[case]
    body = make()
    began = time.thread_time()
    try:
        look_at(codec, body)
    except MalformedMessage as error:
        assert str(error)
    assert time.thread_time() - began < 0.2


def test_the_parts_of_a_picture_are_counted() -> None:
    """As many as no real picture has."""
    with pytest.raises(MalformedMessage, match=f"more than {PARTS} parts"):
        look_at("h264", units(*[SLICE] * (PARTS + 1)))
