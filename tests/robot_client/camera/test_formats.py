"""Every encoding's colours compared with a card of known pixels, wrong sizes, and damaged messages."""

from __future__ import annotations

import math
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image

from relay_protocol.errors import Invalid
from robot_client.camera import formats
from robot_client.camera.formats import (
    ENCODINGS,
    MAX_PIXELS,
    RawImage,
    compressed_file,
    decode_compressed,
    decode_file,
    decode_image,
    message_format,
)
from robot_client.camera.images import DamagedImage
from tests.worlds.image_cards import (
    INVERSE,
    PATCHES,
    Coded,
    card,
    coded,
    compressed_cdr,
    depth_files,
    depth_head,
    depths,
    grey_of,
    image_cdr,
    middle_of,
    png_of,
    quantised,
)

DEPTH = ("16UC1", "32FC1")
GREY = ("mono8", "mono16", "8UC1")
SUBSAMPLED = ("uyvy", "yuv422", "yuyv", "yuv422_yuy2", "nv12", "nv21", "yuv420", "i420")
COLOUR = [each for each in ENCODINGS if each not in (*DEPTH, *GREY)]
EXACT = [each for each in COLOUR if "bayer" not in each and each not in (*SUBSAMPLED, "nv24")]
WAYS = [(big_endian, padding) for big_endian in (False, True) for padding in (0, 7)]

LOSSY, LOSSLESS = (
    cv2.imencode(".webp", card(64, 48)[:, :, ::-1], (cv2.IMWRITE_WEBP_QUALITY, quality))[1].tobytes()
    for quality in (90, 101)
)
"""WebP, whose quality above 100 loses nothing (OpenCV, ImwriteFlags)."""


def extended(file: bytes, width: int = 64, height: int = 48) -> bytes:
    """The same WebP as a file with a canvas (RFC 9649, 2.7), as files with additional data have."""
    canvas = bytes(4) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    body = b"WEBPVP8X" + struct.pack("<I", len(canvas)) + canvas + file[12:]
    return b"RIFF" + struct.pack("<I", len(body)) + body


JPEG = cv2.imencode(".jpg", card(64, 48)[:, :, ::-1])[1].tobytes()
PNG = cv2.imencode(".png", card(64, 48)[:, :, ::-1])[1].tobytes()


def small(of: str = "bgr8", **changed: object) -> Coded:
    return coded(of, 12, 8)._replace(**changed)


def test_every_usual_encoding_is_known() -> None:
    """Those of cameras and drivers, by the names of image_encodings.hpp."""
    usual = {"rgb8", "bgr8", "rgba8", "bgra8", "mono8", "mono16", "8UC1", "8UC3", "16UC1", "32FC1"}
    usual |= {"8UC4", "16UC3", "16UC4", "32FC3", "32FC4"}
    yuv = {"yuv422", "yuv422_yuy2", "uyvy", "yuyv", "nv12", "nv21", "nv24", "yuv420", "i420"}
    bayer = {f"bayer_{order}{bits}" for order in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)}
    assert usual | yuv | bayer <= set(ENCODINGS)


@pytest.mark.parametrize(("big_endian", "padding"), WAYS)
@pytest.mark.parametrize("encoding", COLOUR)
def test_patches_have_their_colours(encoding: str, big_endian: bool, padding: int) -> None:
    """The middle of each bar has its colour, as B, G, R; YUV may round."""
    raw = decode_image(image_cdr(coded(encoding, big_endian=big_endian, padding=padding)))
    assert raw.encoding == encoding
    assert (raw.width, raw.height) == (320, 240)
    assert raw.pixels.shape == (240, 320, 3)
    assert raw.pixels.dtype == np.uint8
    for name, (red, green, blue) in PATCHES.items():
        assert raw.pixels[middle_of(name)].tolist() == pytest.approx([blue, green, red], abs=3), name


@pytest.mark.parametrize(("big_endian", "padding"), WAYS)
@pytest.mark.parametrize("encoding", EXACT)
def test_packed_colours_are_exact_everywhere(encoding: str, big_endian: bool, padding: int) -> None:
    """Without interpolation every pixel of the card is reproduced."""
    raw = decode_image(image_cdr(coded(encoding, big_endian=big_endian, padding=padding)))
    assert np.array_equal(raw.pixels, card()[:, :, ::-1])


