"""Cameras: what 1, 10 and 50 viewers cost robot and relay, how old pictures are, what slow viewers do to fast ones.

Real relay, daemon and simulated robot, whose camera has 640×480 at 15 pictures a second, then 1280×720 at 30. How old a
picture is is read from the clock in it, when it has come and is decoded; in a browser ``bench/browser.py`` reads it.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from bench.cameras import CAMERAS, USERS, Camera, Clock, Scene, counts, glass_to_glass, scene
from bench.child import Child
from bench.cpu import measured
from bench.relay import Relay
from bench.report import Options, Row, Unavailable
from relay_protocol.image_check import validate
from tests.worlds.client_threads import Driver
from tests.worlds.processes import running
from tests.worlds.waiting import wait_for

VIEWERS = (1, 10, 50)
GROUP = 25
"""Viewers of one user, who may have 32 on a robot."""

SLOW_BYTES = 20_000
"""Per second."""

LATE_SECONDS = 0.7
"""After that a viewer of H.264 takes a picture who is too slow for it: what came meanwhile is too old by then."""

FAST = 3
"""Viewers of H.264 that keep up; this process reads for them."""


class Watched(Protocol):
    """What has a camera: a relay, users of it, and where its files go."""

    folder: Path
    relay: Relay
    tokens: list[str]

    def path(self, what: str) -> str:
        """An address below ``video``."""


class Viewers(Child):
    """``bench/mjpeg_viewers.py``, running: some who watch, all of one user.

    :param rate: bytes a second each reads; 0: all, -1: none
    """

    def __init__(self, at: Watched, count: int, rate: float = 0, user: int = 0) -> None:
        request = at.folder / f"request-{user}"
        who = f"Authorization: Bearer {at.tokens[user]}"
        head = f"GET {at.path('stream')} HTTP/1.1\r\nHost: relay\r\n{who}\r\n\r\n"
        request.write_text(head, newline="")
        numbers = [str(at.relay.http_port), str(count), str(request), str(rate)]
        command = [sys.executable, "-m", "bench.mjpeg_viewers", *numbers]
        super().__init__(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.ready(Unavailable("the viewers do not start; see above"))

    def all_see(self) -> None:
        """Wait until each has a picture."""
        wait_for("each viewer has a picture", lambda: not self.ask()["waiting"])


def groups(at: Scene, count: int) -> list[Viewers]:
    """Some who watch, of as many users as it takes, beside one more of the first user."""
    sizes = [min(GROUP, count - done) for done in range(0, count, GROUP)]
    return [Viewers(at, size, user=user) for user, size in enumerate(sizes)]


class Cost(NamedTuple):
    """Of one picture the robot sends.

    :param robot: processor time of daemon and camera process, microseconds
    :param uplink: bytes
    :param relay: processor time, microseconds per viewer
    :param fps: pictures per second of the slowest viewer
    """

    robot: float
    uplink: float
    relay: float
    fps: float


def cost(at: Scene, viewers: list[Viewers], count: int, seconds: float) -> Cost:
    """While they watch for a while.

    :param viewers: groups that watch
    :param count: how many they are together
    """
    relay, robot = at.relay.pid, at.robot.daemon.popen.pid
    for each in viewers:
        each.all_see()
    time.sleep(seconds / 4)  # nothing tells when what joining costs is over
    for each in viewers:
        each.ask()
    before, began = at.proxy.up, time.monotonic()
    shown = 0
    with measured(robot, children=True) as on_robot, measured(relay) as on_relay:
        while not shown:  # on a busy machine a short measurement may see no picture
            time.sleep(seconds)  # what is measured: the time they need while this one does nothing
            told = [each.ask() for each in viewers]
            shown = sum(each["pictures"] for each in told)
    up, passed = at.proxy.up - before, time.monotonic() - began
    made = shown / count
    least = min(each["least"] for each in told)
    return Cost(on_robot.seconds * 1e6 / made, up / made, on_relay.seconds * 1e6 / shown, least / passed)


def costs(at: Scene, options: Options) -> list[Row]:
    """Each number of viewers in turn; medians."""
    numbers = tuple(int(options.pick(few, many)) for few, many in zip((1, 2, 3), VIEWERS, strict=True))
    seconds, rounds = options.pick(0.2, 5), int(options.pick(1, 2))
    found: dict[int, list[Cost]] = {number: [] for number in numbers}
    # The first viewer stays, so that nothing is opened and closed on the robot between the rounds.
    with running(first := Viewers(at, 1)):
        for _ in range(rounds):
            for number in numbers:
                if number == 1:
                    found[number].append(cost(at, [first], number, seconds))
                    continue
                with running(*(others := groups(at, number - 1))):
                    found[number].append(cost(at, [first, *others], number, seconds))
    medians = {
        number: Cost(*(statistics.median(each) for each in zip(*several, strict=True)))
        for number, several in found.items()
    }
    return [row for number in numbers for row in rows_of(at.camera, number, medians[number], medians[1])]


def rows_of(camera: Camera, count: int, this: Cost, one: Cost) -> list[Row]:
    """What so many viewers cost, beside what one costs."""
    words = f"{camera.name}, {'one viewer' if count == 1 else f'{count} viewers'}"
    note = f"{words}: the slowest had {this.fps:.1f} pictures per second"
    if count == 1:
        note += f"; the robot needed {this.robot:.0f} µs and {this.uplink:.0f} bytes for each"
    rows = [Row("video", f"relay, per viewer and picture, {words}", "µs", this.relay, note=note)]
    if count > 1:
        for what, unit, ours, other in (
            ("processor time", "µs", this.robot, one.robot),
            ("uplink", "bytes", this.uplink, one.uplink),
        ):
            rows.append(
                Row("video", f"robot's {what} per picture, {words}", unit, ours, other, "one viewer", 1.1)
            )
    return rows


# --- from the clock in the picture to the one who looks -------------------------------------------------------


def by_multipart(at: Scene) -> Iterator[bytes]:
    """The pictures of the stream, as they come."""
    connection = http.client.HTTPConnection("127.0.0.1", at.relay.http_port, timeout=20)
    with contextlib.closing(connection):
        connection.request("GET", at.path("stream"), headers=at.headers)
        answer = connection.getresponse()
        while line := answer.readline():
            if line.lower().startswith(b"content-length:"):
                length = int(line.partition(b":")[2])
                while answer.readline() != b"\r\n":
                    pass
                yield answer.read(length)


def websocket(at: Scene, codec: str) -> ClientConnection:
    """One that shows the camera."""
    address = f"ws://127.0.0.1:{at.relay.http_port}{at.path('ws', f'&codec={codec}')}"
    return connect(address, additional_headers=at.headers, close_timeout=1)


def by_websocket(at: Scene, codec: str) -> Iterator[bytes]:
    """The pictures, each taken when the next is wanted."""
    with websocket(at, codec) as connection:
        while True:
            message = json.loads(connection.recv(timeout=20))
            if message["op"] == "frame":
                body = connection.recv(timeout=20)
                assert isinstance(body, bytes)
                connection.send(json.dumps({"op": "frame_ack", "number": message["number"]}))
                yield body


def jpeg(body: bytes) -> Any:
    """Pixels of a JPEG."""
    return cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)


def h264() -> Callable[[bytes], Any]:
    """What makes pixels of the pictures of a stream, one by one."""
    try:
        import av
    except ImportError:
        raise Unavailable("H.264 needs the extra 'video'") from None
    decoder: Any = av.CodecContext.create("h264", "r")
    # Else it keeps pictures back, for threads and for order.
    decoder.thread_type = "NONE"
    decoder.flags |= av.codec.context.Flags.low_delay

    def decode(body: bytes) -> Any:
        frames = decoder.decode(av.Packet(body))
        return frames[-1].to_ndarray(format="bgr24") if frames else None

    return decode


def ways(at: Scene, options: Options) -> list[Row]:
    """Three ways to look at the same camera."""
    first, count = counts(options)
    clock, rows = Clock(at.camera), []
    for way, pictures, decode in (
        ("MJPEG", by_multipart(at), jpeg),
        ("websocket, JPEG", by_websocket(at, "jpeg"), jpeg),
        ("websocket, H.264", by_websocket(at, "h264"), h264()),
    ):
        shown: list[tuple[Any, float]] = []
        sizes = []
        with contextlib.closing(pictures):
            for number, body in enumerate(pictures):
                picture = decode(body)
                if picture is not None and number >= first:
                    shown.append((clock.cut(picture).copy(), time.time()))
                    sizes.append(len(body))
                if len(shown) == count:
                    break
        ages = [clock.age_ms(picture, came) for picture, came in shown]
        note = f"{statistics.mean(sizes) / 1000:.1f} kB a picture, of a robot that stands"
        rows += glass_to_glass("video", f"{at.camera.name}, {way}", ages, note)
    return rows


def weight(at: Scene, options: Options) -> list[Row]:
    """Bytes of H.264 and of JPEG, of a robot that drives in circles."""
    count, sizes = int(options.pick(4, 150)), {}
    at.relay.cli("right", "grant", USERS[0], "rover", "operator")
    with at.relay.connect("rover", at.tokens[0]) as client:
        driver = Driver(client)
        driver.start()
        wait_for("the robot moves", at.robot.moving)
        for codec in ("jpeg", "h264"):
            with contextlib.closing(by_websocket(at, codec)) as pictures:
                sizes[codec] = statistics.mean(len(next(pictures)) for _ in range(count))
        driver.stop()
    what = f"H.264, bytes of a picture, {at.camera.name}, of a robot that drives in circles"
    return [Row("video", what, "bytes", sizes["h264"], sizes["jpeg"], "JPEG of quality 80", 1 / 3)]


def mixed(at: Scene, options: Options) -> list[Row]:
    """Ten fast ones by themselves, then beside one at 20 KB/s and one that has stopped."""
    seconds = options.pick(0.3, 10)
    with running(fast := Viewers(at, 10)):
        fast.all_see()

        def between() -> float:
            fast.ask()
            began = time.monotonic()
            time.sleep(seconds)  # what is measured: how much comes in this time
            return (time.monotonic() - began) * 1000 / max(1, fast.ask()["least"])

        alone = between()
        with running(slow := Viewers(at, 1, SLOW_BYTES), Viewers(at, 1, -1)):
            beside = between()
            got = slow.ask()["bytes"]
    what = f"{at.camera.name}, ten fast viewers beside a slow and a stopped one: time between two pictures"
    note = f"{at.camera.name}: the slow one had {got / seconds / 1000:.0f} KB/s"
    return [Row("video", what, "ms", beside, alone, "by themselves", 1.1, note=note)]


class Looker:
    """A viewer of H.264, read by a thread: what has come since the count was set back.

    :param late: seconds after which it takes a picture
    """

    def __init__(self, at: Scene, late: float = 0) -> None:
        self._at = at
        self._late = late
        self._left = threading.Event()
        self.pictures = self.keys = self.bytes = 0

    def look(self) -> None:
        """Until it leaves."""
        with contextlib.closing(by_websocket(self._at, "h264")) as pictures:
            for body in pictures:
                self.pictures += 1
                self.bytes += len(body)
                self.keys += validate("h264", body).key
                if self._left.wait(self._late):
                    return

    def leave(self) -> None:
        """No more after the next picture."""
        self._left.set()

    def anew(self) -> None:
        """Count from here."""
        self.pictures = self.keys = self.bytes = 0


def mixed_h264(at: Scene, options: Options) -> list[Row]:
    """Some that keep up by themselves, then beside one that takes each picture late and one that takes none."""
    seconds = options.pick(1, 20)
    fast, slow = [Looker(at) for _ in range(FAST)], Looker(at, LATE_SECONDS)

    def watched() -> tuple[float, Looker]:
        """Milliseconds between two pictures of the one that has the fewest, and that one."""
        for each in (*fast, slow):
            each.anew()
        began = time.monotonic()
        time.sleep(seconds)  # what is measured: how much comes in this time
        least = min(fast, key=lambda each: each.pictures)
        return (time.monotonic() - began) * 1000 / max(1, least.pictures), least

    with ThreadPoolExecutor(FAST + 1) as pool, contextlib.ExitStack() as stack:
        for each in (*fast, slow):
            stack.callback(each.leave)
        looking = [pool.submit(each.look) for each in fast]
        wait_for("each has a picture", lambda: all(each.pictures for each in fast))
        alone, one = watched()
        keys = one.keys
        with websocket(at, "h264"):
            looking.append(pool.submit(slow.look))
            wait_for("the slow one has a picture", lambda: slow.pictures)
            beside, one = watched()
    for each in looking:
        with contextlib.suppress(ConnectionClosed):
            each.result()
    name = at.camera.name
    note = (
        f"{name}, H.264: in {seconds:g} s {one.keys} key frames beside the slow ones, {keys} without them; "
        f"the one that takes each picture {LATE_SECONDS:g} s late had {slow.pictures}"
    )
    what = f"{name}, H.264, {FAST} fast viewers beside a slow and a stopped one: time between two pictures"
    return [Row("video", what, "ms", beside, alone, "by themselves", 1.1, note=note)]


def run(options: Options) -> list[Row]:
    """All of it, with a relay and a robot for each camera."""
    rows = []
    for camera in CAMERAS[:1] if options.quick else CAMERAS:
        with scene(camera) as at:
            rows += [*ways(at, options), *mixed(at, options), *mixed_h264(at, options)]
            rows += [*costs(at, options), *weight(at, options)]
    for row in rows:
        print(f"    {row.what}: {row.ours:.1f} {row.unit}", flush=True)
    return rows
