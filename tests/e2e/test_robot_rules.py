"""Decisions of the robot, with an unmodified relay and daemon: its hardware switch, and goals by topic."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.robot_client.ros import Peer
from tests.worlds.machine_pauses import NOTICED, Pulse
from tests.worlds.processes import ros_environment
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

GOALS = 12
PAUSE_SECONDS = 0.37
"""No part of a second in which pings come, nor of one between two of a link that is not commanded."""


class ControlWorld:
    """A relay, a robot whose service ``/reset`` stops its hardware and whose topic ``/go`` takes goals."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        settings = {"STOP_SERVICE": "/reset", "GOAL_TOPICS": "/go"}
        environment = {f"SWITCHBOARD_ROBOT_SAFETY_{key}": value for key, value in settings.items()}
        self.robot = Robot(self.relay, "rover", daemon_env=environment)
        self.peer = Peer(ros_environment(self.robot.domain))
        self._tokens = {name: self.relay.user(name) for name in ("ann", "olga")}
        self.relay.cli("right", "grant", "ann", "rover", "operator")
        self.relay.cli("right", "grant", "olga", "rover", "owner")

    def connect(self, name: str) -> Client:
        """A user's connection."""
        return self.relay.connect("rover", self._tokens[name])

    def resets(self) -> int:
        """The number of resets, by the robot's own log."""
        return len(self.robot.events("reset"))

    def goals(self) -> list[str]:
        """Texts that its node has received on ``/go``."""
        return [each["text"] for each in self.peer.heard("/go")]

    def stop(self) -> None:
        self.peer.close()
        self.robot.stop()
        self.relay.stop()


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[ControlWorld]:
    """One for all tests."""
    scene = ControlWorld(tmp_path)
    try:
        yield scene
    finally:
        scene.stop()


def serves(client: Client, service: str) -> bool:
    """Whether the robot's graph has a service, for a client."""
    return service in client.call("/rosapi/services")["values"]["services"]


def test_only_a_stop_throws_the_switch(scene: ControlWorld) -> None:
    """An operator or owner with control cannot call it, whether the robot is stopped or not."""
    with scene.connect("ann") as ann, scene.connect("olga") as olga:
        wait_for("the owner has control", lambda: olga.call("/relay/take_control")["values"]["success"])
        wait_for("its services are known", lambda: serves(olga, "/reset"))
        for stopped in (False, True):
            if stopped:
                assert ann.call("/relay/stop")["values"]["success"]
            for client in (ann, olga):
                answer = client.call("/reset")
                assert not answer["result"]
                assert "/relay/resume" in str(answer["values"])
            assert scene.resets() == stopped


def test_goals_arrive_whenever_they_are_given(scene: ControlWorld) -> None:
    """All of them, even if the driver sends no other command: none has to wait for a much later ping."""
    scene.peer.do("listen", "/go", "string")
    with scene.connect("ann") as ann:
        wait_for("she has control", lambda: ann.call("/relay/take_control")["values"]["success"])
        ann.send(op="advertise", topic="/go", type="std_msgs/String")

        def arrives() -> bool:
            ann.send(op="publish", topic="/go", msg={"data": "first"})
            return bool(scene.goals())

        wait_for("the robot's publisher is known", arrives)
        rounds = itertools.count()

        def all_arrive() -> bool:
            """All of one round arrive, unless the machine stalled: then one may be too late."""
            name = f"round {next(rounds)}"
            given = [f"{name}, goal {number}" for number in range(GOALS)]

            def come() -> bool:
                return [each for each in scene.goals() if each.startswith(name)] == given

            with Pulse() as pulse:
                # Any time of sending must work.
                for each in given:
                    time.sleep(PAUSE_SECONDS)
                    ann.send(op="publish", topic="/go", msg={"data": each})
                wait_for("all have come", lambda: come() or pulse.held_up() > NOTICED)
            return come()

        wait_for("all of a round have come", all_arrive)