@pytest.mark.parametrize("encoding", [each for each in ENCODINGS if each not in DEPTH])
def test_ramps_are_even(encoding: str) -> None:
    """No value of the card's ramp differs by more than rounding and interpolation."""
    pixels = decode_image(image_cdr(coded(encoding))).pixels[-20].astype(int)
    expected = np.linspace(0, 255, 320)[:, None]
    assert np.abs(pixels.reshape(320, -1) - expected).max() <= 4


@pytest.mark.parametrize(("big_endian", "padding"), WAYS)
@pytest.mark.parametrize("encoding", GREY)
def test_grey_stays_grey(encoding: str, big_endian: bool, padding: int) -> None:
    """One value per pixel; 16 bits are scaled by 255 / 65535."""
    raw = decode_image(image_cdr(coded(encoding, big_endian=big_endian, padding=padding)))
    assert np.array_equal(raw.pixels, grey_of(card()))


@pytest.mark.parametrize(("value", "shown"), [(0, 0), (128, 0), (129, 1), (257, 1), (4095, 16), (65535, 255)])
def test_sixteen_bits_are_rounded(value: int, shown: int) -> None:
    """The scale is that of the format, not of the image: the picture does not flicker."""
    one = Coded("mono16", 1, 1, False, 2, struct.pack("<H", value))
    assert decode_image(image_cdr(one)).pixels.tolist() == [[shown]]


@pytest.mark.parametrize(("big_endian", "padding"), WAYS)
@pytest.mark.parametrize("encoding", DEPTH)
def test_depth_goes_from_red_to_blue_over_black(encoding: str, big_endian: bool, padding: int) -> None:
    """Near is red, 2 m green, far blue; unmeasured pixels are black."""
    pixels = decode_image(image_cdr(coded(encoding, big_endian=big_endian, padding=padding))).pixels
    assert pixels.shape == (240, 320, 3)
    near, middle, far = (pixels[0, column].astype(int) for column in (2, 160, 317))
    assert near[2] > near[0] + 100
    assert near[2] > near[1] + 100
    assert middle[1] > middle[0] + 100
    assert far[0] > far[2] + 60
    assert far[0] > far[1] + 60
    assert not pixels[-1].any()


def depth_colour(metres: float) -> tuple[int, ...]:
    one = Coded("32FC1", 1, 1, False, 4, struct.pack("<f", metres))
    return tuple(decode_image(image_cdr(one)).pixels[0, 0].tolist())


@pytest.mark.parametrize("millimetres", [1, 250, 999, 2000, 15_999, 16_000, 65_535])
def test_metres_and_millimetres_have_the_same_colours(millimetres: int) -> None:
    """A distance has its colour in every encoding and for any other content."""
    one = Coded("16UC1", 1, 1, False, 2, struct.pack("<H", millimetres))
    assert tuple(decode_image(image_cdr(one)).pixels[0, 0].tolist()) == depth_colour(millimetres / 1000)


@pytest.mark.parametrize("metres", [0.0, -1.0, math.nan, math.inf, -math.inf, 0.0004])
def test_unmeasured_depth_is_black(metres: float) -> None:
    """REP 118 has NaN for invalid, and infinities for too near and too far."""
    assert depth_colour(metres) == (0, 0, 0)


def test_depth_beyond_the_scale_keeps_its_ends() -> None:
    """Nearer than the scale is red, farther is blue."""
    assert depth_colour(0.01) == depth_colour(0.25)
    assert depth_colour(16.0) == depth_colour(3e38)
    assert depth_colour(0.25) != depth_colour(0.3)


def stamped(message: object) -> object:
    """Sets the header of the messages made by hand."""
    message.header.stamp.sec, message.header.stamp.nanosec = 1_700_000_000, 5
    message.header.frame_id = "camera"
    return message


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_messages_of_rclpy_are_read(encoding: str) -> None:
    """ROS and these tests make the same messages, except for padding, which has no meaning."""
    made = coded(encoding, 12, 8, big_endian=True, padding=3)
    message = stamped(
        Image(height=8, width=12, encoding=encoding, is_bigendian=1, step=made.step, data=made.data)
    )
    assert deserialize_message(image_cdr(made), Image) == message
    assert np.array_equal(
        decode_image(serialize_message(message)).pixels, decode_image(image_cdr(made)).pixels
    )


