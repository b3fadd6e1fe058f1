"""Organised point clouds of a real graph: those that pass, and those that cause an error."""

from __future__ import annotations

import base64
import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cbor2
import pytest
from websockets.sync.client import connect

from tests.worlds.processes import Process, ros_environment, running
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client

MIB = 1024 * 1024
NODE = Path(__file__).parent / "clients" / "clouds.py"
CLOUD = "sensor_msgs/msg/PointCloud2"
PASSES, TOO_LARGE = 18 * MIB, 21 * MIB


@pytest.fixture(scope="module")
def cloudy(world: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """A robot that sends messages of up to 20 MiB, with a node that has published one of 18 MiB and one of 21
    MiB.
    """
    robot = Robot(world.relay, "cloudy", daemon_env={"SWITCHBOARD_ROBOT_ROS_LARGEST_SAMPLE_MB": "20"})
    try:
        world.relay.cli("right", "grant", "operator", "cloudy", "operator")
        command = [sys.executable, str(NODE), "/organised", str(PASSES), "/enormous", str(TOO_LARGE)]
        node = Process(command, tmp_path_factory.mktemp("clouds"), "clouds", ros_environment(robot.domain))
        with running(node):
            node.wait_to_say("READY")
            yield robot
    finally:
        robot.stop()


@pytest.fixture
def client(world: Any, cloudy: Robot) -> Iterator[Client]:
    """A client that accepts messages of any size and receives errors."""
    url = world.relay.url("cloudy")
    headers = {"Authorization": f"Bearer {world.operator}"}
    with Client(connect(url, additional_headers=headers, max_size=None)) as client:
        client.send(op="set_level", level="error")
        yield client


def test_an_organised_cloud_passes(client: Client) -> None:
    """It is larger than a frame of the robot's link."""
    for _ in range(2):
        client.send(op="subscribe", topic="/organised", type=CLOUD, compression="cbor")
        message = cbor2.loads(client.connection.recv(timeout=60))
        data = message["msg"]["data"]
        assert bytes(data.value if hasattr(data, "value") else data) == bytes(range(16)) * (PASSES // 16)
        client.send(op="unsubscribe", topic="/organised")


def test_the_subscriber_is_notified_of_samples_that_are_too_large(client: Client, cloudy: Robot) -> None:
    """With reason and advice; the status counts it, and the robot's log has one line."""
    client.send(op="subscribe", id="e", topic="/enormous", type=CLOUD)
    words = client.until(op="status", id="e")["msg"]
    assert words.startswith("/enormous: a message of 220")
    assert "raise --largest-sample-mb of the relay and largest_sample_mb of the robot" in words
    client.send(op="subscribe", topic="/relay/status")
    lost = client.until(op="publish", topic="/relay/status")["msg"]["lost"]
    assert lost == [{"topic": "/enormous", "reason": "too_large", "count": 1}]
    assert cloudy.daemon.log.read_text().count("/enormous: a sample of 220") == 1


def test_a_client_publishes_as_much_as_rosbridge_takes(client: Client) -> None:
    """A message of nearly 10 MB reaches the robot's graph, and returns from it."""
    data = bytes(range(256)) * 28_000
    client.send(op="advertise", topic="/picture", type="sensor_msgs/msg/Image")
    client.send(op="subscribe", topic="/picture", type="sensor_msgs/msg/Image", compression="cbor")
    message = {
        "width": 256,
        "height": 28_000,
        "step": 256,
        "encoding": "mono8",
        "data": base64.b64encode(data).decode(),
    }
    heard = None
    for _ in range(20):
        # Until DDS has matched publisher and subscription.
        client.send(op="publish", topic="/picture", msg=message)
        with contextlib.suppress(TimeoutError):
            heard = cbor2.loads(client.connection.recv(timeout=3))["msg"]["data"]
            break
    assert heard is not None
    assert bytes(heard.value if hasattr(heard, "value") else heard) == data
