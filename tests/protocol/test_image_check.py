"""The check of images: real ones of every kind pass, and nothing else does."""

from __future__ import annotations

import contextlib
import io
import struct
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
from relay_protocol.image_check import MAX_PARTS, ImageInfo, validate
from tests.worlds.growth import grows_linearly, steps
from tests.worlds.viewers import IDR, PPS, SLICE, SPS, jpeg, png, units

WIDTH, HEIGHT = 61, 37
NOISE = np.random.default_rng(7).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def by_pillow(kind: str, mode: str = "RGB", **options: Any) -> bytes:
    """An image written by Pillow."""
    file = io.BytesIO()
    Image.fromarray(NOISE).convert(mode).save(file, kind, **options)
    return file.getvalue()


def by_opencv(kind: str, pixels: Any, *options: int) -> bytes:
    """An image written by OpenCV."""
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
def test_size_of_real_images_is_read(codec: str, body: bytes) -> None:
    """For every writer and every option."""
    size = Image.open(io.BytesIO(body)).size
    assert validate(codec, body) == ImageInfo(*size, True)


REAL = [("jpeg", body) for body in JPEGS.values()] + [("png", body) for body in PNGS.values()]


@settings(deadline=None)
@given(real=st.sampled_from(REAL), data=st.data())
def test_a_truncated_image_is_invalid(real: tuple[str, bytes], data: st.DataObject) -> None:
    """At every place of the cut."""
    codec, body = real
    cut = data.draw(st.integers(0, len(body) - 1))
    for rest in (body[:cut], body[cut + 1 :]):
        with pytest.raises(MalformedMessage):
            validate(codec, rest)


@settings(deadline=None)
@given(real=st.sampled_from(REAL), more=st.binary(min_size=1, max_size=100))
@example(real=REAL[0], more=b"<html>")
@example(real=REAL[0], more=REAL[0][1])
@example(real=REAL[-1], more=b"\x00")
def test_no_bytes_before_or_after_a_frame(real: tuple[str, bytes], more: bytes) -> None:
    """Not even another frame."""
    codec, body = real
    for bad in (body + more, more + body):
        with pytest.raises(MalformedMessage):
            validate(codec, bad)


@settings(deadline=None)
@given(body=st.binary(max_size=300))
@example(b"")
@example(b"<!doctype html><script>alert(1)</script>")
@example(b"\xff\xd8\xff")
@example(b"\xff\xd8\xff\xd9")
@example(b"\x89PNG\r\n\x1a\n")
@example(b"GIF89a")
@example(b"\x00\x00\x01")
def test_other_bytes_are_no_image(body: bytes) -> None:
    """In every format, with a reason."""
    for codec in ("jpeg", "png"):
        with pytest.raises(MalformedMessage):
            validate(codec, body)
    if not body.startswith((b"\x00\x00\x01", b"\x00\x00\x00\x01")):
        with pytest.raises(MalformedMessage):
            validate("h264", body)


@settings(deadline=None)
@given(real=st.sampled_from(REAL), data=st.data())
def test_a_damaged_image_is_valid_or_an_error(real: tuple[str, bytes], data: st.DataObject) -> None:
    """For any changed or missing bytes there is no third result."""
    codec, body = real[0], bytearray(real[1])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(body) - 1))
        body[at : at + data.draw(st.integers(0, 2))] = data.draw(st.binary(max_size=2))
    try:
        seen = validate(codec, bytes(body))
    except MalformedMessage as error:
        assert str(error)
    else:
        assert 0 < seen.width <= limits.IMAGE_SIDE
        assert 0 < seen.height <= limits.IMAGE_SIDE


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
def test_key_frames_of_real_h264_are_recognised(options: dict[str, str]) -> None:
    """For any settings of the encoder; the first frame has its parameter sets."""
    context = av.VideoCodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt, context.framerate = 64, 48, "yuv420p", 15
    context.bit_rate = 900_000
    context.options = options
    kinds = []
    for number in range(6):
        pixels = np.random.default_rng(number).integers(0, 256, (72, 64), np.uint8)
        frame = av.VideoFrame.from_ndarray(pixels, "yuv420p")
        frame.pts = number
        kinds += [validate("h264", bytes(packet)) for packet in context.encode(frame)]
    assert [seen.key for seen in kinds[:3]] == [True, False, False]


def test_media_types_are_distinguished() -> None:
    """A stream sends only the requested type."""
    bodies = {"jpeg": jpeg(), "png": png(), "h264": units(SPS, PPS, IDR)}
    for codec in bodies:
        for other, body in bodies.items():
            if other != codec:
                with pytest.raises(MalformedMessage, match=r"^not "):
                    validate(codec, body)


def _segment(marker: int, content: bytes) -> bytes:
    return bytes((0xFF, marker)) + (len(content) + 2).to_bytes(2, "big") + content


_SOI, _EOI = b"\xff\xd8", b"\xff\xd9"
_SOF = _segment(0xC0, struct.pack("!BHHB", 8, 2, 3, 1) + b"\x01\x11\x00")
_SOS = _segment(0xDA, b"\x01\x01\x00\x00\x3f\x00") + b"\x12\xff\x00\x34"