@pytest.mark.parametrize("frame", ["", "a", "ab", "abc", "abcd"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_padding_in_the_message_follows_its_strings(frame: str, order: str) -> None:
    """Numbers are aligned for any frame name, in both byte orders of the message."""
    raw = decode_image(image_cdr(small(), frame=frame, order=order))
    assert np.array_equal(raw.pixels, card(12, 8)[:, :, ::-1])


def test_bgr_is_not_copied() -> None:
    """Two megapixels at 30 Hz would be costly to copy."""
    cdr = image_cdr(coded("bgr8"))
    assert np.shares_memory(decode_image(cdr).pixels, np.frombuffer(cdr, np.uint8))


def test_unknown_encoding_is_named_with_those_that_are_known() -> None:
    """The user of the camera learns what to change."""
    with pytest.raises(Invalid, match=r"'yuv999' can't be shown; supported are rgb8, bgr8, .*nv24"):
        decode_image(image_cdr(small(encoding="yuv999")))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (small(step=35), "rows of 36 bytes, but step says 35"),
        (small(step=0), "rows of 36 bytes, but step says 0"),
        (small(step=2**32 - 1), "needs 34359738360 bytes; the message has 288"),
        (small(data=small().data[:-1]), "needs 288 bytes; the message has 287"),
        (small(data=b""), "needs 288 bytes; the message has 0"),
        (small(width=0), "image of 0×8 pixels"),
        (small(height=0), "image of 12×0 pixels"),
        (small(height=8193), "1 to 8192"),
        (small(width=2**31), "image of 2147483648×8 pixels"),
        (small("yuv422", width=11), "pairs of pixels"),
        (small("nv21", height=7), "pairs of pixels"),
        (small("nv21", height=10), "needs 180 bytes; the message has 144"),
        (small("nv12", height=10), "needs 180 bytes; the message has 144"),
        (small("i420", width=11), "pairs of pixels"),
        (small("yuv420", height=10), "needs 180 bytes; the message has 144"),
        (small("32FC3", step=143), "rows of 144 bytes, but step says 143"),
        (small("nv24", height=9), "needs 324 bytes; the message has 288"),
        (small("bayer_rggb8", height=2), "at least 3 pixels"),
        (small(encoding="x" * 255), "256 bytes; the most is 255"),
        (small(encoding="rgb8\n"), "printable"),
    ],
)
def test_sizes_that_do_not_fit_are_refused_with_the_reason(wrong: Coded, words: str) -> None:
    """Nothing is read beyond the message, and no memory is allocated for it."""
    with pytest.raises(Invalid, match=words):
        decode_image(image_cdr(wrong))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_cut_is_invalid(encoding: str) -> None:
    """A truncated message is never half a picture."""
    whole = image_cdr(small(encoding))
    for length in range(len(whole)):
        with pytest.raises(Invalid):
            decode_image(whole[:length])


BOUNDS = st.sampled_from([0, 1, 2, 3, 0x7F, 0xFF, 0x1FFF, 0x2000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF])


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """A message with some bytes, numbers or parts changed."""
    bytes_ = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, min(len(bytes_), 120) - 4)))
        match draw(st.sampled_from(["byte", "number", "cut", "more"])):
            case "byte":
                bytes_[at : at + 1] = draw(st.binary(min_size=1, max_size=1))
            case "number":
                place = at // 4 * 4
                bytes_[place : place + 4] = struct.pack(draw(st.sampled_from("<>")) + "I", draw(BOUNDS))
            case "cut":
                del bytes_[draw(st.integers(0, len(bytes_))) :]
            case "more":
                bytes_[at:at] = draw(st.binary(max_size=9))
    return bytes(bytes_)


@given(st.data())
def test_damaged_images_are_invalid_or_images_no_larger_than_they(data: st.DataObject) -> None:
    """Only Invalid is raised, and memory is bounded by the input."""
    cdr = data.draw(damaged(image_cdr(small(data.draw(st.sampled_from(ENCODINGS))))))
    try:
        raw = decode_image(cdr)
    except Invalid:
        return
    assert raw.pixels.shape[:2] == (raw.height, raw.width)
    assert raw.pixels.nbytes <= 3 * len(cdr)
    assert message_format(cdr, False) == (raw.encoding, raw.width, raw.height)


