"""The simulated robot as a process in a real ROS 2 graph."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import BatteryState, CompressedImage, Image, LaserScan
from std_srvs.srv import Trigger

from tests.worlds.processes import mortal
from tests.worlds.ros_domains import free_domain

PATIENCE = 60.0
"""Seconds; only a failure takes that long."""
DOMAIN = free_domain()
SETTINGS = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


@contextlib.contextmanager
def simulator(*options: str) -> Iterator[subprocess.Popen[str]]:
    """A running simulator that has printed READY."""
    process = subprocess.Popen(
        mortal([sys.executable, "-m", "robot_client.sim.main", *options]),
        env={**os.environ, **SETTINGS},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "READY\n"
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
        try:
            process.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            raise


class Graph:
    """A node of the test, with the newest message of each topic."""

    def __init__(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=DOMAIN)
        self.node = rclpy.create_node("onlooker", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.newest: dict[str, Any] = {}

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def wait_for(self, fact: Callable[[], Any], meanwhile: Callable[[], None] | None = None) -> Any:
        """Spin until a condition holds, and return its value; in between repeat an action."""
        deadline = time.monotonic() + PATIENCE
        while not (value := fact()):
            assert time.monotonic() < deadline, "it didn't come about in time"
            if meanwhile is not None:
                meanwhile()
            self._executor.spin_once(timeout_sec=0.05)
        return value

    def watch(self, topic: str, kind: type, qos: Any = 10) -> Callable[[], Any]:
        """Subscribe; return a function that gives a message that arrived after its call."""
        self.node.create_subscription(kind, topic, lambda m: self.newest.__setitem__(topic, m), qos)

        def fresh() -> Any:
            self.newest.pop(topic, None)
            return self.wait_for(lambda: self.newest.get(topic))

        return fresh

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service until it responds: a response can be lost during discovery."""
        client = self.node.create_client(kind, name)
        self.wait_for(client.service_is_ready)
        asked: list[Any] = []

        def ask() -> None:
            if not asked or time.monotonic() > asked[-1][0] + 5.0:
                asked.append((time.monotonic(), client.call_async(request)))

        answered = self.wait_for(
            lambda: next((future for _, future in asked if future.done()), None), meanwhile=ask
        )
        return answered.result()

    def driver(self, topic: str) -> Callable[[float, float, Callable[[], Any]], Any]:
        """Publish a velocity until a condition holds; once is not enough during discovery."""
        publisher = self.node.create_publisher(Twist, topic, 10)

        def drive(speed: float, turn: float, until: Callable[[], Any]) -> Any:
            message = Twist()
            message.linear.x, message.angular.z = speed, turn
            return self.wait_for(until, meanwhile=lambda: publisher.publish(message))

        return drive


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    for name, value in SETTINGS.items():
        monkeypatch.setenv(name, value)
    graph = Graph()
    yield graph
    graph.close()


@pytest.fixture(scope="module")
def robot() -> Iterator[subprocess.Popen[str]]:
    with simulator("--seed", "1") as process:
        yield process


def set_speed(graph: Graph, value: float) -> Any:
    wanted = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    request = SetParameters.Request(parameters=[Parameter(name="max_speed", value=wanted)])
    return graph.call(SetParameters, "/switchboard_sim/set_parameters", request).results[0]


def test_robot_drives_stops_and_resets(robot: subprocess.Popen[str], graph: Graph) -> None:
    odom = graph.watch("/odom", Odometry)
    drive = graph.driver("/cmd_vel")
    begin = odom()
    moved = drive(
        0.4, 0.0, lambda: (m := odom()).pose.pose.position.x > begin.pose.pose.position.x + 0.3 and m
    )
    assert moved.twist.twist.linear.x == pytest.approx(0.4, abs=0.01)
    assert (moved.header.frame_id, moved.child_frame_id) == ("odom", "base_link")
    drive(0.0, 0.0, lambda: odom().twist.twist.linear.x == 0.0)
    answer = graph.call(Trigger, "/reset", Trigger.Request())
    assert answer.success and answer.message
    # What was published before waits in the queue.
    graph.wait_for(lambda: odom().pose.pose.position == begin.pose.pose.position)


