"""Camera clients: by request, by MJPEG, by websocket."""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from email.parser import BytesParser
from typing import Any, NamedTuple
from urllib.parse import urlencode

import cv2
import numpy as np
from websockets.sync.client import connect

from tests.worlds.http_requests import Answer, ask
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import PATIENCE, wait_for

CAMERA = "/camera/image_raw"
"""Of the simulated robot."""


def path(what: str, robot: str = "rover", **parameters: Any) -> str:
    """An address below a robot's ``video``."""
    return f"/robots/{robot}/video/{what}?{urlencode({'topic': CAMERA, **parameters})}"


def get(relay: Relay, token: str, what: str, robot: str = "rover", **parameters: Any) -> Answer:
    """Sends a request."""
    return ask(relay.http_port, "GET", path(what, robot, **parameters), token=token)


def streams(relay: Relay, token: str, robot: str = "rover") -> list[dict[str, Any]]:
    """The camera's present streams."""
    cameras = get(relay, token, "cameras", robot).json["cameras"]
    return next((each["streams"] for each in cameras if each["name"] == CAMERA), [])


def known(relay: Relay, token: str, robot: str = "rover") -> None:
    """Waits until the relay knows the robot's camera."""

    def there() -> bool:
        cameras = get(relay, token, "cameras", robot).json["cameras"]
        return any(each["name"] == CAMERA for each in cameras)

    wait_for("the camera is known", there)


def decoded(picture: bytes) -> Any:
    """Its pixels, height × width × 3."""
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    return pixels


class Part(NamedTuple):
    """One part of a multipart answer."""

    headers: Any
    body: bytes


class Mjpeg:
    """A viewer of ``…/video/stream``, which finds the parts by their boundary as in RFC 2046."""

    def __init__(self, relay: Relay, token: str, robot: str = "rover", **parameters: Any) -> None:
        self.seen = 0
        """Parts so far."""
        self._connection = http.client.HTTPConnection("127.0.0.1", relay.http_port, timeout=PATIENCE)
        headers = {"Authorization": f"Bearer {token}"}
        self._connection.request("GET", path("stream", robot, **parameters), headers=headers)
        self.answer = self._connection.getresponse()
        boundary = re.fullmatch(
            r"multipart/x-mixed-replace; *boundary=(\S+)", self.answer.headers["Content-Type"]
        )
        assert self.answer.status == 200
        assert boundary
        self._delimiter = b"--" + boundary[1].encode()
        self._bytes = b""

    def part(self) -> Part | None:
        """The next part; ``None`` at the end, which may be a reset."""
        while True:
            before, delimiter, rest = self._bytes.partition(self._delimiter)
            if delimiter:
                self._bytes = rest
                head, _, body = before.removeprefix(b"\r\n").partition(b"\r\n\r\n")
                if head:
                    self.seen += 1
                    return Part(BytesParser().parsebytes(head), body.removesuffix(b"\r\n"))
                continue
            try:
                data = self.answer.read1(1 << 18)
            except ConnectionResetError:
                return None
            if not data:
                return None
            self._bytes += data

    def close(self) -> None:
        self.answer.close()
        self._connection.close()


class MjpegViewers(contextlib.ExitStack):
    """Many MJPEG viewers, each read by a thread."""

    def __init__(self, relay: Relay, token: str, count: int, robot: str = "rover", **parameters: Any) -> None:
        super().__init__()
        self._pool = ThreadPoolExecutor(count)
        self._left = threading.Event()
        self.viewers = [Mjpeg(relay, token, robot, **parameters) for _ in range(count)]
        self.callback(self._pool.shutdown)
        self.callback(self._left.set)
        for each in self.viewers:
            self._pool.submit(self._read, each)

    def _read(self, viewer: Mjpeg) -> None:
        with contextlib.closing(viewer):
            while not self._left.is_set() and viewer.part() is not None:
                pass

    def rates(self, seconds: float) -> list[float]:
        """Frames per second of each from now on."""
        before, began = [each.seen for each in self.viewers], time.monotonic()
        self._left.wait(seconds)
        passed = time.monotonic() - began
        return [(each.seen - seen) / passed for each, seen in zip(self.viewers, before, strict=True)]


class Shown(NamedTuple):
    """A frame received by the websocket, and its age then."""

    head: dict[str, Any]
    body: bytes
    delay_ms: float


class VideoViewer:
    """A viewer by ``…/video/ws``."""

    def __init__(self, relay: Relay, token: str, robot: str = "rover", **parameters: Any) -> None:
        self.playing: dict[str, Any] = {}
        """The latest word of how it is made."""
        self._stack = contextlib.ExitStack()
        connecting = connect(
            f"ws://127.0.0.1:{relay.http_port}{path('ws', robot, **parameters)}",
            additional_headers={"Authorization": f"Bearer {token}"},
            open_timeout=PATIENCE,
            close_timeout=1,
        )
        self.connection = self._stack.enter_context(connecting)

    def __enter__(self) -> VideoViewer:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def untaken(self, seconds: float = PATIENCE) -> Shown:
        """The next frame, without an acknowledgement."""
        while True:
            message = json.loads(self.connection.recv(timeout=seconds))
            if message["op"] == "stream_status":
                self.playing = message
                continue
            assert message["op"] == "frame"
            body = self.connection.recv(timeout=seconds)
            assert isinstance(body, bytes)
            assert len(body) == message["size"]
            return Shown(message, body, (time.time() - message["stamp"]) * 1000)

    def took(self, shown: Shown) -> None:
        """Acknowledges, so that the next one is sent."""
        self.connection.send(json.dumps({"op": "frame_ack", "number": shown.head["number"]}))

    def picture(self, seconds: float = PATIENCE) -> Shown:
        """The next frame, with its acknowledgement."""
        shown = self.untaken(seconds)
        self.took(shown)
        return shown

    def watch(self, seconds: float) -> list[Shown]:
        """All frames in this time."""
        until = time.monotonic() + seconds
        shown = []
        while time.monotonic() < until:
            shown.append(self.picture())
        return shown

    def watch_until(self, what: str, condition: Callable[[Shown], bool], seconds: float) -> Shown:
        """Reads frames until one fits."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            shown = self.picture()
            if condition(shown):
                return shown
        raise AssertionError(f"not within {seconds:g} s: {what}; playing {self.playing}")
