"""docs/examples/json_robot.py at a real relay: enrolled, watched, driven, called."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from robots_under_test import EXAMPLE
from switchboard_harness import Client, Process, Relay, wait_for

NAME = "tin-man"


class World:
    """A relay with the robot, and somebody who may drive it."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        code = self.relay.cli("robot", "add", NAME)["enrolment_code"]
        command = [sys.executable, str(EXAMPLE), "--relay", f"127.0.0.1:{self.relay.robots_port}"]
        self._command = [*command, "--robot", NAME, "--state", str(folder / "robot.json")]
        self._folder = folder
        self.token = self.relay.user("driver")
        self.relay.cli("right", "grant", "driver", NAME, "operator")
        self.robot = Process([*self._command, "--code", code], folder, "robot")
        self.wait()

    def wait(self) -> None:
        """Until it is online."""
        wait_for("the robot is online", lambda: self.relay.state_of(NAME) != "offline")

    def restart(self) -> None:
        """Start it again, without a code."""
        self.robot.stop()
        self.robot = Process(self._command, self._folder, "robot")

    def stop(self) -> None:
        """End both."""
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """One relay and one robot for all."""
    made = World(tmp_path_factory.mktemp("example"))
    try:
        yield made
    finally:
        made.stop()


@pytest.fixture
def client(world: World) -> Iterator[Client]:
    """A rosbridge client of the robot."""
    with world.relay.connect(NAME, world.token) as connected:
        yield connected


def speed(client: Client) -> float:
    """The next speed its motors were told."""
    return float(client.until(op="publish", topic="/cmd_vel/heard")["msg"]["linear"]["x"])


def drive(client: Client) -> None:
    """Drive until it moves."""
    client.send(op="subscribe", topic="/cmd_vel/heard")
    for _ in range(200):
        client.drive(0.2)
        if speed(client) == 0.2:
            return
    raise AssertionError("it did not move")


def test_its_graph_is_known(client: Client) -> None:
    """Clients see its topics with their types."""
    values = client.call("/rosapi/topics")["values"]
    assert dict(zip(values["topics"], values["types"], strict=True))["/temperature"] == "std_msgs/msg/Float64"


def test_its_sensor_is_watched(client: Client) -> None:
    """A subscriber gets its samples."""
    client.send(op="subscribe", topic="/temperature", type="std_msgs/msg/Float64")
    assert 19 <= client.until(op="publish", topic="/temperature")["msg"]["data"] <= 21


def test_its_service_is_called(client: Client) -> None:
    """A call is answered, and one of a service it does not have is answered in words."""
    assert client.call("/beep")["values"] == {"success": True, "message": "beep"}
    assert client.call("/no_such_service")["result"] is False


def test_it_is_driven_and_stops_by_itself(client: Client) -> None:
    """Commands move it; when they cease it stands, and says so."""
    drive(client)
    wait_for("it stands", lambda: speed(client) == 0)


def test_it_stops_when_its_driver_leaves(world: World, client: Client) -> None:
    """When the only driver disconnects it stands."""
    client.send(op="subscribe", topic="/cmd_vel/heard")
    with world.relay.connect(NAME, world.token) as driver:
        drive(driver)
    wait_for("it stands", lambda: speed(client) == 0)


def test_it_comes_back(world: World) -> None:
    """Started again it needs no code, and its clients go on."""
    with world.relay.connect(NAME, world.token) as client:
        client.send(op="subscribe", topic="/temperature", type="std_msgs/msg/Float64")
        client.until(op="publish", topic="/temperature")
        world.restart()
        wait_for("its log is there", lambda: world.robot.popen.poll() is None)
        assert client.until(30, op="publish", topic="/temperature")


def test_a_wrong_code_is_refused_in_words(world: World, tmp_path: Path) -> None:
    """With a code that is none it ends, and keeps no key."""
    state = tmp_path / "robot.json"
    command = [sys.executable, str(EXAMPLE), "--relay", f"127.0.0.1:{world.relay.robots_port}"]
    stranger = Process(
        [*command, "--robot", NAME, "--code", "guess", "--state", str(state)], tmp_path, "stranger"
    )
    try:
        assert stranger.popen.wait(20) != 0
        assert "refused" in stranger.log.read_text()
        assert not state.exists()
    finally:
        stranger.stop()
