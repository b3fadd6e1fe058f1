"""A robot greets who comes, and nobody twice: real faces, speech, relay and programs."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_msgs.msg import String
from switchboard_http import ask
from switchboard_processes import Process, running
from switchboard_relay import Relay
from switchboard_robot import Robot

from tests.robot_client.services.onlooker import Onlooker, service
from tests.robot_client.services.pictures_of_people import EILEEN, people, scene
from tests.robot_client.services.test_ros import picture, repeated

ALREADY = "eileen was greeted already"


class Door:
    """A robot at a door, to which Eileen comes."""

    def __init__(self, folder: Path, relay: Relay, robot: Robot, onlooker: Onlooker) -> None:
        self.relay = relay
        self.robot = robot
        self.folder = folder
        self.onlooker = onlooker
        self.token = relay.user("host")
        relay.cli("right", "grant", "host", "rover", "operator")
        images = onlooker.node.create_publisher(Image, "/camera/image_raw", qos_profile_sensor_data)
        message = picture(scene(EILEEN, 0.8, (120, 40)), "mono8", "camera_optical_frame")
        self.show = repeated(lambda: images.publish(message), 0.1)
        onlooker.watch("/said", String)
        self._runs = 0

    @property
    def said(self) -> list[str]:
        """What the robot has said."""
        return [each.data for each in self.onlooker.heard["/said"]]

    def program(self) -> Process:
        """A program that greets, from now on."""
        self._runs += 1
        command = [sys.executable, "-u", "-m", "robot_client.apps.greeting", self.relay.url("rover")]
        # Longer than the test takes, however slow the machine is.
        command += ["--within", "3600"]
        environment = {**os.environ, "SWITCHBOARD_TOKEN": self.token}
        process = Process(command, self.folder, f"greeting{self._runs}", environment)
        process.wait_to_say("looking for people")
        return process

    def until_told(self, program: Process, *words: str, after: str = "") -> None:
        """Show Eileen until a program has said one of these, after something else."""

        def told() -> bool:
            _, found, rest = program.said().rpartition(after) if after else ("", True, program.said())
            return bool(found) and any(each in rest.splitlines() for each in words)

        self.onlooker.until(f"one of {words}", told, self.show)

    def events(self, kind: str) -> list[dict[str, Any]]:
        """What the relay remembers."""
        answer = ask(self.relay.http_port, "GET", f"/api/v1/events?kind={kind}", token=self.token)
        return [dict(each) for each in answer.json["events"]]


@pytest.fixture
def door(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Door]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    relay = Relay(tmp_path)
    with running(relay):
        robot = Robot(relay, "rover")
        with running(robot):
            onlooker = Onlooker(robot.domain)
            try:
                faces = ("faces", "--view", "75", "--people", str(people(tmp_path / "people")))
                speech = ("speech", "--out", str(tmp_path / "said.wav"))
                with service(robot.domain, tmp_path, *faces), service(robot.domain, tmp_path, *speech):
                    yield Door(tmp_path, relay, robot, onlooker)
            finally:
                onlooker.close()


def test_nobody_is_greeted_twice(door: Door) -> None:
    """Not by two programs at once, by one that is started anew, nor when the relay was gone for a while."""
    one, other = door.program(), door.program()
    with running(one, other):
        greeted, late = "greeted eileen", "eileen is greeted by another program"
        door.until_told(one, greeted, late, ALREADY)
        door.until_told(other, greeted, late, ALREADY)
        door.onlooker.until("the robot says it", lambda: door.said, door.show)
        (event,) = door.events("greeted")
        assert (event["robot"], event["data"]) == ("rover", {"person": "eileen"})
        assert other.stop() == 0
        again = door.program()
        with running(again):
            door.until_told(again, ALREADY)
            door.relay.kill()
            door.relay.start()
            for each in (one, again):
                door.until_told(each, ALREADY, after="is lost")
            assert again.stop() == 0
        assert one.stop() == 0
    assert len(door.events("greeted")) == 1
    assert door.said == ["Hello, eileen."]