@given(st.data())
def test_damaged_files_are_invalid_or_images_of_the_size_they_say(data: st.DataObject) -> None:
    """For any content of a CompressedImage."""
    files = JPEG, PNG, LOSSY, LOSSLESS, extended(LOSSLESS)
    whole = st.sampled_from([*map(compressed_cdr, files), INVERSE_CDR])
    cdr = data.draw(damaged(data.draw(whole)))
    try:
        look = message_format(cdr, True)
        raw = decode_compressed(compressed_file(cdr))
    except Invalid:
        return
    assert (raw.encoding, raw.width, raw.height) == look
    assert raw.pixels.shape[1::-1] == look[1:]
    assert raw.pixels.dtype == np.uint8


@given(st.binary(max_size=200))
def test_any_bytes_are_no_more_than_invalid(cdr: bytes) -> None:
    """No other exception passes."""
    for read in (
        decode_image,
        compressed_file,
        decode_file,
        lambda each: message_format(each, True),
        lambda each: message_format(each, False),
    ):
        with pytest.raises(Invalid):
            read(cdr)


@pytest.mark.parametrize(("file", "kind"), [(JPEG, "jpeg"), (PNG, "png"), (LOSSY, "webp")])
@pytest.mark.parametrize("order", ["<", ">"])
def test_files_go_through_untouched(file: bytes, kind: str, order: str) -> None:
    """The kind follows from the bytes, not from the format field."""
    assert compressed_file(compressed_cdr(file, "bgr8; tiff compressed", order=order))[:2] == (kind, file)
    assert message_format(compressed_cdr(file, order=order), True) == (kind, 64, 48)


@pytest.mark.parametrize("file", [LOSSY, LOSSLESS, extended(LOSSY), extended(LOSSLESS)])
def test_webp_is_decoded_as_opencv_does(file: bytes) -> None:
    """Each of its forms, with padding of the camera's buffer too, and with the size in its header."""
    cdr = compressed_cdr(file + b"\0" * 100, "webp")
    assert message_format(cdr, True) == ("webp", 64, 48)
    raw = decode_compressed(compressed_file(cdr))
    assert np.array_equal(raw.pixels, cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR))
    assert np.abs(raw.pixels.astype(int) - card(64, 48)[:, :, ::-1]).mean() < 12


def test_lossless_webp_is_exact() -> None:
    """Every pixel."""
    assert np.array_equal(decode_file(LOSSLESS).pixels, card(64, 48)[:, :, ::-1])


@pytest.mark.parametrize("file", [LOSSY, LOSSLESS, extended(LOSSY)])
def test_webp_that_breaks_off_is_damaged(file: bytes) -> None:
    """At any place after its signature."""
    for length in range(12, len(file)):
        with pytest.raises(DamagedImage):
            decode_compressed(compressed_file(compressed_cdr(file[:length], "webp")))


def test_webp_of_too_many_pixels_is_not_decoded() -> None:
    """Only its header is read."""
    huge = extended(LOSSY, 8192, 8192)
    with pytest.raises(Invalid, match="too large to be decoded"):
        decode_compressed(compressed_file(compressed_cdr(huge, "webp")))


@pytest.mark.parametrize(
    ("value", "shown"),
    [(math.nan, 0), (-1.0, 0), (-math.inf, 0), (0.5, 128), (1.0, 255), (7.0, 255), (math.inf, 255)],
)
def test_floating_colour_goes_from_0_to_1(value: float, shown: int) -> None:
    """Values outside are clipped."""
    one = Coded("32FC3", 1, 1, False, 12, struct.pack("<3f", value, 0, 1))
    assert decode_image(image_cdr(one)).pixels.tolist() == [[[shown, 0, 255]]]


