"""Kinematics of mobile robots: wheel speeds from velocities and back, odometry from encoders. Pure."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple


class WheelSpeeds(NamedTuple):
    """Angular speeds of both wheels: rad/s, positive forwards."""

    left: float
    right: float


class Odometry(NamedTuple):
    """Pose since the start, and velocity.

    :ivar x: metres ahead of the start
    :ivar y: metres to the left of it
    :ivar heading: radians, counter-clockwise, -π to π
    :ivar speed: m/s
    :ivar turn: rad/s, counter-clockwise
    """

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    speed: float = 0.0
    turn: float = 0.0


class MobileRobot(ABC):
    """The drive of a robot as :class:`robot_client.devices.RobotNode` needs it. To be inherited, for any wheels."""

    @abstractmethod
    def drive(self, speed: float, turn: float) -> None:
        """Set the velocity of the base. Zero is repeated while the base should stand still.

        :param speed: m/s, positive forwards
        :param turn: rad/s, positive counter-clockwise
        """

    @abstractmethod
    def odometry(self) -> Odometry:
        """Where the base is now, and how it moves."""


class DifferentialDrive:
    """Two driven wheels on one axis, with encoders.

    :param wheel_radius: metres
    :param wheel_separation: metres between the points at which the wheels touch the ground
    :param ticks_per_revolution: counts of an encoder for one turn of its wheel
    :param counter_bits: size of the encoders' counters, which begin again at the end
    :raises ValueError: a size is not positive
    """

    def __init__(
        self,
        wheel_radius: float,
        wheel_separation: float,
        ticks_per_revolution: float,
        counter_bits: int = 32,
    ) -> None:
        sizes = {
            "wheel_radius": wheel_radius,
            "wheel_separation": wheel_separation,
            "ticks_per_revolution": ticks_per_revolution,
            "counter_bits": counter_bits,
        }
        for name, value in sizes.items():
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} = {value} is not a positive number")
        self._radius = wheel_radius
        self._separation = wheel_separation
        self._metres_per_tick = math.tau * wheel_radius / ticks_per_revolution
        self._range: int = 1 << counter_bits
        self._ticks: tuple[int, int] | None = None
        self._at = 0.0
        self.odometry = Odometry()
        """As of the latest :meth:`update`."""

    def wheel_speeds(self, speed: float, turn: float) -> WheelSpeeds:
        """Speeds of the wheels for a velocity of the robot.

        :param speed: m/s
        :param turn: rad/s
        """
        difference = turn * self._separation / 2
        return WheelSpeeds((speed - difference) / self._radius, (speed + difference) / self._radius)

    def velocity(self, wheels: WheelSpeeds) -> tuple[float, float]:
        """Speed (m/s) and turn (rad/s) of the robot for speeds of its wheels; undoes :meth:`wheel_speeds`."""
        left, right = wheels.left * self._radius, wheels.right * self._radius
        return (left + right) / 2, (right - left) / self._separation

    def update(self, left: int, right: int, at: float) -> Odometry:
        """Add what the wheels have turned since the update before; the first one sets the counters' start.

        Between two updates both wheels turn evenly, so the robot follows an arc. A counter that reached its end between
        them has begun again; it must be read more often than it takes to count half its range.

        :param left: count of the left encoder, signed or not
        :param right: count of the right one
        :param at: when they were read: seconds of a clock that only grows
        """
        before, self._ticks = self._ticks, (left, right)
        elapsed, self._at = at - self._at, at
        if before is None:
            return self.odometry
        left_distance = self._moved(left - before[0]) * self._metres_per_tick
        right_distance = self._moved(right - before[1]) * self._metres_per_tick
        self.odometry = self._along_arc(left_distance, right_distance, elapsed)
        return self.odometry

    def _moved(self, difference: int) -> int:
        """Ticks between two counts: in the shorter direction."""
        half = self._range // 2
        return (difference + half) % self._range - half

    def _along_arc(self, left: float, right: float, elapsed: float) -> Odometry:
        length, angle = (left + right) / 2, (right - left) / self._separation
        # The chord of the arc, in the direction of the mean of both headings.
        half = angle / 2
        chord = length * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        x, y, heading, *_ = self.odometry
        speed, turn = (length / elapsed, angle / elapsed) if elapsed > 0 else (0.0, 0.0)
        return Odometry(
            x + chord * math.cos(heading + half),
            y + chord * math.sin(heading + half),
            math.remainder(heading + angle, math.tau),
            speed,
            turn,
        )
