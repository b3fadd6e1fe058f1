"""Bindings of elements: addresses, the resource that a command is sent to, and fields."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol.errors import Invalid, NotFound
from relay_server.roles.bindings import (
    Binding,
    Command,
    ElementNotCommandable,
    binding_of,
    choose,
    field_path,
    message_with,
    value_at,
)


def bound(text: str) -> Binding:
    found = binding_of(text)
    assert found is not None
    return found


JOY = bound("robots/pad/topics/joy#/axes/0")
SPEED = bound("robots/rover/topics/cmd_vel#/linear/x")
LAMP = bound("robots/home/topics/lamp/power")
DRIVER = bound("robots/rover/modules/driver")
BEEP = bound("robots/rover/services/beep")
PIPE = bound("pipes/drive")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("robots/pad/topics/joy#/axes/0", ("pad", "topics", "joy", "/axes/0")),
        ("/api/v1/robots/a%20b/params/%2Fnode:x", ("a b", "params", "/node:x", "")),
        ("pipes/drive", ("", "pipes", "drive", "")),
        ("robots/pad", None),
        ("robots/pad/cameras/front", None),
        ("pipes/Drive", None),
        ("pipes/drive#/state", None),
    ],
)
def test_addresses_of_resources(text: str, expected: tuple[str, ...] | None) -> None:
    found = binding_of(text)
    assert (None if found is None else found[1:]) == expected


@pytest.mark.parametrize(
    ("command", "own", "mapped", "expected"),
    [
        ("get", [JOY], [SPEED], JOY),
        ("get", [], [SPEED], SPEED),
        ("start", [JOY, DRIVER], [], "several resources that take 'start': robots/pad"),
        ("call", [JOY], [BEEP], BEEP),
        ("get", [SPEED, SPEED], [], SPEED),
        ("start", [], [PIPE], PIPE),
        ("call", [JOY], [], "which takes no 'call'; 'call' needs one of services"),
        ("get", [], [], "bound to no resource"),
    ],
)
def test_a_command_goes_to_the_own_resource_before_a_mapped_one(
    command: Command, own: list[Binding], mapped: list[Binding], expected: Binding | str
) -> None:
    if isinstance(expected, Binding):
        assert choose("X", command, own, mapped) == expected
        return
    with pytest.raises((Invalid, ElementNotCommandable), match=expected):
        choose("X", command, own, mapped)


@pytest.mark.parametrize(
    ("binding", "value", "expected"),
    [
        (SPEED, 0.5, {"linear": {"x": 0.5}}),
        (LAMP, True, {"data": True}),
        (LAMP, {"data": False}, {"data": False}),
        (JOY, 1.0, None),
    ],
)
def test_a_value_becomes_a_message(binding: Binding, value: Any, expected: Any) -> None:
    if expected is None:
        with pytest.raises(Invalid, match="a value in a list can't be set alone"):
            message_with(value, binding)
        return
    assert message_with(value, binding) == expected


def test_a_field_of_a_message() -> None:
    assert value_at({"axes": [0.25, 1.0]}, JOY) == 0.25
    assert value_at({"data": 1}, LAMP) == {"data": 1}
    for message in ({"axes": []}, {"axes": 1}, [], None):
        with pytest.raises(NotFound, match="no field /axes/0"):
            value_at(message, JOY)
    for step in ("0x", "01", "1_0", "-1", "9999999999"):
        with pytest.raises(NotFound, match=f"no field /axes/{step}"):
            value_at({"axes": [1, 2]}, JOY._replace(pointer=f"/axes/{step}"))
    assert [field_path(each) for each in (JOY, SPEED, LAMP)] == ["axes[0]", "linear.x", ""]
