"""What the robot judges by itself, through a relay and a daemon as they are: its switch, and topics that take goals."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from switchboard_client import Client
from switchboard_processes import ros_environment
from switchboard_pulse import Pulse
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_waiting import wait_for

from tests.robot_client.ros import Peer

GOALS = 12
PAUSE_SECONDS = 0.37
"""No part of a second in which pings come, nor of one between two of a link that is not commanded."""


class Place:
    """A relay, a robot whose service ``/reset`` stops its hardware and whose topic ``/go`` takes goals."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        settings = {"STOP_CALL": "/reset", "GOAL_TOPICS": "/go"}
        environment = {f"SWITCHBOARD_ROBOT_SAFETY_{key}": value for key, value in settings.items()}
        self.robot = Robot(self.relay, "rover", daemon_env=environment)
        self.peer = Peer(ros_environment(self.robot.domain))
        self._tokens = {name: self.relay.user(name) for name in ("ann", "olga")}
        self.relay.cli("right", "grant", "ann", "rover", "operator")
        self.relay.cli("right", "grant", "olga", "rover", "owner")

    def connect(self, name: str) -> Client:
        """A connection of one of them."""
        return self.relay.connect("rover", self._tokens[name])

    def resets(self) -> int:
        """How often the robot was reset, by its own record."""
        return len(self.robot.events("reset"))

    def goals(self) -> list[str]:
        """What its node has heard on ``/go``."""
        return [each["text"] for each in self.peer.heard("/go")]

    def stop(self) -> None:
        """End everything."""
        self.peer.close()
        self.robot.stop()
        self.relay.stop()


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    """One of them."""
    place = Place(tmp_path)
    try:
        yield place
    finally:
        place.stop()


def serves(client: Client, service: str) -> bool:
    """Whether the robot's graph, as a client is told of it, has a service."""
    return service in client.call("/rosapi/services")["values"]["services"]


def test_only_a_stop_throws_the_switch(place: Place) -> None:
    """Neither an operator nor an owner who has control can call it, while the robot is stopped or not."""
    with place.connect("ann") as ann, place.connect("olga") as olga:
        wait_for("the owner has control", lambda: olga.call("/relay/take_control")["values"]["success"])
        wait_for("its services are known", lambda: serves(olga, "/reset"))
        for stopped in (False, True):
            if stopped:
                assert ann.call("/relay/stop")["values"]["success"]
            for client in (ann, olga):
                answer = client.call("/reset")
                assert not answer["result"]
                assert "/relay/resume" in str(answer["values"])
            assert place.resets() == stopped


def test_goals_arrive_whenever_they_are_given(place: Place) -> None:
    """All of them, though the driver moves nothing else: not one waits for a ping that is due much later."""
    place.peer.do("listen", "/go", "string")
    with place.connect("ann") as ann:
        wait_for("she has control", lambda: ann.call("/relay/take_control")["values"]["success"])
        ann.send(op="advertise", topic="/go", type="std_msgs/String")

        def arrives() -> bool:
            ann.send(op="publish", topic="/go", msg={"data": "first"})
            return bool(place.goals())

        wait_for("the robot's publisher is known", arrives)
        rounds = itertools.count()

        def all_arrive() -> bool:
            """All of one round, unless the machine stood still: then one may have come too late to be taken."""
            name = f"round {next(rounds)}"
            given = [f"{name}, goal {number}" for number in range(GOALS)]

            def come() -> bool:
                return [each for each in place.goals() if each.startswith(name)] == given

            with Pulse() as pulse:
                # What is proved is that a goal comes at whatever time it is given.
                for each in given:
                    time.sleep(PAUSE_SECONDS)
                    ann.send(op="publish", topic="/go", msg={"data": each})
                wait_for("all have come", lambda: come() or pulse.lost())
            return come()

        wait_for("all of a round have come", all_arrive)
