"""A robot with a low battery drives to its charger: real program, relay, daemon, simulator and marker
service.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.worlds.http_requests import ask
from tests.worlds.processes import Process, running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.service_process import service
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

THERE = 300.0
"""Seconds for a way that takes half a minute on a machine that has nothing else to do."""
CHARGING = 1


class World:
    """A robot with a low battery, a marker service, and a program that drives it to its charger."""

    def __init__(self, folder: Path, relay: Relay, robot: Robot) -> None:
        self.folder = folder
        self.relay = relay
        self.robot = robot
        self.person, self.token = (relay.user(name) for name in ("ann", "program"))
        for name in ("ann", "program"):
            relay.cli("right", "grant", name, "rover", "operator")
        self._runs = 0

    def program(self) -> Process:
        """Starts the program."""
        self._runs += 1
        command = [sys.executable, "-u", "-m", "robot_client.apps.recharge", self.relay.url("rover")]
        environment = {**os.environ, "SWITCHBOARD_TOKEN": self.token}
        return Process(command, self.folder, f"recharge{self._runs}", environment)

    def reported(self, path: str) -> Any:
        """The relay's data about the robot."""
        return ask(self.relay.http_port, "GET", f"/api/v1/robots/rover/{path}", token=self.person).json

    def free(self) -> bool:
        """Whether the robot has no controller."""
        return self.reported("control")["holder"] is None

    def stands(self) -> bool:
        """Whether the robot stands, with a zero as last command."""
        commands = self.robot.events("command")
        return not self.robot.moving() and (commands[-1]["v"], commands[-1]["w"]) == (0.0, 0.0)

    def charges(self) -> bool:
        """Whether its battery charges."""
        state = self.reported("topics/battery_state?wait=5")
        return state.get("value", {}).get("power_supply_status") == CHARGING


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    relay = Relay(tmp_path)
    with running(relay):
        robot = Robot(relay, "rover", camera=True, sim_options=("--charge", "15", "--camera-fps", "8"))
        markers = ("markers", "--view", "75", "--size", "0.4")
        with running(robot), service(robot.domain, tmp_path, *markers):
            yield World(tmp_path, relay, robot)


def says(program: Process, words: str) -> None:
    """Waits for a line of a program's output."""
    wait_for(f"it says: {words}", lambda: words in program.said().splitlines(), THERE)


def resume(client: Client) -> None:
    """Resumes a stopped robot without a controller, which on a busy machine may confirm too late that it has one."""

    def has_control() -> bool:
        answer = client.call("/relay/take_control")
        assert "asked" not in str(answer), answer
        return bool(answer["result"] and answer["values"]["success"])

    wait_for("it has control", has_control)
    wait_for("it is resumed", lambda: client.call("/relay/resume")["result"])
    assert client.call("/relay/release_control")["values"]["success"]


def test_a_robot_with_a_low_battery_drives_to_its_charger(world: World) -> None:
    """It waits for another driver, ends with a zero, stands while stopped, continues afterwards, and arrives.

    This includes an absence of the relay: the robot stands by itself meanwhile, and the program prints the
    reason.
    """
    robot = world.robot
    with world.relay.connect("rover", world.person) as ann:
        assert ann.call("/relay/take_control")["values"]["success"]
        program = world.program()
        with running(program):
            says(program, "battery low, waiting: ann has control")
            assert robot.events("command") == []
            assert ann.call("/relay/release_control")["values"]["success"]
            says(program, "looking for marker 7")
            wait_for("it turns", robot.moving)
            assert program.stop() == 0
        wait_for("it stands", world.stands)
        wait_for("control is given back", world.free)
        program = world.program()
        with running(program):
            says(program, "driving to marker 7")
            assert ann.call("/relay/stop")["values"]["done"]
            says(program, "control released: the robot is stopped by ann")
            wait_for("it stands", world.stands)
            wait_for("control is given back", world.free)
            resume(ann)
            wait_for("it drives on", robot.moving)
            world.relay.kill()
            wait_for("it says so", lambda: "is lost" in program.said())
            wait_for("it stands", lambda: not robot.moving())
            world.relay.start()
            wait_for("it charges", world.charges, THERE)
            says(program, "charging")
            wait_for("control is free", world.free)
            assert world.stands()
            assert program.stop() == 0
    assert robot.events("bump") == []
    for each in robot.events("command"):
        assert abs(each["v"]) <= 0.3 and abs(each["w"]) <= 1.0
