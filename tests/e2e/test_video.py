"""Cameras from the simulated robot to those who watch: real relay, daemon, camera process and sockets."""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import socket
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from email.parser import BytesParser
from typing import Any, NamedTuple
from urllib.parse import urlencode

import cv2
import numpy as np
import pytest
from playwright.sync_api import expect
from switchboard_browser import chromium
from switchboard_http import Answer, ask
from switchboard_proxy import ChaosProxy
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_waiting import wait_for
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

CAMERA = "/camera/image_raw"
WAIT_SECONDS = 20.0
TARGET_MS = 300
"""The delay a robot keeps its pictures under."""


def path(what: str, robot: str = "rover", **parameters: Any) -> str:
    """An address below a robot's ``video``."""
    return f"/robots/{robot}/video/{what}?{urlencode({'topic': CAMERA, **parameters})}"


def get(relay: Relay, token: str, what: str, robot: str = "rover", **parameters: Any) -> Answer:
    """One request."""
    return ask(relay.http_port, "GET", path(what, robot, **parameters), token=token)


def url(relay: Relay, token: str, what: str, **parameters: Any) -> str:
    """What a program that knows neither headers nor cookies is given."""
    answer = ask(relay.http_port, "POST", "/api/v1/tickets", {"robot": "rover"}, token=token)
    return f"http://127.0.0.1:{relay.http_port}{path(what, **parameters, ticket=answer.json['ticket'])}"


def streams(relay: Relay, token: str, robot: str = "rover") -> list[dict[str, Any]]:
    """How the camera is shown now."""
    cameras = get(relay, token, "cameras", robot).json["cameras"]
    return next((each["streams"] for each in cameras if each["name"] == CAMERA), [])


def known(relay: Relay, token: str, robot: str = "rover") -> None:
    """Wait until the relay knows the robot's camera."""

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
    """A viewer of ``…/video/stream``, who finds the parts by their boundary as RFC 2046 has it."""

    def __init__(self, relay: Relay, token: str, robot: str = "rover", **parameters: Any) -> None:
        self.seen = 0
        """Parts so far."""
        self._connection = http.client.HTTPConnection("127.0.0.1", relay.http_port, timeout=WAIT_SECONDS)
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
        """The next; ``None`` at the end, which may be a reset."""
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
        """Leave."""
        self.answer.close()
        self._connection.close()


class Crowd(contextlib.ExitStack):
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
        """Pictures per second of each from now on."""
        before, began = [each.seen for each in self.viewers], time.monotonic()
        self._left.wait(seconds)
        passed = time.monotonic() - began
        return [(each.seen - seen) / passed for each, seen in zip(self.viewers, before, strict=True)]


class Shown(NamedTuple):
    """One picture that came by the websocket, and how old it was then."""

    head: dict[str, Any]
    body: bytes
    delay_ms: float


