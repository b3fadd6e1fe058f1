"""The simulated robot without ROS: body, battery, scanner and record in one place."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from robot_client.sim.battery import SimBattery
from robot_client.sim.drive import DEFAULT_LIMITS, STANDING, SimBody, Twist
from robot_client.sim.recorder import MotionRecorder
from robot_client.sim.world import World

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
    """Takes velocity commands, lives in steps of time.

    :param seed: of the scanner's noise
    :param clock: seconds, monotonic; only for the age of the last command
    :param charge: of the battery at the beginning and after a reset, 0 to 1
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
        """Seconds after which a command is void; 0 means never, as with many bases."""
        self._recorder = recorder
        self._clock = clock
        self._commanded_at = clock()
        self._random = np.random.default_rng(seed)
        self._angles = SCAN_BEGIN + SCAN_STEP * np.arange(SCAN_RAYS, dtype=np.float64)

    @property
    def max_speed(self) -> float:
        """The most the body drives, m/s; takes effect with the next step."""
        return self.body.limits.speed

    @max_speed.setter
    def max_speed(self, speed: float) -> None:
        self.body.limits = self.body.limits._replace(speed=speed)

    def command(self, speed: float, turn: float) -> None:
        """Ask for a velocity in m/s and rad/s. What is no finite number stops the robot."""
        self._recorder.command(speed, turn)
        self._commanded_at = self._clock()
        sound = math.isfinite(speed) and math.isfinite(turn)
        self.body.target = Twist(speed, turn) if sound else STANDING

    def step(self, seconds: float) -> None:
        """Let time pass for body and battery, and note whether the body moves."""
        if self.command_timeout and self._clock() - self._commanded_at > self.command_timeout:
            self.body.target = STANDING
        self.body.step(seconds)
        pose = self.body.pose
        charging = not self.body.moving and self.world.charges(pose.x, pose.y)
        self.battery.step(seconds, *self.body.velocity, charging)
        self._recorder.motion(self.body.moving)
        self._recorder.touch(self.body.touching)

    def reset(self) -> None:
        """Back to the start: place, velocity and charge."""
        self.body.reset(self.world.start)
        self.battery = SimBattery(self._first_charge)
        self._recorder.reset()
        self._recorder.motion(self.body.moving)

    def scan(self) -> npt.NDArray[np.float32]:
        """One turn of the scanner, metres per ray from behind over the right side round; `inf` is nothing."""
        pose = self.body.pose
        true = self.world.cast(pose.x, pose.y, pose.heading + self._angles).distance
        seen = true + self._random.normal(0.0, SCAN_NOISE, SCAN_RAYS)
        within = (true <= SCAN_FARTHEST) & (seen >= SCAN_NEAREST)
        return np.where(within, np.minimum(seen, SCAN_FARTHEST), np.inf).astype(np.float32)
