"""State of a battery, as Linux reports it, and its diagnostics."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from relay_protocol.errors import Unavailable
from relay_protocol.text import escape_unprintable
from robot_client.services.health import Level, ServiceFinding

SUPPLIES = Path("/sys/class/power_supply")

LONGEST = 256
"""Most bytes read of a file; the kernel's files hold a word or a number."""
RECOVERY = 0.02
"""Hysteresis of the thresholds, as fraction of the charge."""

STATUS = {"Charging": 1, "Discharging": 2, "Not charging": 3, "Full": 4}
HEALTH = {
    "Good": 1,
    "Overheat": 2,
    "Dead": 3,
    "Over voltage": 4,
    "Unspecified failure": 5,
    "Cold": 6,
    "Watchdog timer expire": 7,
    "Safety timer expire": 8,
}
TECHNOLOGY = {"NiMH": 1, "Li-ion": 2, "Li-poly": 3, "LiFe": 4, "NiCd": 5, "LiMn": 6}
"""States of the kernel (Documentation/ABI/testing/sysfs-class-power) as numbers of sensor_msgs/BatteryState."""

CHARGING, FULL = STATUS["Charging"], STATUS["Full"]
_GOOD = (0, HEALTH["Good"])


class ChargeState(NamedTuple):
    """A battery, in the units of sensor_msgs/BatteryState. Unknown values are NaN.

    :ivar volts: voltage
    :ivar amperes: negative while discharging
    :ivar celsius: temperature
    :ivar charge: Ah left
    :ivar capacity: Ah when full, now
    :ivar design: Ah when full, by design
    :ivar share: charge, 0 to 1
    """

    volts: float = math.nan
    amperes: float = math.nan
    celsius: float = math.nan
    charge: float = math.nan
    capacity: float = math.nan
    design: float = math.nan
    share: float = math.nan
    status: int = 0
    health: int = 0
    technology: int = 0
    present: bool = True
    serial: str = ""


def supply(folder: Path) -> Path:
    """The folder of the machine's first battery.

    Batteries of mice and keyboards (``scope`` is ``Device``) are ignored.

    :param folder: :data:`SUPPLIES`, or one battery's own folder, which is taken as it is
    :raises Unavailable: there is none
    """
    if (folder / "type").exists():
        return folder
    try:
        for each in sorted(folder.iterdir()):
            facts = read(each)
            if facts.get("type") == "Battery" and facts.get("scope") != "Device":
                return each
    except OSError as error:
        raise Unavailable(f"{folder}: {error.strerror}") from None
    raise Unavailable(f"there is no battery in {folder}")


_FILES = (
    "type",
    "scope",
    "present",
    "status",
    "health",
    "technology",
    "capacity",
    "voltage_now",
    "current_now",
    "power_now",
    "temp",
    "serial_number",
    "charge_now",
    "charge_full",
    "charge_full_design",
    "energy_now",
    "energy_full",
    "energy_full_design",
    "voltage_min_design",
)


def read(folder: Path) -> dict[str, str]:
    """Read the existing files of one power supply."""
    facts = {}
    for name in _FILES:
        try:
            with (folder / name).open("rb") as file:
                text = file.read(LONGEST).decode("ascii", "replace").strip()
        except OSError:  # not there, or the hardware doesn't answer now
            continue
        if text:
            facts[name] = escape_unprintable(text)
    return facts


def parse_facts(facts: Mapping[str, str]) -> ChargeState:
    """Parse the files of a power supply, which hold millionths and tenths of a degree."""
    volts = _number(facts, "voltage_now") / 1e6
    amperes = _number(facts, "current_now") / 1e6
    if math.isnan(amperes):
        amperes = _quotient(_number(facts, "power_now") / 1e6, volts)
    status = STATUS.get(facts.get("status", ""), 0)
    if status == STATUS["Discharging"]:
        amperes = -abs(amperes)  # drivers don't agree on the sign
    elif status == CHARGING:
        amperes = abs(amperes)
    now, full, design = (_ampere_hours(facts, each, volts) for each in ("now", "full", "full_design"))
    share = _number(facts, "capacity") / 100
    if math.isnan(share) and full > 0:
        share = min(1.0, max(0.0, now / full))  # an aged battery can hold more than it has learned
    return ChargeState(
        volts=volts,
        amperes=amperes,
        celsius=_number(facts, "temp") / 10,
        charge=now,
        capacity=full,
        design=design,
        share=share,
        status=status,
        health=HEALTH.get(facts.get("health", ""), 0),
        technology=TECHNOLOGY.get(facts.get("technology", ""), 0),
        present=facts.get("present", "1") != "0",
        serial=facts.get("serial_number", ""),
    )


