"""Settings of the device manager (``[offload]``): when a component of the device is critical."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

Percent = Annotated[float, msgspec.Meta(ge=0, le=100)]


class CriticalValues(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Values at which a component is critical. ``None``: it never is.

    :param battery: charge at or below this, per cent
    :param cpu: load of the whole machine at or above this, per cent
    :param memory: in use at or above this, per cent
    :param disk: in use at or above this, per cent, of the fullest disk with the daemon's state folder or the folder of
        a group of files
    :param temperature: of the hottest sensor at or above this, degrees Celsius
    :param signal: of the wireless link at or below this, dBm
    :param quality: of the wireless link at or below this, in its driver's scale, which often ends at 70
    """

    battery: Percent | None = 20.0
    cpu: Percent | None = 90.0
    memory: Percent | None = 90.0
    disk: Percent | None = 90.0
    temperature: Annotated[float, msgspec.Meta(ge=-50, le=200)] | None = 85.0
    signal: Annotated[float, msgspec.Meta(ge=-200, le=0)] | None = -80.0
    quality: Annotated[float, msgspec.Meta(ge=0, le=255)] | None = None


class DeviceSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The device manager.

    :param cycle_seconds: seconds between two measurements
    :param cpu_in_a_row: measurements in a row in which the load must be too high
    :param where: where programs run functions that are offloaded: ``auto`` by the state of the device, or always
        ``here`` or in the ``cloud``
    :param critical: values at which components are critical
    """

    cycle_seconds: Annotated[float, msgspec.Meta(ge=0.1, le=120)] = 60.0
    cpu_in_a_row: Annotated[int, msgspec.Meta(ge=1, le=100)] = 3
    where: Literal["auto", "here", "cloud"] = "auto"
    critical: CriticalValues = msgspec.field(default_factory=CriticalValues)
