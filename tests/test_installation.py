"""Dependencies of each side: a robot needs no server parts, a server no ROS."""

from __future__ import annotations

import subprocess
import sys

import pytest

SERVER_ONLY = [
    "autobahn",
    "klein",
    "sqlalchemy",
    "alembic",
    "passlib",
    "argon2",
    "pybase64",
    "prometheus_client",
    "rich",
]
ROBOT_ONLY = ["rclpy", "cv2", "av"]
VIDEO_ONLY = ["numpy", "cv2", "av"]

WITHOUT = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent!r}:
            raise ModuleNotFoundError("No module named " + name, name=name)

sys.meta_path.insert(0, Absent())
{body}
"""


def run_without(absent: list[str], body: str) -> subprocess.CompletedProcess[str]:
    """A Python in which these modules are not installed."""
    program = WITHOUT.format(absent=set(absent), body=body)
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )


@pytest.mark.parametrize("module", ["robot_client.cli", "robot_client.run", "robot_client.motion.guard"])
def test_the_daemon_imports_without_the_servers_dependencies(module: str) -> None:
    """A robot installs only the extra 'robot'."""
    done = run_without(SERVER_ONLY, f"import {module}")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("module", ["robot_client.cli", "robot_client.run", "robot_client.motion.guard"])
def test_the_daemon_imports_without_what_cameras_need(module: str) -> None:
    """The extra 'video' is for robots with cameras."""
    done = run_without(VIDEO_ONLY, f"import {module}")
    assert done.returncode == 0, done.stderr


def test_a_robot_without_opencv_names_what_to_install() -> None:
    """The error has the missing package and the command that installs it."""
    body = """
from relay_protocol.errors import Unavailable
from robot_client.camera import check_installed
try:
    check_installed()
except Unavailable as error:
    print(error)
"""
    done = run_without(VIDEO_ONLY, body)
    assert done.returncode == 0, done.stderr
    assert "without numpy: No module named numpy (pip install 'robot-switchboard[video]')" in done.stdout


@pytest.mark.parametrize("module", ["relay_server.cli", "relay_server.relay", "relay_server.run"])
def test_the_relay_imports_without_ros(module: str) -> None:
    """A server installs only the extra 'server'."""
    done = run_without(ROBOT_ONLY, f"import {module}")
    assert done.returncode == 0, done.stderr


def test_the_daemon_explains_that_ros_is_missing(tmp_path: object) -> None:
    """Without rclpy the daemon's command line works, and 'run' names the missing package."""
    body = f"from robot_client.cli import main; main(['run', '--state', {str(tmp_path)!r}])"
    done = run_without(["rclpy"], body)
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
