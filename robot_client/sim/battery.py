"""A battery that drains with time and with motion."""

from __future__ import annotations

from dataclasses import dataclass

FULL_VOLTS = 25.2
EMPTY_VOLTS = 19.8
CAPACITY_AH = 5.0
IDLE_AMPERES = 1.2
AMPERES_PER_SPEED = 5.0
"""Amperes for each m/s."""
AMPERES_PER_TURN = 0.6
"""Amperes for each rad/s."""
_RESISTANCE = 0.05


@dataclass
class Battery:
    """A six-cell lithium pack of 5 Ah: about four hours standing, about an hour and a half driving.

    An empty pack stays at zero and the robot goes on: a demo left running overnight must still drive.

    :ivar charge: share of the capacity that is left, 0 to 1
    :ivar current: amperes drawn at the moment
    """

    charge: float = 1.0
    current: float = IDLE_AMPERES

    @property
    def voltage(self) -> float:
        """Volts at the poles under the present load."""
        return EMPTY_VOLTS + (FULL_VOLTS - EMPTY_VOLTS) * self.charge - _RESISTANCE * self.current

    def step(self, seconds: float, speed: float, turn: float) -> None:
        """Drain for so long at a speed (m/s) and a turning rate (rad/s)."""
        self.current = IDLE_AMPERES + AMPERES_PER_SPEED * abs(speed) + AMPERES_PER_TURN * abs(turn)
        self.charge = max(0.0, self.charge - self.current * seconds / 3600 / CAPACITY_AH)
