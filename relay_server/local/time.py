"""``/rosapi/…`` about time and the version of ROS."""

from __future__ import annotations

from typing import Any

from relay_server.session import Session


async def get_time(session: Session, args: Any) -> Any:
    """``/rosapi/get_time``: the robot's simulated time where it has one, else the relay's wall clock."""
    sec, nanosec = divmod(session.channel.now_ns(), 10**9)
    # roslibpy reads the names of ROS 1.
    return {"time": {"sec": sec, "nanosec": nanosec, "secs": sec, "nsecs": nanosec}}


async def get_ros_version(session: Session, args: Any) -> Any:
    """``/rosapi/get_ros_version``"""
    return {"version": 2, "distro": session.robot.description.distro}
