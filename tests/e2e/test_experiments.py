"""Two programs share a robot by subsumption: one drives and does not look, the other keeps the robot from what is near.

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
from switchboard_client import Client
from switchboard_drive import LET_GO_SECONDS, understood
from switchboard_processes import Process, running
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_threads import Driver, Listener
from switchboard_waiting import wait_for

from robot_client.sim.worlds import WORLDS

AHEAD = 0.3
"""Metres per second; nothing else commands this speed."""


class Room:
    """A robot in a bare room, a driver, and the program that keeps it away from walls."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.robot = Robot(self.relay, "rover", sim_options=("--world", "room"))
        self.driver = self.relay.user("driver")
        self.relay.cli("right", "grant", "driver", "rover", "operator")
        self.guardian = self.relay.user("guardian")
        self.relay.cli("right", "grant", "guardian", "rover", "owner")

    @contextlib.contextmanager
    def driven(self, speed: float, turn: float) -> Iterator[Process]:
        """Somebody takes control and drives, always the same; the program watches."""
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
        """End everything."""
        self.robot.stop()
        self.relay.stop()


class Track(Listener):
    """Where the robot is, five times a second."""

    def __init__(self, client: Client) -> None:
        super().__init__(client)
        self.places: list[tuple[float, float]] = []
        client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry", throttle_rate=200)

    def take(self, message: dict[str, Any]) -> None:
        """Keep it."""
        if message["op"] == "publish":
            place = message["msg"]["pose"]["pose"]["position"]
            self.places.append((place["x"], place["y"]))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Room]:
    """One for both."""
    room = Room(tmp_path_factory.mktemp("room"))
    with running(room):
        yield room


def test_before_a_wall_the_robot_turns_away_and_is_its_drivers_again(room: Room) -> None:
    """It touches nothing; control has never changed hands; between two walls the driver's commands move it."""
    with room.driven(AHEAD, 0.0) as runaway:
        for times in (1, 2):
            wait_for("it turns away", lambda times=times: runaway.said().count("turning away") == times, 60)
            wait_for("it gives back", lambda times=times: runaway.said().count("given back") == times)
            given = room.robot.record()[-1]["t"]
            wait_for(
                "the driver drives",
                lambda given=given: any(each["v"] == AHEAD for each in room.robot.events("command", given)),
            )
        with room.relay.connect("rover", room.driver) as client:
            client.send(op="subscribe", topic="/relay/control")
            told = client.until(op="publish")["msg"]
        assert told["holder"]["user"] == "driver"
    assert room.robot.events("bump") == []
    speeds = {each["v"] for each in room.robot.events("command")}
    assert speeds >= {AHEAD, 0.0, 0.2}


def test_a_driver_who_leans_on_a_wall_follows_it(room: Room) -> None:
    """Turning to the right all the time the robot goes along the walls, never far from them, and touches none."""
    walls = WORLDS["room"]()
    with room.driven(AHEAD, -0.18) as runaway:
        wait_for("it has come to a wall", lambda: "turning away" in runaway.said(), 60)
        path = Track(room.relay.connect("rover", room.driver))
        with running(path):
            path.start()
            wait_for("it goes along", lambda: len(path.places) >= 120, 120)
    distances = [walls.nearest(*each).distance for each in path.places]
    assert room.robot.events("bump") == []
    assert max(np.ptp(path.places, axis=0)) > 1.5
    assert min(distances) > 0.25
    assert np.quantile(distances, 0.9) < 1.0


def test_a_relay_that_is_killed_costs_it_time_alone(room: Room) -> None:
    """It connects anew, and keeps the robot from the next wall for whoever drives then."""
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
                wait_for("it gives back", lambda: runaway.said().splitlines()[-1] == "clear: given back")
    assert room.robot.events("bump") == []