@pytest.mark.parametrize("encoding", ["nv12", "nv21", "i420", "yuv420"])
def test_quartered_colours_are_as_opencv_has_them(encoding: str) -> None:
    """For an image with a different colour in each pixel, with planes put together by hand."""
    grey, first, second = (
        np.random.default_rng(7).integers(16, 236, shape, np.uint8) for shape in ((8, 12), (4, 6), (4, 6))
    )
    if encoding.startswith("nv"):
        behind, code = (
            np.stack((first, second), axis=2).ravel(),
            getattr(cv2, f"COLOR_YUV2BGR_{encoding.upper()}"),
        )
    else:
        behind, code = np.concatenate((first.ravel(), second.ravel())), cv2.COLOR_YUV2BGR_I420
    planes = np.concatenate((grey.ravel(), behind))
    raw = decode_image(image_cdr(Coded(encoding, 12, 8, False, 12, planes.tobytes())))
    assert np.array_equal(raw.pixels, cv2.cvtColor(planes.reshape(12, 12), code))


def test_compressed_messages_of_rclpy_are_read() -> None:
    """ROS and these tests make the same CompressedImage."""
    message = stamped(CompressedImage(format="jpeg", data=JPEG))
    assert deserialize_message(compressed_cdr(JPEG), CompressedImage) == message
    assert compressed_file(serialize_message(message)) == ("jpeg", JPEG, "", (0.0, 0.0))


@pytest.mark.parametrize("file", [JPEG, PNG])
def test_padding_behind_a_file_is_cut_off(file: bytes) -> None:
    """Some drivers send their whole buffer; the relay accepts no bytes after the end."""
    assert compressed_file(compressed_cdr(file + bytes(500)))[1] == file


@pytest.mark.parametrize(
    ("file", "words"),
    [
        (JPEG[:-2], "JPEG is cut off"),
        (PNG[:-12], "PNG is cut off"),
        (b"<html></html>", "no JPEG, PNG or WebP"),
        (b"", "no JPEG, PNG or WebP"),
    ],
)
def test_truncated_file_is_refused(file: bytes, words: str) -> None:
    """The relay would end the stream."""
    with pytest.raises(Invalid, match=words):
        compressed_file(compressed_cdr(file))


def shown(file: bytes, format_: str) -> RawImage:
    """The image that viewers get of a CompressedImage."""
    cdr = compressed_cdr(file, format_)
    raw = decode_compressed(compressed_file(cdr))
    assert message_format(cdr, True) == (raw.encoding, raw.width, raw.height)
    return raw


@pytest.mark.parametrize("format_", [each for each in depth_files() if each.startswith("16UC1")])
def test_depth_in_a_png_has_the_colours_of_the_raw_topic(format_: str) -> None:
    """For any plugin of image_transport; the reported encoding is the original one."""
    raw = shown(depth_files()[format_], format_)
    assert raw.encoding == "16UC1"
    assert np.array_equal(raw.pixels, decode_image(image_cdr(coded("16UC1"))).pixels)


def test_depth_that_was_quantised_by_its_inverse_has_the_colours_of_its_metres() -> None:
    """With the remaining resolution: steps of 6 cm at 16 m; unmeasured pixels stay black."""
    format_ = "32FC1; compressedDepth png"
    raw = shown(depth_files()[format_], format_)
    values = quantised(depths())
    assert set(np.unique(values[-60:])) == {0}
    metres = np.where(values > 0, INVERSE[0] / (np.maximum(values, 1) - INVERSE[1]), np.nan)
    left = Coded("32FC1", 320, 240, False, 4 * 320, metres.astype("<f4").tobytes())
    assert raw.encoding == "32FC1"
    assert np.abs(raw.pixels.astype(int) - decode_image(image_cdr(left)).pixels).max() <= 3
    assert not raw.pixels[-60:].any()


@pytest.mark.parametrize("scale", [(0.0, 0.0), (-5.0, 0.0), (3e38, -3e38), (1e-38, 65535.0), (1.0, 3e38)])
def test_scale_that_makes_no_sense_shows_nothing_worse_than_an_image(scale: tuple[float, float]) -> None:
    """Without overflow; invalid distances are black."""
    raw = shown(depth_head(*scale) + png_of(quantised(depths(12, 8))), "32FC1; compressedDepth png")
    assert raw.pixels.shape == (8, 12, 3)


def test_mono16_in_a_png_is_as_grey_as_on_the_raw_topic() -> None:
    """Rounded by 255 / 65535, not cut to the upper eight bits."""
    values = np.array([[0, 128, 129, 257, 4095, 65535]], np.uint16)
    for format_, head in (("mono16; png compressed ", b""), ("mono16; compressedDepth png", depth_head())):
        raw = shown(head + png_of(values), format_)
        assert (raw.encoding, raw.pixels.tolist()) == ("mono16", [[0, 0, 1, 1, 16, 255]])


