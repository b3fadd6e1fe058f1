"""Rules that decide which components of the device are critical, by its readings. Pure.

While the wireless signal is too weak nothing else is checked, because work could not be moved to the relay anyway. The
load of the CPU counts only when it is too high several times in a row.
"""

from __future__ import annotations

from typing import NamedTuple

from robot_client.device_state.settings import DeviceSettings
from robot_client.offload.device import WIRELESS

SIGNAL, QUALITY = WIRELESS
BATTERY = "battery"
CPU = "cpu"
MEMORY = "memory"
DISK = "disk"
TEMPERATURE = "temperature"


class Rule(NamedTuple):
    """When a component is critical.

    :param too_low: whether low values are critical; otherwise high ones
    :param unit: of the reading, for people
    """

    too_low: bool
    unit: str


RULES = {
    SIGNAL: Rule(True, "dBm"),
    QUALITY: Rule(True, ""),
    BATTERY: Rule(True, "%"),
    CPU: Rule(False, "%"),
    MEMORY: Rule(False, "%"),
    DISK: Rule(False, "%"),
    TEMPERATURE: Rule(False, "°C"),
}
"""The components, in the order in which they are checked."""


class CriticalComponents:
    """Decides after each measurement which components are critical."""

    def __init__(self, settings: DeviceSettings) -> None:
        self._settings = settings
        self._cpu_high = 0
        self._critical = dict.fromkeys(RULES, False)

    def measured(self, readings: dict[str, float]) -> dict[str, bool]:
        """Whether each component is critical, after these readings. A component without a reading is not.

        :param readings: by component; percent, degrees Celsius, dBm
        """
        for component in WIRELESS:
            self._critical[component] = self._exceeded(component, readings)
        if any(self._critical[each] for each in WIRELESS):
            # The others keep what was found before; readings in a row begin again.
            self._cpu_high = 0
            return dict(self._critical)
        for component in RULES:
            if component not in (*WIRELESS, CPU):
                self._critical[component] = self._exceeded(component, readings)
        self._cpu_high = self._cpu_high + 1 if self._exceeded(CPU, readings) else 0
        self._critical[CPU] = self._cpu_high >= self._settings.cpu_in_a_row
        return dict(self._critical)

    def limit(self, component: str) -> float | None:
        """The critical value of a component; ``None``: it is never critical."""
        found: float | None = getattr(self._settings.critical, component)
        return found

    def _exceeded(self, component: str, readings: dict[str, float]) -> bool:
        limit, value = self.limit(component), readings.get(component)
        if limit is None or value is None:
            return False
        return value <= limit if RULES[component].too_low else value >= limit
