"""The device manager: readings of a kernel in a folder, the rules value by value, and who gets to know."""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from relay_protocol import link
from robot_client.device_state.manager import DeviceManager
from robot_client.device_state.readings import DeviceReadings
from robot_client.device_state.rules import CriticalComponents
from robot_client.device_state.settings import CriticalValues, DeviceSettings

HEAD = "Inter-| sta-|   Quality        |   Discarded packets\n face | tus | link level noise |  nwid  crypt\n"


class Kernel:
    """A folder with ``proc`` and ``sys``."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.charge: float | None = None
        self.busy = self.idle = 1000
        self.write("proc/stat", "cpu  1000 0 0 1000 0 0 0 0 0 0\ncpu0 1 2 3\n")
        self.memory(50)

    def write(self, path: str, text: str) -> None:
        (self.root / path).parent.mkdir(parents=True, exist_ok=True)
        (self.root / path).write_text(text)

    def load(self, percent: int) -> None:
        self.busy, self.idle = self.busy + percent, self.idle + 100 - percent
        self.write("proc/stat", f"cpu  {self.busy} 0 0 {self.idle} 0 0 0 0 0 0\n")

    def memory(self, percent: int) -> None:
        self.write(
            "proc/meminfo", f"MemTotal: 1000 kB\nMemFree: 1 kB\nMemAvailable: {1000 - 10 * percent} kB\n"
        )

    def signal(self, *levels: str) -> None:
        lines = [
            f" wlan{i}: 0000   {60 + i}.  {level}  -256        0      0\n" for i, level in enumerate(levels)
        ]
        self.write("proc/net/wireless", HEAD + "".join(lines))

    def readings(self) -> DeviceReadings:
        return DeviceReadings([self.root], lambda: self.charge, self.root)


@pytest.fixture
def kernel(tmp_path: Path) -> Kernel:
    return Kernel(tmp_path)


def test_readings_of_cpu_and_memory(kernel: Kernel) -> None:
    readings = kernel.readings()
    kernel.load(73)
    kernel.memory(81)
    found = readings.read()
    assert (found["cpu"], found["memory"]) == (73.0, 81.0)
    assert 0 <= found["disk"] <= 100


def test_the_best_wireless_signal_counts(kernel: Kernel) -> None:
    kernel.signal("-71.", "-52.", "0", "nonsense")
    found = kernel.readings().read()
    assert (found["signal"], found["quality"]) == (-52.0, 61.0)


def test_the_hottest_sensor_counts(kernel: Kernel) -> None:
    for number, value in enumerate(("41000", "72500", "broken")):
        kernel.write(f"sys/class/thermal/thermal_zone{number}/temp", value)
    kernel.write("sys/class/thermal/cooling_device0/temp", "99000")
    assert kernel.readings().read()["temperature"] == 72.5


def test_the_battery_is_that_of_the_robots_topic_or_else_of_the_system(kernel: Kernel) -> None:
    kernel.write("sys/class/power_supply/AC/type", "Mains")
    kernel.write("sys/class/power_supply/BAT0/type", "Battery")
    kernel.write("sys/class/power_supply/BAT0/capacity", "37")
    kernel.write("sys/class/power_supply/A-mouse/type", "Battery")
    kernel.write("sys/class/power_supply/A-mouse/scope", "Device")
    kernel.write("sys/class/power_supply/A-mouse/capacity", "5")
    readings = kernel.readings()
    assert readings.read()["battery"] == 37.0
    kernel.write("sys/class/power_supply/BAT0/capacity", "0")
    assert readings.read()["battery"] == 0.0
    kernel.charge = 0.9
    assert readings.read()["battery"] == 90.0


def test_what_can_not_be_read_is_left_out(tmp_path: Path) -> None:
    readings = DeviceReadings([tmp_path / "none"], lambda: None, tmp_path / "none")
    assert readings.read() == {}


def test_the_fullest_disk_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot's recordings are often on another disk than its system."""
    used = {"/state": 40, "/bags": 93, "/maps": 12}

    def statvfs(folder: Path) -> Any:
        if str(folder) not in used:
            raise FileNotFoundError
        left = 100 - used[str(folder)]
        return SimpleNamespace(f_blocks=100, f_bfree=left, f_bavail=left)

    monkeypatch.setattr(os, "statvfs", statvfs)
    folders = [Path(each) for each in ("/state", "/bags", "/maps", "/unplugged")]
    assert DeviceReadings(folders, lambda: None).read()["disk"] == 93.0


FINE = {
    "battery": 50.0,
    "cpu": 50.0,
    "memory": 50.0,
    "disk": 50.0,
    "temperature": 50.0,
    "signal": -50.0,
    "quality": 60.0,
}