@pytest.mark.parametrize("format_", ["png", "", "bgr16; png compressed bgr16", "rgb8; png compressed bgr8"])
def test_sixteen_bits_not_called_depth_are_grey(format_: str) -> None:
    """Larger values are brighter; the file's kind is reported."""
    raw = shown(png_of(np.full((4, 6), 0x8000, np.uint16)), format_)
    assert (raw.encoding, raw.pixels.tolist()) == ("png", np.full((4, 6), 128).tolist())


@pytest.mark.parametrize("file", [JPEG, PNG])
def test_eight_bit_depth_image_is_shown_unscaled(file: bytes) -> None:
    """The file's own type counts."""
    raw = shown(file, "16UC1; jpeg compressed ")
    assert np.array_equal(raw.pixels, decode_file(file).pixels)


@pytest.mark.parametrize(
    ("file", "format_", "words"),
    [
        (bytes(400), "16UC1; compressedDepth rvl", "RVL.*format of its publisher to png.*raw depth"),
        (png_of(quantised(depths(4, 4))), "bgr8; compressedDepth png", "'bgr8'.*16UC1, mono16, 32FC1"),
        (JPEG, "16UC1; compressedDepth png", "only be shown if its file is PNG"),
        (PNG, "16UC1; compressedDepth png", "16-bit grey"),
    ],
)
def test_depth_in_other_forms_is_refused_with_the_reason(file: bytes, format_: str, words: str) -> None:
    """At once, and with advice if there is any."""
    with pytest.raises(Invalid, match=words) as caught:
        compressed_file(compressed_cdr(depth_head() + file, format_))
    assert not isinstance(caught.value, DamagedImage)


DEPTH_PNG = png_of(quantised(depths(64, 48)))
INVERSE_CDR = compressed_cdr(depth_head(*INVERSE) + DEPTH_PNG, "32FC1; compressedDepth png")


@pytest.mark.parametrize(
    "cdr",
    [
        compressed_cdr(JPEG[:-2]),
        compressed_cdr(PNG[:-12], "png"),
        compressed_cdr(b"", "whatever"),
        compressed_cdr(b"\0" * 100 + JPEG, "rgb8; jpeg compressed bgr8"),
        compressed_cdr(PNG[:40] + b"\0" * 30 + PNG[70:]),
        compressed_cdr(b"\xff\xd8\xff\xdb" + bytes(60) + b"\xff\xd9"),
        compressed_cdr(depth_head(), "16UC1; compressedDepth png"),
        compressed_cdr(depth_head() + DEPTH_PNG[:-12], "16UC1; compressedDepth png"),
        compressed_cdr(
            depth_head() + DEPTH_PNG[:60] + bytes(20) + DEPTH_PNG[80:], "16UC1; compressedDepth png"
        ),
        compressed_cdr(depth_head(math.nan, 1.0) + DEPTH_PNG, "32FC1; compressedDepth png"),
        INVERSE_CDR[:-5],
    ],
)
def test_damaged_frames_differ_from_undecodable_ones(cdr: bytes) -> None:
    """A stream continues after a damaged one: the next frame may be valid."""
    with pytest.raises(DamagedImage):
        decode_compressed(compressed_file(cdr))


def test_image_that_ends_early_is_damaged() -> None:
    """Some drivers begin with such frames; an unknown encoding would be repeated."""
    with pytest.raises(DamagedImage):
        decode_image(image_cdr(small(data=small().data[:-1])))
    with pytest.raises(Invalid) as caught:
        decode_image(image_cdr(small(encoding="yuv999")))
    assert not isinstance(caught.value, DamagedImage)


@pytest.mark.parametrize("file", [JPEG, PNG])
def test_decoded_files_have_the_cards_colours(file: bytes) -> None:
    """B, G, R; JPEG nearly so."""
    raw = decode_file(file)
    for name, (red, green, blue) in PATCHES.items():
        assert raw.pixels[middle_of(name, 64, 48)].tolist() == pytest.approx([blue, green, red], abs=12), name


