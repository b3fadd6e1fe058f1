"""Diagnostics of the simulated robot, from its state."""

from __future__ import annotations

import enum
from typing import NamedTuple

BATTERY_LOW = 0.20
BATTERY_NEARLY_EMPTY = 0.05


class Severity(enum.IntEnum):
    """Values of diagnostic_msgs/DiagnosticStatus.level."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class PartFinding(NamedTuple):
    """State of one part of the robot, with measurements."""

    part: str
    severity: Severity
    message: str
    values: dict[str, str]


def motors(speed: float, turn: float, blocked: bool, travelled: float) -> PartFinding:
    """:param speed: m/s; :param turn: rad/s; :param travelled: metres since the last reset"""
    values = {"speed_m_s": f"{speed:.3f}", "turn_rad_s": f"{turn:.3f}", "travelled_m": f"{travelled:.2f}"}
    if blocked:
        return PartFinding("motors", Severity.WARN, "stalled: an obstacle holds the robot back", values)
    return PartFinding("motors", Severity.OK, "driving" if speed or turn else "standing", values)


def battery(charge: float, volts: float, amperes: float, charging: bool = False) -> PartFinding:
    """:param charge: remaining capacity, 0 to 1; :param charging: whether a charger is connected"""
    values = {"charge_percent": f"{charge * 100:.1f}", "volts": f"{volts:.2f}", "amperes": f"{amperes:.2f}"}
    if charging:
        return PartFinding("battery", Severity.OK, "charging" if charge < 1.0 else "full", values)
    if charge < BATTERY_NEARLY_EMPTY:
        return PartFinding("battery", Severity.ERROR, "nearly empty: charge it now", values)
    if charge < BATTERY_LOW:
        return PartFinding("battery", Severity.WARN, "low: charge it soon", values)
    return PartFinding("battery", Severity.OK, "charged", values)


def camera(enabled: bool, viewers: int, frames: int, render_ms: float) -> PartFinding:
    """:param viewers: subscriptions to its topics; :param frames: images sent so far"""
    values = {"viewers": str(viewers), "frames": str(frames), "render_ms": f"{render_ms:.2f}"}
    if not enabled:
        return PartFinding("camera", Severity.STALE, "switched off", values)
    return PartFinding("camera", Severity.OK, "streaming" if viewers else "waiting for viewers", values)
