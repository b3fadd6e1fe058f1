"""The time in rosapi."""

from __future__ import annotations

from tests.worlds.relay import Person, World
from tests.worlds.relay_node_calls import ask


def test_time_is_the_relays_wall_clock(world: World, operator: Person) -> None:
    """It has the two parts of ROS 2."""
    time = ask(operator, "/rosapi/get_time")["time"]
    assert time["sec"] * 10**9 + time["nanosec"] == world.channel.now_ns() == world.now_ns() + 10**18


def test_the_version_is_the_robots(operator: Person) -> None:
    """ROS 2 and its distribution."""
    assert ask(operator, "/rosapi/get_ros_version") == {"version": 2, "distro": "jazzy"}
