"""Robots without ROS, by the example program: each is enrolled at a relay, and runs in its own process."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.worlds.processes import Process
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import wait_for

PROGRAM = Path(__file__).parents[2] / "docs" / "examples" / "json_robot.py"


class JsonRobot:
    """A robot with the topics /temperature, /cmd_vel and /cmd_vel/heard, and the service /beep."""

    def __init__(self, relay: Relay, name: str) -> None:
        self.name = name
        code = relay.cli("robot", "add", name)["enrolment_code"]
        file = relay.folder / f"{name}.json"
        command = [sys.executable, str(PROGRAM), "127.0.0.1", str(relay.robots_port), name, code, str(file)]
        self.process = Process(command, relay.folder, f"robot-{name}")
        wait_for(f"{name} is online", lambda: relay.state_of(name) == "online")

    def stop(self) -> None:
        self.process.stop()
