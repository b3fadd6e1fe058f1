"""CDR → JSON, messages as robots send them, against the way rosbridge goes; in this process, one core.

Ours is all of it, from the bytes DDS delivered to the bytes of JSON. The alternative is ``deserialize_message`` (what
an executor does before a callback), the walk of ``bench/rosbridge_way.py`` and ``ujson.dumps``, which rosbridge
takes when it is there. The parts are told in the notes.
"""

from __future__ import annotations

import importlib
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy

from bench import rosbridge_way
from bench.messages import text_of
from bench.report import Options, Row, Unavailable
from relay_protocol.ros_types import TypeRegistry

try:
    from ujson import dumps
except ImportError:
    # rosbridge does the same.
    dumps = json.dumps

BEAMS, POINTS = 1080, 18_750
ROUND_SECONDS = 0.1


@dataclass
class Case:
    """A message with a name for people."""

    name: str
    type: str
    message: Any


def cases() -> list[Case]:
    """The five messages, with values such as sensors give."""
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import Image, LaserScan, PointCloud2, PointField

    noise = numpy.random.default_rng(7)
    twist = Twist()
    twist.linear.x, twist.angular.z = 0.4173829374651, -0.88273645
    odometry = Odometry(child_frame_id="base_link", twist=_with_covariance(noise, twist))
    odometry.header.frame_id = "odom"
    odometry.header.stamp.sec, odometry.header.stamp.nanosec = 1_790_000_000, 123_456_789
    odometry.pose.pose.position.x, odometry.pose.pose.position.y = noise.normal(size=2)
    odometry.pose.pose.orientation.z, odometry.pose.pose.orientation.w = 0.382683432, 0.923879532
    odometry.pose.covariance = noise.normal(scale=0.01, size=36)
    scan = LaserScan(angle_min=-2.35, angle_max=2.35, angle_increment=4.7 / BEAMS, range_max=30.0)
    scan.header = odometry.header
    ranges = noise.uniform(0.2, 30.0, BEAMS).astype("f4")
    ranges[::40] = numpy.inf
    scan.ranges = ranges.tolist()
    scan.intensities = noise.uniform(0, 255, BEAMS).astype("f4").tolist()
    cloud = PointCloud2(height=1, width=POINTS, point_step=16, row_step=16 * POINTS, is_dense=True)
    cloud.header = odometry.header
    cloud.fields = [
        PointField(name=name, offset=4 * at, datatype=7, count=1) for at, name in enumerate("xyzi")
    ]
    cloud.data = noise.normal(scale=5, size=4 * POINTS).astype("f4").tobytes()
    image = Image(height=480, width=640, encoding="rgb8", step=1920)
    image.header = odometry.header
    image.data = (
        (numpy.add.outer(numpy.arange(480), numpy.arange(1920)) + noise.integers(0, 9, (480, 1920)))
        .astype("u1")
        .tobytes()
    )
    return [
        Case("Twist", "geometry_msgs/msg/Twist", twist),
        Case("Odometry", "nav_msgs/msg/Odometry", odometry),
        Case(f"LaserScan, 2×{BEAMS}", "sensor_msgs/msg/LaserScan", scan),
        Case("PointCloud2, 300 KB", "sensor_msgs/msg/PointCloud2", cloud),
        Case("Image, 640×480 rgb8", "sensor_msgs/msg/Image", image),
    ]


def _with_covariance(noise: Any, twist: Any) -> Any:
    from geometry_msgs.msg import TwistWithCovariance

    return TwistWithCovariance(twist=twist, covariance=noise.normal(scale=0.01, size=36))


def timed(work: Callable[[], object], seconds: float) -> float:
    """Microseconds of processor time one call takes, over at least so many seconds."""
    count, spent = 1, 0
    while True:
        begun = time.process_time_ns()
        for _ in range(count):
            work()
        spent = time.process_time_ns() - begun
        if spent >= seconds * 1e9 or (seconds == 0 and count):
            return spent / 1e3 / count
        count = max(count + 1, int(count * min(10.0, 1.1 * seconds * 1e9 / max(spent, 1))))


def medians(works: dict[str, Callable[[], object]], options: Options) -> dict[str, float]:
    """Each in turn, some rounds; medians of microseconds."""
    seconds, rounds = options.pick(0.0, ROUND_SECONDS), int(options.pick(1, 3))
    found: dict[str, list[float]] = {name: [] for name in works}
    for work in works.values():
        work()
    for _ in range(rounds):
        for name, work in works.items():
            found[name].append(timed(work, seconds))
    return {name: statistics.median(each) for name, each in found.items()}


def rows_of(case: Case, types: TypeRegistry, options: Options) -> list[Row]:
    """One message: to JSON with the bar, to CBOR and from JSON without."""
    from rclpy.serialization import deserialize_message, serialize_message

    package, _, short = case.type.split("/")
    kind = getattr(importlib.import_module(f"{package}.msg"), short)
    cdr = serialize_message(case.message)
    parsed = deserialize_message(cdr, kind)
    plain = rosbridge_way.values(parsed)
    to_json, to_cbor, to_cdr = (
        types.reader(case.type, "json"),
        types.reader(case.type, "cbor"),
        types.writer(case.type),
    )
    text = to_json(cdr)
    assert text, case.name
    took = medians(
        {
            "json": lambda: to_json(cdr),
            "cbor": lambda: to_cbor(cdr),
            "cdr": lambda: to_cdr(text, 0),
            "parse": lambda: deserialize_message(cdr, kind),
            "walk": lambda: rosbridge_way.values(parsed),
            "dumps": lambda: dumps(plain),
            "whole": lambda: dumps(rosbridge_way.values(deserialize_message(cdr, kind))),
            "lean": lambda: dumps(rosbridge_way.lean(deserialize_message(cdr, kind))),
        },
        options,
    )
    print(f"    {case.name}: {took['json']:.2f} µs, rosbridge's way {took['whole']:.1f} µs", flush=True)
    note = (
        f"{case.name}, rosbridge's way: deserialize {took['parse']:.3g} + walk {took['walk']:.3g} + "
        f"{dumps.__module__}.dumps {took['dumps']:.3g} µs; with a lean walk {took['lean']:.3g} µs in all, "
        f"{took['lean'] / took['json']:.3g} times ours"
    )
    return [
        Row(
            "codec",
            f"CDR → JSON, {case.name}",
            "µs",
            took["json"],
            took["whole"],
            "rosbridge's way (stand-in)",
            1 / 50,
            note=note,
        ),
        Row("codec", f"CDR → CBOR, {case.name}", "µs", took["cbor"]),
        Row("codec", f"JSON → CDR, {case.name}", "µs", took["cdr"]),
    ]


def run(options: Options) -> list[Row]:
    """All five."""
    try:
        importlib.import_module("rclpy.serialization")
    except ImportError as error:
        raise Unavailable(f"no ROS 2 here ({error})") from None
    types = TypeRegistry()
    found = cases()
    for name, text in text_of(*(case.type for case in found)).items():
        types.add(name, text)
    rows = [row for case in found for row in rows_of(case, types, options)]
    return sorted(rows, key=lambda row: row.ratio_bar is None)
