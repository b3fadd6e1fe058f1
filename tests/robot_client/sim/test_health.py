"""Diagnostics of the simulated robot."""

import pytest

from robot_client.sim import health
from robot_client.sim.health import Severity


@pytest.mark.parametrize(
    ("charge", "severity"),
    [
        (1.0, Severity.OK),
        (0.21, Severity.OK),
        (0.19, Severity.WARN),
        (0.04, Severity.ERROR),
        (0, Severity.ERROR),
    ],
)
def test_battery_warns_before_it_is_empty(charge: float, severity: Severity) -> None:
    assert health.battery(charge, 22.0, 1.0).severity is severity


def test_blocked_motors_warn() -> None:
    finding = health.motors(0.0, 0.0, blocked=True, travelled=1.0)
    assert finding.severity is Severity.WARN
    assert "obstacle" in finding.message


@pytest.mark.parametrize(
    ("speed", "turn", "message"), [(0.1, 0, "driving"), (0, 0.1, "driving"), (0, 0, "standing")]
)
def test_free_motors_are_ok(speed: float, turn: float, message: str) -> None:
    finding = health.motors(speed, turn, blocked=False, travelled=1.0)
    assert (finding.severity, finding.message) == (Severity.OK, message)


@pytest.mark.parametrize(
    ("enabled", "viewers", "severity", "message"),
    [
        (True, 2, Severity.OK, "streaming"),
        (True, 0, Severity.OK, "waiting for viewers"),
        (False, 0, Severity.STALE, "switched off"),
    ],
)
def test_states_of_the_camera(enabled: bool, viewers: int, severity: Severity, message: str) -> None:
    finding = health.camera(enabled, viewers, 10, 3.0)
    assert (finding.severity, finding.message) == (severity, message)


def test_charging_battery_is_never_low() -> None:
    assert health.battery(0.01, 19.9, -8.8, charging=True)[1:3] == (Severity.OK, "charging")
    assert health.battery(1.0, 25.2, 0.0, charging=True)[1:3] == (Severity.OK, "full")
