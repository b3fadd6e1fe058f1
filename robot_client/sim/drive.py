"""Differential-drive physics: what the body makes of the velocity asked for. Pure; time is an argument."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from robot_client.sim.world import Pose, World

RADIUS = 0.18
"""Metres from the robot's centre to its round hull."""

LONGEST_STEP = 0.02
"""Seconds; longer times are cut into steps, so that nothing moves further than the hull's radius at once."""

HIGHEST_SPEED = 2.0
"""m/s, the most `max_speed` may be set to. 2 m/s × 0.02 s is less than the hull's radius: walls hold."""

_SKIN = 1e-6
_PUSHES = 4
_STILL = 1e-9
_BLOCKED_SHARE = 0.3


class MotorLimits(NamedTuple):
    """What the motors can do.

    Stops are harder than starts, as with a short-circuit brake: 0.5 m/s is gone in two steps of 20 ms.

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


STANDING = Twist(0.0, 0.0)


@dataclass
class SimBody:
    """A round robot on two wheels in a world.

    :ivar target: the velocity asked for, before limits
    :ivar velocity: the velocity the body really has, walls considered
    :ivar moving: the body turned or changed place in its last step, be it by sliding
    :ivar touching: a wall turned it aside or held it back in its last step
    :ivar blocked: the body is held back by a wall while it wants to drive on
    :ivar travelled: metres driven since the beginning
    """

    world: World
    pose: Pose
    limits: MotorLimits = DEFAULT_LIMITS
    target: Twist = STANDING
    velocity: Twist = STANDING
    moving: bool = False
    touching: bool = False
    blocked: bool = False
    travelled: float = 0.0

    def reset(self, pose: Pose) -> None:
        """Put the body somewhere, standing still, with nothing asked of it."""
        self.pose, self.target, self.velocity = pose, STANDING, STANDING
        self.moving, self.touching, self.blocked, self.travelled = False, False, False, 0.0

    def step(self, seconds: float) -> None:
        """Let time pass."""
        while seconds > 1e-9:
            self._step(min(seconds, LONGEST_STEP))
            seconds -= LONGEST_STEP

    def _step(self, dt: float) -> None:
        wanted_velocity = self._wheels(dt)
        wanted = along_arc(self.pose, wanted_velocity, dt)
        reached = self._held_by_walls(wanted)
        moved_x, moved_y = reached.x - self.pose.x, reached.y - self.pose.y
        moved = math.hypot(moved_x, moved_y)
        self.velocity, self.blocked = wanted_velocity, False
        self.touching = reached is not wanted
        if reached is not wanted and wanted_velocity.speed:
            middle = self.pose.heading + wanted_velocity.turn * dt / 2
            achieved = (moved_x * math.cos(middle) + moved_y * math.sin(middle)) / dt
            # A push out of a wall may never add speed, nor turn the way of travel round.
            share = clamp(max(achieved / wanted_velocity.speed, 0.0), 1.0)
            speed = wanted_velocity.speed * share if moved > _STILL else 0.0
            self.velocity = Twist(speed, wanted_velocity.turn)
            self.blocked = share < _BLOCKED_SHARE
        self.moving = self.velocity != STANDING or moved > _STILL
        self.travelled += moved
        self.pose = reached

    def _wheels(self, dt: float) -> Twist:
        limits, now = self.limits, self.velocity
        speed, turn = clamp(self.target.speed, limits.speed), clamp(self.target.turn, limits.turn)
        return Twist(
            approach(now.speed, speed, limits.speeding_up * dt, limits.braking * dt),
            approach(now.turn, turn, limits.turning_up * dt, limits.turn_braking * dt),
        )

    def _held_by_walls(self, wanted: Pose) -> Pose:
        """Slide along what is in the way; stay where no place is free. The same object if nothing is."""
        x, y = wanted.x, wanted.y
        for _ in range(_PUSHES):
            contact = self.world.nearest(x, y)
            if contact.distance >= RADIUS:
                return wanted if (x, y) == wanted[:2] else Pose(x, y, wanted.heading)
            push = RADIUS + _SKIN - contact.distance
            x, y = x + push * contact.away_x, y + push * contact.away_y
        return Pose(self.pose.x, self.pose.y, wanted.heading)


def along_arc(pose: Pose, twist: Twist, dt: float) -> Pose:
    """Where a body is after driving a circular arc at constant velocity for dt seconds (exact, not Euler)."""
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
