"""Requests to a kernel device, as written in settings."""

from __future__ import annotations

import pytest

from relay_protocol.errors import Invalid
from robot_client.camera.device import CameraDevice, read_device


@pytest.mark.parametrize(
    ("source", "device"),
    [
        ("v4l2:/dev/video0", CameraDevice("/dev/video0")),
        ("v4l2:/dev/video0?", CameraDevice("/dev/video0")),
        (
            "v4l2:/dev/video0?width=1280&height=720&fps=30&format=MJPG",
            CameraDevice("/dev/video0", 1280, 720, 30, "MJPG"),
        ),
        ("v4l2:/dev/video0?format=YUYV&height=8192&width=1", CameraDevice("/dev/video0", 1, 8192, 0, "YUYV")),
        ("v4l2:/dev/video0?fps=240", CameraDevice("/dev/video0", fps=240)),
        ("v4l2:/dev/video0?format=Y16%20", CameraDevice("/dev/video0", format="Y16 ")),
        (
            "v4l2:/dev/v4l/by-path/pci-0000:00:14.0-usb-0:1:1.0-video-index0?fps=1",
            CameraDevice("/dev/v4l/by-path/pci-0000:00:14.0-usb-0:1:1.0-video-index0", fps=1),
        ),
    ],
)
def test_query_follows_the_path(source: str, device: CameraDevice) -> None:
    """In any order; missing values are chosen by the driver."""
    assert read_device(source) == device


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("width=0&height=720", r"width must be a whole number from 1 to 8192 \(pixels\); it is '0'"),
        ("width=8193&height=720", "width must be a whole number from 1 to 8192"),
        ("width=1280&height=-1", "height must be a whole number from 1 to 8192"),
        ("width=1280&height=", "height must be a whole number from 1 to 8192"),
        ("width=12e2&height=720", "it is '12e2'"),
        ("width=\N{ARABIC-INDIC DIGIT ONE}&height=720", "width must be"),
        (f"width={'9' * 5000}&height=720", "width must be"),
        ("fps=0", "fps must be a whole number from 1 to 240"),
        ("fps=241", "fps must be a whole number from 1 to 240"),
        ("fps=7.5", "it is '7.5'"),
        ("format=MJPEG", "a FourCC such as MJPG or YUYV; it is 'MJPEG'"),
        ("format=", "FourCC"),
        ("format=MJP%0a", "FourCC"),
        ("format=MJP\N{LATIN CAPITAL LETTER G WITH BREVE}", "FourCC"),
        ("width=1280", "set both"),
        ("height=720", "set both"),
        ("size=1280x720", "'size' is not a setting; there are width, height, fps and format"),
        ("Width=1280&height=720", "'Width' is not a setting"),
        ("fps=5&fps=30", "once"),
        ("fps", "can't be read; write v4l2:/dev/video0.width=1280"),
        ("fps=30&", "can't be read"),
    ],
)
def test_unavailable_stream_is_refused_with_the_reason(query: str, words: str) -> None:
    """The error has the valid values; the device is not opened."""
    with pytest.raises(Invalid, match=words):
        read_device(f"v4l2:/dev/video0?{query}")
