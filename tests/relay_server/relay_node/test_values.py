"""Parameter values from JSON and back."""

from __future__ import annotations

import base64
from typing import Any

import pytest

from relay_protocol.errors import Invalid
from relay_server.relay_node.params import MAX_VALUES, from_parameter, to_parameter

VALUES: list[tuple[Any, int | None, int, str]] = [
    (True, None, 1, "bool_value"),
    (3, None, 2, "integer_value"),
    (3, 3, 3, "double_value"),
    (0.5, None, 3, "double_value"),
    ("text", None, 4, "string_value"),
    ([1, 255], 5, 5, "byte_array_value"),
    ([True, False], None, 6, "bool_array_value"),
    ([1, 2], None, 7, "integer_array_value"),
    ([1, 300], 5, 7, "integer_array_value"),
    ([1, 2], 8, 8, "double_array_value"),
    ([1, 2.5], None, 8, "double_array_value"),
    (["a"], None, 9, "string_array_value"),
    ([], 9, 9, "string_array_value"),
]


@pytest.mark.parametrize(("value", "has", "kind", "field"), VALUES)
def test_json_becomes_the_type_of_its_value_or_the_one_the_parameter_has(
    value: Any, has: int | None, kind: int, field: str
) -> None:
    """JSON has one kind of number, so the parameter's own type decides if needed."""
    made = to_parameter(value, has)
    assert made == {"type": kind, field: value}
    assert from_parameter(made) == (value,)


@pytest.mark.parametrize("value", [None, {}, {"a": 1}, [None], [[1]], [1, "a"], [True, 1], []])
def test_unstorable_parameter_value_is_refused_with_a_reason(value: Any) -> None:
    """These are objects, null, nested or mixed lists, and empty lists of unknown type."""
    with pytest.raises(Invalid, match=r"a parameter|list"):
        to_parameter(value)


@pytest.mark.parametrize(
    ("value", "has", "kind"), [(None, 3, 3), ([None], 8, 8), ([None, 1], 8, 8), ([0.5, None], None, 8)]
)
def test_null_is_nan_where_the_parameter_is_of_floats(value: Any, has: int | None, kind: int) -> None:
    """As NaN is read; for any other type it is nothing."""
    made = to_parameter(value, has)
    assert made["type"] == kind
    assert "nan" in repr(made)


def test_bytes_are_a_list_of_numbers_and_nan_is_null() -> None:
    """In messages they are base64."""
    assert from_parameter({"type": 5, "byte_array_value": "AP8="}) == ([0, 255],)
    assert from_parameter({"type": 3, "double_value": None}) == (None,)
    assert from_parameter({"type": 0}) is None


@pytest.mark.parametrize("reported", [None, 7, {}, {"type": 77}, {"type": "1"}, {"type": 1}, {"type": [1]}])
def test_invented_names_of_a_robot_are_distinguished(reported: Any) -> None:
    """Robots are not trusted."""
    with pytest.raises(Invalid, match="no value"):
        from_parameter(reported)


def test_bytes_that_are_no_base64_are_distinguished() -> None:
    """Never by an internal error."""
    with pytest.raises(Invalid):
        from_parameter({"type": 5, "byte_array_value": "???"})


def test_long_lists_are_refused_before_they_are_looked_at() -> None:
    """Each value is looked at several times."""
    for value in ([0] * (MAX_VALUES + 1), ["x"] * (MAX_VALUES + 1)):
        with pytest.raises(Invalid, match="65536 values, not 65537"):
            to_parameter(value)
    longest = {"type": 5, "byte_array_value": base64.b64encode(bytes(MAX_VALUES)).decode()}
    assert from_parameter(longest) == ([0] * MAX_VALUES,)
    for reported in (
        {"type": 5, "byte_array_value": base64.b64encode(bytes(MAX_VALUES + 2)).decode()},
        {"type": 7, "integer_array_value": [0] * (MAX_VALUES + 1)},
    ):
        with pytest.raises(Invalid, match="more than 65536 values"):
            from_parameter(reported)
