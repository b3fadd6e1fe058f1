"""Interface packages built at set-up, used by a real ROS 2 node."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.worlds.ros_domains import free_domain

SCRIPT = Path(__file__).parents[2] / "scripts" / "build_interfaces.py"
PACKAGE = "built_for_test_interfaces"
FILES = {
    "msg/Reading.msg": "uint8 HOT=1\nstd_msgs/Header header\nfloat64[] values\nstring unit\n",
    "srv/Move.srv": "geometry_msgs/Point to\n---\nbool arrived\n",
    # the same stem as the service: rosidl's own helper would mix the two up
    "action/Move.action": "Reading[] via\n---\nuint32 steps\n---\nfloat32 share\n",
}
USE = f"""
import rclpy
from {PACKAGE}.action import Move as MoveAction
from {PACKAGE}.msg import Reading
from {PACKAGE}.srv import Move
from rclpy.serialization import deserialize_message, serialize_message

reading = Reading(values=[1.5, 2.5], unit="°C")
reading.header.frame_id = "oven"
assert deserialize_message(serialize_message(reading), Reading) == reading
goal = MoveAction.Goal(via=[reading])
assert deserialize_message(serialize_message(goal), MoveAction.Goal) == goal

rclpy.init()
node = rclpy.create_node("user")
def move(request, response):
    response.arrived = request.to.x == 3.0
    return response
node.create_service(Move, "move", move)
client = node.create_client(Move, "move")
assert client.wait_for_service(timeout_sec=30)
request = Move.Request()
request.to.x = 3.0
future = client.call_async(request)
rclpy.spin_until_future_complete(node, future, timeout_sec=30)
assert future.result().arrived
node.create_publisher(Reading, "reading", 1)
hashes = [str(end.topic_type_hash) for end in node.get_publishers_info_by_topic("reading")]
assert hashes[0].startswith("RIHS01_"), hashes
rclpy.shutdown()
print("used")
"""


def run(prefix: Path, *command: str) -> subprocess.CompletedProcess[str]:
    libraries = os.pathsep.join(filter(None, (str(prefix / "lib"), os.environ.get("LD_LIBRARY_PATH"))))
    site = next(prefix.glob("lib/python3*/site-packages"), prefix)
    return subprocess.run(
        [sys.executable, *command],
        env={
            **os.environ,
            "PYTHONPATH": str(site),
            "LD_LIBRARY_PATH": libraries,
            "ROS_DOMAIN_ID": str(free_domain()),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        },
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


@pytest.fixture
def package(tmp_path: Path) -> Path:
    folder = tmp_path / PACKAGE
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def test_message_service_and_action_work_in_a_node(tmp_path: Path, package: Path) -> None:
    """Built types pass through the middleware; a second build finds them up to date; a change causes a new
    build.
    """
    prefix = tmp_path / "prefix"
    built = run(prefix, str(SCRIPT), "--prefix", str(prefix), str(package))
    assert built.returncode == 0, built.stderr
    assert f"{PACKAGE} is built" in built.stdout
    used = run(prefix, "-c", USE)
    assert used.stdout == "used\n", used.stderr
    again = run(prefix, str(SCRIPT), "--prefix", str(prefix), str(package))
    assert again.stdout == f"{PACKAGE} is up to date\n"
    (package / "msg" / "Reading.msg").write_text("float64 value\n", encoding="utf-8")
    changed = run(prefix, str(SCRIPT), "--prefix", str(prefix), str(package))
    assert f"{PACKAGE} is built" in changed.stdout, changed.stderr


def test_a_folder_without_interfaces_is_reported(tmp_path: Path) -> None:
    """The reason is one line, not a traceback."""
    done = run(tmp_path, str(SCRIPT), "--prefix", str(tmp_path), str(tmp_path))
    assert done.returncode == 1
    assert "holds no msg/*.msg" in done.stderr
    assert "Traceback" not in done.stderr
