"""Fields of definitions, compared with rosidl's own parser."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosidl_adapter import parser as rosidl

from relay_protocol.ros.definition import PRIMITIVES, Definition, FieldType, Shape, parse
from robot_client.platforms.definitions import full_text

PACKAGES = ("a", "b", "std_msgs", "a_2")
MESSAGES = ("Header", "Point", "String", "Time", "A1", "Duration", "Request")
OTHERS = {f"{package}/msg/{name}": "int8 x\n" for package in PACKAGES for name in MESSAGES}
"""Each package has a message of each name."""

NUMBERS = {
    "bool": ["true", "False", "1", "0"],
    "float32": ["1", "-1.5e3", ".5", "1e-3"],
    "float64": ["1", "-1.5e3", ".5", "nan", "-inf"],
}
WORDS = ['"it is"', "'it is'", "plain", '"a, b"', "two words", '""', "'say \"x\"'"]
LITERALS = {
    name: NUMBERS.get(name, WORDS if "string" in name else ["0", "7", "0x0F", "0b11", "1_0", "0o7"])
    for name in PRIMITIVES
}


@st.composite
def lines(draw: Any) -> str:
    """One field or constant in any of the forms that both parsers must read alike."""
    message = draw(st.booleans())
    base = draw(st.sampled_from(MESSAGES if message else list(PRIMITIVES)))
    literals = LITERALS.get(base, [])
    if message and draw(st.booleans()):
        base = f"{draw(st.sampled_from(PACKAGES))}/{base}"
    space = draw(st.sampled_from([" ", "   ", "\t", " \t "]))
    comment = draw(st.sampled_from(["", " # why", "# Header other", "#"]))
    if literals and draw(st.booleans()):
        equals = draw(st.sampled_from(["=", " = ", " =", "= "]))
        return f"{base}{space}X{draw(st.integers(0, 9))}{equals}{draw(st.sampled_from(literals))}{comment}"
    if base in ("string", "wstring"):
        base += draw(st.sampled_from(["", "<=40"]))
    brackets = draw(st.sampled_from(["", "[]", "[2]", "[<=3]", "[02]"]))
    default = ""
    if literals and draw(st.booleans()):
        default = draw(st.sampled_from(literals))
        if brackets:
            default = f"[{default}, {draw(st.sampled_from(literals))}]"
        default = space + default
    return f"{base}{brackets}{space}field_{draw(st.integers(0, 99))}{default}{comment}"


def name_of(line: str) -> str:
    """The name a line gives its field or constant."""
    return line.split()[1].partition("=")[0].partition("#")[0]


TEXTS = (
    st.lists(lines() | st.sampled_from(["", "# Header no_field", "#"]), max_size=8)
    .map(lambda found: list({name_of(line) if line[:1] not in ("", "#") else line: line for line in found}.values()))
    .flatmap(lambda found: st.sampled_from(["\n", "\r\n"]).map(lambda end: end.join(found)))
)  # fmt: skip


def seen_by_us(found: Definition) -> list[Any]:
    """The relay's result, as plain values."""
    fields = [(each.name, *_type(each.type), _plain(each.default)) for each in found.fields]
    return [fields, [(each.name, each.type.base, _plain(each.value)) for each in found.constants]]


def _type(kind: FieldType) -> tuple[Any, ...]:
    return kind.base, kind.bound or None, kind.shape is not Shape.SCALAR, kind.length or None


def seen_by_rosidl(found: Any) -> list[Any]:
    """rosidl's result."""
    fields = []
    for each in found.fields:
        kind = each.type
        base = kind.type if kind.pkg_name is None else f"{kind.pkg_name}/msg/{kind.type}"
        default = _plain(each.default_value)
        fields.append((each.name, base, kind.string_upper_bound, kind.is_array, kind.array_size, default))
    return [fields, [(each.name, each.type, _plain(each.value)) for each in found.constants]]


def _plain(value: Any) -> Any:
    """A value that equals itself, NaN too."""
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return repr(value) if isinstance(value, float) and not math.isfinite(value) else value


@given(TEXTS, st.sampled_from(["a", "b", "std_msgs"]))
def test_every_form_is_read_as_rosidl_reads_it(text: str, package: str) -> None:
    """Names with and without a package, bounds, arrays, defaults and constants, through the robot's own text."""
    name = f"{package}/msg/Whole"
    whole = full_text(name, {**OTHERS, name: text}.get)
    expected = seen_by_rosidl(rosidl.parse_message_string(package, "Whole", text))
    assert seen_by_us(parse(name, whole)[name]) == expected


@pytest.mark.parametrize("kind", ["msg", "srv", "action"])
def test_a_header_is_of_its_own_package_first(kind: str) -> None:
    """If the package has none, it is that of std_msgs, at any depth and in every part."""
    divider = {"msg": "", "srv": "---\n", "action": "---\n---\n"}[kind]
    texts = {
        f"a/{kind}/Top": f"Header header\nb/Inner inner\nc/Inner other\n{divider}",
        "a/msg/Header": "uint32 number\n",
        "b/msg/Inner": "Header header\n",
        "c/msg/Inner": "Header[] headers\n",
        "c/msg/Header": "int8 x\n",
        "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
        "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    }
    found = parse(f"a/{kind}/Top", full_text(f"a/{kind}/Top", texts.get))
    top = next(iter(found.values()))
    assert top.fields[0].type.base == "a/msg/Header"
    assert found["b/msg/Inner"].fields[0].type.base == "std_msgs/msg/Header"
    assert found["c/msg/Inner"].fields[0].type.base == "c/msg/Header"
