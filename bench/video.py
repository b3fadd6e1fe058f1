"""Cameras: what 1, 10 and 50 viewers cost robot and relay, how old pictures are, what slow viewers do to fast ones.

Real relay and daemon. 640×480 at 15 pictures a second is the simulated robot's own camera; 1280×720 at 30, which it
does not have, comes from a ROS 2 publisher beside it. How old a picture is is read from the clock the simulated camera
draws into it, when it has come and is decoded.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from switchboard_http import ask
from switchboard_processes import ros_environment, running
from switchboard_proxy import ChaosProxy
from switchboard_robot import Robot
from switchboard_waiting import wait_for
from websockets.sync.client import connect

from bench.child import Child
from bench.cpu import measured
from bench.relay import Relay
from bench.report import Options, Row, Unavailable
from bench.robot import Publisher
from robot_client.sim.camera import HEIGHT, WIDTH, draw_captions

VIEWERS = (1, 10, 50)
GROUP = 25
"""Viewers of one user, who may have 32 on a robot."""

SLOW_BYTES = 20_000
"""Per second."""

DIGITS = (slice(HEIGHT - 36, HEIGHT - 8), slice(6, 170))
"""Where in the picture the clock is: rows and columns."""

OLDEST_MS = 500
"""How old a picture can be for its clock to be found."""


class Source(NamedTuple):
    """A camera.

    :param fps: pictures per second that are expected
    """

    topic: str
    name: str
    fps: float


SIMULATED = Source("/camera/image_raw", "640×480@15", 15)
LARGE = Source("/bench/image", "1280×720@30", 30)


class Scene:
    """A relay, a simulated robot behind a proxy that counts, and somebody who may watch."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self.folder = folder
        self.relay = Relay(folder)
        stack.enter_context(running(self.relay))
        self.proxy = ChaosProxy(self.relay.robots_port)
        stack.callback(self.proxy.close)
        self.robot = Robot(self.relay, "rover", port=self.proxy.port, camera=True)
        stack.enter_context(running(self.robot))
        self.tokens = []
        for name in ("first", "second", "third"):
            self.tokens.append(self.relay.user(name))
            self.relay.cli("right", "grant", name, "rover", "viewer")

    @property
    def headers(self) -> dict[str, str]:
        """Who asks, where it is one alone."""
        return {"Authorization": f"Bearer {self.tokens[0]}"}

    def path(self, what: str, camera: Source, parameters: str = "") -> str:
        """An address below ``video``."""
        return f"/robots/rover/video/{what}?topic={camera.topic}{parameters}"

    def wait_for(self, camera: Source) -> None:
        """Until the relay knows it."""

        def known() -> bool:
            answer = ask(
                self.relay.http_port, "GET", "/robots/rover/video/cameras", token=self.tokens[0]
            ).json
            return any(each["name"] == camera.topic for each in answer["cameras"])

        wait_for(f"{camera.topic} is known", known)

    @contextlib.contextmanager
    def large_camera(self) -> Iterator[None]:
        """The publisher."""
        stream = {"topic": LARGE.topic, "kind": "image", "rate": LARGE.fps, "size": 1280}
        publisher = Publisher(ros_environment(self.robot.domain), [stream])
        with running(publisher):
            yield

    def viewers(self, camera: Source, count: int, rate: float = 0, user: int = 0) -> Viewers:
        """Some who watch, all of one user."""
        return Viewers(self, camera, count, rate, self.tokens[user])

    def groups(self, camera: Source, count: int) -> list[Viewers]:
        """Some who watch, of as many users as it takes, beside one more of the first user."""
        sizes = [min(GROUP, count - done) for done in range(0, count, GROUP)]
        return [self.viewers(camera, size, user=user) for user, size in enumerate(sizes)]