def test_max_speed_takes_effect_at_once_and_is_bounded(robot: subprocess.Popen[str], graph: Graph) -> None:
    odom = graph.watch("/odom", Odometry)
    drive = graph.driver("/cmd_vel")
    assert set_speed(graph, 0.1).successful
    drive(1.0, 2.0, lambda: odom().twist.twist.linear.x == pytest.approx(0.1))
    refused = set_speed(graph, 50.0)
    assert not refused.successful and "range" in refused.reason
    assert odom().twist.twist.linear.x == pytest.approx(0.1)
    assert set_speed(graph, 0.5).successful
    graph.wait_for(lambda: odom().twist.twist.linear.x > 0.2)
    drive(0.0, 0.0, lambda: odom().twist.twist.linear.x == 0.0)
    graph.call(Trigger, "/reset", Trigger.Request())


def test_scan_has_a_ray_for_every_degree(robot: subprocess.Popen[str], graph: Graph) -> None:
    scan = graph.watch("/scan", LaserScan, qos_profile_sensor_data)()
    ranges = np.array(scan.ranges)
    assert len(ranges) == 360
    assert scan.angle_min + 359 * scan.angle_increment == pytest.approx(scan.angle_max, abs=1e-4)
    assert scan.angle_increment * 360 == pytest.approx(2 * np.pi, abs=1e-4)
    seen = ranges[np.isfinite(ranges)]
    assert len(seen) > 180
    assert seen.min() >= scan.range_min and seen.max() <= scan.range_max
    assert scan.header.frame_id == "laser"


