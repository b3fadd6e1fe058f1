"""Limits of what the devices of the broker may have, before anything is built of it."""

from __future__ import annotations

import pytest

from relay_protocol.errors import Invalid
from robot_client.platforms.mqtt.devices import (
    MAX_DEVICE_ITEMS,
    MAX_ITEMS,
    DeviceNames,
    DeviceRegistry,
    ProblemList,
)
from robot_client.platforms.mqtt.messages import BOOL
from robot_client.platforms.mqtt.model import DevicePart, Element


def registry() -> DeviceRegistry:
    return DeviceRegistry(DeviceNames(None), ProblemList())


def part(key: str, count: int, name: str = "same") -> DevicePart:
    return DevicePart(key, key, [Element(name, BOOL) for _ in range(count)])


def test_a_device_has_so_many_elements_at_most_and_keeps_those_before() -> None:
    devices = registry()
    devices.set_part("a", part("lamp", MAX_DEVICE_ITEMS - 1))
    devices.set_part("b", part("lamp", 1))
    with pytest.raises(Invalid, match="those of c are left out"):
        devices.set_part("c", part("lamp", 1))
    (found,) = devices.flush().devices.values()
    assert found is not None and len(found.elements) == MAX_DEVICE_ITEMS
    # What grows beyond that is left out whole, and what shrinks makes room.
    with pytest.raises(Invalid):
        devices.set_part("b", part("lamp", 2))
    devices.set_part("a", part("lamp", 1))
    devices.set_part("b", part("lamp", 2))
    (found,) = devices.flush().devices.values()
    assert found is not None and len(found.elements) == 3


def test_all_devices_have_so_many_elements_at_most() -> None:
    devices = registry()
    whole = MAX_ITEMS // MAX_DEVICE_ITEMS
    for number in range(whole):
        devices.set_part(f"d{number}", part(f"lamp{number}", MAX_DEVICE_ITEMS))
    with pytest.raises(Invalid, match="all devices have more than"):
        devices.set_part("more", part("more", 1))
    devices.set_part("d0", None)
    devices.set_part("more", part("more", MAX_DEVICE_ITEMS))


def test_devices_are_built_some_at_a_time() -> None:
    devices = registry()
    for number in range(5):
        devices.set_part(f"d{number}", part(f"lamp{number}", 1))
    sizes = []
    while devices.has_changed:
        sizes.append(len(devices.flush(2).devices))
    assert (sizes, len(devices.devices)) == ([2, 2, 1], 5)
