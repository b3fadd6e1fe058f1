"""Readings of the device from the kernel, below a root that tests replace. Values that can't be read are left out."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from robot_client.device_state.rules import BATTERY, CPU, DISK, MEMORY, QUALITY, SIGNAL, TEMPERATURE


class DeviceReadings:
    """Reads CPU, memory, disk, temperature and wireless signal.

    :param folders: whose disks count
    :param battery: charge from 0 to 1 as the robot's topic says, ``None`` if it says none
    :param root: folder with ``proc`` and ``sys``
    """

    def __init__(
        self, folders: Iterable[Path], battery: Callable[[], float | None], root: Path = Path("/")
    ) -> None:
        self._folders = list(folders)
        self._battery = battery
        self._root = root
        self._times = self._cpu_times()

    def read(self) -> dict[str, float]:
        """The readings by component: per cent, degrees Celsius, dBm. The CPU's load is since the call before."""
        signal, quality = self._wireless()
        found: dict[str, float | None] = {
            SIGNAL: signal,
            QUALITY: quality,
            BATTERY: self._charge(),
            CPU: self._cpu(),
            MEMORY: self._memory(),
            DISK: self._disk(),
            TEMPERATURE: self._temperature(),
        }
        return {name: round(value, 1) for name, value in found.items() if value is not None}

    def _wireless(self) -> tuple[float | None, float | None]:
        """Signal and quality of the wireless interface with the best signal (proc(5), ``/proc/net/wireless``)."""
        found = []
        for line in self._text("proc/net/wireless").splitlines()[2:]:
            fields = line.split()
            try:
                quality, level = (float(each.rstrip(".")) for each in fields[2:4])
            except ValueError:
                continue
            if -200 <= level < 0:
                found.append((level, quality))
        return max(found, default=(None, None))

    def _charge(self) -> float | None:
        charge = self._battery()
        if charge is not None:
            return charge * 100
        supplies = self._children("sys/class/power_supply")
        of_system = (
            each
            for each in supplies
            if self._text_of(each / "type") == "Battery" and self._text_of(each / "scope") != "Device"
        )
        charges = (_number(self._text_of(each / "capacity")) for each in of_system)
        return next((each for each in charges if each is not None), None)

    def _cpu_times(self) -> tuple[float, float] | None:
        """Idle and all time since the start, ticks (proc(5), ``/proc/stat``)."""
        first = self._text("proc/stat").partition("\n")[0].split()
        try:
            times = [float(each) for each in first[1:9]]
        except ValueError:
            return None
        return (times[3] + times[4], sum(times)) if len(times) >= 5 else None

    def _cpu(self) -> float | None:
        before, self._times = self._times, self._cpu_times()
        if before is None or self._times is None or self._times[1] <= before[1]:
            return None
        idle, total = self._times[0] - before[0], self._times[1] - before[1]
        return min(100.0, max(0.0, 100 * (1 - idle / total)))

    def _memory(self) -> float | None:
        fields = {}
        for line in self._text("proc/meminfo").splitlines():
            name, _, value = line.partition(":")
            fields[name] = _number(value.removesuffix("kB").strip())
        total, available = fields.get("MemTotal"), fields.get("MemAvailable")
        if not total or available is None:
            return None
        return 100 * (1 - available / total)

    def _disk(self) -> float | None:
        """Of the fullest disk."""
        found = []
        for folder in self._folders:
            with suppress(OSError):
                disk = os.statvfs(folder)
                used = disk.f_blocks - disk.f_bfree
                if used + disk.f_bavail:
                    found.append(100 * used / (used + disk.f_bavail))
        return max(found, default=None)

    def _temperature(self) -> float | None:
        zones = self._children("sys/class/thermal")
        found = [
            _number(self._text_of(each / "temp")) for each in zones if each.name.startswith("thermal_zone")
        ]
        return max((each / 1000 for each in found if each is not None), default=None)

    def _children(self, path: str) -> list[Path]:
        try:
            return sorted((self._root / path).iterdir())
        except OSError:
            return []

    def _text(self, path: str) -> str:
        return self._text_of(self._root / path)

    @staticmethod
    def _text_of(path: Path) -> str:
        try:
            return path.read_text(errors="replace").strip()
        except OSError:
            return ""


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
