"""The battery drains with time and more so with motion."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.sim.robot import (
    CAPACITY_AH,
    CHARGER_AMPERES,
    EMPTY_VOLTS,
    FULL_VOLTS,
    IDLE_AMPERES,
    SimBattery,
)


def test_idle_current_drains_the_battery() -> None:
    battery = SimBattery()
    battery.step(3600, 0.0, 0.0)
    assert battery.charge == pytest.approx(1 - IDLE_AMPERES / CAPACITY_AH)


@given(speed=st.floats(0.01, 2), turn=st.floats(0.01, 3))
def test_motion_drains_more_in_any_direction(speed: float, turn: float) -> None:
    idle, ahead, back = SimBattery(), SimBattery(), SimBattery()
    idle.step(60, 0.0, 0.0)
    ahead.step(60, speed, turn)
    back.step(60, -speed, -turn)
    assert ahead.charge < idle.charge
    assert ahead == back


@given(st.lists(st.tuples(st.floats(0, 1e5), st.floats(-2, 2), st.floats(-3, 3)), max_size=20))
def test_charge_only_falls_and_stays_within_bounds(steps: list[tuple[float, float, float]]) -> None:
    battery = SimBattery()
    for seconds, speed, turn in steps:
        before = battery.charge
        battery.step(seconds, speed, turn)
        assert 0 <= battery.charge <= before
        assert EMPTY_VOLTS - 1 < battery.voltage <= FULL_VOLTS


def test_charger_fills_the_battery() -> None:
    """A full one draws nothing."""
    battery = SimBattery(0.1)
    battery.step(300, 0.0, 0.0, charging=True)
    assert battery.charging and battery.current == pytest.approx(IDLE_AMPERES - CHARGER_AMPERES)
    assert battery.charge == pytest.approx(0.1 + (CHARGER_AMPERES - IDLE_AMPERES) / 12 / CAPACITY_AH)
    battery.step(7200, 0.0, 0.0, charging=True)
    battery.step(1, 0.0, 0.0, charging=True)
    assert (battery.charge, battery.current) == (1.0, 0.0)
    battery.step(60, 0.0, 0.0)
    assert battery.charge < 1.0 and not battery.charging
