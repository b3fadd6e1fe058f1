"""The apps' own client class and parsers (``@foxglove/ws-protocol``, ``@foxglove/rosmsg``) on a real ROS 2 graph."""

from __future__ import annotations

import contextlib
import itertools
import json
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from tests.e2e.conftest import MESH
from tests.worlds.driving import LIMIT_MS
from tests.worlds.foxglove_apps import saw_the_robot, visit
from tests.worlds.foxglove_client import twist
from tests.worlds.machine_pauses import Pulse
from tests.worlds.processes import Process, ros_environment
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import PATIENCE, wait_for

CLIENTS = Path(__file__).parent / "clients"
POINTS = 1000
SDK, LEGACY = "foxglove.sdk.v1", "foxglove.websocket.v1"


@pytest.mark.parametrize(
    ("protocols", "selected"), [((SDK,), SDK), ((LEGACY,), LEGACY), ((LEGACY, SDK), SDK)]
)
def test_the_apps_client_decodes_everything_drives_calls_and_sets(
    world: Any, protocols: tuple[str, ...], selected: str
) -> None:
    """As an operator."""
    seen = visit(world.relay.url("rover"), world.operator, *protocols)
    assert seen["protocol"] == selected
    saw_the_robot(seen)
    first, ping, second = seen["answers"]
    assert first["success"]
    assert second["success"]
    assert ping["relay_time_ns"] > 0
    assert seen["speed"]["type"] == "float64"
    assert seen["set"] == [{"name": seen["speed"]["name"], "value": 1, "type": "float64"}]
    assert seen["none"] == []
    assert seen["changed"] == seen["set"]
    assert seen["back"] == [seen["speed"]]
    assert "max_speed" in seen["refused"]
    assert seen["moved"]
    assert seen["stopped"]


def test_a_viewer_sees_everything_and_may_change_nothing(world: Any) -> None:
    """The right to publish is not offered."""
    seen = visit(world.relay.url("rover"), world.viewer, LEGACY, SDK)
    saw_the_robot(seen)
    assert "clientPublish" not in seen["info"]["capabilities"]
    assert "/reset" not in seen["services"]
    assert seen["parameters"] == 0


def opened(world: Any, options: str = "") -> ClientConnection:
    """A viewer's connection.

    :param options: of the URL, such as ``?stride=10``
    """
    return connected(f"{world.relay.url('rover')}{options}", world.viewer)


def connected(url: str, token: str) -> ClientConnection:
    """A connection with an access token."""
    return connect(
        url,
        additional_headers={"Authorization": f"Bearer {token}"},
        subprotocols=[SDK],
        max_size=None,
        max_queue=None,
        open_timeout=PATIENCE,
    )


def channel_of(client: ClientConnection, topic: str) -> int:
    """A topic's channel number, as soon as it is advertised."""
    while True:
        message = client.recv(PATIENCE)
        if isinstance(message, str) and (found := json.loads(message))["op"] == "advertise":
            numbers = {each["topic"]: each["id"] for each in found["channels"]}
            if topic in numbers:
                return int(numbers[topic])


def binary(client: ClientConnection, opcode: int) -> bytes:
    """The next binary message with an opcode, without it."""
    while True:
        message = client.recv(PATIENCE)
        if isinstance(message, bytes) and message[0] == opcode:
            return message[1:]


def test_a_mesh_of_the_robot_arrives_whole(world: Any) -> None:
    with opened(world) as client:
        uri = "package://rover_description/meshes/base.stl"
        client.send(json.dumps({"op": "fetchAsset", "requestId": 7, "uri": uri}))
        answer = binary(client, 4)
    assert struct.unpack_from("<IBI", answer) == (7, 0, 0)
    assert answer[9:] == MESH


@pytest.fixture(scope="module")
def cloud(world: Any) -> Iterator[str]:
    """A topic with point clouds whose points are all in one cube."""
    command = [sys.executable, str(CLIENTS / "lidar.py"), "/cloud", str(POINTS)]
    node = Process(command, world.robot.folder, "lidar", ros_environment(world.robot.domain))
    try:
        node.wait_to_say("READY")
        yield "/cloud"
    finally:
        node.stop()


@pytest.mark.parametrize(
    ("options", "points"), [("?stride=10", POINTS // 10), ("?voxel=0.1", 1), ("", POINTS)]
)
def test_a_cloud_is_thinned_by_the_urls_options(world: Any, cloud: str, options: str, points: int) -> None:
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import PointCloud2

    with opened(world, options) as client:
        subscription = {"id": 1, "channelId": channel_of(client, cloud)}
        client.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))

        def is_thinned() -> bool:
            received = deserialize_message(binary(client, 1)[12:], PointCloud2)
            return (received.width * received.height, len(received.data)) == (points, 16 * points)

        # Clouds for an earlier connection may still be under way.
        wait_for(f"a cloud of {points} points arrives", is_thinned)


LINEAR_LIMIT = 0.3
"""Metres a second; the Teleop panel's default is 1.0."""


@pytest.fixture(scope="module")
def slow(world: Any) -> Iterator[Robot]:
    """A robot with a speed limit for its users, and no other driver."""
    robot = Robot(world.relay, "slow", settings=f"[limits]\nlinear = {LINEAR_LIMIT}\n")
    world.relay.cli("right", "grant", "operator", "slow", "operator")
    try:
        yield robot
    finally:
        robot.stop()


