"""A thin uplink of a robot: how old a small topic is beside many middling ones.

Real relay, daemon and ROS 2 publisher. A pose (20 Hz, few bytes) and ten topics of 10 kB at 10 Hz, 1 MB/s in all, are
watched by one client, and the robot's bytes go through a proxy that passes 300 kB a second. Ages are from the
publisher's stamp to the client's read, by one clock.
"""

from __future__ import annotations

import json
import time

from bench.messages import STRING
from bench.report import Options, Row
from bench.robot import real_robot, settle

KILOBYTES = 300
"""A second, up from the robot."""

POSE = "/pose"
MIDDLING = tuple(f"/middling{number}" for number in range(10))
P50_MS, P99_MS = 300.0, 600.0
"""Goals for the age of a pose, as on a thin downlink."""


def run(options: Options) -> list[Row]:
    """One line."""
    streams = [{"topic": POSE, "kind": "string", "rate": 20, "size": 40}]
    streams += [{"topic": each, "kind": "string", "rate": 10, "size": 10_000} for each in MIDDLING]
    ages: list[float] = []
    middling, seconds = 0, options.pick(1, 30)
    with real_robot(streams) as robot:
        settle(options)
        token = robot.viewer("watcher")
        robot.proxy.squeeze(KILOBYTES * 8000)
        with robot.relay.connect(robot.name, token) as client:
            for topic in (POSE, *MIDDLING):
                client.send(op="subscribe", topic=topic, type=STRING)
            client.until(op="publish", topic=POSE)
            first, begun = robot.publisher.sent()[POSE], time.monotonic()
            while time.monotonic() < begun + seconds:
                message = json.loads(client.connection.recv())
                if message.get("topic") == POSE:
                    stamp = int(message["msg"]["data"].partition("@")[2].rstrip("."))
                    ages.append((time.monotonic_ns() - stamp) / 1e6)
                middling += message.get("topic") in MIDDLING
            poses = robot.publisher.sent()[POSE] - first
    ages.sort()
    what = f"uplink of {KILOBYTES} kB/s beside ten topics of 100 kB/s"
    note = f"{what}: {len(ages)} of {poses} poses, {middling / seconds:.1f} middling samples a second"
    print(f"    {note}", flush=True)
    return [
        Row("thin", f"{what}: age of a pose, p50", "ms", ages[len(ages) // 2], bar=P50_MS),
        Row("thin", f"{what}: age of a pose, p99", "ms", ages[int(0.99 * len(ages))], bar=P99_MS, note=note),
    ]
