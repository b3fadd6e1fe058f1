"""A LaserScan at 40 Hz from ROS 2 to ten viewers: daemon and relay, against a server built like rosbridge_server.

Both subscribe to the same publisher at the same time, each with ten clients, and are measured over the same seconds.
rosbridge_server is not on the package index; what stands in for it is ``bench/rosbridge_like.py``, which is ours.
"""

from __future__ import annotations

import contextlib
import importlib.util
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from switchboard_processes import running
from switchboard_waiting import wait_for

from bench import ROOT
from bench.cpu import seconds_of
from bench.native import Receivers
from bench.relay import Relay
from bench.report import Options, Row
from bench.robot import SETTLE_SECONDS, RealRobot
from bench.viewers import SCAN, STREAM, TOPIC, subscribe
from bench.wire import handshake

VIEWERS = 10


def stand_in() -> bool:
    """Whether what the stand-in is made of is installed."""
    return all(importlib.util.find_spec(module) for module in ("tornado", "ujson"))


class RosbridgeLike:
    """The stand-in, running."""

    def __init__(self, environment: dict[str, str], topic: str) -> None:
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self.port = probe.getsockname()[1]
        self._popen = subprocess.Popen(
            [sys.executable, "-m", "bench.rosbridge_like", str(self.port), topic],
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=ROOT,
        )
        assert self._popen.stdout is not None
        if self._popen.stdout.readline().strip() != "READY":
            self.stop()
            raise AssertionError("the stand-in for rosbridge does not start; see above")

    @property
    def pid(self) -> int:
        """Its process."""
        return self._popen.pid

    def stop(self) -> None:
        """End and reap it."""
        assert self._popen.stdout is not None
        self._popen.terminate()
        try:
            self._popen.wait(5)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()
        self._popen.stdout.close()


def spent_by(pids: dict[str, int], seconds: float) -> dict[str, float]:
    """Processor milliseconds a second over a while."""
    begun = time.monotonic()
    before = {name: seconds_of(pid, children=True) for name, pid in pids.items()}
    time.sleep(seconds)
    used = {name: seconds_of(pid, children=True) - before[name] for name, pid in pids.items()}
    return {name: each * 1000 / (time.monotonic() - begun) for name, each in used.items()}


def watched(
    robot: RealRobot, pids: dict[str, int], watching: list[Receivers], seconds: float
) -> dict[str, float]:
    """Processor milliseconds a second over a while in which every viewer of ours gets every sample."""
    for each in watching:
        each.report()
    sent = robot.publisher.sent()[TOPIC]
    used = spent_by(pids, seconds)
    sent = robot.publisher.sent()[TOPIC] - sent
    # The stand-in may fall behind on a busy machine; then it has spent less than it should have.
    watching[0].until_each_has(0.95 * sent)
    return used


def run(options: Options) -> list[Row]:
    """Some windows of time; medians of processor milliseconds a second."""
    seconds, rounds = options.pick(1, 8), int(options.pick(1, 3))
    with tempfile.TemporaryDirectory(prefix="bench-") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        relay = Relay(folder)
        stack.enter_context(running(relay))
        robot = RealRobot(relay, "rover", [STREAM])
        stack.enter_context(running(robot))
        time.sleep(options.pick(0, SETTLE_SECONDS))
        rest = spent_by({"daemon": robot.pid, "relay": relay.pid}, seconds / 2)
        ask = subscribe((TOPIC, SCAN, 0))
        request = handshake("/robots/rover", robot.viewer("watcher"))
        watching = [Receivers(folder, relay.http_port, VIEWERS, request, ask)]
        pids = {"daemon": robot.pid, "relay": relay.pid}
        if stand_in():
            bridge = RosbridgeLike(robot.environment, TOPIC)
            stack.enter_context(running(bridge))
            watching.append(Receivers(folder, bridge.port, VIEWERS, handshake("/"), ask))
            pids["stand-in"] = bridge.pid
        stack.enter_context(running(*watching))
        for each in watching:
            wait_for("all viewers have something", lambda each=each: each.report()["least"] > 0, 20)
        time.sleep(seconds / 4)
        spells = [watched(robot, pids, watching, seconds) for _ in range(rounds)]
    spent = {name: statistics.median(each[name] for each in spells) for name in pids}
    row = Row(
        "endtoend",
        f"LaserScan 40 Hz to {VIEWERS} viewers: daemon + relay",
        "ms/s",
        spent["daemon"] + spent["relay"],
        spent.get("stand-in"),
        "rosbridge-like server (stand-in)" if "stand-in" in spent else "",
        0.1 if "stand-in" in spent else None,
        note=f"daemon {spent['daemon']:.1f} ms/s on the robot, relay {spent['relay']:.1f} ms/s elsewhere; the "
        f"stand-in runs on the robot. While nobody watches: daemon {rest['daemon']:.1f}, "
        f"relay {rest['relay']:.1f} ms/s",
    )
    print(f"    {', '.join(f'{name} {each:.1f} ms/s' for name, each in spent.items())}", flush=True)
    return [row]