@pytest.mark.parametrize(
    ("component", "value", "critical"),
    [
        ("battery", 20.1, False),
        ("battery", 20.0, True),
        ("battery", 0.0, True),
        ("memory", 89.9, False),
        ("memory", 90.0, True),
        ("disk", 89.9, False),
        ("disk", 90.0, True),
        ("temperature", 84.9, False),
        ("temperature", 85.0, True),
        ("signal", -79.9, False),
        ("signal", -80.0, True),
    ],
)
def test_a_component_is_critical_from_its_value_on(component: str, value: float, critical: bool) -> None:
    found = CriticalComponents(DeviceSettings()).measured({**FINE, component: value})
    assert found == {**dict.fromkeys(FINE, False), component: critical}


@pytest.mark.parametrize(
    ("loads", "critical"),
    [
        ([95], [False]),
        ([95, 95, 95], [False, False, True]),
        ([95, 95, 10, 95, 95, 90], [False, False, False, False, False, True]),
        ([95, 95, 95, 95, 10], [False, False, True, True, False]),
    ],
)
def test_the_cpu_is_critical_after_three_readings_in_a_row(loads: list[float], critical: list[bool]) -> None:
    rules = CriticalComponents(DeviceSettings())
    assert [rules.measured({**FINE, "cpu": each})["cpu"] for each in loads] == critical


def test_with_a_poor_signal_nothing_else_is_checked(kernel: Kernel) -> None:
    rules = CriticalComponents(DeviceSettings())
    full = {**FINE, "memory": 99.0}
    assert rules.measured({**full, "signal": -90.0})["memory"] is False
    assert rules.measured(full)["memory"] is True
    assert rules.measured({**FINE, "signal": -90.0})["memory"] is True, "what was found before stays"
    assert rules.measured(FINE)["memory"] is False


def test_a_poor_signal_interrupts_readings_in_a_row() -> None:
    rules = CriticalComponents(DeviceSettings())
    busy = {**FINE, "cpu": 99.0}
    for _ in range(2):
        rules.measured(busy)
    rules.measured({**busy, "signal": -90.0})
    assert [rules.measured(busy)["cpu"] for _ in range(3)] == [False, False, True]


def test_a_low_quality_counts_if_the_settings_say_so() -> None:
    """Its scale is the driver's, so there is no value for all."""
    poor = {**FINE, "quality": 9.0, "memory": 99.0}
    assert CriticalComponents(DeviceSettings()).measured(poor)["quality"] is False
    found = CriticalComponents(DeviceSettings(critical=CriticalValues(quality=10.0))).measured(poor)
    assert found == {**dict.fromkeys(FINE, False), "quality": True}


def test_a_component_without_a_reading_or_a_value_is_not_critical() -> None:
    never = DeviceSettings(critical=CriticalValues(memory=None))
    assert not any(CriticalComponents(never).measured({"memory": 100.0}).values())


class Managed:
    def __init__(self, kernel: Kernel) -> None:
        self.sent: list[Any] = []
        self.published: list[link.DeviceReport] = []
        self.alerts: list[tuple[str, str, bool]] = []
        self.manager = DeviceManager(
            DeviceSettings(),
            kernel.readings(),
            kernel.root,
            send=self.sent.append,
            publish=self.published.append,
            alert=self.alert,
            wall=lambda: 1000.0,
        )

    def alert(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        assert kind == "device"
        self.alerts.append((about, text, over))


def test_pressure_reaches_the_file_the_relay_and_users(kernel: Kernel) -> None:
    made = Managed(kernel)
    kernel.memory(95)
    made.manager.measure()
    assert made.sent == []
    assert made.manager.full
    published = json.loads((kernel.root / "device.json").read_bytes())
    assert published["at"] == 1000.0
    assert published["critical"]["memory"] is True
    assert published["readings"]["memory"] == 95.0
    assert published["where"] == "auto"
    made.manager.registered()
    assert isinstance(made.sent[0], link.DeviceReport)
    assert made.sent[0].critical["memory"] is True
    kernel.memory(96)
    made.manager.measure()
    kernel.memory(10)
    made.manager.measure()
    memory = [each for each in made.alerts if each[0] == "memory"]
    assert memory == [
        ("memory", "memory is critical: 95 %, at or above 90 %", False),
        ("memory", "memory is not critical any more", True),
    ]
    assert len(made.sent) == 3
    made.manager.link_lost()
    made.manager.measure()
    assert len(made.sent) == 3
    assert [each.readings["memory"] for each in made.published] == [95.0, 96.0, 10.0, 10.0]


def test_state_folder_that_can_not_be_written_is_reported_until_it_can(kernel: Kernel) -> None:
    made = Managed(kernel)
    taken = kernel.root / "device.json"
    taken.mkdir()
    made.manager.measure()
    made.manager.measure()
    taken.rmdir()
    made.manager.measure()
    assert [each for each in made.alerts if each[0] == "device.json"] == [
        (
            "device.json",
            f"the daemon can't write into its state folder {kernel.root}: Is a directory",
            False,
        ),
        ("device.json", "the daemon can write into its state folder again", True),
    ]