@pytest.mark.parametrize("ending", [".jpg", ".png"])
def test_decoded_grey_stays_grey(ending: str) -> None:
    """It needs a third of the bytes."""
    raw = decode_file(cv2.imencode(ending, grey_of(card(64, 48)))[1].tobytes())
    assert raw.pixels.shape == (48, 64)


def test_a_png_of_sixteen_bits_or_with_alpha_becomes_colour_of_eight() -> None:
    """An encoder's input, for any file."""
    deep = np.full((4, 6, 3), 0x8001, np.uint16)
    clear = np.full((4, 6, 4), 128, np.uint8)
    for each in (deep, clear):
        raw = decode_file(cv2.imencode(".png", each)[1].tobytes())
        assert raw.pixels.dtype == np.uint8
        assert raw.pixels.tolist() == np.full((4, 6, 3), 128).tolist()


@pytest.mark.parametrize(
    "parameters", [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 1)]
)
def test_jpeg_size_is_found_in_every_form(parameters: tuple[int, ...]) -> None:
    """Baseline, progressive, with restarts; with a comment and padding before its frame."""
    file = cv2.imencode(".jpg", card(64, 48), parameters)[1].tobytes()
    commented = file[:2] + b"\xff\xff\xfe" + struct.pack(">H", 60_002) + b"\xff\xc0" * 30_000 + file[2:]
    for each in (file, commented):
        assert message_format(compressed_cdr(each), True) == ("jpeg", 64, 48)
        assert decode_file(each).pixels.shape == (48, 64, 3)


def test_a_jpeg_that_hides_its_size_from_us_is_not_decoded() -> None:
    """A decoder skips invalid markers, and finds a frame header that our parser skipped inside a segment."""
    at = JPEG.index(b"\xff\xc0")
    behind = at + 2 + int.from_bytes(JPEG[at + 2 : at + 4], "big")
    frame = JPEG[at:behind]
    large = frame[:5] + struct.pack(">HH", 8000, 8000) + frame[9:]
    hidden = (
        b"\xff\x00"
        + struct.pack(">H", len(large) + 6)
        + large
        + b"\xff\xfe"
        + struct.pack(">H", len(frame) + 2)
    )
    with pytest.raises(Invalid, match="has no size"):
        decode_file(JPEG[:at] + hidden + frame + JPEG[behind:])


@pytest.mark.parametrize("filling", [b"\xff\xff", b"\xff\xd0", b"\xff\xfe\x00\x02"])
def test_a_jpeg_of_nothing_but_markers_is_discarded_soon(filling: bytes) -> None:
    """For any length."""
    with pytest.raises(Invalid, match="has no size"):
        message_format(compressed_cdr(b"\xff\xd8" + filling * 5_000 + JPEG[2:]), True)


def test_a_file_that_would_unfold_to_gigabytes_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The size in its header is checked first."""
    monkeypatch.delattr(cv2, "imdecode")
    side = math.isqrt(MAX_PIXELS) + 1
    bomb = PNG[:16] + struct.pack(">II", side, side) + PNG[24:]
    with pytest.raises(Invalid, match="too large to be decoded"):
        decode_file(bomb)
    deep = DEPTH_PNG[:16] + struct.pack(">II", side, side) + DEPTH_PNG[24:]
    for format_, head in (("16UC1; png compressed ", b""), ("32FC1; compressedDepth png", depth_head(1, 0))):
        with pytest.raises(Invalid, match="too large to be decoded"):
            decode_compressed(compressed_file(compressed_cdr(head + deep, format_)))
    huge = PNG[:16] + struct.pack(">II", 2**31, 2**31) + PNG[24:]
    with pytest.raises(Invalid, match="each side may have"):
        message_format(compressed_cdr(huge), True)


def test_a_broken_body_is_invalid() -> None:
    """OpenCV returns nothing for it."""
    with pytest.raises(Invalid, match="PNG is broken"):
        decode_file(PNG[:40] + b"\0" * 30 + PNG[70:])


def test_looking_touches_no_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras without viewers are inspected regularly; an unknown encoding is reported too."""
    monkeypatch.delattr(formats, "cv2")
    assert message_format(image_cdr(small("16UC1")), False) == ("16UC1", 12, 8)
    assert message_format(image_cdr(small(encoding="yuv999")), False) == ("yuv999", 12, 8)
    assert message_format(compressed_cdr(JPEG), True) == ("jpeg", 64, 48)
