"""Base classes of modules that are Python classes: devices, bases of robots, ROS nodes.

Each runs in a process of its own, started by the daemon (``[[module]]`` with ``python``). A command reaches it from
another module, as the ``CommandServer``, through its runner; feedback takes the same path back.
See docs/guides/devices.md.
"""

from robot_client.devices.drive import DifferentialDrive, MobileRobot, Odometry, WheelSpeeds
from robot_client.devices.launch_file import LaunchFile
from robot_client.devices.module import Module
from robot_client.devices.ros_node import RobotNode, RosNode
from robot_client.devices.serial_device import SerialDevice, SerialPort

__all__ = [
    "DifferentialDrive",
    "LaunchFile",
    "MobileRobot",
    "Module",
    "Odometry",
    "RobotNode",
    "RosNode",
    "SerialDevice",
    "SerialPort",
    "WheelSpeeds",
]
