"""Two programs share a robot by subsumption: one drives blindly, the other keeps the robot away from
obstacles.

The experiments of SOM4R in the simulator, over a real relay: stop and turn away before a wall; follow a wall.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_client.sim.world import WORLDS
from tests.worlds.client_threads import Driver, Listener
from tests.worlds.driving import LET_GO_SECONDS, understood
from tests.worlds.processes import Process, running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

AHEAD = 0.3
"""Metres per second; nothing else commands this speed."""


class Room:
    """A robot in an empty room, a driver, and the program that avoids walls."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.robot = Robot(self.relay, "rover", sim_options=("--world", "room"))
        self.driver = self.relay.user("driver")
        self.relay.cli("right", "grant", "driver", "rover", "operator")
        self.guardian = self.relay.user("guardian")
        self.relay.cli("right", "grant", "guardian", "rover", "owner")

    @contextlib.contextmanager
    def driven(self, speed: float, turn: float) -> Iterator[Process]:
        """A client takes control and sends a constant command; the program watches."""
        environment = {**os.environ, "SWITCHBOARD_TOKEN": self.guardian}
        command = [
            sys.executable,
            "-u",
            "-m",
            "robot_client.apps.collision_avoidance",
            self.relay.url("rover"),
        ]
        with self.relay.connect("rover", self.driver) as client:
            wait_for("the robot is put back", lambda: client.call("/reset")["result"])
            assert client.call("/relay/take_control")["values"]["success"]
            runaway = Process(command, self.robot.folder, "runaway", environment)
            driver = Driver(client, speed, turn)
            with running(runaway, driver):
                runaway.wait_to_say("READY")
                driver.start()
                yield runaway

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()


class Track(Listener):
    """The robot's position, five times a second."""

    def __init__(self, client: Client) -> None:
        super().__init__(client)
        self.places: list[tuple[float, float]] = []
        client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry", throttle_rate=200)

    def take(self, message: dict[str, Any]) -> None:
        """Stores it."""
        if message["op"] == "publish":
            place = message["msg"]["pose"]["pose"]["position"]
            self.places.append((place["x"], place["y"]))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Room]:
    """One for both tests."""
    room = Room(tmp_path_factory.mktemp("room"))
    with running(room):
        yield room


def test_before_a_wall_the_robot_turns_away_and_is_its_drivers_again(room: Room) -> None:
    """It touches no wall, and the controller never changes; after the wall the driver's commands move it."""
    with room.driven(AHEAD, 0.0) as runaway:
        wait_for("it turns away", lambda: "turning away" in runaway.said(), 60)
        wait_for("it gives back", lambda: "suppression ended" in runaway.said())
        given = room.robot.record()[-1]["t"]
        wait_for(
            "the driver drives",
            lambda: any(each["v"] == AHEAD for each in room.robot.events("command", given)),
        )
        with room.relay.connect("rover", room.driver) as client:
            client.send(op="subscribe", topic="/relay/control")
            reported = client.until(op="publish")["msg"]
        assert reported["holder"]["user"] == "driver"
    assert room.robot.events("bump") == []
    speeds = {each["v"] for each in room.robot.events("command")}
    assert speeds >= {AHEAD, 0.0, 0.2}


def test_a_driver_pressed_against_a_wall_follows_it(room: Room) -> None:
    """Constantly turning right the robot follows the walls at a small distance, without touching them."""
    walls = WORLDS["room"]()
    with room.driven(AHEAD, -0.18) as runaway:
        wait_for("it has come to a wall", lambda: "turning away" in runaway.said(), 60)
        path = Track(room.relay.connect("rover", room.driver))
        with running(path):
            path.start()
            wait_for("it goes along", lambda: len(path.places) >= 60, 120)
    distances = [walls.nearest(*each).distance for each in path.places]
    assert room.robot.events("bump") == []
    assert max(np.ptp(path.places, axis=0)) > 1.5
    assert min(distances) > 0.25
    assert np.quantile(distances, 0.9) < 1.0


def test_a_relay_that_is_killed_costs_it_time_alone(room: Room) -> None:
    """The program connects again and avoids the next wall for the next driver."""
    with room.driven(AHEAD, 0.0) as runaway:
        room.relay.kill()
        room.relay.start()
        room.robot.wait_online()
        wait_for("it watches again", lambda: runaway.said().count("READY") == 2)
        before = runaway.said().count("turning away")
        with room.relay.connect("rover", room.driver) as client:
            assert client.call("/relay/take_control")["values"]["success"]
            driver = Driver(client, AHEAD, 0.0)
            driver.begin_with_a_pause(LET_GO_SECONDS)
            with running(driver):
                driver.start()
                understood(driver, room.robot)
                wait_for("it turns away", lambda: runaway.said().count("turning away") > before, 60)
                wait_for(
                    "it gives back", lambda: runaway.said().splitlines()[-1] == "clear: suppression ended"
                )
    assert room.robot.events("bump") == []
