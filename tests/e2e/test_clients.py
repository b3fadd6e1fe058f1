"""Third-party clients: roslibpy and roslib.js, unmodified."""

from __future__ import annotations

import json
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from tests.worlds.processes import ros_environment

CLIENTS = Path(__file__).parent / "clients"
ROOT = Path(__file__).parents[2]
ROSLIB = ROOT / "web_client" / "node_modules" / "roslib" / "dist" / "RosLib.js"


def run(command: list[str], **options: Any) -> dict[str, Any]:
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, **options)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def roslibpy(world: Any) -> dict[str, Any]:
    """A complete run of roslibpy."""
    return run([sys.executable, str(CLIENTS / "with_roslibpy.py"), world.relay.url("rover"), world.operator])


def roslib(world: Any, url: str, token: str) -> dict[str, Any]:
    """A complete run of roslib.js in Node."""
    node = [str(ROOT / "scripts" / "with-node.sh"), "node"]
    return run([*node, str(CLIENTS / "with_roslib.mjs"), str(ROSLIB), url, token])


def saw_everything(seen: dict[str, Any]) -> None:
    """The results that every client must have."""
    assert {"/scan", "/odom", "/cmd_vel", "/battery_state"} <= set(seen["topics"])
    assert "/reset" in seen["services"]
    assert seen["scan_type"] == "sensor_msgs/msg/LaserScan"
    assert seen["rays"] == 360
    assert seen["odom"]
    assert seen["moved"]
    assert seen["reset"]["success"] is True


def test_roslibpy_lists_watches_drives_and_calls(world: Any) -> None:
    """roslibpy with a Bearer header does all common operations."""
    saw_everything(roslibpy(world))


def test_roslib_js_with_the_auth_operation(world: Any) -> None:
    """roslib.js authenticates by ``ros.authenticate`` with the access token."""
    saw_everything(roslib(world, world.relay.url("rover"), world.operator))


def test_roslib_js_with_a_ticket(world: Any) -> None:
    """roslib.js connects by a single-use ticket in the URL; a second use fails."""
    request = urllib.request.Request(
        f"http://127.0.0.1:{world.relay.http_port}/api/v1/tickets",
        json.dumps({"robot": "rover"}).encode(),
        {"Authorization": f"Bearer {world.operator}", "Content-Type": "application/json"},
    )
    with urllib.request.urlopen(request) as answer:
        ticket = json.load(answer)["ticket"]
    url = f"{world.relay.url('rover')}?ticket={ticket}"
    saw_everything(roslib(world, url, ""))
    with pytest.raises(AssertionError):
        roslib(world, url, "")
    assert ticket not in world.relay.log


def test_three_clients_share_one_subscription_on_the_robot(world: Any) -> None:
    """For any number of clients the relay has one subscription on the robot; it ends with the last client."""
    counter = [sys.executable, str(CLIENTS / "subscriptions_of.py"), "/odom"]
    clients = [world.relay.connect("rover", token) for token in (world.operator, world.viewer, world.viewer)]
    try:
        for client in clients:
            client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
        for client in clients:
            assert client.until(op="publish", topic="/odom")["msg"]["child_frame_id"]
        environment = ros_environment(world.robot.domain)
        done = subprocess.run(
            counter, capture_output=True, text=True, env=environment, timeout=60, check=True
        )
        assert done.stdout.strip() == "1"
    finally:
        for client in clients:
            client.close()
