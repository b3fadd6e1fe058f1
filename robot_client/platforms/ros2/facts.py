"""What ROS 2 the robot has."""

from __future__ import annotations

import os
import platform as machine
from importlib import metadata

import rclpy

from robot_client.platforms.base import Facts

_DISTROS = {3: "humble", 4: "iron", 7: "jazzy", 9: "kilted"}
"""By the major version of rclpy."""


def read(sim_time: bool) -> Facts:
    """ROS 2, its distribution and middleware.

    :param sim_time: whether the robot's time is a simulation's
    """
    return Facts(
        "ros2",
        os.environ.get("ROS_DISTRO", "") or _distro(),
        {
            "rmw": rclpy.get_rmw_implementation_identifier(),
            "domain": os.environ.get("ROS_DOMAIN_ID", "0"),
            "python": machine.python_version(),
        },
        sim_time,
    )


def _distro() -> str:
    """The distribution, for installations that don't set ``ROS_DISTRO``."""
    for name in ("ros-rclpy", "rclpy"):
        try:
            return _DISTROS.get(int(metadata.version(name).split(".")[0]), "")
        except (metadata.PackageNotFoundError, ValueError):
            continue
    return ""