class Eye:
    """A viewer by ``…/video/ws``."""

    def __init__(self, relay: Relay, token: str, robot: str = "rover", **parameters: Any) -> None:
        self.playing: dict[str, Any] = {}
        """The latest word of how it is made."""
        self._stack = contextlib.ExitStack()
        connecting = connect(
            f"ws://127.0.0.1:{relay.http_port}{path('ws', robot, **parameters)}",
            additional_headers={"Authorization": f"Bearer {token}"},
            close_timeout=1,
        )
        self.connection = self._stack.enter_context(connecting)

    def __enter__(self) -> Eye:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def untaken(self, seconds: float = WAIT_SECONDS) -> Shown:
        """The next picture, which is not answered."""
        while True:
            message = json.loads(self.connection.recv(timeout=seconds))
            if message["op"] == "playing":
                self.playing = message
                continue
            assert message["op"] == "picture"
            body = self.connection.recv(timeout=seconds)
            assert isinstance(body, bytes)
            assert len(body) == message["size"]
            return Shown(message, body, (time.time() - message["stamp"]) * 1000)

    def took(self, shown: Shown) -> None:
        """Have the next one."""
        self.connection.send(json.dumps({"op": "took", "number": shown.head["number"]}))

    def picture(self, seconds: float = WAIT_SECONDS) -> Shown:
        """The next picture, and the word that it is here."""
        shown = self.untaken(seconds)
        self.took(shown)
        return shown

    def watch(self, seconds: float) -> list[Shown]:
        """All that comes in this time."""
        until = time.monotonic() + seconds
        shown = []
        while time.monotonic() < until:
            shown.append(self.picture())
        return shown

    def watch_until(self, what: str, condition: Callable[[Shown], bool], seconds: float) -> Shown:
        """Watch until a picture is as it should be."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            shown = self.picture()
            if condition(shown):
                return shown
        raise AssertionError(f"not within {seconds:g} s: {what}; playing {self.playing}")


def unread(relay: Relay, token: str, **parameters: Any) -> socket.socket:
    """A connection that has asked for the stream, whose reading is up to the test."""
    sock = socket.socket()
    # Little may wait here, so that the relay sees at once that nothing is taken.
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.settimeout(WAIT_SECONDS)
    sock.connect(("127.0.0.1", relay.http_port))
    asked = path("stream", **parameters)
    sock.sendall(f"GET {asked} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {token}\r\n\r\n".encode())
    return sock


@pytest.fixture(scope="module")
def shown(world: Any) -> Any:
    """The world, once the relay knows its camera."""
    known(world.relay, world.viewer)
    return world


class Thin(NamedTuple):
    """A robot whose uplink can be made thin."""

    relay: Relay
    robot: Robot
    proxy: ChaosProxy
    token: str


@pytest.fixture(scope="module")
def thin(world: Any) -> Iterator[Thin]:
    """Beside the others, at the same relay."""
    proxy = ChaosProxy(world.relay.robots_port)
    robot = Robot(world.relay, "thin", port=proxy.port, camera=True)
    try:
        world.relay.cli("right", "grant", "viewer", "thin", "viewer")
        yield Thin(world.relay, robot, proxy, world.viewer)
    finally:
        robot.stop()
        proxy.close()


def test_a_snapshot_has_the_size_that_was_asked_for(shown: Any) -> None:
    """JPEG or PNG, not kept by anybody, with the time it was taken."""
    for kind, start in (("mjpeg", b"\xff\xd8"), ("png", b"\x89PNG")):
        answer = get(shown.relay, shown.viewer, "snapshot", width=320, type=kind)
        assert answer.status == 200
        assert answer.headers["Content-Type"] == ("image/png" if kind == "png" else "image/jpeg")
        assert answer.headers["Cache-Control"] == "no-store"
        assert abs(time.time() - float(answer.headers["X-Timestamp"])) < WAIT_SECONDS
        assert answer.body.startswith(start)
        assert decoded(answer.body).shape == (240, 320, 3)


def test_edits_are_those_that_were_asked_for(shown: Any) -> None:
    """The upper left corner of a turned picture is the lower right one of the other, for a robot that stands."""
    whole, turned, cut = (
        decoded(get(shown.relay, shown.viewer, "snapshot", **edit).body).astype(int)
        for edit in ({}, {"invert": ""}, {"crop": "100,50,200,100"})
    )
    assert cut.shape == (100, 200, 3)
    assert np.abs(cut - whole[50:150, 100:300]).mean() < 6
    # Not the line with the clock.
    assert np.abs(turned[60:] - whole[::-1, ::-1][60:]).mean() < 6


def test_the_stream_has_one_jpeg_a_part(shown: Any) -> None:
    """Each as long as it says, each later than the one before, all of the size that was asked for."""
    with contextlib.closing(Mjpeg(shown.relay, shown.viewer, width=320)) as viewer:
        assert viewer.answer.headers["Cache-Control"] == "no-store"
        parts = [viewer.part() for _ in range(10)]
    stamps = []
    for part in parts:
        assert part is not None
        assert part.headers["Content-Type"] == "image/jpeg"
        assert int(part.headers["Content-Length"]) == len(part.body)
        assert decoded(part.body).shape == (240, 320, 3)
        stamps.append(float(part.headers["X-Timestamp"]))
    assert stamps == sorted(set(stamps))


def test_ffmpeg_reads_the_stream(shown: Any) -> None:
    """The one that comes with OpenCV, by a ticket in the address."""
    capture = cv2.VideoCapture(url(shown.relay, shown.viewer, "stream"), cv2.CAP_FFMPEG)
    try:
        assert capture.isOpened()
        for _ in range(5):
            there, picture = capture.read()
            assert there
            assert picture.shape == (480, 640, 3)
    finally:
        capture.release()


def test_a_browser_shows_the_stream(shown: Any) -> None:
    """An ``<img>`` on another site's page, by a ticket: its picture has the camera's size, and it moves."""
    with chromium() as browser:
        page = browser.new_page()
        page.set_content(f'<img src="{url(shown.relay, shown.viewer, "stream")}">')
        image = page.locator("img")
        expect(image).to_have_js_property("naturalWidth", 640, timeout=WAIT_SECONDS * 1000)
        expect(image).to_have_js_property("naturalHeight", 480)
        first = image.screenshot()
        wait_for("the clock in the picture goes on", lambda: image.screenshot() != first)


def test_the_websocket_waits_for_took(shown: Any) -> None:
    """No second picture before the first was taken; then the newest."""
    with Eye(shown.relay, shown.viewer) as eye:
        first = eye.untaken()
        assert first.head["codec"] == "jpeg"
        assert decoded(first.body).shape == (first.head["height"], first.head["width"], 3) == (480, 640, 3)
        with pytest.raises(TimeoutError):
            eye.untaken(1)
        eye.took(first)
        second = eye.picture()
        # Fifteen a second went by.
        assert second.head["number"] > first.head["number"] + 3
        assert second.head["stamp"] - first.head["stamp"] > 0.5


def test_h264_begins_with_a_key_frame_and_decodes(shown: Any) -> None:
    """Also for who comes later; fewer bytes than JPEG of the same size."""
    av = pytest.importorskip("av")
    with Eye(shown.relay, shown.viewer, codec="h264") as early:
        early.picture()
        with Eye(shown.relay, shown.viewer, codec="h264") as late:
            pictures = [late.picture() for _ in range(20)]
    assert pictures[0].head["key"]
    assert {each.head["codec"] for each in pictures} == {"h264"}
    decoder = av.CodecContext.create("h264", "r")
    frames = [frame for each in pictures for frame in decoder.decode(av.Packet(each.body))]
    frames += decoder.decode(None)
    assert len(frames) == len(pictures)
    assert {(frame.width, frame.height) for frame in frames} == {(640, 480)}
    with Eye(shown.relay, shown.viewer) as eye:
        jpeg = eye.picture()
    assert statistics.median(len(each.body) for each in pictures) < len(jpeg.body)


def code_of(relay: Relay, token: str) -> int:
    """How the websocket refuses somebody: the status of the handshake, or the close code."""
    try:
        with Eye(relay, token) as eye:
            eye.untaken()
    except InvalidStatus as error:
        return error.response.status_code
    except ConnectionClosed as error:
        assert error.rcvd
        return error.rcvd.code
    raise AssertionError("a picture came")


def test_who_may_not_view_gets_no_picture(shown: Any) -> None:
    """Nobody: 401; a stranger, or a camera that is denied: 404 as if it were not there; 403 in a handshake."""
    shown.relay.user("blinkered")
    shown.relay.cli("right", "grant", "blinkered", "rover", "viewer", "--deny", "view:/camera/**")
    blinkered = shown.relay.token("blinkered")
    for token, status, handshake in (("swb_x", 401, 401), (shown.stranger, 404, 403), (blinkered, 404, 403)):
        for what in ("stream", "snapshot"):
            assert get(shown.relay, token, what).status == status
        assert code_of(shown.relay, token) == handshake
    assert get(shown.relay, blinkered, "cameras").json["cameras"] == []


def test_a_revoked_right_ends_what_runs(shown: Any) -> None:
    """Stream and websocket, within a second of the command's end."""
    shown.relay.user("guest")
    guest = shown.relay.token("guest")
    shown.relay.cli("right", "grant", "guest", "rover", "viewer")

    def end_of(watch: Callable[[], Any]) -> float:
        with contextlib.suppress(ConnectionClosed):
            while watch() is not None:
                pass
        return time.monotonic()

    with (
        contextlib.closing(Mjpeg(shown.relay, guest)) as viewer,
        Eye(shown.relay, guest) as eye,
        ThreadPoolExecutor(2) as pool,
    ):
        assert viewer.part() is not None
        eye.picture()
        ends = [pool.submit(end_of, each) for each in (viewer.part, eye.picture)]
        shown.relay.cli("right", "revoke", "guest", "rover")
        revoked = time.monotonic()
        assert max(each.result(WAIT_SECONDS) for each in ends) < revoked + 1
    assert get(shown.relay, guest, "stream").status == 404


