"""Cameras without ROS, by OpenCV: what the kernel has, what streams over the network, files."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable

import cv2
import numpy as np

from robot_client.camera.formats import Pixels

V4L2 = "v4l2:"
RETRY = (0.5, 5.0)
"""Seconds until it is opened again, growing."""

_CREDENTIALS = re.compile("//.*@")
"""What stands before the host in an address."""

_BUFFERED = 1
"""Pictures the driver may keep: older ones are of no use."""


class Capture:
    """Reads one camera in a thread of its own, for ever; opened again when it fails or a file is at its end.

    :param source: ``v4l2:/dev/video0``, an address such as ``rtsp://…``, or the path of a file
    :param on_picture: called with each picture, in the thread
    :param on_trouble: called with a sentence when it can't be read, in the thread; once until it can again
    """

    def __init__(
        self, source: str, on_picture: Callable[[Pixels], None], on_trouble: Callable[[str], None]
    ) -> None:
        self._source = source
        self._on_picture = on_picture
        self._on_trouble = on_trouble
        self._closed = threading.Event()
        # A read from a network that is gone may take half a minute: nobody waits for this thread.
        threading.Thread(target=self._run, name="capture", daemon=True).start()

    def close(self) -> None:
        """Read no more."""
        self._closed.set()

    def _run(self) -> None:
        least, most = RETRY
        failures = 0
        while not self._closed.is_set():
            if self._read_to_the_end():
                failures = 0
                continue
            if failures == 0:
                # Who may read the log may not know the camera's password.
                shown = _CREDENTIALS.sub("//…@", self._source)
                self._on_trouble(f"the camera {shown} can't be read; it is tried again")
            self._closed.wait(min(most, least * 2 ** min(failures, 16)))
            failures += 1

    def _read_to_the_end(self) -> bool:
        """Whether there was any picture."""
        capture = self._opened()
        any_picture = False
        pause = self._pause(capture)
        try:
            while not self._closed.is_set():
                done, pixels = capture.read()
                if not done:
                    return any_picture
                any_picture = True
                self._on_picture(np.asarray(pixels, np.uint8))
                if pause:
                    self._closed.wait(pause)
        finally:
            capture.release()
        return any_picture

    def _opened(self) -> cv2.VideoCapture:
        if self._source.startswith(V4L2):
            capture = cv2.VideoCapture(self._source[len(V4L2) :], cv2.CAP_V4L2)
        else:
            capture = cv2.VideoCapture(self._source)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, _BUFFERED)
        return capture

    def _pause(self, capture: cv2.VideoCapture) -> float:
        """Seconds between pictures of a file, which would come as fast as they can be read."""
        if "://" in self._source or self._source.startswith(V4L2):
            return 0.0
        fps = capture.get(cv2.CAP_PROP_FPS)
        return 1.0 / fps if 0 < fps < 1000 else 0.04
