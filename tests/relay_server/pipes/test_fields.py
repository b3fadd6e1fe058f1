"""Values that are carried from field to field: paths, checks before a pipe starts, conversion."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol.errors import Invalid
from relay_protocol.ros_types import TypeRegistry
from relay_server.pipes.fields import FieldConverter, check_mapping, convert, steps_of, type_of_field
from relay_server.pipes.schemas import FieldMapping
from tests.worlds.relay import TEXTS, TWIST

JOY = "sensor_msgs/msg/Joy"
JOY_TEXT = "float32[] axes\nint32[] buttons\nuint8[] raw\nfloat32[2] stick\nstring name\n"


@pytest.fixture(scope="module")
def types() -> TypeRegistry:
    made = TypeRegistry()
    made.add(JOY, JOY_TEXT)
    made.add(TWIST, TEXTS[TWIST])
    return made


@pytest.mark.parametrize(
    ("path", "steps"),
    [
        ("data", ["data"]),
        ("linear.x", ["linear", "x"]),
        ("axes[0]", ["axes", 0]),
        ("poses[12].position.x", ["poses", 12, "position", "x"]),
    ],
)
def test_paths_name_fields_and_indices(path: str, steps: list[Any]) -> None:
    assert steps_of(path) == steps


@pytest.mark.parametrize(
    "path", ["", ".x", "x.", "[0]", "x[]", "x[-1]", "x y", "x..y", "x[0]y", "x[0", "1x", "x\n"]
)
def test_other_texts_are_no_paths(path: str) -> None:
    with pytest.raises(Invalid, match="is no field"):
        steps_of(path)


@pytest.mark.parametrize(
    ("type_name", "path", "kind"),
    [
        (JOY, "axes[3]", "float32"),
        (JOY, "stick[1]", "float32"),
        (JOY, "name", "string"),
        (TWIST, "linear.x", "float64"),
    ],
)
def test_a_field_has_a_basic_type(types: TypeRegistry, type_name: str, path: str, kind: str) -> None:
    assert type_of_field(types.definitions(type_name), type_name, path) == kind


@pytest.mark.parametrize(
    ("type_name", "path", "words"),
    [
        (JOY, "axes", "is no single value"),
        (JOY, "axes.x", "needs an index"),
        (JOY, "name[0]", "one value only"),
        (JOY, "stick[2]", "beyond the 2 values"),
        (JOY, "raw[0]", "one of many bytes"),
        (TWIST, "linear", "is no single value"),
        (TWIST, "linear.w", "has x, y, z"),
        (TWIST, "linear.x.y", "no fields"),
    ],
)
def test_a_field_that_can_not_be_carried_is_named(
    types: TypeRegistry, type_name: str, path: str, words: str
) -> None:
    with pytest.raises(Invalid, match=words):
        type_of_field(types.definitions(type_name), type_name, path)


@pytest.mark.parametrize(
    ("value", "kind", "result"),
    [
        (True, "float64", 1.0),
        (False, "int8", 0),
        (True, "string", "true"),
        (0.0, "bool", False),
        (-2, "bool", True),
        (1.6, "int32", 2),
        (7.0, "string", "7"),
        (0.25, "string", "0.25"),
        ("on", "string", "on"),
        (3, "float32", 3.0),
    ],
)
def test_values_become_those_of_another_type(value: Any, kind: str, result: Any) -> None:
    found = convert(value, kind, "'x'")
    assert found == result
    assert type(found) is type(result)


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        (300, "uint8"),
        (-1, "uint16"),
        (1 << 63, "int64"),
        (1e39, "float32"),
        ("1", "int32"),
        (None, "bool"),
        (1e400, "int32"),
        ([1], "int32"),
        ({}, "float64"),
        ([1], "bool"),
        (10**400, "float64"),
        (None, "string"),
        ([1], "string"),
        ({"a": 1}, "string"),
    ],
)
def test_values_that_do_not_fit_are_refused(value: Any, kind: str) -> None:
    with pytest.raises(Invalid):
        convert(value, kind, "'x'")


@pytest.mark.parametrize(
    ("mapping", "source", "target", "words"),
    [
        (FieldMapping("a", "b"), "string", "float64", "give a table"),
        (FieldMapping("a", "b", scale=2.0), "string", "string", "are for numbers"),
        (FieldMapping("a", "b", offset=1.0), "float64", "string", "are for numbers"),
        (FieldMapping("a", "b", table={"on": 300}), "string", "uint8", "does not fit"),
        (FieldMapping("a", "b", table={"on": "x"}), "string", "bool", "takes no string"),
    ],
)
def test_unconvertible_message_is_refused_before_the_start(
    mapping: FieldMapping, source: str, target: str, words: str
) -> None:
    with pytest.raises(Invalid, match=words):
        check_mapping(mapping, source, target)


def test_several_fields_make_one_message() -> None:
    converter = FieldConverter(
        [
            (FieldMapping("axes[1]", "linear.x", scale=0.5), "float64"),
            (FieldMapping("axes[0]", "angular.z", scale=2.0, offset=-1.0), "float64"),
            (FieldMapping("mode", "gear", table={"slow": 1, "fast": 2}), "uint8"),
        ]
    )
    assert converter.convert({"axes": [1.0, 0.5], "mode": "fast"}) == {
        "linear": {"x": 0.25},
        "angular": {"z": 1.0},
        "gear": 2,
    }


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ({"axes": []}, r"has no 'axes\[0\]'"),
        ({}, r"has no 'axes\[0\]'"),
        ({"axes": [None]}, "takes no empty value"),
    ],
)
def test_a_message_without_the_value_is_not_carried(message: dict[str, Any], words: str) -> None:
    converter = FieldConverter([(FieldMapping("axes[0]", "data"), "float32")])
    with pytest.raises(Invalid, match=words):
        converter.convert(message)


def test_a_value_that_the_table_lacks_is_not_carried() -> None:
    converter = FieldConverter([(FieldMapping("state", "data", table={"true": "on"}), "string")])
    assert converter.convert({"state": True}) == {"data": "on"}
    with pytest.raises(Invalid, match="'false' of 'state' is not in the table"):
        converter.convert({"state": False})


@given(st.one_of(st.booleans(), st.integers(-(2**70), 2**70), st.floats(), st.text()), st.sampled_from(sorted(
    {"bool", "int8", "uint8", "int64", "uint64", "float32", "float64", "string"}
)))  # fmt: skip
def test_a_value_is_converted_so_that_the_type_holds_it_or_refused(value: Any, kind: str) -> None:
    types = TypeRegistry()
    types.add("x/msg/X", f"{kind} data\n")
    try:
        found = convert(value, kind, "'data'")
    except Invalid:
        return
    if isinstance(found, float) and found not in (found, float("inf"), float("-inf")):
        return
    if isinstance(found, str) and "\0" in found:
        return
    types.from_json("x/msg/X", {"data": found}, 0)


@given(st.floats(-1e6, 1e6), st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_scale_and_offset_are_a_line(value: float, scale: float, offset: float) -> None:
    converter = FieldConverter([(FieldMapping("a", "b", scale=scale, offset=offset), "float64")])
    assert converter.convert({"a": value})["b"] == value * scale + offset
