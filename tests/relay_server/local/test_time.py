"""What time it is, by rosapi."""

from __future__ import annotations

from tests.relay_server.local.asking import ask
from tests.relay_server.memory import Person, World


def test_time_is_the_relays_wall_clock(world: World, operator: Person) -> None:
    """In ROS 2's two parts."""
    time = ask(operator, "/rosapi/get_time")["time"]
    assert time["sec"] * 10**9 + time["nanosec"] == world.channel.now_ns() == world.now_ns() + 10**18


def test_the_version_is_the_robots(operator: Person) -> None:
    """ROS 2, and its distribution."""
    assert ask(operator, "/rosapi/get_ros_version") == {"version": 2, "distro": "jazzy"}
