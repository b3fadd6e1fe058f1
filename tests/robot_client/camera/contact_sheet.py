"""Draws one PNG with a still of every encoding as a viewer gets it, to be looked at.

    python -m tests.robot_client.camera.contact_sheet build/stills.png

``make stills`` does just that.

Bars: white, yellow, cyan, green, magenta, red, blue, grey, over a ramp. Depth: red to blue over black, in every form.
"""

from __future__ import annotations

import sys
from pathlib import Path

import av
import cv2
import numpy as np

from relay_protocol.link import VideoSettings
from robot_client.camera.encoder import JpegEncoder, PngEncoder, build_encoder
from robot_client.camera.formats import (
    ENCODINGS,
    RawImage,
    compressed_file,
    decode_compressed,
    decode_file,
    decode_image,
)
from robot_client.camera.transforms import plan_transforms
from tests.worlds.image_cards import Pixels, card, coded, compressed_cdr, depth_files, image_cdr

WIDTH, HEIGHT, COLUMNS, TITLE = 240, 180, 6, 24
NOON = 1_763_726_400.789


def stills() -> dict[str, Pixels]:
    """Titles and BGR images, each decoded from a viewer's JPEG."""
    shown = {}
    for encoding in ENCODINGS:
        for title, cdr in {
            encoding: image_cdr(coded(encoding, big_endian=False, padding=24)),
            f"{encoding}, big endian": image_cdr(coded(encoding, big_endian=True), order=">"),
        }.items():
            shown[title] = _edited(decode_image(cdr))
    for format_, file in depth_files().items():
        shown[format_.strip()] = _edited(decode_compressed(compressed_file(compressed_cdr(file, format_))))
    bgr = np.ascontiguousarray(card(WIDTH, HEIGHT)[:, :, ::-1])
    for kind, encoder in (("jpeg", JpegEncoder()), ("png", PngEncoder())):
        shown[f"{kind}, passed through"] = decode_file(
            compressed_file(compressed_cdr(encoder.encode(bgr, 80, True)[0]))[1]
        ).pixels
    webp = cv2.imencode(".webp", bgr, (cv2.IMWRITE_WEBP_QUALITY, 80))[1].tobytes()
    shown["webp"] = _edited(decode_compressed(compressed_file(compressed_cdr(webp, "webp"))))
    for title, changed in {
        "crop 80,60,80,60": {"crop": (80, 60, 80, 60)},
        "rotate 90": {"rotate": 90},
        "invert": {"invert": True},
        "80 wide, stamp": {"width": 80, "stamp": True},
        "1920 wide, stamp": {"width": 1920, "stamp": True},
    }.items():
        shown[title] = plan_transforms(VideoSettings(**changed), WIDTH, HEIGHT).apply(bgr, NOON)
    picture, _ = build_encoder("h264", WIDTH, HEIGHT, 15).encode(bgr, 80, True)
    shown["h264, key frame"] = h264_decoded([picture])[0]
    return shown


def _edited(raw: RawImage) -> Pixels:
    settings = VideoSettings(width=WIDTH, height=HEIGHT, stamp=True)
    edited = plan_transforms(settings, raw.width, raw.height).apply(raw.pixels, NOON)
    return decode_file(JpegEncoder().encode(edited, 80, True)[0]).pixels


def h264_decoded(pictures: list[bytes]) -> list[Pixels]:
    """BGR of each frame of a stream."""
    context = av.VideoCodecContext.create("h264", "r")
    frames = [frame for picture in pictures for frame in context.decode(av.Packet(picture))]
    return [frame.to_ndarray(format="bgr24") for frame in [*frames, *context.decode(None)]]


def sheet(shown: dict[str, Pixels]) -> Pixels:
    """All of them, side by side."""
    rows = -(-len(shown) // COLUMNS)
    canvas = np.full((rows * (HEIGHT + TITLE), COLUMNS * (WIDTH + 8), 3), 64, np.uint8)
    for place, (title, picture) in enumerate(shown.items()):
        top, left = place // COLUMNS * (HEIGHT + TITLE), place % COLUMNS * (WIDTH + 8)
        cv2.putText(
            canvas,
            title,
            (left + 2, top + 16),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.5,
            (255, 255, 255),
            1,
            cv2.LINE_AA,
        )
        scale = min(1, WIDTH / picture.shape[1], HEIGHT / picture.shape[0])
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        colour = small if small.ndim == 3 else cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
        canvas[top + TITLE : top + TITLE + small.shape[0], left : left + small.shape[1]] = colour
    return canvas


if __name__ == "__main__":
    Path(sys.argv[1]).write_bytes(PngEncoder().encode(sheet(stills()), 100, True)[0])
