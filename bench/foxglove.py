"""Scan, image and point cloud from ROS 2 to ten Foxglove clients: daemon and relay, against foxglove-sdk's server.

Both subscribe to the same publishers at the same time, each with ten clients, and are measured over the same seconds.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import statistics
import subprocess
import sys
import time
from typing import Any, NamedTuple

from websockets.sync.client import connect

from bench.child import Child, free_port
from bench.endtoend import spent_by
from bench.native import Receivers
from bench.report import Options, Row, Unavailable
from bench.robot import real_robot, settle
from bench.wire import handshake, text_frame
from tests.worlds.processes import running

CLIENTS = 10
PROTOCOL = "foxglove.sdk.v1"
STREAMS = [
    {"topic": "/bench/scan", "kind": "scan", "rate": 40.0, "size": 0},
    {"topic": "/bench/image", "kind": "image", "rate": 15.0, "size": 640 * 480 * 3},
    {"topic": "/bench/cloud", "kind": "cloud", "rate": 10.0, "size": 300_000},
]
TYPES = {
    "/bench/scan": "sensor_msgs/msg/LaserScan",
    "/bench/image": "sensor_msgs/msg/Image",
    "/bench/cloud": "sensor_msgs/msg/PointCloud2",
}
MOST = 1.2
"""Most processor time for each message that a client received, in parts of that of foxglove-sdk's server."""


class SdkServer(Child):
    """The server of foxglove-sdk, running."""

    def __init__(self, environment: dict[str, str]) -> None:
        self.port = free_port()
        command = [sys.executable, "-m", "bench.foxglove_sdk_server", str(self.port), json.dumps(TYPES)]
        super().__init__(command, stdout=subprocess.PIPE, env=environment)
        self.ready(AssertionError("the server of foxglove-sdk does not start; see above"))


def opening(path: str, token: str = "") -> bytes:
    """The HTTP request of a Foxglove client."""
    return handshake(path, token).replace(
        b"\r\n\r\n", f"\r\nSec-WebSocket-Protocol: {PROTOCOL}\r\n\r\n".encode()
    )


def channels(url: str, headers: dict[str, str]) -> dict[str, int]:
    """The numbers of the channels, as soon as all three topics are advertised at once."""
    found: dict[str, int] = {}
    with connect(url, subprotocols=[PROTOCOL], additional_headers=headers) as client:  # type: ignore[list-item]
        while not found.keys() >= TYPES.keys():
            data = client.recv(20)
            message: dict[str, Any] = json.loads(data) if isinstance(data, str) else {}
            if message.get("op") == "advertise":
                found |= {each["topic"]: each["id"] for each in message["channels"]}
    return {topic: found[topic] for topic in TYPES}


def subscribing(url: str, headers: dict[str, str]) -> bytes:
    """The frame that subscribes to all topics. The first connection has the definitions requested."""
    channels(url, headers)
    numbers = channels(url, headers)
    entries = [{"id": number, "channelId": each} for number, each in enumerate(numbers.values(), 1)]
    return text_frame(json.dumps({"op": "subscribe", "subscriptions": entries}).encode())


class Measurement(NamedTuple):
    """All windows of time together.

    :ivar spent: of each process, milliseconds of processor time in each second of each window
    :ivar seconds: length of all windows together
    :ivar received: messages that the clients of the relay received, and those of foxglove-sdk's server
    """

    spent: dict[str, list[float]]
    seconds: float
    received: tuple[int, int]


def measure(options: Options) -> Measurement:
    """Clients of both, at the same time."""
    seconds, rounds = options.pick(0.3, 8), int(options.pick(1, 3))
    with real_robot(STREAMS) as robot, contextlib.ExitStack() as stack:
        relay = robot.relay
        settle(options)
        token = robot.viewer("watcher")
        subscribe = subscribing(relay.url("rover"), {"Authorization": f"Bearer {token}"})
        request = opening("/robots/rover", token)
        ours = Receivers(relay.folder, relay.http_port, CLIENTS, request, subscribe)
        stack.enter_context(running(ours))
        server = SdkServer(robot.environment)
        stack.enter_context(running(server))
        subscribe = subscribing(f"ws://127.0.0.1:{server.port}", {})
        theirs = Receivers(relay.folder, server.port, CLIENTS, opening("/"), subscribe)
        stack.enter_context(running(theirs))
        for each in (ours, theirs):
            each.until_each_has(20)  # more than the answers to connecting
        time.sleep(seconds / 4)  # what connecting costs is not measured
        for each in (ours, theirs):
            each.report()  # its counts begin again
        pids = {"daemon": robot.pid, "relay": relay.pid, "sdk": server.pid}
        windows = [spent_by(pids, seconds) for _ in range(rounds)]
        received = ours.report()["messages"], theirs.report()["messages"]
    return Measurement({name: [each[name] for each in windows] for name in pids}, seconds * rounds, received)


def run(options: Options) -> list[Row]:
    """Medians of processor milliseconds a second, and the mean for each message.

    :raises Unavailable: foxglove-sdk is not installed
    """
    if importlib.util.find_spec("foxglove") is None:
        raise Unavailable(
            "foxglove-sdk is not installed, beside whose server this is measured (scripts/setup.sh python)"
        )
    found = measure(options)
    spent = {name: statistics.median(each) for name, each in found.spent.items()}
    mean = {name: statistics.mean(each) for name, each in found.spent.items()}
    ours, theirs = found.received
    print(
        f"    {', '.join(f'{name} {each:.1f} ms/s' for name, each in spent.items())}; "
        f"messages {ours} and {theirs}",
        flush=True,
    )
    against = "server of foxglove-sdk with rclpy"
    return [
        Row(
            "foxglove",
            f"LaserScan 40 Hz, image 640×480 15 Hz, cloud of 300 KB 10 Hz to {CLIENTS} Foxglove clients: "
            "daemon + relay",
            "ms/s",
            spent["daemon"] + spent["relay"],
            spent["sdk"],
            against,
            note=f"daemon {spent['daemon']:.1f} ms/s on the robot, relay {spent['relay']:.1f} ms/s elsewhere; "
            "the server of foxglove-sdk runs on the robot",
        ),
        Row(
            "foxglove",
            "the same, for each message that a client received",
            "µs/message",
            1000 * (mean["daemon"] + mean["relay"]) * found.seconds / ours,
            1000 * mean["sdk"] * found.seconds / theirs,
            against,
            ratio_bar=MOST,
            note=f"messages received, of the same publishers: {ours}, {theirs}",
        ),
    ]
