"""A LaserScan at 40 Hz from ROS 2 to ten viewers: daemon and relay, against a server built like rosbridge_server.

Both subscribe to the same publisher at the same time, each with ten clients, and are measured over the same seconds.
rosbridge_server is not on the package index; what stands in for it is ``bench/rosbridge_like.py``, which is ours.
"""

from __future__ import annotations

import contextlib
import importlib.util
import statistics
import subprocess
import sys
import time

from bench.child import Child, free_port
from bench.cpu import seconds_of
from bench.native import Receivers
from bench.report import Options, Row
from bench.robot import RealRobot, real_robot, settle
from bench.viewers import SCAN, STREAM, TOPIC, subscribe
from bench.wire import handshake
from tests.worlds.processes import running
from tests.worlds.waiting import wait_for

VIEWERS = 10


def stand_in() -> bool:
    """Whether what the stand-in is made of is installed."""
    return all(importlib.util.find_spec(module) for module in ("tornado", "ujson"))


class RosbridgeLike(Child):
    """The stand-in, running."""

    def __init__(self, environment: dict[str, str], topic: str) -> None:
        self.port = free_port()
        command = [sys.executable, "-m", "bench.rosbridge_like", str(self.port), topic]
        super().__init__(command, stdout=subprocess.PIPE, env=environment)
        self.ready(AssertionError("the stand-in for rosbridge does not start; see above"))


def spent_by(pids: dict[str, int], seconds: float) -> dict[str, float]:
    """Processor milliseconds a second over a while."""
    begun = time.monotonic()
    before = {name: seconds_of(pid, children=True) for name, pid in pids.items()}
    time.sleep(seconds)  # what is measured: the time others need while this one does nothing
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
    seconds, rounds = options.pick(0.3, 8), int(options.pick(1, 3))
    with real_robot([STREAM]) as robot, contextlib.ExitStack() as stack:
        relay = robot.relay
        settle(options)
        rest = spent_by({"daemon": robot.pid, "relay": relay.pid}, seconds / 2)
        ask = subscribe((TOPIC, SCAN, 0))
        request = handshake("/robots/rover", robot.viewer("watcher"))
        watching = [Receivers(relay.folder, relay.http_port, VIEWERS, request, ask)]
        pids = {"daemon": robot.pid, "relay": relay.pid}
        if stand_in():
            bridge = RosbridgeLike(robot.environment, TOPIC)
            stack.enter_context(running(bridge))
            watching.append(Receivers(relay.folder, bridge.port, VIEWERS, handshake("/"), ask))
            pids["stand-in"] = bridge.pid
        stack.enter_context(running(*watching))
        for each in watching:
            wait_for("all viewers have something", lambda each=each: each.report()["least"] > 0, 20)
        time.sleep(seconds / 4)  # the viewers' coming is not to be measured
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