def test_ten_viewers_are_one_stream_which_ends_with_the_last(thin: Thin) -> None:
    """The robot makes it once for all, and two seconds after the last has left nothing is sent any more."""
    known(thin.relay, thin.token, "thin")
    with Crowd(thin.relay, thin.token, 9, "thin") as crowd, Eye(thin.relay, thin.token, "thin") as eye:
        eye.picture()
        wait_for("each has a picture", lambda: all(each.seen for each in crowd.viewers))
        (stream,) = streams(thin.relay, thin.token, "thin")
        assert stream["viewers"] == 10
        before, seen = thin.proxy.up, crowd.viewers[0].seen
        pictures = eye.watch(2)
        sizes = statistics.median(len(each.body) for each in pictures)
        # One after the other through one link: not more bytes than one stream has.
        assert thin.proxy.up - before < 1.5 * sizes * (crowd.viewers[0].seen - seen + 2)
    left = time.monotonic()
    wait_for("the stream is closed", lambda: not streams(thin.relay, thin.token, "thin"), 2)
    time.sleep(max(0.0, left + 2 - time.monotonic()))  # so long it may go on
    before = thin.proxy.up
    time.sleep(1)  # to see that nothing comes
    assert thin.proxy.up - before < sizes / 2


def test_slow_viewers_are_nothing_to_fast_ones(shown: Any) -> None:
    """One that stops reading is cut, one at 20 KB/s stays; ten others have as many pictures as without them."""
    relay, token = shown.relay, shown.viewer

    def watching(count: int) -> bool:
        return sum(each["viewers"] for each in streams(relay, token)) == count

    with contextlib.ExitStack() as stack:
        fast = stack.enter_context(Crowd(relay, token, 10, quality=50))
        wait_for("each has a picture", lambda: all(each.seen for each in fast.viewers))
        alone = statistics.median(fast.rates(3))
        stopped, slow = (stack.enter_context(unread(relay, token, quality=50)) for _ in range(2))
        sips: list[int] = []
        enough = threading.Event()

        def sip() -> None:
            while not enough.wait(0.1):
                sips.append(len(slow.recv(2000)))

        sipping = stack.enter_context(ThreadPoolExecutor(1)).submit(sip)
        stack.callback(enough.set)
        wait_for("both watch", lambda: watching(12))
        assert min(fast.rates(3)) > 0.8 * alone
        wait_for("the stopped one is cut", lambda: watching(11))
        assert min(fast.rates(2)) > 0.8 * alone
        assert watching(11)
        assert not sipping.done()
        assert all(sips)
        assert sum(sips) > 50_000
        with contextlib.suppress(ConnectionResetError):
            while stopped.recv(1 << 16):
                pass


