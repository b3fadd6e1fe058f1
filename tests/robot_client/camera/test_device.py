"""What a device of the kernel is asked for, as settings write it."""

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
def test_what_is_asked_for_stands_behind_the_path(source: str, device: CameraDevice) -> None:
    """In any order; what is left out is the driver's to choose."""
    assert read_device(source) == device


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("width=0&height=720", "width has to be 1 to 8192 pixels, as a whole number; it is '0'"),
        ("width=8193&height=720", "width has to be 1 to 8192 pixels"),
        ("width=1280&height=-1", "height has to be 1 to 8192 pixels"),
        ("width=1280&height=", "height has to be 1 to 8192 pixels"),
        ("width=12e2&height=720", "it is '12e2'"),
        ("width=\N{ARABIC-INDIC DIGIT ONE}&height=720", "width has to be"),
        (f"width={'9' * 5000}&height=720", "width has to be"),
        ("fps=0", "fps has to be 1 to 240 pictures per second"),
        ("fps=241", "fps has to be 1 to 240 pictures per second"),
        ("fps=7.5", "as a whole number; it is '7.5'"),
        ("format=MJPEG", "four letters, such as MJPG or YUYV; it is 'MJPEG'"),
        ("format=", "four letters"),
        ("format=MJP%0a", "four letters"),
        ("format=MJP\N{LATIN CAPITAL LETTER G WITH BREVE}", "four letters"),
        ("width=1280", "set together"),
        ("height=720", "set together"),
        ("size=1280x720", "'size' can't be set; there are width, height, fps and format"),
        ("Width=1280&height=720", "'Width' can't be set"),
        ("fps=5&fps=30", "once"),
        ("fps", "can't be read; write v4l2:/dev/video0.width=1280"),
        ("fps=30&", "can't be read"),
    ],
)
def test_what_can_not_be_asked_for_is_refused_in_words(query: str, words: str) -> None:
    """With what there may be, before anything is opened."""
    with pytest.raises(Invalid, match=words):
        read_device(f"v4l2:/dev/video0?{query}")
