"""Charge of a battery, from files and from messages."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from relay_protocol.errors import Unavailable
from robot_client.services import battery
from robot_client.services.battery import CHARGING, ChargeState, Gauge
from robot_client.services.health import Level

LAPTOP = {
    "type": "Battery",
    "status": "Discharging",
    "present": "1",
    "technology": "Li-ion",
    "health": "Good",
    "capacity": "57",
    "voltage_now": "11400000",
    "voltage_min_design": "10800000",
    "power_now": "22800000",
    "energy_now": "27000000",
    "energy_full": "47520000",
    "energy_full_design": "54000000",
    "temp": "312",
    "serial_number": " 4711",
}
"""One that counts energy, as many laptops have."""


def supply(folder: Path, **facts: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, value in facts.items():
        (folder / name).write_text(value + "\n")
    return folder


def test_energy_is_converted_to_charge(tmp_path: Path) -> None:
    """By the design voltage; power becomes a current."""
    state = battery.parse_facts(battery.read(supply(tmp_path, **LAPTOP)))
    assert state.volts == pytest.approx(11.4)
    assert state.amperes == pytest.approx(-2.0)
    assert state.celsius == pytest.approx(31.2)
    assert (state.charge, state.capacity, state.design) == pytest.approx((2.5, 4.4, 5.0))
    assert state.share == pytest.approx(0.57)
    assert (state.status, state.health, state.technology, state.serial) == (2, 1, 2, "4711")


def test_charge_and_sign_of_the_current_are_read(tmp_path: Path) -> None:
    facts = {"type": "Battery", "status": "Charging", "current_now": "-1500000"}
    facts |= {"charge_now": "1000000", "charge_full": "4000000"}
    state = battery.parse_facts(battery.read(supply(tmp_path, **facts)))
    assert (state.amperes, state.charge, state.share) == pytest.approx((1.5, 1.0, 0.25))
    assert math.isnan(state.volts)


def test_invalid_and_missing_files_are_unknown(tmp_path: Path) -> None:
    folder = supply(tmp_path, type="Battery", capacity="full", status="?")
    (folder / "voltage_now").write_bytes(b"\xff" * 10_000)
    state = battery.parse_facts(battery.read(folder))
    assert math.isnan(state.share) and math.isnan(state.volts)
    assert state.status == 0


def test_battery_of_the_machine_is_found(tmp_path: Path) -> None:
    """Among mains and the batteries of mice."""
    supply(tmp_path / "AC", type="Mains")
    supply(tmp_path / "hid-mouse", type="Battery", scope="Device")
    ours = supply(tmp_path / "hid-system", type="Battery", scope="System")
    assert battery.supply(tmp_path) == ours
    assert battery.supply(ours) == ours


def test_missing_battery_is_reported(tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match="there is no battery in"):
        battery.supply(tmp_path)
    with pytest.raises(Unavailable, match="No such file"):
        battery.supply(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("state", "share"),
    [
        (ChargeState(share=0.4), 0.4),
        (ChargeState(charge=1.0, capacity=4.0), 0.25),
        (ChargeState(volts=21.0), 0.5),
        (ChargeState(volts=30.0), 1.0),
        (ChargeState(share=57.0, volts=18.0), 0.0),
    ],
)
def test_charge_is_reported_or_from_capacity_or_voltage(state: ChargeState, share: float) -> None:
    assert Gauge(0.2, 0.1, (18.0, 24.0)).share(state) == pytest.approx(share)


def test_low_and_nearly_empty_batteries_are_reported() -> None:
    """With hysteresis."""
    gauge = Gauge(0.2, 0.1)
    shares = (0.5, 0.19, 0.21, 0.09, 0.11, 0.125, 0.225)
    levels = [gauge.finding(ChargeState(share=each)).level for each in shares]
    ok, warn, error = Level.OK, Level.WARN, Level.ERROR
    assert levels == [ok, warn, warn, error, error, warn, ok]
    assert gauge.finding(ChargeState(share=0.05)).message == "nearly empty: 5 %, charge it now"


def test_charging_battery_is_not_low() -> None:
    assert Gauge(0.2, 0.1).finding(ChargeState(share=0.05, status=CHARGING)).level is Level.OK


def test_faulty_missing_and_unknown_batteries_are_reported() -> None:
    gauge = Gauge(0.2, 0.1)
    hot = gauge.finding(ChargeState(share=0.9, health=battery.HEALTH["Overheat"]))
    assert (hot.level, hot.message) == (Level.ERROR, "the battery reports: overheat")
    assert gauge.finding(ChargeState(present=False)).level is Level.ERROR
    assert gauge.finding(ChargeState()).level is Level.WARN


def test_charge_out_of_range_is_reported_in_words(tmp_path: Path) -> None:
    """It is neither clamped nor left out, whatever else is known."""
    wrong = "it reports a charge of 57, which is not from 0 to 1; "
    found = Gauge(0.2, 0.1).finding(ChargeState(share=57.0))
    assert (found.level, found.message) == (Level.WARN, wrong + "the charge of the battery is unknown")
    gauge = Gauge(0.2, 0.1, (18.0, 24.0))
    found = gauge.finding(ChargeState(share=57.0, volts=23.7))
    assert (found.level, found.message) == (Level.WARN, wrong + "charged: 95 %")
    found = gauge.finding(ChargeState(share=57.0, volts=18.3))
    assert (found.level, found.message) == (Level.ERROR, wrong + "nearly empty: 5 %, charge it now")
    folder = supply(tmp_path, type="Battery", capacity="104", status="Discharging")
    found = gauge.finding(battery.parse_facts(battery.read(folder)))
    assert found.message.startswith("it reports a charge of 1.04, which is not from 0 to 1; ")