class Viewers(Child):
    """``bench/mjpeg_viewers.py``, running."""

    def __init__(self, scene: Scene, camera: Source, count: int, rate: float, token: str) -> None:
        request = scene.folder / f"request-{scene.tokens.index(token)}{camera.topic.replace('/', '-')}"
        head = f"GET {scene.path('stream', camera)} HTTP/1.1\r\nHost: relay\r\nAuthorization: Bearer {token}\r\n\r\n"
        request.write_text(head, newline="")
        numbers = [str(scene.relay.http_port), str(count), str(request), str(rate)]
        command = [sys.executable, "-m", "bench.mjpeg_viewers", *numbers]
        super().__init__(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.ready(Unavailable("the viewers do not start; see above"))

    def all_see(self) -> None:
        """Wait until each has a picture."""
        wait_for("each viewer has a picture", lambda: not self.ask()["waiting"])


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


def cost(scene: Scene, viewers: list[Viewers], count: int, seconds: float) -> Cost:
    """While they watch for a while.

    :param viewers: groups that watch
    :param count: how many they are together
    """
    relay, robot = scene.relay.pid, scene.robot.daemon.popen.pid
    for each in viewers:
        each.all_see()
    time.sleep(seconds / 4)  # nothing tells when what joining costs is over
    for each in viewers:
        each.ask()
    before, began = scene.proxy.up, time.monotonic()
    with measured(robot, children=True) as on_robot, measured(relay) as on_relay:
        time.sleep(seconds)  # what is measured: the time they need while this one does nothing
    up, passed = scene.proxy.up - before, time.monotonic() - began
    told = [each.ask() for each in viewers]
    shown = sum(each["pictures"] for each in told)
    made = shown / count
    least = min(each["least"] for each in told)
    return Cost(on_robot.seconds * 1e6 / made, up / made, on_relay.seconds * 1e6 / shown, least / passed)


def costs(scene: Scene, camera: Source, options: Options) -> list[Row]:
    """Each number of viewers in turn; medians."""
    counts = tuple(int(options.pick(few, many)) for few, many in zip((1, 2, 3), VIEWERS, strict=True))
    seconds, rounds = options.pick(0.5, 5), int(options.pick(1, 2))
    found: dict[int, list[Cost]] = {count: [] for count in counts}
    # The first viewer stays, so that nothing is opened and closed on the robot between the rounds.
    with running(first := scene.viewers(camera, 1)):
        for _ in range(rounds):
            for count in counts:
                if count == 1:
                    found[count].append(cost(scene, [first], count, seconds))
                    continue
                with running(*(others := scene.groups(camera, count - 1))):
                    found[count].append(cost(scene, [first, *others], count, seconds))
    medians = {
        count: Cost(*(statistics.median(each) for each in zip(*several, strict=True)))
        for count, several in found.items()
    }
    return [row for count in counts for row in rows_of(camera, count, medians[count], medians[1])]


def rows_of(camera: Source, count: int, this: Cost, one: Cost) -> list[Row]:
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


def age_ms(clock: Any, came: float) -> float:
    """How old a picture is, by the clock in it: of clocks drawn for each millisecond the one it is most like.

    :param clock: that part of the picture, BGR
    :param came: when it was there, Unix seconds
    """
    seen = (clock.max(axis=2) > 160).astype(np.float32)
    latest = int(came * 1000)
    blank = np.zeros((HEIGHT, WIDTH, 3), np.uint8)

    def likeness(milliseconds: int) -> float:
        blank[DIGITS] = 0
        draw_captions(blank, 0.0, milliseconds / 1000 + 0.0002)
        drawn = (blank[DIGITS].max(axis=2) > 160).astype(np.float32)
        return -float(np.abs(seen - drawn).sum())

    best = max(range(latest - OLDEST_MS, latest + 1), key=likeness)
    return came * 1000 - best


def by_multipart(scene: Scene) -> Iterator[bytes]:
    """The pictures of the stream, as they come."""
    connection = http.client.HTTPConnection("127.0.0.1", scene.relay.http_port, timeout=20)
    with contextlib.closing(connection):
        connection.request("GET", scene.path("stream", SIMULATED), headers=scene.headers)
        answer = connection.getresponse()
        while line := answer.readline():
            if line.lower().startswith(b"content-length:"):
                length = int(line.partition(b":")[2])
                while answer.readline() != b"\r\n":
                    pass
                yield answer.read(length)


def by_websocket(scene: Scene, codec: str, camera: Source = SIMULATED) -> Iterator[bytes]:
    """The pictures, each taken when the next is wanted."""
    address = f"ws://127.0.0.1:{scene.relay.http_port}{scene.path('ws', camera, f'&codec={codec}')}"
    with connect(address, additional_headers=scene.headers, close_timeout=1) as connection:
        while True:
            message = json.loads(connection.recv(timeout=20))
            if message["op"] == "picture":
                body = connection.recv(timeout=20)
                assert isinstance(body, bytes)
                connection.send(json.dumps({"op": "took", "number": message["number"]}))
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


def glass_to_glass(scene: Scene, options: Options) -> list[Row]:
    """Three ways to look at the same camera."""
    count, first = int(options.pick(4, 120)), int(options.pick(2, 30))
    rows = []
    for way, pictures, decode in (
        ("MJPEG", by_multipart(scene), jpeg),
        ("websocket, JPEG", by_websocket(scene, "jpeg"), jpeg),
        ("websocket, H.264", by_websocket(scene, "h264"), h264()),
    ):
        shown: list[tuple[Any, float]] = []
        sizes = []
        with contextlib.closing(pictures):
            for number, body in enumerate(pictures):
                picture = decode(body)
                if picture is not None and number >= first:
                    shown.append((picture[DIGITS].copy(), time.time()))
                    sizes.append(len(body))
                if len(shown) == count:
                    break
        ages = sorted(age_ms(picture, came) for picture, came in shown)
        note = f"{way}: {statistics.mean(sizes) / 1000:.1f} kB a picture, of a robot that stands"
        rows += [
            Row("video", f"glass to glass, {way}, median", "ms", statistics.median(ages), note=note),
            Row("video", f"glass to glass, {way}, p95", "ms", ages[int(0.95 * (len(ages) - 1))]),
        ]
    return rows


def weight(scene: Scene, options: Options) -> list[Row]:
    """Bytes of H.264 and of JPEG, of a camera that swings to and fro."""
    count, sizes = int(options.pick(10, 150)), {}
    for codec in ("jpeg", "h264"):
        with contextlib.closing(by_websocket(scene, codec, LARGE)) as pictures:
            sizes[codec] = statistics.mean(len(next(pictures)) for _ in range(count))
    what = f"H.264, bytes of a picture, {LARGE.name}, a camera in motion"
    return [Row("video", what, "bytes", sizes["h264"], sizes["jpeg"], "JPEG of quality 80", 1 / 3)]


def mixed(scene: Scene, options: Options) -> list[Row]:
    """Ten fast ones by themselves, then beside one at 20 KB/s and one that has stopped."""
    seconds = options.pick(1, 10)
    with running(fast := scene.viewers(SIMULATED, 10)):
        fast.all_see()

        def between() -> float:
            fast.ask()
            began = time.monotonic()
            time.sleep(seconds)  # what is measured: how much comes in this time
            return (time.monotonic() - began) * 1000 / max(1, fast.ask()["least"])

        alone = between()
        with running(slow := scene.viewers(SIMULATED, 1, SLOW_BYTES), scene.viewers(SIMULATED, 1, -1)):
            beside = between()
            got = slow.ask()["bytes"]
    what = "ten fast viewers beside a slow and a stopped one: time between two pictures"
    note = f"the slow one had {got / seconds / 1000:.0f} KB/s"
    return [Row("video", what, "ms", beside, alone, "by themselves", 1.1, note=note)]


def run(options: Options) -> list[Row]:
    """All of it, with one relay and one robot."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, contextlib.ExitStack() as stack:
        scene = Scene(Path(folder), stack)
        scene.wait_for(SIMULATED)
        rows = [*glass_to_glass(scene, options), *mixed(scene, options), *costs(scene, SIMULATED, options)]
        with scene.large_camera():
            scene.wait_for(LARGE)
            rows += [*costs(scene, LARGE, options), *weight(scene, options)]
    for row in rows:
        print(f"    {row.what}: {row.ours:.1f} {row.unit}", flush=True)
    return rows
