"""Homie 4 and 5: attributes become elements."""

from __future__ import annotations

import json

import pytest

from relay_protocol.errors import Invalid
from robot_client.platforms.mqtt import homie
from robot_client.platforms.mqtt.homie import MAX_DEVICES, HomieDevices
from robot_client.platforms.mqtt.messages import BOOL, NUMBER, TEXT
from robot_client.platforms.mqtt.model import DevicePart

VERSION_4 = {
    "$homie": "4.0.0",
    "$name": "Thermostat",
    "$state": "ready",
    "$nodes": "heat",
    "heat/$properties": "target,mode,on",
    "heat/target/$datatype": "float",
    "heat/target/$format": "5:30",
    "heat/target/$settable": "true",
    "heat/mode/$datatype": "enum",
    "heat/mode/$format": "eco,comfort",
    "heat/mode/$settable": "true",
    "heat/on/$datatype": "boolean",
}
VERSION_5 = {
    "homie": "5.0",
    "name": "Thermostat",
    "nodes": {
        "heat": {
            "properties": {
                "target": {"datatype": "float", "format": "5:30:0.5", "settable": True},
                "mode": {"datatype": "enum", "format": "eco,comfort", "settable": True},
                "on": {"datatype": "boolean"},
            }
        }
    },
}


def changed_4(attributes: dict[str, str]) -> list[tuple[str, DevicePart | None]]:
    devices = HomieDevices("homie")
    for name, value in attributes.items():
        assert devices.handle(f"homie/th-1/{name}", value.encode())
    return devices.take_changed()


def changed_5(description: str) -> list[tuple[str, DevicePart | None]]:
    devices = HomieDevices("homie")
    devices.handle("homie/5/th-1/$state", b"ready")
    devices.handle("homie/5/th-1/$description", description.encode())
    return devices.take_changed()


@pytest.mark.parametrize("version", [4, 5])
def test_device_with_all_forms(version: int) -> None:
    base = "homie/th-1" if version == 4 else "homie/5/th-1"
    ((source, part),) = changed_4(VERSION_4) if version == 4 else changed_5(json.dumps(VERSION_5))
    assert source == base
    assert part is not None
    assert (part.name, part.problems) == ("Thermostat", [])
    target, mode, on = part.elements
    assert (target.name, target.type) == ("heat/target", NUMBER)
    assert (mode.name, mode.type) == ("heat/mode", TEXT)
    assert (on.name, on.type, on.command) == ("heat/on", BOOL, None)
    assert target.source is not None and target.command is not None
    assert target.source.topic == f"{base}/heat/target"
    assert target.source.value(b"21.5") == 21.5
    assert (target.command.topic, target.command.payload(22.0)) == (f"{base}/heat/target/set", "22")
    with pytest.raises(Invalid):
        target.command.payload(31.0)
    assert mode.command is not None
    with pytest.raises(Invalid):
        mode.command.payload("party")
    assert on.source is not None
    assert on.source.value(b"true") is True
    (availability,) = part.availability
    (state,) = availability.sources
    assert [state.value(each) for each in (b"ready", b"lost", b"sleeping", b"what")] == [
        True,
        False,
        True,
        None,
    ]


@pytest.mark.parametrize("missing", ["$homie", "$state", "$nodes"])
def test_device_that_is_not_complete_waits(missing: str) -> None:
    assert changed_4({name: value for name, value in VERSION_4.items() if name != missing}) == []


@pytest.mark.parametrize(("version", "attribute"), [(4, "$homie"), (4, "$state"), (5, "$description")])
def test_empty_attribute_removes_the_device(version: int, attribute: str) -> None:
    devices = HomieDevices("homie")
    if version == 4:
        for name, value in VERSION_4.items():
            devices.handle(f"homie/th-1/{name}", value.encode())
    else:
        devices.handle("homie/5/th-1/$state", b"ready")
        devices.handle("homie/5/th-1/$description", json.dumps(VERSION_5).encode())
    devices.take_changed()
    base = "homie/th-1" if version == 4 else "homie/5/th-1"
    devices.handle(f"{base}/{attribute}", b"")
    assert devices.take_changed() == [(base, None)]


@pytest.mark.parametrize(
    ("description", "problem"),
    [
        ("no json", "not JSON"),
        ("[]", "not a JSON object"),
        ('{"nodes":{"a":{"properties":{"b":{"datatype":"blob"}}}}}', "datatype 'blob'"),
        ('{"nodes":{"a":{"properties":{"b":{"datatype":"float","format":"x:y"}}}}}', "format"),
        ('{"nodes":{"a/#":{"properties":{"b":{}}}}}', "id"),
    ],
)
def test_description_that_is_not_understood(description: str, problem: str) -> None:
    ((_, part),) = changed_5(description)
    assert part is not None
    assert part.elements == []
    assert problem in part.problems[0]


@pytest.mark.parametrize("names", [["?"] * 2000, [f"p{each}" for each in range(500)]])
def test_of_many_properties_200_are_read(names: list[str]) -> None:
    """Each node has all of them, and each node and property is listed several times."""
    devices = HomieDevices("homie")
    attributes = {"$homie": "4.0.0", "$state": "ready", "$nodes": "a,b," * 1000}
    attributes |= {f"{node}/$properties": ",".join(names) for node in "ab"}
    for name, value in attributes.items():
        devices.handle(f"homie/x/{name}", value[:4096].encode())
    ((_, part),) = devices.take_changed()
    assert part is not None
    assert len(part.elements) == (200 if len(names) == 500 else 0)
    assert part.problems[0] == (
        "there are more than 200 properties; the others are left out"
        if len(names) == 500
        else "'a/?' has an id that is not valid"
    )
    assert len(part.problems) <= 20


def test_floods_are_bounded() -> None:
    devices = HomieDevices("homie")
    for number in range(MAX_DEVICES):
        devices.handle(f"homie/d{number}/$homie", b"4.0.0")
    with pytest.raises(Invalid, match="left out"):
        devices.handle("homie/one-more/$homie", b"4.0.0")
    with pytest.raises(Invalid, match="larger"):
        devices.handle("homie/d1/$name", b"x" * 5000)
    with pytest.raises(Invalid, match="not valid"):
        devices.handle("homie/D 1/$name", b"x")


def test_all_attributes_have_a_limit_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(homie, "MAX_BYTES", 20_000)
    devices = HomieDevices("homie")
    for number in range(4):
        devices.handle(f"homie/d{number}/$name", b"x" * 4000)
    with pytest.raises(Invalid, match="'d5' is too much"):
        for each in ("$homie", "$nodes", "$name"):
            devices.handle(f"homie/d5/{each}", b"x" * 4000)
    # What is replaced or gone makes room.
    devices.handle("homie/d1/$name", b"x")
    devices.handle("homie/d2/$homie", b"")
    for each in ("$nodes", "$name"):
        devices.handle(f"homie/d5/{each}", b"y" * 3900)
    sizes = []
    while devices.has_changed:
        sizes.append(len(devices.take_changed(2)))
    assert sizes == [0, 1, 0]


@pytest.mark.parametrize("topic", ["homie/th-1/heat/target", "other/th-1/$homie", "homie/$x"])
def test_other_topics_are_left_alone(topic: str) -> None:
    assert not HomieDevices("homie").handle(topic, b"x")
