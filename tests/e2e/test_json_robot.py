"""Messages to a robot that speaks JSON, by the bytes of its link."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from tests.worlds.small_robot import SmallRobot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

STRING, TWIST = "std_msgs/msg/String", "geometry_msgs/msg/Twist"


def echo(robot: SmallRobot, args: Any) -> Any:
    """Records the arguments of service calls."""
    robot.heard.append(args)
    return msgspec.Raw(b"{}")


@pytest.fixture
def small(world: Any) -> Iterator[SmallRobot]:
    """A robot that answers no question about types."""
    robot = SmallRobot(world.relay, "small", {"/beep": echo}).comes()
    world.relay.cli("right", "grant", "operator", "small", "operator")
    try:
        yield robot
    finally:
        robot.goes()
        world.relay.cli("robot", "remove", "small", "--yes")


def refused(client: Client, topic: str, type_name: str, msg: str) -> str:
    """The error of a message that is not sent to the robot."""
    text = f'{{"op":"publish","id":"p","topic":"{topic}","type":"{type_name}","msg":{msg}}}'
    client.connection.send(text)
    return str(client.until(op="status", id="p")["msg"])


def test_only_what_is_of_the_type_with_exact_numbers(world: Any, small: SmallRobot) -> None:
    """Messages and arguments are checked as for CDR robots, and sent in the client's own text."""
    with world.relay.connect("small", world.operator) as client:
        client.send(op="set_level", level="error")
        wrong = "linear.x must be a number, not a boolean"
        assert (
            refused(client, "/twist", TWIST, '{"linear":{"x":true}}') == f"publish /twist: {TWIST}: {wrong}"
        )
        for msg in ('"1"', "null", "[1]", "1e999"):
            assert refused(client, "/twist", TWIST, msg)
        number = "std_msgs/msg/Int64"
        client.connection.send(
            f'{{"op":"publish","topic":"/n","type":"{number}","msg":{{"data": 9007199254740993}}}}'
        )
        wait_for("the number comes", lambda: small.heard == [{"data": 9007199254740993}])
        answer = client.call("/beep", {"tone": 1})
        assert (
            answer["values"]
            == "std_srvs/srv/Trigger_Request: tone is no field of std_srvs/srv/Trigger_Request, which has none"
        )
        assert client.call("/beep", [])["result"]
        assert small.heard[1:] == [{}]
