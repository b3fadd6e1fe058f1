"""A real robot for measurements: the daemon, a ROS 2 publisher, and a count of the bytes between daemon and relay."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench.child import Child
from bench.relay import Relay
from bench.report import Options, Unavailable
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.processes import BIN, Process, ros_environment, running
from tests.worlds.ros_domains import free_domain
from tests.worlds.waiting import wait_for

SETTLE_SECONDS = 8.0
"""A daemon that has just come up is busy for some seconds with what it finds."""


class Publisher(Child):
    """``bench/ros_publisher.py``, running.

    :param streams: as it takes them
    """

    def __init__(self, environment: dict[str, str], streams: list[dict[str, Any]]) -> None:
        command = [sys.executable, "-m", "bench.ros_publisher", json.dumps(streams)]
        super().__init__(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        self.ready(Unavailable("the ROS 2 publisher does not start; see above"))

    def sent(self) -> dict[str, int]:
        """Messages published so far, by topic."""
        return self.ask()


class RealRobot:
    """A daemon, enrolled and online, in a ROS domain of its own, with a publisher beside it."""

    def __init__(self, relay: Relay, name: str, streams: list[dict[str, Any]]) -> None:
        self.name = name
        self.relay = relay
        self.folder = relay.folder / name
        self.folder.mkdir()
        self.environment = ros_environment(free_domain())
        self.proxy = ChaosProxy(relay.robots_port)
        self.publisher = Publisher(self.environment, streams)
        state = str(self.folder / "state")
        code = relay.cli("robot", "add", name)["enrolment_code"]
        enroll = [str(BIN / "switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{self.proxy.port}"]
        enroll += ["--robot", name, "--code", "-", "--state", state]
        subprocess.run(enroll, input=code, text=True, capture_output=True, timeout=60, check=True)
        run = [str(BIN / "switchboard-robot"), "run", "--state", state]
        self.daemon = Process(run, self.folder, "daemon", self.environment)
        wait_for(f"{name} is online", lambda: relay.state_of(name) != "offline", 30)

    @property
    def pid(self) -> int:
        """The daemon; its guard is its child."""
        return self.daemon.popen.pid

    def viewer(self, user: str) -> str:
        """A token of somebody who may watch."""
        token = self.relay.user(user)
        self.relay.cli("right", "grant", user, self.name, "viewer")
        return token

    def stop(self) -> None:
        """End all."""
        self.daemon.stop()
        self.publisher.stop()
        self.proxy.close()


@contextlib.contextmanager
def real_robot(streams: list[dict[str, Any]]) -> Iterator[RealRobot]:
    """A relay and a robot that publishes these, in a folder that goes with them."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        relay = Relay(Path(folder))
        with running(relay):
            robot = RealRobot(relay, "rover", streams)
            with running(robot):
                yield robot


def settle(options: Options) -> None:
    """Wait until a daemon that has just come up costs what it costs from then on. Nothing tells when."""
    time.sleep(options.pick(0, SETTLE_SECONDS))
