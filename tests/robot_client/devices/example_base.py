"""A base that moves as commanded, at once."""

from __future__ import annotations

from robot_client.devices import MobileRobot, Odometry, RobotNode


class Exact(MobileRobot):
    def __init__(self) -> None:
        self.now = Odometry()

    def drive(self, speed: float, turn: float) -> None:
        self.now = Odometry(1.0, 2.0, 0.5, speed, turn)

    def odometry(self) -> Odometry:
        return self.now


class Base(RobotNode):
    def __init__(self, command_limit: float) -> None:
        super().__init__(Exact(), command_limit=command_limit, odom_period=0.02)
