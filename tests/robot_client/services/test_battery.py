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


def test_a_battery_that_counts_energy_is_read(tmp_path: Path) -> None:
    """Energy becomes charge by the design's voltage, power becomes a current that is drained."""
    state = battery.of_facts(battery.read(supply(tmp_path, **LAPTOP)))
    assert state.volts == pytest.approx(11.4)
    assert state.amperes == pytest.approx(-2.0)
    assert state.celsius == pytest.approx(31.2)
    assert (state.charge, state.capacity, state.design) == pytest.approx((2.5, 4.4, 5.0))
    assert state.share == pytest.approx(0.57)
    assert (state.status, state.health, state.technology, state.serial) == (2, 1, 2, "4711")


def test_a_battery_that_counts_charge_is_read(tmp_path: Path) -> None:
    """Its current is positive when it charges, whatever sign the driver gives; without a share one is computed."""
    facts = {"type": "Battery", "status": "Charging", "current_now": "-1500000"}
    facts |= {"charge_now": "1000000", "charge_full": "4000000"}
    state = battery.of_facts(battery.read(supply(tmp_path, **facts)))
    assert (state.amperes, state.charge, state.share) == pytest.approx((1.5, 1.0, 0.25))
    assert math.isnan(state.volts)


def test_nonsense_in_files_is_not_known(tmp_path: Path) -> None:
    """Text where a number should be, binary rubbish and a missing file are all unknown."""
    folder = supply(tmp_path, type="Battery", capacity="full", status="?")
    (folder / "voltage_now").write_bytes(b"\xff" * 10_000)
    state = battery.of_facts(battery.read(folder))
    assert math.isnan(state.share) and math.isnan(state.volts)
    assert state.status == 0


def test_the_machines_battery_is_found_among_mice_and_mains(tmp_path: Path) -> None:
    """Mains are no battery, and a mouse's is not the robot's; a folder of one battery is taken as it is."""
    supply(tmp_path / "AC", type="Mains")
    supply(tmp_path / "hid-mouse", type="Battery", scope="Device")
    ours = supply(tmp_path / "hid-system", type="Battery", scope="System")
    assert battery.supply(tmp_path) == ours
    assert battery.supply(ours) == ours


def test_without_a_battery_it_says_so(tmp_path: Path) -> None:
    """Also when the folder isn't there."""
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
def test_the_charge_is_found_in_what_a_battery_tells(state: ChargeState, share: float) -> None:
    """As it says, else by capacity, else by voltage; a share that is no share is none."""
    assert Gauge(0.2, 0.1, (18.0, 24.0)).share(state) == pytest.approx(share)


def test_it_warns_when_low_and_is_in_error_when_nearly_empty() -> None:
    """And at a threshold it does not flicker."""
    gauge = Gauge(0.2, 0.1)
    shares = (0.5, 0.19, 0.21, 0.09, 0.11, 0.125, 0.225)
    levels = [gauge.finding(ChargeState(share=each)).level for each in shares]
    ok, warn, error = Level.OK, Level.WARN, Level.ERROR
    assert levels == [ok, warn, warn, error, error, warn, ok]
    assert gauge.finding(ChargeState(share=0.05)).message == "nearly empty: 5 %, charge it now"


def test_what_charges_is_not_low() -> None:
    """Whoever stands at the charger need not be told to go there."""
    assert Gauge(0.2, 0.1).finding(ChargeState(share=0.05, status=CHARGING)).level is Level.OK


def test_a_battery_in_trouble_is_an_error() -> None:
    """Overheated, gone, or unknown: each in its words."""
    gauge = Gauge(0.2, 0.1)
    hot = gauge.finding(ChargeState(share=0.9, health=battery.HEALTH["Overheat"]))
    assert (hot.level, hot.message) == (Level.ERROR, "the battery tells: overheat")
    assert gauge.finding(ChargeState(present=False)).level is Level.ERROR
    assert gauge.finding(ChargeState()).level is Level.WARN
