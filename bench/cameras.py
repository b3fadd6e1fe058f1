"""A simulated robot's camera at a relay, and the clock in its pictures, read back."""

from __future__ import annotations

import contextlib
import functools
import statistics
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bench.relay import Relay
from bench.report import Options, Row
from robot_client.sim.camera import HEIGHT, WIDTH, draw_clock
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.http_requests import ask
from tests.worlds.processes import running
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for

TOPIC = "/camera/image_raw"
USERS = ("first", "second", "third")

OLDEST_MS = 2000
"""How old a picture can be for its clock to be found."""

_LIGHT = 160
_ONES = np.array([each.bit_count() for each in range(256)], np.uint16)
"""In a byte."""

_UNREADABLE = 0.03
"""Share of pixels: of the right time about one in a hundred differs, of what is no clock many more."""


class Camera(NamedTuple):
    """What the simulated robot is told to have.

    :param width: pixels
    :param height: pixels
    :param fps: pictures per second
    """

    width: int
    height: int
    fps: int

    @property
    def name(self) -> str:
        """As rows call it."""
        return f"{self.width}×{self.height}@{self.fps}"

    @property
    def options(self) -> tuple[str, ...]:
        """Of the simulator."""
        return "--camera-size", f"{self.width}x{self.height}", "--camera-fps", str(self.fps)


CAMERAS = (Camera(640, 480, 15), Camera(1280, 720, 30))


class Scene:
    """A relay, a simulated robot behind a proxy that counts, and somebody who may watch."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack, camera: Camera) -> None:
        self.folder = folder
        self.camera = camera
        self.relay = Relay(folder)
        stack.enter_context(running(self.relay))
        self.proxy = ChaosProxy(self.relay.robots_port)
        stack.callback(self.proxy.close)
        self.robot = Robot(self.relay, "rover", port=self.proxy.port, camera=True, sim_options=camera.options)
        stack.enter_context(running(self.robot))
        self.tokens = []
        for name in USERS:
            self.tokens.append(self.relay.user(name))
            self.relay.cli("right", "grant", name, "rover", "viewer")

    @property
    def url(self) -> str:
        """The relay's own origin."""
        return f"http://127.0.0.1:{self.relay.http_port}"

    @property
    def headers(self) -> dict[str, str]:
        """Who asks, where it is one alone."""
        return {"Authorization": f"Bearer {self.tokens[0]}"}

    def path(self, what: str, parameters: str = "") -> str:
        """An address below ``video``."""
        return f"/robots/rover/video/{what}?topic={TOPIC}{parameters}"

    def wait_for_camera(self) -> None:
        """Until the relay knows it."""

        def known() -> bool:
            answer = ask(self.relay.http_port, "GET", "/robots/rover/video/cameras", token=self.tokens[0])
            return any(each["name"] == TOPIC for each in answer.json["cameras"])

        wait_for("the camera is known", known)


@contextlib.contextmanager
def scene(camera: Camera) -> Iterator[Scene]:
    """One, in a folder that goes with it."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, contextlib.ExitStack() as stack:
        found = Scene(Path(folder), stack, camera)
        found.wait_for_camera()
        yield found


class Clock:
    """What reads the time in a camera's pictures."""

    def __init__(self, camera: Camera) -> None:
        scale = min(camera.width / WIDTH, camera.height / HEIGHT)
        self.left, self.right = round(6 * scale), round(170 * scale)
        self.top, self.bottom = (camera.height - round(each * scale) for each in (36, 8))
        self._blank = np.zeros((camera.height, camera.width, 3), np.uint8)
        self._drawn = functools.lru_cache(2 * OLDEST_MS)(self._draw)

    def cut(self, picture: Any) -> Any:
        """The part of a picture where the clock is, BGR."""
        return picture[self.top : self.bottom, self.left : self.right]

    def age_ms(self, clock: Any, came: float) -> float:
        """How old a picture is, by the clock in it: of clocks drawn for each millisecond the one it is most like.

        :param clock: as :meth:`cut` cuts it
        :param came: when it was there, Unix seconds
        :raises ValueError: it is like none of them
        """
        seen = _written(clock)
        latest = int(came * 1000)
        times = range(latest - OLDEST_MS, latest + 1)
        unlike = _ONES[np.array([self._drawn(each) for each in times]) ^ seen].sum(axis=1)
        best = int(np.argmin(unlike))
        if unlike[best] > _UNREADABLE * seen.size * 8:
            raise ValueError("the clock in the picture can't be read")
        return came * 1000 - times[best]

    def _draw(self, milliseconds: int) -> npt.NDArray[np.uint8]:
        self.cut(self._blank)[:] = 0
        # Else the thousandths of seconds, which are no round numbers in binary, may be one too low.
        draw_clock(self._blank, milliseconds / 1000 + 0.0002)
        return _written(self.cut(self._blank))


def _written(clock: Any) -> npt.NDArray[np.uint8]:
    """Which pixels are light, as bits."""
    return np.packbits(clock.max(axis=2) > _LIGHT)


def counts(options: Options) -> tuple[int, int]:
    """How many pictures are passed over, until all runs as it will, and how many are looked at then."""
    return int(options.pick(2, 30)), int(options.pick(4, 150))


def glass_to_glass(measurement: str, words: str, ages: list[float], note: str) -> list[Row]:
    """Two rows.

    :param words: which camera, seen how
    :param ages: milliseconds
    """
    ages = sorted(ages)
    return [
        Row(
            measurement,
            f"glass to glass, {words}, median",
            "ms",
            statistics.median(ages),
            note=f"{words}: {note}",
        ),
        Row(measurement, f"glass to glass, {words}, p95", "ms", ages[int(0.95 * (len(ages) - 1))]),
    ]