def test_images_raw_and_compressed(robot: subprocess.Popen[str], graph: Graph) -> None:
    jpeg = graph.watch("/camera/image_raw/compressed", CompressedImage, qos_profile_sensor_data)()
    decoded = cv2.imdecode(np.frombuffer(jpeg.data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == (480, 640, 3)
    raw = graph.watch("/camera/image_raw", Image, qos_profile_sensor_data)()
    assert (raw.width, raw.height, raw.step, raw.encoding) == (640, 480, 1920, "rgb8")
    pixels = np.frombuffer(raw.data, np.uint8).reshape(480, 640, 3)
    above_captions = slice(0, 430)
    difference = decoded[above_captions, :, ::-1].astype(int) - pixels[above_captions]
    assert np.abs(difference).mean() < 6


def test_camera_has_the_configured_size_and_rate(graph: Graph) -> None:
    with simulator("--namespace", "large", "--camera-size", "1280x720", "--camera-fps", "2"):
        raw = graph.watch("/large/camera/image_raw", Image, qos_profile_sensor_data)()
        assert (raw.width, raw.height, raw.step, len(raw.data)) == (1280, 720, 3840, 3840 * 720)
        fresh = graph.watch("/large/camera/image_raw/compressed", CompressedImage, qos_profile_sensor_data)
        shown = [fresh() for _ in range(4)]
    assert cv2.imdecode(np.frombuffer(shown[0].data, np.uint8), cv2.IMREAD_COLOR).shape == (720, 1280, 3)
    stamps = [each.header.stamp.sec + each.header.stamp.nanosec / 1e9 for each in shown]
    assert stamps[-1] - stamps[0] > 1


def test_transforms_agree_with_odometry(robot: subprocess.Popen[str], graph: Graph) -> None:
    graph.watch("/odom", Odometry)()
    topics = dict(graph.node.get_topic_names_and_types())
    if importlib.util.find_spec("tf2_msgs") is None:
        assert "/tf" not in topics
        return
    from tf2_msgs.msg import TFMessage

    graph.call(Trigger, "/reset", Trigger.Request())
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    fixed = graph.watch("/tf_static", TFMessage, latched)().transforms
    sensors = {"laser", "camera", "camera_depth_optical_frame"}
    assert {each.child_frame_id for each in fixed} == {*sensors, "odom"}
    assert {each.header.frame_id for each in fixed if each.child_frame_id == "odom"} == {"map"}
    (moving,) = graph.watch("/tf", TFMessage)().transforms
    assert (moving.header.frame_id, moving.child_frame_id) == ("odom", "base_link")
    stands_at = graph.watch("/odom", Odometry)().pose.pose.position
    assert (moving.transform.translation.x, moving.transform.translation.y) == (stands_at.x, stands_at.y)


def test_battery_drains(robot: subprocess.Popen[str], graph: Graph) -> None:
    battery = graph.watch("/battery_state", BatteryState)
    first, second = battery(), battery()
    assert 0 < second.percentage < first.percentage <= 1
    assert second.voltage > 18 and second.current < 0


def test_diagnostics_report_a_stall(robot: subprocess.Popen[str], graph: Graph) -> None:
    diagnostics = graph.watch("/diagnostics", DiagnosticArray)

    def motors() -> DiagnosticStatus:
        by_part = {status.name.split(": ")[1]: status for status in diagnostics().status}
        assert set(by_part) == {"motors", "battery", "camera"}
        return by_part["motors"]

    graph.call(Trigger, "/reset", Trigger.Request())
    drive = graph.driver("/cmd_vel")
    assert motors().level == DiagnosticStatus.OK
    assert set_speed(graph, 2.0).successful
    stalled = drive(-2.0, 0.0, lambda: (m := motors()).level == DiagnosticStatus.WARN and m)
    assert "obstacle" in stalled.message
    drive(0.0, 0.0, lambda: motors().level == DiagnosticStatus.OK)
    assert set_speed(graph, 0.5).successful
    graph.call(Trigger, "/reset", Trigger.Request())


def test_two_namespaces_are_two_robots(graph: Graph) -> None:
    with simulator("--namespace", "one", "--no-camera"), simulator("--namespace", "/two", "--no-camera"):
        one, two = (graph.watch(f"/{name}/odom", Odometry) for name in ("one", "two"))
        still = two().pose.pose.position
        graph.driver("/one/cmd_vel")(0.4, 0.0, lambda: one().twist.twist.linear.x > 0.3)
        assert two().pose.pose.position == still
        assert (one().header.frame_id, two().header.frame_id) == ("one/odom", "two/odom")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_ends_cleanly_by_signal(number: signal.Signals) -> None:
    """Exit code 0, and an empty stderr."""
    with simulator("--no-camera") as process:
        process.send_signal(number)
        _, errors = process.communicate(timeout=PATIENCE)
        assert (process.returncode, errors) == (0, "")


def test_record_is_written_at_once(graph: Graph, tmp_path: Path) -> None:
    file = tmp_path / "record.jsonl"

    def events() -> list[dict[str, Any]]:
        return [json.loads(line) for line in file.read_bytes().splitlines()]

    def names() -> set[str]:
        return {event["event"] for event in events()}

    with simulator("--no-camera", "--world", "open", "--record", str(file)):
        drive = graph.driver("/cmd_vel")
        drive(0.3, 0.0, lambda: "moving" in names())
        drive(0.0, 0.0, lambda: "standstill" in names())
        written = events()
    order = [event["event"] for event in written]
    assert order[0] == "command"
    assert order.index("moving") < order.index("standstill")
    stop = next(event for event in written if event.get("v") == 0.0)
    standstill = written[order.index("standstill")]
    assert stop["t"] < standstill["t"]
    assert [event["t"] for event in written] == sorted(event["t"] for event in written)


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--namespace", "a b", "'a b' is not a ROS namespace"),
        ("--camera-size", "1280", "'1280' is not a size; write width and height in pixels, as 1280x720"),
        ("--camera-size", "1280x2000", "1280x2000 is out of range: 320x240 to 1920x1080"),
        ("--camera-fps", "61", "61 is not in the range"),
    ],
)
def test_invalid_options_are_reported(option: str, value: str, words: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "robot_client.sim.main", option, value],
        env={**os.environ, **SETTINGS},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
