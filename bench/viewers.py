"""What watching costs the robot: a LaserScan at 40 Hz to one viewer and to fifty.

Real daemon and ROS 2 publisher; the daemon's processor time (with its guard's) and the bytes on its links, by sample.
"""

from __future__ import annotations

import contextlib
import statistics
import time
from typing import NamedTuple

from bench.cpu import measured
from bench.native import Receivers
from bench.report import Options, Row
from bench.robot import RealRobot, real_robot, settle
from bench.wire import handshake, text_frame
from relay_protocol import jsontext
from tests.worlds.waiting import wait_for

SCAN = "sensor_msgs/msg/LaserScan"
TOPIC = "/bench/scan"
STREAM = {"topic": TOPIC, "kind": "scan", "rate": 40.0, "size": 0}


class Cost(NamedTuple):
    """By sample."""

    micros: float
    bytes: float


def subscribe(*topics: tuple[str, str, int]) -> bytes:
    """Frames that subscribe to (topic, type, throttle in milliseconds)."""
    return b"".join(
        text_frame(
            jsontext.encode({"op": "subscribe", "topic": topic, "type": kind, "throttle_rate": throttle})
        )
        for topic, kind, throttle in topics
    )


def watched(robot: RealRobot, receivers: Receivers, seconds: float) -> Cost:
    """What it costs the robot while these watch."""
    # Everybody has subscribed when something has come for all.
    wait_for("all viewers have something", lambda: receivers.report()["least"] > 0, 20)
    begun, sent = robot.proxy.up, robot.publisher.sent()[TOPIC]
    with measured(robot.pid, children=True) as watch:
        time.sleep(seconds)  # what is measured: the time the robot needs while this one does nothing
        samples = robot.publisher.sent()[TOPIC] - sent
    passed = robot.proxy.up - begun
    receivers.until_each_has(0.95 * samples)
    return Cost(watch.seconds * 1e6 / samples, passed / samples)


def run(options: Options) -> list[Row]:
    """One viewer, fifty, in turn; medians."""
    many = int(options.pick(2, 50))
    seconds, rounds = options.pick(0.3, 7), int(options.pick(1, 4))
    costs: dict[int, list[Cost]] = {1: [], many: []}
    with real_robot([STREAM]) as robot, contextlib.ExitStack() as stack:
        relay = robot.relay
        request, ask = handshake("/robots/rover", robot.viewer("watcher")), subscribe((TOPIC, SCAN, 0))
        # The first viewer stays, so that nothing is opened and closed on the robot between the rounds.
        first = Receivers(relay.folder, relay.http_port, 1, request, ask)
        stack.callback(first.stop)
        settle(options)
        for _ in range(rounds):
            costs[1].append(watched(robot, first, seconds))
            others = Receivers(relay.folder, relay.http_port, many - 1, request, ask)
            try:
                costs[many].append(watched(robot, others, seconds))
            finally:
                others.stop()
            first.report()
    one, all_of_them = (
        Cost(*(statistics.median(each) for each in zip(*costs[count], strict=True))) for count in (1, many)
    )
    rows = [
        Row(
            "viewers",
            f"robot's processor time per sample, {many} viewers",
            "µs",
            all_of_them.micros,
            one.micros,
            "one viewer",
            1.1,
        ),
        Row(
            "viewers",
            f"robot's uplink per sample, {many} viewers",
            "bytes",
            all_of_them.bytes,
            one.bytes,
            "one viewer",
            1.02,
        ),
    ]
    for row in rows:
        print(f"    {row.what}: {row.ours:.0f} {row.unit}, one viewer {row.other:.0f}", flush=True)
    return rows