def test_a_jpeg_of_the_least_parts() -> None:
    """Also with padding before its markers."""
    assert validate("jpeg", _SOI + _SOF + _SOS + _EOI) == ImageInfo(3, 2, True)
    assert validate("jpeg", _SOI + b"\xff\xff" + _SOF + _SOS + b"\xff" + _EOI) == ImageInfo(3, 2, True)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (_SOI + _EOI, "ends without an image"),
        (_SOI + _SOF + _EOI, "ends without an image"),
        (_SOI + _SOS + _EOI, "comes before its size"),
        (_SOI + _SOF + _SOF + _SOS + _EOI, "has two sizes"),
        (_SOI + _SOF + _SOS, "ends inside a scan"),
        (_SOI + _SOF + _SOS + _SOI + _EOI, "incomplete|longer than"),
        (_SOI + _SOF + _SOS + _EOI + _SOI, "2 bytes follow"),
        (_SOI + b"<html>" + _SOF + _SOS + _EOI, "extra bytes between"),
        (_SOI + _segment(0xC3, _SOF[4:]) + _SOS + _EOI, "marker 0xc3"),
        (_SOI + _segment(0xC0, _SOF[4:-1]) + _SOS + _EOI, "an invalid header"),
        (_SOI + _SOF.replace(b"\x00\x02\x00\x03", b"\x00\x00\x00\x03") + _SOS + _EOI, "0 pixels"),
        (_SOI + _SOF.replace(b"\x00\x02\x00\x03", b"\xff\xff\x00\x03") + _SOS + _EOI, "65535 pixels"),
        (_SOI + _SOF + _segment(0xDA, b"\x02\x01\x00\x00\x3f\x00") + _EOI, "a header of the wrong length"),
        (_SOI + b"\xff\xe0\x00\x01" + _SOF + _SOS + _EOI, "longer than"),
    ],
)
def test_a_jpeg_that_is_put_together_wrongly(body: bytes, words: str) -> None:
    """The error says what is wrong."""
    with pytest.raises(MalformedMessage, match=words):
        validate("jpeg", body)


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
    """With and without optional chunks."""
    assert validate("png", _PNG + body) == ImageInfo(3, 2, True)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (_IDAT + _IHDR + _IEND, "begin with its header"),
        (_IHDR + _IEND, "ends without an image"),
        (_IHDR + _IDAT + _IEND + b"\n", "1 bytes follow"),
        (_IHDR + _IDAT, "incomplete"),
        (_IHDR + _IDAT + _TEXT + _IDAT + _IEND, "out of order"),
        (_INDEXED + _IDAT + _IEND, "out of order"),
        (_IHDR + _IDAT + _PLTE + _IEND, "palette"),
        (_IHDR + _PLTE + _PLTE + _IDAT + _IEND, "palette"),
        (_IHDR + _chunk(b"HTML", b"<html>") + _IDAT + _IEND, "unknown kind"),
        (_IHDR + _IHDR + _IDAT + _IEND, "unknown kind"),
        (_IHDR + _IDAT[:-1] + b"\x00" + _IEND, "wrong checksum"),
        (_chunk(b"IHDR", bytes(12)) + _IDAT + _IEND, "a wrong length"),
        (_chunk(b"IHDR", struct.pack("!IIBBBBB", 3, 2, 4, 2, 0, 0, 0)) + _IDAT + _IEND, "invalid values"),
        (_chunk(b"IHDR", struct.pack("!IIBBBBB", 2**31, 2, 8, 2, 0, 0, 0)) + _IDAT + _IEND, "pixels"),
    ],
)
def test_a_png_that_is_put_together_wrongly(body: bytes, words: str) -> None:
    """The error says what is wrong."""
    with pytest.raises(MalformedMessage, match=words):
        validate("png", _PNG + body)


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
    """Without them a key frame is useless to a new viewer."""
    assert validate("h264", body) == ImageInfo(0, 0, key)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"<html>" + units(SPS, PPS, IDR), "not H.264"),
        (b"\x00\x00\x00" + units(IDR), "not H.264"),
        (units(SPS, PPS), "no frame"),
        (units(b"\xe5abc"), "is invalid"),
        (units(b""), "is invalid"),
        (units(b"\x65a\x00\x00\x02b"), "is invalid"),
        (units(b"\x05abc"), "has kind 5"),
        (units(b"\x7fabc"), "has kind 31"),
    ],
)
def test_h264_that_is_put_together_wrongly(body: bytes, words: str) -> None:
    """The error says what is wrong."""
    with pytest.raises(MalformedMessage, match=words):
        validate("h264", body)


FULL = limits.VIDEO_FRAME
STEPS_OF_A_PART = 50
"""Lines of Python for one part of an image, at most."""

HOSTILE: dict[str, tuple[str, Callable[[int], bytes]]] = {
    "empty segments": ("jpeg", lambda size: _SOI + b"\xff\xe0\x00\x02" * (size // 4)),
    "nothing but filling": ("jpeg", lambda size: _SOI + b"\xff" * size),
    "filling in a scan": ("jpeg", lambda size: _SOI + _SOF + _SOS + b"\xff" * size + b"\x00"),
    "scans": ("jpeg", lambda size: _SOI + _SOF + _SOS * (size // len(_SOS))),
    "empty chunks": ("png", lambda size: _PNG + _IHDR + _TEXT * (size // len(_TEXT))),
    "small units": ("h264", lambda size: units(IDR) * (size // 8)),
    "zeros": ("h264", lambda size: units(IDR) + bytes(size)),
    "zeros before": ("h264", bytes),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_no_image_holds_up_the_others(case: str) -> None:
    """Python handles a limited number of parts of the largest frame, and C code each byte a few times."""
    codec, make = HOSTILE[case]

    def check(body: bytes) -> None:
        with contextlib.suppress(MalformedMessage):
            validate(codec, body)

    assert steps(lambda: check(make(FULL))) < STEPS_OF_A_PART * MAX_PARTS
    assert grows_linearly(check, make, FULL)


def test_the_parts_of_an_image_are_counted() -> None:
    """The limit exceeds that of real images."""
    with pytest.raises(MalformedMessage, match=f"more than {MAX_PARTS} parts"):
        validate("h264", units(*[SLICE] * (MAX_PARTS + 1)))
