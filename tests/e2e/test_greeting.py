"""A robot greets each visitor once: real faces, speech, relay and programs."""

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

from tests.robot_client.services.test_ros import picture, repeated
from tests.worlds.face_images import EILEEN, people, scene
from tests.worlds.http_requests import ask
from tests.worlds.processes import Process, running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.service_process import TopicWatcher, service

ALREADY = "eileen was greeted already"


class Door:
    """A robot at a door, and the visitor Eileen."""

    def __init__(self, folder: Path, relay: Relay, robot: Robot, watcher: TopicWatcher) -> None:
        self.relay = relay
        self.robot = robot
        self.folder = folder
        self.watcher = watcher
        self.token = relay.user("host")
        relay.cli("right", "grant", "host", "rover", "operator")
        images = watcher.node.create_publisher(Image, "/camera/image_raw", qos_profile_sensor_data)
        message = picture(scene(EILEEN, 0.8, (120, 40)), "mono8", "camera_optical_frame")
        self.show = repeated(lambda: images.publish(message), 0.1)
        watcher.watch("/said", String)
        self._runs = 0

    @property
    def said(self) -> list[str]:
        """Texts that the robot has spoken."""
        return [each.data for each in self.watcher.heard["/said"]]

    def program(self) -> Process:
        """Starts a program that greets."""
        self._runs += 1
        command = [sys.executable, "-u", "-m", "robot_client.apps.greeting", self.relay.url("rover")]
        # Longer than the test takes on any machine.
        command += ["--within", "3600"]
        environment = {**os.environ, "SWITCHBOARD_TOKEN": self.token}
        process = Process(command, self.folder, f"greeting{self._runs}", environment)
        process.wait_to_say("looking for people")
        return process

    def until_printed(self, program: Process, *words: str, after: str = "") -> None:
        """Shows Eileen until a program has printed one of these, after some other line."""

        def reported() -> bool:
            _, found, rest = program.said().rpartition(after) if after else ("", True, program.said())
            return bool(found) and any(each in rest.splitlines() for each in words)

        self.watcher.until(f"one of {words}", reported, self.show)

    def events(self, kind: str) -> list[dict[str, Any]]:
        """Events in the relay's log."""
        answer = ask(self.relay.http_port, "GET", f"/api/v1/events?kind={kind}", token=self.token)
        return [dict(each) for each in answer.json["events"]]


@pytest.fixture
def door(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Door]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    relay = Relay(tmp_path)
    with running(relay):
        robot = Robot(relay, "rover")
        with running(robot):
            watcher = TopicWatcher(robot.domain)
            try:
                faces = ("faces", "--view", "75", "--people", str(people(tmp_path / "people")))
                speech = ("speech", "--out", str(tmp_path / "said.wav"))
                with service(robot.domain, tmp_path, *faces), service(robot.domain, tmp_path, *speech):
                    yield Door(tmp_path, relay, robot, watcher)
            finally:
                watcher.close()


def test_visitors_are_not_greeted_twice(door: Door) -> None:
    """Neither by two programs at once, nor by a restarted one, nor after an absence of the relay."""
    one, other = door.program(), door.program()
    with running(one, other):
        greeted, late = "greeted eileen", "eileen is greeted by another program"
        door.until_printed(one, greeted, late, ALREADY)
        door.until_printed(other, greeted, late, ALREADY)
        door.watcher.until("the robot says it", lambda: door.said, door.show)
        (event,) = door.events("greeted")
        assert (event["robot"], event["data"]) == ("rover", {"person": "eileen"})
        assert other.stop() == 0
        again = door.program()
        with running(again):
            door.until_printed(again, ALREADY)
            door.relay.kill()
            door.relay.start()
            for each in (one, again):
                door.until_printed(each, ALREADY, after="is lost")
            assert again.stop() == 0
        assert one.stop() == 0
    assert len(door.events("greeted")) == 1
    assert door.said == ["Hello, eileen."]
