"""Cameras without ROS, by OpenCV: what the kernel has, what streams over the network, files."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import cv2
import numpy as np

from robot_client.camera.device import V4L2, CameraDevice, read_device
from robot_client.camera.formats import Pixels

_FILE = "file://"

RETRY = (0.5, 5.0)
"""Seconds until it is opened again, growing."""

STEADY = 10.0
"""Seconds of pictures after which the next failure is the first again."""

SILENCE = 10.0
"""Seconds without an answer or a picture after which an address counts as dead; a camera may send a whole picture, with
which all decoding begins, only every few seconds."""

_BUFFERED = 1
"""Pictures the driver may keep: older ones are of no use."""

_THREADS = 1
"""That decode a film from the network: with each one more, pictures come one picture later."""

_CATCH_UP = 1.0
"""Seconds for passing over what came while it was found out what comes: seconds of pictures, all at once."""

Tell = Callable[[str, str], None]
"""Told a level, as in :class:`~robot_client.camera.ipc.LogLine`, and a sentence that goes on from the camera's name."""


class _Backlog:
    """Pictures that came while it was found out what comes: seconds of them, which are given at once.

    :param began: when the first is asked for, seconds
    """

    def __init__(self, began: float) -> None:
        self._began = self._given = began
        self._taken: float | None = None

    def holds(self, given: float, taken: float) -> bool:
        """Whether a picture belongs to it: such are given faster than they were taken.

        :param given: when it was given, seconds
        :param taken: when it was taken, seconds of the camera's own time
        """
        earlier, self._given = self._given, given
        before, self._taken = self._taken, taken
        if given - self._began >= _CATCH_UP:
            return False
        # The first two are of one time: OpenCV has taken the first for itself.
        return before is None or taken <= before or given - earlier < (taken - before) / 2


class Capture:
    """Reads one camera in a thread of its own, for ever; opened again when it fails or a file is at its end.

    Nothing it tells holds the address of a camera: passwords may stand anywhere in it.

    :param source: ``v4l2:/dev/video0`` (see :func:`~robot_client.camera.device.read_device`), an address such as
        ``rtsp://…``, the path of a file or its ``file://…``
    :param on_picture: called with each picture, in the thread
    :param tell: called when it can't be read, and when it can again, in the thread; once each
    :param silence: see :data:`SILENCE`, seconds
    :raises Invalid: what is asked of a device can't be
    """

    latched = False
    """See :class:`~robot_client.camera.latest_frame.Origin`."""

    def __init__(
        self,
        source: str,
        on_picture: Callable[[Pixels], None],
        tell: Tell,
        silence: float = SILENCE,
    ) -> None:
        if source.startswith(_FILE):
            source = url2pathname(urlsplit(source).path)
        self._source = source
        self._device = read_device(source) if source.startswith(V4L2) else None
        self._is_file = source.startswith("/")
        self._on_picture = on_picture
        self._tell = tell
        self._silence = silence
        self._troubled = False
        self._failures = 0
        self._closed = threading.Event()
        # Opening and reading may take as long as the silence that is borne: nobody waits for this thread.
        threading.Thread(target=self._run, name="capture", daemon=True).start()

    def close(self) -> None:
        """Read no more."""
        self._closed.set()

    def _run(self) -> None:
        least, most = RETRY
        while not self._closed.is_set():
            trouble = self._show()
            if not trouble or self._closed.is_set():
                continue
            if not self._troubled:
                self._troubled = True
                self._tell("warn", f"{trouble}; it is tried again")
            self._closed.wait(min(most, least * 2 ** min(self._failures, 16)))
            self._failures += 1

    def _show(self) -> str:
        """Show pictures as long as there are any.

        :returns: why there are no more; empty at the end of a file
        """
        capture = self._opened()
        try:
            if not capture.isOpened():
                return self._why_closed()
            pause = self._pause(capture)
            backlog = None if self._device or self._is_file else _Backlog(time.monotonic())
            first: float | None = None
            while not self._closed.is_set():
                asked, there, now = time.monotonic(), capture.grab(), time.monotonic()
                # After waiting in vain for so long OpenCV still gives what it has kept back: nothing new.
                there = there and now - asked < self._silence
                if there and backlog is not None:
                    if backlog.holds(now, capture.get(cv2.CAP_PROP_POS_MSEC) / 1000):
                        continue
                    backlog = None
                shown, pixels = capture.retrieve() if there else (False, None)
                if not shown:
                    return "" if self._is_file and first is not None else "gives no pictures"
                first = now if first is None else first
                if now - first >= STEADY:
                    self._failures = 0
                if self._troubled:
                    self._troubled = False
                    self._tell("info", "gives pictures again")
                self._on_picture(np.asarray(pixels, np.uint8))
                if pause:
                    self._closed.wait(pause)
            return ""
        finally:
            capture.release()

    def _opened(self) -> cv2.VideoCapture:
        if self._is_file:
            return cv2.VideoCapture(self._source)
        if self._device:
            capture = cv2.VideoCapture(self._device.path, cv2.CAP_V4L2)
            _set(capture, self._device)
            return capture
        patience = round(1000 * self._silence)
        # By this alone: all others would be tried after it, which read no addresses but may log them.
        return cv2.VideoCapture(
            self._source,
            cv2.CAP_FFMPEG,
            [
                cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                patience,
                cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                patience,
                cv2.CAP_PROP_N_THREADS,
                _THREADS,
            ],
        )

    def _why_closed(self) -> str:
        """Why it could not be opened, as far as can be told."""
        path = self._device.path if self._device else self._source
        if not self._device and not self._is_file:
            return "can't be reached, or is no film, or wants another password"
        if not Path(path).exists():
            return f"can't be opened: there is no {path}"
        if not os.access(path, os.R_OK | os.W_OK if self._device else os.R_OK):
            return f"can't be opened: this user may not open {path}"
        if not self._device:
            return f"can't be opened: {path} is no film"
        if not Path(path).is_char_device():
            return f"can't be opened: {path} is no device"
        return f"can't be opened: {path} gives no pictures, or to another program at present"

    def _pause(self, capture: cv2.VideoCapture) -> float:
        """Seconds between pictures of a file, which would come as fast as they can be read."""
        if not self._is_file:
            return 0.0
        fps = capture.get(cv2.CAP_PROP_FPS)
        return 1.0 / fps if 0 < fps < 1000 else 0.04


def _set(capture: cv2.VideoCapture, device: CameraDevice) -> None:
    """Ask a driver for what is wanted of it; one that can't do that goes on as near to it as it can."""
    # The format first: which sizes and rates there are depends on it.
    if device.format:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*device.format))
    if device.width:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, device.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, device.height)
    if device.fps:
        capture.set(cv2.CAP_PROP_FPS, device.fps)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, _BUFFERED)
