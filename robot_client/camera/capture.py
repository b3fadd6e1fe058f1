"""Cameras without ROS, by OpenCV: V4L2 devices, network streams, files."""

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
"""Shortest and longest delay before it is opened again, seconds."""

STEADY = 10.0
"""Seconds of frames after which the delay starts over."""

TIMEOUT = 10.0
"""Seconds without a frame after which an address counts as dead. A camera may send key frames only every
few seconds."""

_DRIVER_BUFFERS = 1
"""Frames the driver may buffer; older ones have no use."""

_DECODER_THREADS = 1
"""Each further thread delays a network stream by one frame."""

_SKIP_SECONDS = 1.0
"""Longest time for skipping the frames that OpenCV buffered while it detected the format."""

OnLog = Callable[[str, str], None]
"""Takes a level, as in :class:`~robot_client.camera.ipc.LogLine`, and a text that follows the camera's
name."""


class _Backlog:
    """Frames that OpenCV buffered while it detected the format: seconds of them, returned faster than they
    were taken.

    :param began: when the first frame is requested, seconds
    """

    def __init__(self, began: float) -> None:
        self._began = self._returned = began
        self._taken: float | None = None

    def contains(self, returned: float, taken: float) -> bool:
        """Whether a frame belongs to the backlog.

        :param returned: when OpenCV returned it, seconds
        :param taken: when it was taken, seconds on the camera's clock
        """
        earlier, self._returned = self._returned, returned
        before, self._taken = self._taken, taken
        if returned - self._began >= _SKIP_SECONDS:
            return False
        # The first two have one time: OpenCV used the first to detect the format.
        return before is None or taken <= before or returned - earlier < (taken - before) / 2


class Capture:
    """Reads one camera in its own thread until :meth:`close`. It is opened again when it fails or a file
    ends.

    Log texts never contain the camera's address, since it may contain a password anywhere.

    :param source: ``v4l2:/dev/video0`` (see :func:`~robot_client.camera.device.read_device`), an address
        such as ``rtsp://…``, the path of a file or its ``file://…``
    :param on_frame: called with each frame, in the thread
    :param on_log: called in the thread once when reading fails, and once when it works again
    :param timeout: see :data:`TIMEOUT`, seconds
    :raises Invalid: the setting of a device is wrong
    """

    latched = False
    """See :class:`~robot_client.camera.frame.FrameSource`."""

    def __init__(
        self,
        source: str,
        on_frame: Callable[[Pixels], None],
        on_log: OnLog,
        timeout: float = TIMEOUT,
    ) -> None:
        if source.startswith(_FILE):
            source = url2pathname(urlsplit(source).path)
        self._source = source
        self._device = read_device(source) if source.startswith(V4L2) else None
        self._is_file = source.startswith("/")
        self._on_frame = on_frame
        self._on_log = on_log
        self._timeout = timeout
        self._failing = False
        self._failures = 0
        self._closed = threading.Event()
        # Opening and reading can block until the timeout: the thread is never joined.
        threading.Thread(target=self._run, name="capture", daemon=True).start()

    def close(self) -> None:
        """Stop reading; a frame may still follow."""
        self._closed.set()

    def _run(self) -> None:
        shortest, longest = RETRY
        while not self._closed.is_set():
            problem = self._read()
            if not problem or self._closed.is_set():
                continue
            if not self._failing:
                self._failing = True
                self._on_log("warn", f"{problem}; trying again")
            self._closed.wait(min(longest, shortest * 2 ** min(self._failures, 16)))
            self._failures += 1

    def _read(self) -> str:
        """Pass frames on until there are no more.

        :returns: why there are no more; empty at the end of a file or after :meth:`close`
        """
        capture = self._open()
        try:
            if not capture.isOpened():
                return self._why_closed()
            pause = self._pause(capture)
            backlog = None if self._device or self._is_file else _Backlog(time.monotonic())
            first: float | None = None
            while not self._closed.is_set():
                requested, grabbed, now = time.monotonic(), capture.grab(), time.monotonic()
                # After a timeout OpenCV still returns buffered frames, which are old.
                grabbed = grabbed and now - requested < self._timeout
                if grabbed and backlog is not None:
                    if backlog.contains(now, capture.get(cv2.CAP_PROP_POS_MSEC) / 1000):
                        continue
                    backlog = None
                retrieved, pixels = capture.retrieve() if grabbed else (False, None)
                if not retrieved:
                    return "" if self._is_file and first is not None else "delivers no frames"
                first = now if first is None else first
                if now - first >= STEADY:
                    self._failures = 0
                if self._failing:
                    self._failing = False
                    self._on_log("info", "delivers frames again")
                self._on_frame(np.asarray(pixels, np.uint8))
                if pause:
                    self._closed.wait(pause)
            return ""
        finally:
            capture.release()

    def _open(self) -> cv2.VideoCapture:
        if self._is_file:
            return cv2.VideoCapture(self._source)
        if self._device:
            capture = cv2.VideoCapture(self._device.path, cv2.CAP_V4L2)
            _configure(capture, self._device)
            return capture
        timeout_ms = round(1000 * self._timeout)
        # FFmpeg alone: OpenCV would try other backends after it, which may log the address.
        return cv2.VideoCapture(
            self._source,
            cv2.CAP_FFMPEG,
            [
                cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                timeout_ms,
                cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                timeout_ms,
                cv2.CAP_PROP_N_THREADS,
                _DECODER_THREADS,
            ],
        )

    def _why_closed(self) -> str:
        """Why it could not be opened, as far as known."""
        path = self._device.path if self._device else self._source
        if not self._device and not self._is_file:
            return "can't be reached, is not a video stream, or refuses the password"
        if not Path(path).exists():
            return f"can't be opened: there is no {path}"
        if not os.access(path, os.R_OK | os.W_OK if self._device else os.R_OK):
            return f"can't be opened: this user has no permission for {path}"
        if not self._device:
            return f"can't be opened: {path} is not a video file"
        if not Path(path).is_char_device():
            return f"can't be opened: {path} is not a device"
        return f"can't be opened: {path} delivers no frames, or is in use by another program"

    def _pause(self, capture: cv2.VideoCapture) -> float:
        """Seconds between frames of a file; 0 for other sources, which set the pace themselves."""
        if not self._is_file:
            return 0.0
        fps = capture.get(cv2.CAP_PROP_FPS)
        return 1.0 / fps if 0 < fps < 1000 else 0.04


def _configure(capture: cv2.VideoCapture, device: CameraDevice) -> None:
    """Request a format from the driver, which uses the nearest it has."""
    # The pixel format first: the available sizes and rates depend on it.
    if device.format:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*device.format))
    if device.width:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, device.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, device.height)
    if device.fps:
        capture.set(cv2.CAP_PROP_FPS, device.fps)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, _DRIVER_BUFFERS)