def test_the_teleop_panel_at_its_default_rate_moves_a_robot_that_its_watchdog_stops(
    world: Any, slow: Robot
) -> None:
    """1 Hz, 1.0 m/s, the ROS 1 spelling of the type, and no message when the button is released."""
    channel = {"id": 1, "topic": "/cmd_vel", "encoding": "cdr", "schemaName": "geometry_msgs/Twist"}
    with connected(world.relay.url("slow"), world.operator) as client:
        channel_of(client, "/cmd_vel")
        client.send(json.dumps({"op": "advertise", "channels": [channel]}))
        wait_for("the robot moves, stands and moves again", lambda: _press(client, slow, channel["id"]))


def _press(client: ClientConnection, robot: Robot, channel: int) -> bool:
    """Holds a button of the panel for 3 s. The watchdog stops the robot in time after each message.

    :returns: whether it has moved, stood, moved and stood; a busy machine may drop a command as too old
    """
    since_ns = time.monotonic_ns()
    with Pulse() as pulse:
        for _ in range(3):
            client.send(struct.pack("<BI", 1, channel) + twist(1.0))
            time.sleep(1.0)
        held_up_ms = 1000 * pulse.held_up()
    commands = robot.events("command", since_ns)
    assert all(each["v"] <= LINEAR_LIMIT for each in commands)
    for moving, following in itertools.pairwise(commands):
        if moving["v"]:
            # A command that follows without a zero comes a second later.
            assert (following["t"] - moving["t"]) / 1e6 < LIMIT_MS + held_up_ms
    changes = [each["event"] for each in robot.record() if each["t"] >= since_ns]
    seen = [each for each in changes if each in ("moving", "standstill")]
    return seen[-4:] == 2 * ["moving", "standstill"]


# --- control ----------------------------------------------------------------------------------------------


class Driver:
    """A client that drives, and the statuses that it shows now."""

    def __init__(self, client: ClientConnection) -> None:
        self._client = client
        self.shown: dict[str, dict[str, Any]] = {}
        """By id."""
        channel = {"id": 1, "topic": "/cmd_vel", "encoding": "cdr", "schemaName": "geometry_msgs/Twist"}
        channel_of(client, "/cmd_vel")
        client.send(json.dumps({"op": "advertise", "channels": [channel]}))

    def drives(self, speed: float) -> None:
        """Publish one command."""
        self._client.send(struct.pack("<BI", 1, 1) + twist(speed))

    def shows(self) -> set[str]:
        """Ids of the statuses that are shown, once nothing has come for a moment."""
        with contextlib.suppress(TimeoutError):
            while True:
                data = self._client.recv(0.2)
                message: dict[str, Any] = json.loads(data) if isinstance(data, str) else {}
                if message.get("op") == "status":
                    self.shown[message["id"]] = message
                elif message.get("op") == "removeStatus":
                    for id in message["statusIds"]:
                        del self.shown[id]
        return set(self.shown)


def test_who_controls_the_robot_is_shown_while_another_is_refused_and_taken_back_when_it_is_free(
    world: Any, slow: Robot
) -> None:
    token = world.relay.user("bob")
    world.relay.cli("right", "grant", "bob", "slow", "operator")
    url = world.relay.url("slow")
    with connected(url, token) as second:
        bob = Driver(second)
        with connected(url, world.operator) as first:
            ann = Driver(first)

            def holds() -> bool:
                ann.drives(0.1)
                return "control" in bob.shows()

            wait_for("the holder is shown", holds)
            state = bob.shown["control"]
            assert (state["level"], state["message"]) == (0, "the robot is controlled by operator")

            def refused() -> bool:
                """A busy machine may drop a command as too old instead."""
                ann.drives(0.1)
                bob.drives(0.1)
                bob.shows()
                refusal = bob.shown.get("publish:/cmd_vel", {"level": 0, "message": ""})
                return refusal["level"] == 2 and "is controlled by operator" in refusal["message"]

            wait_for("the refusal names the holder", refused)
            assert "control" not in ann.shows()
        wait_for("both are taken back", lambda: not bob.shows() & {"control", "publish:/cmd_vel"})

        def drives() -> bool:
            bob.drives(0.1)
            return "control" not in bob.shows() and slow.moving()

        wait_for("the robot is free, and moves", drives)


# --- thin links -------------------------------------------------------------------------------------------


def test_a_scan_is_throttled_by_the_urls_option_and_for_that_client_alone(world: Any) -> None:
    """Between two scans of this client another one gets all others."""

    def subscribes(client: ClientConnection) -> int:
        """Returns the time of the first scan, nanoseconds."""
        subscription = {"id": 1, "channelId": channel_of(client, "/scan")}
        client.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
        return received(client)

    def received(client: ClientConnection) -> int:
        return int(struct.unpack_from("<IQ", binary(client, 1))[1])

    with opened(world) as whole, opened(world, "?throttle=2000") as thin:
        every = [subscribes(whole)]
        some = [subscribes(thin), *(received(thin) for _ in range(2))]
        while every[-1] < some[-1]:
            every.append(received(whole))
    assert set(some) <= set(every)
    between = [sum(first < each < second for each in every) for first, second in itertools.pairwise(some)]
    assert all(between)
