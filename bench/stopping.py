"""How fast anybody's stop is: a viewer stops a robot that another drives, while all that can load its links does.

The camera at 1280×720 and 30 pictures a second to two viewers, a point cloud of 300 KB at 10 Hz to two more, and the
driver's commands. The camera is a process of its own beside the simulated base, which has nothing to do but to drive,
as on a robot. What counts is the time from the viewer's word to the standstill in the base's own record.
"""

from __future__ import annotations

import contextlib
import random
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench.cameras import CAMERAS, Camera
from bench.crowd import CLOUD, TYPES
from bench.driving import AHEAD, EVERY, TOPIC, TURN, TWIST, connected, take_control
from bench.native import Receivers
from bench.relay import Relay
from bench.report import Options, Row
from bench.robot import Publisher
from bench.video import Viewers
from bench.viewers import subscribe
from bench.wire import handshake
from tests.worlds.processes import BIN, Process, ros_environment, running
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

STREAM = {"topic": CLOUD, "kind": "cloud", "rate": 10.0, "size": 300_000}
BAR_MS = 100
EYES = "/eyes"
"""Namespace of the camera."""


class Holder(threading.Thread):
    """Has control, and drives whenever it is let."""

    def __init__(self, client: Client) -> None:
        super().__init__(daemon=True)
        self._client = client
        self._goes = threading.Event()
        self._end = threading.Event()
        self._resumed = threading.Event()
        self.broken = ""

    def run(self) -> None:
        """Drive, stand, and resume the robot in between."""
        try:
            take_control(self._client)
            self._client.send(op="advertise", topic=TOPIC, type=TWIST)
            while not self._end.is_set():
                if self._goes.is_set():
                    self._client.drive(AHEAD, TURN)
                else:
                    self._stand()
                with contextlib.suppress(TimeoutError):
                    self._client.receive(EVERY)
        except Exception as error:
            self.broken = repr(error)

    def _stand(self) -> None:
        """Say zero, before the robot is resumed and after: who has not let go moves nothing."""
        self._client.drive(0.0)
        if not self._resumed.is_set():
            answer = self._client.call("/relay/resume", {"why": "bench"})
            if not answer["result"] and "after you sent this" in answer["values"]:
                # No ping has come back since the stop: nobody can tell yet that this was asked for after it.
                return
            assert answer["result"], answer["values"]
            assert answer["values"]["success"], answer["values"]["message"]
            self._client.drive(0.0)
            self._resumed.set()

    def go(self) -> None:
        """Drive."""
        self._goes.set()

    def resume(self) -> None:
        """Let go, and resume the robot."""
        self._resumed.clear()
        self._goes.clear()
        wait_for("the robot is resumed", lambda: self._resumed.is_set() or self.broken)
        assert not self.broken, self.broken

    def stop(self) -> None:
        """Leave."""
        self._end.set()
        self.join(10)
        self._client.close()


class Scene:
    """A relay, a robot with its camera beside it, and who drives, watches and stops.

    :param camera: as the simulator draws it
    """

    def __init__(self, folder: Path, stack: contextlib.ExitStack, camera: Camera) -> None:
        self.folder = folder
        self.relay = Relay(folder)
        stack.enter_context(running(self.relay))
        self.robot = Robot(self.relay, "rover")
        stack.enter_context(running(self.robot))
        self.environment = ros_environment(self.robot.domain)
        command = [str(BIN / "switchboard-sim"), "--namespace", EYES, "--camera", *camera.options]
        eyes = Process(command, self.robot.folder, "eyes", self.environment)
        stack.enter_context(running(eyes))
        eyes.wait_to_say("READY")
        self.tokens = [self.relay.user(name) for name in ("watcher", "stopper", "driver")]
        for name, level in (("watcher", "viewer"), ("stopper", "viewer"), ("driver", "operator")):
            self.relay.cli("right", "grant", name, "rover", level)

    def path(self, what: str) -> str:
        """An address below ``video``."""
        return f"/robots/rover/video/{what}?topic={EYES}/camera/image_raw"


def stops(at: Scene, count: int) -> tuple[list[float], list[float]]:
    """So many stops by a viewer; milliseconds to the standstill, and to the answer."""
    robot, chance, port = at.robot, random.Random(7), at.relay.http_port
    _, stopper, driver = at.tokens
    holder, viewer = Holder(connected(port, "rover", driver)), connected(port, "rover", stopper)
    stood: list[float] = []
    answered: list[float] = []
    with running(holder), contextlib.closing(viewer):
        holder.start()
        holder.resume()
        for _ in range(count):
            holder.go()
            wait_for("the robot moves", lambda: robot.moving() or holder.broken)
            assert not holder.broken, holder.broken
            time.sleep(0.1 + chance.random() * EVERY)  # somewhere between two commands
            said = time.monotonic_ns()
            done: dict[str, Any] = viewer.call("/relay/stop", {"why": "bench"})["values"]
            answered.append((time.monotonic_ns() - said) / 1e6)
            assert done["success"], done["message"]
            wait_for("the robot stands", lambda: not robot.moving())
            stood.append((robot.events("standstill")[-1]["t"] - said) / 1e6)
            holder.resume()
    return sorted(stood), sorted(answered)


@contextlib.contextmanager
def loaded(at: Scene) -> Iterator[None]:
    """Pictures and clouds to two viewers each, meanwhile."""
    request = handshake("/robots/rover", at.tokens[0])
    with running(Publisher(at.environment, [STREAM]), viewers := Viewers(at, 2)):
        frames = subscribe((CLOUD, TYPES[CLOUD], 0))
        watchers = Receivers(at.folder, at.relay.http_port, 2, request, frames)
        with running(watchers):
            viewers.all_see()
            wait_for("the cloud comes", lambda: watchers.report()["least"] > 0, 30)
            yield


def run(options: Options) -> list[Row]:
    """With all of the load, then without any."""
    count = options.runs or int(options.pick(3, 200))
    camera = CAMERAS[0] if options.quick else CAMERAS[1]
    rows = []
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, contextlib.ExitStack() as stack:
        at = Scene(Path(folder), stack, camera)
        with loaded(at):
            rows += _rows(f"{camera.name} and a cloud", *stops(at, count), BAR_MS)
        rows += _rows("no load", *stops(at, count), None)
    for row in rows:
        print(f"    {row.what}: {row.ours:.1f} {row.unit}", flush=True)
    return rows


def _rows(load: str, stood: list[float], answered: list[float], bar: float | None) -> list[Row]:
    last = answered[int(0.99 * (len(answered) - 1))]
    note = f"{load}: {len(stood)} stops, the longest {stood[-1]:.0f} ms; the answer came within {last:.0f} ms (p99)"
    return [
        Row(
            "stopping",
            f"viewer's stop → standstill, {load}, median",
            "ms",
            statistics.median(stood),
            note=note,
        ),
        Row(
            "stopping",
            f"viewer's stop → standstill, {load}, p99",
            "ms",
            stood[int(0.99 * (len(stood) - 1))],
            bar=bar,
        ),
    ]