@pytest.mark.parametrize("kilobits", [1000, 200])
def test_a_thin_uplink_makes_pictures_smaller_not_late(thin: Thin, kilobits: int) -> None:
    """After 5 s the delay is under the target; when the uplink is as before, so are the pictures."""
    known(thin.relay, thin.token, "thin")
    with Eye(thin.relay, thin.token, "thin") as eye:
        whole = eye.watch_until("pictures are as asked for", lambda _: eye.playing["reduced"] == 0, 30)
        thin.proxy.squeeze(kilobits * 1000)
        try:
            eye.watch(5)
            pictures = eye.watch(4)
            playing = eye.playing
        finally:
            thin.proxy.squeeze(None)
        delays = sorted(each.delay_ms for each in pictures)
        assert statistics.median(delays) < TARGET_MS, (delays, playing)
        assert playing["delay_ms"] < TARGET_MS, (delays, playing)
        assert playing["reduced"] > 0
        assert statistics.median(len(each.body) for each in pictures) < len(whole.body) / 2
        eye.watch_until("pictures are as before", lambda _: eye.playing["reduced"] == 0, 60)
        after = eye.picture()
        assert decoded(after.body).shape == (480, 640, 3)


def test_pictures_go_on_when_the_daemon_is_started_again(thin: Thin) -> None:
    """On the same websocket, by themselves."""
    known(thin.relay, thin.token, "thin")
    with Eye(thin.relay, thin.token, "thin") as eye:
        before = eye.picture()
        thin.robot.daemon.kill()
        thin.robot.start_daemon()
        again = eye.watch_until(
            "a picture taken after that", lambda each: each.head["stamp"] > before.head["stamp"] + 1, 30
        )
        assert decoded(again.body).shape == (480, 640, 3)
        assert len(eye.watch(1)) > 3
