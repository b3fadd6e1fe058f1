"""A robot whose battery is low drives to its charger: the real program, relay, daemon, simulator and marker service."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from switchboard_client import Client
from switchboard_http import ask
from switchboard_processes import Process, running
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_waiting import wait_for

from tests.robot_client.services.onlooker import service

THERE = 300.0
"""Seconds for a way that takes half a minute on a machine that has nothing else to do."""
CHARGING = 1


class Hungry:
    """A robot with a low battery, a marker service, and a program that is to bring it to its charger."""

    def __init__(self, folder: Path, relay: Relay, robot: Robot) -> None:
        self.folder = folder
        self.relay = relay
        self.robot = robot
        self.person, self.token = (relay.user(name) for name in ("ann", "program"))
        for name in ("ann", "program"):
            relay.cli("right", "grant", name, "rover", "operator")
        self._runs = 0

    def program(self) -> Process:
        """The program, from now on."""
        self._runs += 1
        command = [sys.executable, "-u", "-m", "robot_client.apps.recharge", self.relay.url("rover")]
        environment = {**os.environ, "SWITCHBOARD_TOKEN": self.token}
        return Process(command, self.folder, f"recharge{self._runs}", environment)

    def told(self, path: str) -> Any:
        """What the relay tells of the robot."""
        return ask(self.relay.http_port, "GET", f"/api/v1/robots/rover/{path}", token=self.person).json

    def free(self) -> bool:
        """Whether nobody has control."""
        return self.told("control")["holder"] is None

    def stands(self) -> bool:
        """Whether the robot does, by a zero that was said last."""
        commands = self.robot.events("command")
        return not self.robot.moving() and (commands[-1]["v"], commands[-1]["w"]) == (0.0, 0.0)

    def charges(self) -> bool:
        """Whether its battery does."""
        state = self.told("topics/battery_state?wait=5")
        return state.get("value", {}).get("power_supply_status") == CHARGING


@pytest.fixture
def hungry(tmp_path: Path) -> Iterator[Hungry]:
    relay = Relay(tmp_path)
    with running(relay):
        robot = Robot(relay, "rover", camera=True, sim_options=("--charge", "15", "--camera-fps", "8"))
        markers = ("markers", "--view", "75", "--size", "0.4")
        with running(robot), service(robot.domain, tmp_path, *markers):
            yield Hungry(tmp_path, relay, robot)


def says(program: Process, words: str) -> None:
    """Wait for what a program says, in a line of its own."""
    wait_for(f"it says: {words}", lambda: words in program.said().splitlines(), THERE)


def resume(client: Client) -> None:
    """Let a robot go on that was stopped."""
    assert client.call("/relay/take_control")["values"]["success"]
    wait_for("it is resumed", lambda: client.call("/relay/resume")["result"])
    assert client.call("/relay/release_control")["values"]["success"]


def test_a_robot_with_a_low_battery_drives_to_its_charger(hungry: Hungry) -> None:
    """It waits for who drives, ends with a zero, stands when it is stopped, goes on afterwards, and arrives."""
    robot = hungry.robot
    with hungry.relay.connect("rover", hungry.person) as ann:
        assert ann.call("/relay/take_control")["values"]["success"]
        program = hungry.program()
        with running(program):
            says(program, "the battery is low, and it waits: ann has control")
            assert robot.events("command") == []
            assert ann.call("/relay/release_control")["values"]["success"]
            says(program, "looking for marker 7")
            wait_for("it turns", robot.moving)
            assert program.stop() == 0
        wait_for("it stands", hungry.stands)
        wait_for("control is given back", hungry.free)
        program = hungry.program()
        with running(program):
            says(program, "driving to marker 7")
            assert ann.call("/relay/stop")["values"]["done"]
            says(program, "control given back: the robot is stopped by ann")
            wait_for("it stands", hungry.stands)
            resume(ann)
            wait_for("it charges", hungry.charges, THERE)
            says(program, "charging")
            wait_for("control is free", hungry.free)
            assert hungry.stands()
            assert program.stop() == 0
    assert robot.events("bump") == []
    for each in robot.events("command"):
        assert abs(each["v"]) <= 0.3 and abs(each["w"]) <= 1.0


def test_it_goes_on_when_the_relay_was_gone(hungry: Hungry) -> None:
    """The robot stands by itself meanwhile; the program says why, and arrives."""
    program = hungry.program()
    with running(program):
        says(program, "driving to marker 7")
        hungry.relay.kill()
        wait_for("it says so", lambda: "is lost" in program.said())
        wait_for("it stands", lambda: not hungry.robot.moving())
        hungry.relay.start()
        wait_for("it charges", hungry.charges, THERE)
        says(program, "charging")
        assert program.stop() == 0
    assert hungry.robot.events("bump") == []
