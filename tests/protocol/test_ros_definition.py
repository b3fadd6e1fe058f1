"""Definitions as robots send them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol.errors import Invalid
from relay_protocol.limits import TYPE_DEFINITION
from relay_protocol.ros.definition import Constant, FieldType, Shape, normalise, parse
from tests.worlds.ros_texts import LINE


def contained(name: str, text: str) -> str:
    """A nested type in a text."""
    return f"\n{LINE}\nMSG: {name}\n{text}"


def test_every_form_of_a_field() -> None:
    """Basic types, bounds, arrays, references, defaults, constants and comments."""
    text = (
        '# about\nint32 X=-7 # why\nstring WORD= "a # b"\nbool ON=True\nuint8 MASK=0x0F\nfloat32 PI=3.5e0\n'
        "float64 x 1.5 # half\nstring<=5[<=3] words\nbyte[4] raw\nPoint[] path\n"
        "b/Point other\nc/msg/Point third\n"
        "wstring w 'it''s'\nint8[] l [1, -2]\nstring[2] s [\"a,b\", c]\r\n\tchar  c\n"
    )
    points = "".join(contained(f"{package}/Point", "float64 x") for package in "abc")
    definition = parse("a/msg/B", text + points)["a/msg/B"]
    fields = {field.name: field for field in definition.fields}
    assert fields["x"].default == 1.5
    assert fields["words"].type == FieldType("string", 5, Shape.SEQUENCE, 3)
    assert fields["raw"].type == FieldType("byte", 0, Shape.ARRAY, 4)
    assert fields["path"].type == FieldType("a/msg/Point", 0, Shape.SEQUENCE)
    assert [fields[name].type.base for name in ("other", "third")] == ["b/msg/Point", "c/msg/Point"]
    assert fields["l"].default == [1, -2]
    assert fields["s"].default == ["a,b", "c"]
    assert [(each.name, each.value) for each in definition.constants] == [
        ("X", -7), ("WORD", "a # b"), ("ON", True), ("MASK", 15), ("PI", 3.5)
    ]  # fmt: skip
    assert definition.constants[0] == Constant("X", FieldType("int32"), -7)


def test_a_service_has_two_parts_and_an_action_three() -> None:
    """Each part is a message."""
    assert [*parse("a/srv/B", "int8 x\n---\nint8 y")][:2] == ["a/srv/B_Request", "a/srv/B_Response"]
    action = parse("a/action/B", "int8 x\n---\n---\nint8 y")
    assert [*action][:3] == ["a/action/B_Goal", "a/action/B_Result", "a/action/B_Feedback"]
    assert action["a/action/B_Result"].fields == ()


def test_time_is_known_without_being_sent() -> None:
    """builtin_interfaces need not be in the text."""
    assert "builtin_interfaces/msg/Time" in parse("a/msg/B", "builtin_interfaces/Time t")


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("int33 x", "contains a/msg/int33, whose definition is not in the text"),
        ("c/Point p", "contains c/msg/Point, whose definition is not in the text"),
        ("B b", "a/msg/B contains itself"),
        ("C c" + contained("a/C", "D[] d") + contained("a/D", "C c"), "contains itself"),
        ("int8 x\nint8 x", "has two fields 'x'"),
        ("int8", "'int8' is not a field"),
        ("int8 9x", "is not a field"),
        ("module a { struct B {}; };", "is a message and can't have a value"),
        ("int8[0] x", "array of length 0"),
        ("int8<=4 x", "can't have a bound"),
        ("int8 x 128", "'128' is not a value for 'x', which is int8"),
        ("bool x maybe", "'maybe' is not a value for 'x', which is bool"),
        ("float32 X=1e39", "is not a value for 'X'"),
        ("string<=2 x 'abc'", "is not a value for 'x'"),
        ("int8[2] x [1]", "'x' can't hold 1 values"),
        ("int8[] x [1", "is not a value for 'x'"),
        ("int8 X=" + "1" * 5000, "is not a value for 'X'"),
        ("int8 x\n---\nint8 y", "2 parts divided by '---', expected 1"),
        (LINE + "\nnothing", "after a line of '=' comes 'MSG: package/msg/Name', not 'nothing'"),
        (LINE, "not ''"),
        (LINE + "\nMSG: ../../etc", "is not a type name"),
        ("string[1000000000] x", "'string[1000000000] x' is not a field"),
        ("string[100000000] x", "too large even when its sequences are empty"),
        ("float64[100000000] x", "too large even when its sequences are empty"),
        ("\n".join(f"int8 x{number}" for number in range(5000)), "more than 4000 fields"),
        ("x" * (TYPE_DEFINITION + 1), "more than 262144 characters"),
    ],
)  # fmt: skip
def test_bad_definitions_are_reported(text: str, error: str) -> None:
    """The error has the type's name and the reason."""
    with pytest.raises(Invalid) as caught:
        parse("a/msg/B", text)
    assert error in str(caught.value)
    assert "a/msg/B" in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("parts", ["int8 x", "int8 x\n---\nint8 y\n---"])
