"""A battery that drains with time and with motion, and fills at a charger."""

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
CHARGER_AMPERES = 10.0
"""What a charger gives: full from empty in little more than half an hour."""
_RESISTANCE = 0.05


@dataclass
class SimBattery:
    """A six-cell lithium pack of 5 Ah: about four hours standing, about an hour and a half driving.

    An empty pack stays at zero and the robot goes on: a demo left running overnight must still drive.

    :ivar charge: share of the capacity that is left, 0 to 1
    :ivar current: amperes drawn at the moment; less than zero while it fills
    :ivar charging: whether it hangs on a charger
    """

    charge: float = 1.0
    current: float = IDLE_AMPERES
    charging: bool = False

    @property
    def voltage(self) -> float:
        """Volts at the poles under the present load."""
        return EMPTY_VOLTS + (FULL_VOLTS - EMPTY_VOLTS) * self.charge - _RESISTANCE * self.current

    def step(self, seconds: float, speed: float, turn: float, charging: bool = False) -> None:
        """Drain for so long at a speed (m/s) and a turning rate (rad/s), or fill."""
        self.charging = charging
        self.current = IDLE_AMPERES + AMPERES_PER_SPEED * abs(speed) + AMPERES_PER_TURN * abs(turn)
        if charging:  # a full one draws nothing, since the charger feeds the robot
            self.current -= CHARGER_AMPERES if self.charge < 1.0 else self.current
        left = self.charge - self.current * seconds / 3600 / CAPACITY_AH
        self.charge = min(1.0, max(0.0, left))