def _ampere_hours(facts: Mapping[str, str], which: str, volts: float) -> float:
    charge = _number(facts, f"charge_{which}") / 1e6
    if math.isfinite(charge):
        return charge
    # Some report energy; divided by the design voltage it is charge.
    design = _number(facts, "voltage_min_design") / 1e6
    return _quotient(_number(facts, f"energy_{which}") / 1e6, design if math.isfinite(design) else volts)


def _number(facts: Mapping[str, str], name: str) -> float:
    try:
        return float(int(facts[name]))
    except (KeyError, ValueError):
        return math.nan


def _quotient(value: float, by: float) -> float:
    return value / by if by > 0 else math.nan


class Gauge:
    """Computes the charge of a battery, also from its voltage, and its diagnostics.

    :param low: charge, 0 to 1, below which it is low
    :param critical: charge below which it is nearly empty
    :param volts: when empty and when full; zero when unknown
    """

    def __init__(self, low: float, critical: float, volts: tuple[float, float] = (0.0, 0.0)) -> None:
        self._limits = {Level.WARN: low, Level.ERROR: critical}
        self._volts = volts
        self._level = Level.OK

    def share(self, state: ChargeState) -> float:
        """Charge from 0 to 1, as reported, or from capacity or voltage; NaN when unknown."""
        if 0.0 <= state.share <= 1.0:
            return state.share
        found = _quotient(state.charge, state.capacity)
        empty, full = self._volts
        if math.isnan(found) and full > empty:
            found = (state.volts - empty) / (full - empty)
        return found if math.isnan(found) else min(1.0, max(0.0, found))

    def finding(self, state: ChargeState) -> ServiceFinding:
        """Diagnostics of a state."""
        found = self._finding(state)
        if math.isnan(state.share) or 0.0 <= state.share <= 1.0:
            return found
        words = f"it reports a charge of {state.share:g}, which is not from 0 to 1; {found.message}"
        return found._replace(level=max(Level.WARN, found.level), message=words)

    def _finding(self, state: ChargeState) -> ServiceFinding:
        share = self.share(state)
        values = _values(state, share)
        if not state.present:
            return ServiceFinding(Level.ERROR, "there is no battery", values)
        if state.health not in _GOOD:
            words = next(word for word, number in HEALTH.items() if number == state.health)
            return ServiceFinding(Level.ERROR, f"the battery reports: {words.lower()}", values)
        if math.isnan(share):
            return ServiceFinding(Level.WARN, "the charge of the battery is unknown", values)
        percent = f"{share * 100:.0f} %"
        if state.status in (CHARGING, FULL):
            self._level = Level.OK
            return ServiceFinding(
                Level.OK, f"{'charging' if state.status == CHARGING else 'full'}: {percent}", values
            )
        self._level = self._level_of(share)
        words = {
            Level.ERROR: f"nearly empty: {percent}, charge it now",
            Level.WARN: f"low: {percent}, charge it soon",
        }.get(self._level, f"charged: {percent}")
        return ServiceFinding(self._level, words, values)

    def _level_of(self, share: float) -> Level:
        for level in (Level.ERROR, Level.WARN):
            recovered = RECOVERY if self._level >= level else 0.0
            if share < self._limits[level] + recovered:
                return level
        return Level.OK


def _values(state: ChargeState, share: float) -> dict[str, str]:
    figures = {
        "charge_percent": share * 100,
        "volts": state.volts,
        "amperes": state.amperes,
        "celsius": state.celsius,
    }
    return {name: f"{value:.2f}" for name, value in figures.items() if math.isfinite(value)}