def test_a_service_of_other_parts_is_refused(parts: str) -> None:
    """The error has the number of parts."""
    with pytest.raises(Invalid, match="expected 2"):
        parse("a/srv/B", parts)


@pytest.mark.parametrize("forwards", [True, False])
def test_deep_chains_are_refused(forwards: bool) -> None:
    """The nesting of messages is limited, for any order of arrival."""
    chain = [contained(f"a/A{number}", f"A{number + 1} next") for number in range(1500)]
    chain.append(contained("a/A1500", "int8 x"))
    with pytest.raises(Invalid, match="nested deeper than 32"):
        parse("a/msg/B", "A0 a" + "".join(chain if forwards else reversed(chain)))


def test_doubling_is_refused() -> None:
    """Thirty types, each with the next twice, would be a message of a billion values."""
    chain = [contained(f"a/A{number}", f"A{number + 1} x\nA{number + 1} y") for number in range(30)]
    with pytest.raises(Invalid, match="too large"):
        parse("a/msg/B", "A0 a" + "".join(chain) + contained("a/A30", "int8 x"))


@pytest.mark.parametrize(
    "text",
    [
        "string[] x [" + '\\"' * 120_000 + "]",
        "string[] x [" + " " * 200_000 + '"]',
        "string x " + "\\'" * 120_000,
        "string x '" + "\\" * 200_000,
        " " * 250_000 + "x",
        "a" * 250_000,
        "a/" * 120_000 + " x",
        ("=" * 79 + "\n") * 3000,
        (LINE + " " * 20 + "\n") * 2500,
    ],
)
def test_texts_that_would_stall_careless_patterns_are_read_at_once(text: str) -> None:
    """Parsing takes linear time: otherwise this test would not end."""
    try:
        parse("a/msg/B", text)
    except Invalid:
        return
    assert text.startswith("string x")


PIECES = st.sampled_from(
    [
        "int8", "string", "wstring", "float64", "bool", "<=", "3", "[", "]", "[<=2]", " ", "\n", "\t", "x",
        "X", "=",
        "-1", "1.5", '"', "'", "\\", ",", "#", "---", LINE, "\nMSG: ", "a/C", "C", "/", "\r", "\0", "ß", "é",
    ]
)  # fmt: skip


@given(st.lists(PIECES, max_size=40).map("".join) | st.text(max_size=60))
def test_junk_raises_nothing_but_invalid(text: str) -> None:
    """Any text is a definition or this error."""
    for name in ("a/msg/B", "a/srv/B", "a/action/B"):
        try:
            assert parse(name, text)
        except Invalid as error:
            assert name in str(error)


@pytest.mark.parametrize(
    ("given_name", "full"),
    [("a/B", "a/msg/B"), ("a/msg/B", "a/msg/B"), ("a/srv/B", "a/srv/B"), ("a/action/B", "a/action/B")],
)
def test_short_names_are_of_messages(given_name: str, full: str) -> None:
    """The short form of ROS 1 is accepted."""
    assert normalise(given_name) == full


@pytest.mark.parametrize(
    "name", ["", "B", "a/b/C", "a//B", "/a/B", "a/B ", "a/B\n", "a/1", "ä/B", "a/" + "B" * 300]
)
def test_invalid_type_name_is_refused(name: str) -> None:
    """Names contain only letters, digits and underscores."""
    with pytest.raises(Invalid, match="is not a type name"):
        normalise(name)
