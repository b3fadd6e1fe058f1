"""A slow uplink between a robot and the relay: small topics pass beside too much data, in a real ROS 2 graph."""

from __future__ import annotations

import json
import re
import statistics
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

from tests.worlds.machine_pauses import Pulse
from tests.worlds.waiting import PATIENCE, wait_for

sys.path.insert(0, str(Path(__file__).parents[2]))  # the package ``bench`` is beside the tests

from bench.robot import real_robot

SMALL, CLOUD = "/bench/small", "/bench/cloud"
STREAMS: list[dict[str, Any]] = [
    {"topic": SMALL, "kind": "string", "rate": 20.0, "size": 100},
    {"topic": CLOUD, "kind": "cloud", "rate": 10.0, "size": 100_000},
]
MARK = re.compile(r"#\d+@(\d+)")


@pytest.mark.parametrize("rate", [300_000, 100_000])
def test_a_heavy_topic_does_not_make_the_small_ones_of_a_robot_late(rate: int) -> None:
    """A small sample waits for one part of a large one, not for the network's buffers."""
    with real_robot(STREAMS) as robot:
        token = robot.viewer("ann")
        headers = {"Authorization": f"Bearer {token}"}
        url = robot.relay.url("rover")
        ages: list[float] = []
        clouds = []
        over = threading.Event()
        with connect(url, additional_headers=headers, open_timeout=PATIENCE, max_size=None) as socket:

            def read() -> None:
                while not over.is_set():
                    try:
                        text = socket.recv(timeout=0.5)
                    except TimeoutError:
                        continue
                    message = json.loads(text)
                    if message.get("topic") == SMALL:
                        sent = MARK.match(message["msg"]["data"])
                        assert sent is not None
                        ages.append((time.monotonic_ns() - int(sent[1])) / 1e9)
                    elif message.get("topic") == CLOUD:
                        clouds.append(len(text))

            reading = threading.Thread(target=read, daemon=True)
            reading.start()
            # With a type, an unknown topic is awaited.
            for topic, type_name in ((SMALL, "std_msgs/msg/String"), (CLOUD, "sensor_msgs/msg/PointCloud2")):
                socket.send(json.dumps({"op": "subscribe", "topic": topic, "type": type_name}))
            wait_for("both topics come", lambda: ages and clouds)
            robot.proxy.squeeze(rate * 8)
            time.sleep(3)  # earlier samples have to pass
            ages.clear()
            clouds.clear()
            with Pulse() as pulse:
                wait_for("so much has come", lambda: len(ages) >= 100 and len(clouds) >= 4)
                held_up = pulse.held_up()
            over.set()
            reading.join(PATIENCE)
        assert statistics.median(ages) <= 0.5 + held_up
        assert sorted(ages)[int(0.9 * len(ages))] <= 1.0 + held_up
