"""Values of parameters, from JSON and back."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol.errors import Invalid
from relay_server.relay_node.params import from_parameter, to_parameter

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
    """JSON knows one kind of number; the parameter's own type decides where that is not enough."""
    made = to_parameter(value, has)
    assert made == {"type": kind, field: value}
    assert from_parameter(made) == (value,)


@pytest.mark.parametrize("value", [None, {}, {"a": 1}, [None], [[1]], [1, "a"], [True, 1], []])
def test_what_no_parameter_can_hold_is_refused_in_words(value: Any) -> None:
    """Objects, null, lists of lists, of several types, and of nothing when nobody knows of what."""
    with pytest.raises(Invalid, match=r"a parameter|list"):
        to_parameter(value)


@pytest.mark.parametrize(
    ("value", "has", "kind"), [(None, 3, 3), ([None], 8, 8), ([None, 1], 8, 8), ([0.5, None], None, 8)]
)
def test_null_is_nan_where_the_parameter_is_of_floats(value: Any, has: int | None, kind: int) -> None:
    """As NaN is read; of anything else it is nothing."""
    made = to_parameter(value, has)
    assert made["type"] == kind
    assert "nan" in repr(made)


def test_bytes_are_a_list_of_numbers_and_nan_is_null() -> None:
    """In messages they are base64."""
    assert from_parameter({"type": 5, "byte_array_value": "AP8="}) == ([0, 255],)
    assert from_parameter({"type": 3, "double_value": None}) == (None,)
    assert from_parameter({"type": 0}) is None


@pytest.mark.parametrize("told", [None, 7, {}, {"type": 77}, {"type": "1"}, {"type": 1}, {"type": [1]}])
def test_what_a_robot_makes_up_is_told_apart(told: Any) -> None:
    """Robots are not trusted."""
    with pytest.raises(Invalid, match="no value"):
        from_parameter(told)


def test_bytes_that_are_no_base64_are_told_apart() -> None:
    """Never an internal error."""
    with pytest.raises(Invalid):
        from_parameter({"type": 5, "byte_array_value": "???"})
