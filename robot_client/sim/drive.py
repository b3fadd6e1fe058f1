"""Differential-drive physics: moves a body by commanded velocities, within its limits and walls. Pure; time is an
argument."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from robot_client.sim.world import Pose, World

RADIUS = 0.18
"""Metres from the robot's centre to its round hull."""

LONGEST_STEP = 0.02
"""Seconds of one step; longer times are cut, so that the body never moves further than its radius at once."""

HIGHEST_SPEED = 2.0
"""m/s, the greatest ``max_speed``: 2 m/s × 0.02 s is less than the hull's radius, so no step crosses a wall."""

_SKIN = 1e-6
_PUSHES = 4
_STILL = 1e-9
_BLOCKED_SHARE = 0.3


class MotorLimits(NamedTuple):
    """Limits of the motors, m/s, rad/s, m/s² and rad/s².

    Braking is stronger than speeding up, as with a short-circuit brake: 0.5 m/s ends within two steps of 20 ms.

    :ivar speed: m/s, either way
    :ivar turn: rad/s, either way
    """

    speed: float = 0.5
    turn: float = 2.0
    speeding_up: float = 1.5
    braking: float = 12.5
    turning_up: float = 8.0
    turn_braking: float = 50.0


DEFAULT_LIMITS = MotorLimits()


class Twist(NamedTuple):
    """Speed ahead (m/s) and turning counter-clockwise (rad/s)."""

    speed: float
    turn: float


ZERO_TWIST = Twist(0.0, 0.0)


@dataclass
class SimBody:
    """A round robot on two wheels in a world.

    :ivar target: the commanded velocity, before limits
    :ivar velocity: the actual velocity, limited by motors and walls
    :ivar moving: whether the body turned or changed its position in its last step, also by sliding along a wall
    :ivar touching: whether a wall deflected or stopped it in its last step
    :ivar blocked: whether a wall stops the body while it is commanded to drive
    :ivar travelled: metres driven since the last reset
    """

    world: World
    pose: Pose
    limits: MotorLimits = DEFAULT_LIMITS
    target: Twist = ZERO_TWIST
    velocity: Twist = ZERO_TWIST
    moving: bool = False
    touching: bool = False
    blocked: bool = False
    travelled: float = 0.0
    _stood_at: Pose | None = None
    """The pose after a step in which it stood free. A further one would change nothing."""

    def reset(self, pose: Pose) -> None:
        """Place the body at a pose, at rest and without a commanded velocity."""
        self.pose, self.target, self.velocity = pose, ZERO_TWIST, ZERO_TWIST
        self.moving, self.touching, self.blocked, self.travelled = False, False, False, 0.0

    def step(self, seconds: float) -> None:
        """Advance the body by ``seconds``."""
        while seconds > 1e-9:
            self._step(min(seconds, LONGEST_STEP))
            seconds -= LONGEST_STEP

    def _step(self, dt: float) -> None:
        commanded = self._wheels(dt)
        if commanded == self.velocity == ZERO_TWIST and self.pose is self._stood_at:
            return
        target_pose = along_arc(self.pose, commanded, dt)
        reached = self._slide_along_walls(target_pose)
        moved_x, moved_y = reached.x - self.pose.x, reached.y - self.pose.y
        moved = math.hypot(moved_x, moved_y)
        self.velocity, self.blocked = commanded, False
        self.touching = reached is not target_pose
        if reached is not target_pose and commanded.speed:
            middle = self.pose.heading + commanded.turn * dt / 2
            achieved = (moved_x * math.cos(middle) + moved_y * math.sin(middle)) / dt
            # A push out of a wall must neither add speed nor reverse the direction of travel.
            share = clamp(max(achieved / commanded.speed, 0.0), 1.0)
            speed = commanded.speed * share if moved > _STILL else 0.0
            self.velocity = Twist(speed, commanded.turn)
            self.blocked = share < _BLOCKED_SHARE
        self.moving = self.velocity != ZERO_TWIST or moved > _STILL
        self.travelled += moved
        self.pose = reached
        self._stood_at = None if self.moving or self.touching else reached

    def _wheels(self, dt: float) -> Twist:
        limits, now = self.limits, self.velocity
        speed, turn = clamp(self.target.speed, limits.speed), clamp(self.target.turn, limits.turn)
        return Twist(
            approach(now.speed, speed, limits.speeding_up * dt, limits.braking * dt),
            approach(now.turn, turn, limits.turning_up * dt, limits.turn_braking * dt),
        )

    def _slide_along_walls(self, target_pose: Pose) -> Pose:
        """Slide along obstacles; stay where no position is free. Returns the same object where there is no obstacle."""
        x, y = target_pose.x, target_pose.y
        for _ in range(_PUSHES):
            contact = self.world.nearest(x, y)
            if contact.distance >= RADIUS:
                return target_pose if (x, y) == target_pose[:2] else Pose(x, y, target_pose.heading)
            push = RADIUS + _SKIN - contact.distance
            x, y = x + push * contact.away_x, y + push * contact.away_y
        return Pose(self.pose.x, self.pose.y, target_pose.heading)


def along_arc(pose: Pose, twist: Twist, dt: float) -> Pose:
    """The pose after driving a circular arc at constant velocity for ``dt`` seconds (exact, not Euler)."""
    angle = twist.turn * dt
    heading = math.remainder(pose.heading + angle, math.tau)
    # chord of the arc: length v·dt·sin(a/2)/(a/2), in the direction halfway
    half = angle / 2
    chord = twist.speed * dt * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
    middle = pose.heading + half
    return Pose(pose.x + chord * math.cos(middle), pose.y + chord * math.sin(middle), heading)


def approach(value: float, target: float, faster: float, slower: float) -> float:
    """Move towards a target by at most `faster` away from zero or `slower` towards zero."""
    if value * target < 0:  # through zero: brake first, start again with the next step
        target = 0.0
    room = faster if abs(target) > abs(value) else slower
    return target if abs(target - value) <= room else value + math.copysign(room, target - value)


def clamp(value: float, limit: float) -> float:
    """Keep a value within ± limit."""
    return max(-limit, min(limit, value))
