"""The simulated robot without ROS: body, battery, scanner and motion record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO

import numpy as np
import numpy.typing as npt
import orjson

from robot_client.sim.drive import DEFAULT_LIMITS, ZERO_TWIST, SimBody, Twist
from robot_client.sim.world import World

FULL_VOLTS = 25.2
EMPTY_VOLTS = 19.8
CAPACITY_AH = 5.0
IDLE_AMPERES = 1.2
AMPERES_PER_SPEED = 5.0
"""Amperes for each m/s."""
AMPERES_PER_TURN = 0.6
"""Amperes for each rad/s."""
CHARGER_AMPERES = 10.0
"""Current of a charger: it fills the battery in about half an hour."""
_RESISTANCE = 0.05


@dataclass
class SimBattery:
    """A six-cell lithium pack of 5 Ah: lasts about four hours at rest, or an hour and a half of driving.

    An empty pack stays at zero and the robot still drives, so that a demo can run overnight.

    :ivar charge: remaining capacity, 0 to 1
    :ivar current: amperes drawn now; negative while charging
    :ivar charging: whether a charger is connected
    """

    charge: float = 1.0
    current: float = IDLE_AMPERES
    charging: bool = False

    @property
    def voltage(self) -> float:
        """Volts under the present load."""
        return EMPTY_VOLTS + (FULL_VOLTS - EMPTY_VOLTS) * self.charge - _RESISTANCE * self.current

    def step(self, seconds: float, speed: float, turn: float, charging: bool = False) -> None:
        """Discharge at a speed (m/s) and a turn rate (rad/s), or charge, for ``seconds``."""
        self.charging = charging
        self.current = IDLE_AMPERES + AMPERES_PER_SPEED * abs(speed) + AMPERES_PER_TURN * abs(turn)
        if charging:  # a full one draws nothing, since the charger feeds the robot
            self.current -= CHARGER_AMPERES if self.charge < 1.0 else self.current
        left = self.charge - self.current * seconds / 3600 / CAPACITY_AH
        self.charge = min(1.0, max(0.0, left))


class MotionRecorder:
    """Writes events with a monotonic time, each flushed at once, because the process may be killed.

    :param stream: open for writing bytes, or None to record nothing
    :param clock: nanoseconds, monotonic, shared by all processes of the machine
    """

    def __init__(self, stream: IO[bytes] | None, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._stream = stream
        self._clock = clock
        self._moving = False
        self._touching = False

    def command(self, speed: float, turn: float) -> None:
        """A velocity command arrived, in m/s and rad/s; values that are not finite are written as null."""
        self._write({"event": "command", "v": _finite(speed), "w": _finite(turn)})

    def motion(self, moving: bool) -> None:
        """Record after every step whether the body moves; only changes are written."""
        if moving is not self._moving:
            self._moving = moving
            self._write({"event": "moving" if moving else "standstill"})

    def touch(self, touching: bool) -> None:
        """Record after every step whether the body touches a wall; only the first contact is written."""
        if touching and not self._touching:
            self._write({"event": "bump"})
        self._touching = touching

    def reset(self) -> None:
        """The body was reset to its start."""
        self._write({"event": "reset"})

    def _write(self, event: dict[str, object]) -> None:
        if self._stream is not None:
            self._stream.write(orjson.dumps({"t": self._clock(), **event}) + b"\n")
            self._stream.flush()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


SCAN_RAYS = 360
SCAN_BEGIN = -math.pi
"""Radians from straight ahead, of the first ray."""
SCAN_STEP = math.tau / SCAN_RAYS
SCAN_NEAREST = 0.12
"""Metres."""
SCAN_FARTHEST = 10.0
"""Metres."""
SCAN_NOISE = 0.006
"""Metres, standard deviation."""

FIRST_MAX_SPEED = DEFAULT_LIMITS.speed


class SimRobot:
    """Executes velocity commands in time steps.

    :param seed: of the scanner's noise
    :param clock: seconds, monotonic; only for the age of the last command
    :param charge: of the battery at the start and after a reset, 0 to 1
    """

    def __init__(
        self,
        world: World,
        recorder: MotionRecorder,
        seed: int | None,
        clock: Callable[[], float],
        charge: float = 1.0,
    ) -> None:
        self.world = world
        self.body = SimBody(world, world.start)
        self.battery = SimBattery(charge)
        self._first_charge = charge
        self.command_timeout = 0.0
        """Seconds after which a command expires; 0 means never, as with many bases."""
        self._recorder = recorder
        self._clock = clock
        self._commanded_at = clock()
        self._random = np.random.default_rng(seed)
        self._angles = SCAN_BEGIN + SCAN_STEP * np.arange(SCAN_RAYS, dtype=np.float64)

    @property
    def max_speed(self) -> float:
        """Maximum speed of the body, m/s; applies from the next step."""
        return self.body.limits.speed

    @max_speed.setter
    def max_speed(self, speed: float) -> None:
        self.body.limits = self.body.limits._replace(speed=speed)

    def command(self, speed: float, turn: float) -> None:
        """Command a velocity in m/s and rad/s. Values that are not finite stop the robot."""
        self._recorder.command(speed, turn)
        self._commanded_at = self._clock()
        valid = math.isfinite(speed) and math.isfinite(turn)
        self.body.target = Twist(speed, turn) if valid else ZERO_TWIST

    def step(self, seconds: float) -> None:
        """Advance body and battery by ``seconds``, and record motion."""
        if self.command_timeout and self._clock() - self._commanded_at > self.command_timeout:
            self.body.target = ZERO_TWIST
        self.body.step(seconds)
        pose = self.body.pose
        charging = not self.body.moving and self.world.charges(pose.x, pose.y)
        velocity = self.body.velocity
        self.battery.step(seconds, velocity.speed, velocity.turn, charging)
        self._recorder.motion(self.body.moving)
        self._recorder.touch(self.body.touching)

    def reset(self) -> None:
        """Reset pose, velocity and charge to the start."""
        self.body.reset(self.world.start)
        self.battery = SimBattery(self._first_charge)
        self._recorder.reset()
        self._recorder.motion(self.body.moving)

    def scan(self) -> npt.NDArray[np.float32]:
        """One turn of the scanner, metres per ray, counter-clockwise from behind; `inf` without a hit."""
        pose = self.body.pose
        true = self.world.scan(pose.x, pose.y, pose.heading + self._angles)
        seen = true + self._random.normal(0.0, SCAN_NOISE, SCAN_RAYS)
        within = (true <= SCAN_FARTHEST) & (seen >= SCAN_NEAREST)
        return np.where(within, np.minimum(seen, SCAN_FARTHEST), np.inf).astype(np.float32)
