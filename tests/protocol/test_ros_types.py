"""The registry of a robot's types: names, limits and lifetime."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol.errors import Invalid, NotFound
from relay_protocol.limits import TYPE_DEFINITION
from relay_protocol.ros_types import TypeRegistry
from tests.worlds.ros_texts import LINE, registry

VECTOR = "float64 x\nfloat64 y\nfloat64 z"
TWIST = f"Vector3 linear\nVector3 angular\n{LINE}\nMSG: geometry_msgs/Vector3\n{VECTOR}"


def test_readers_and_writers_are_kept_until_the_type_changes() -> None:
    """They are made once and shared by equal robots; another definition makes new ones, and the old ones stay
    unchanged.
    """
    types, other = registry(B="int8 a"), registry(B="int8 a")
    read, write = types.reader("a/msg/B", "json"), types.writer("a/B", checked=True)
    assert types.reader("a/B", "json") is read is other.reader("a/msg/B", "json")
    assert types.writer("a/msg/B", checked=True) is write
    types.add("a/msg/B", "int16 b")
    assert types.reader("a/msg/B", "json")(types.writer("a/msg/B")(b'{"b":300}', 0)) == b'{"b":300}'
    assert read(write(b'{"a":3}', 0)) == b'{"a":3}'


@pytest.mark.parametrize(
    "ask", [lambda types: types.reader("a/msg/X", "cbor"), lambda types: types.writer("a/msg/X")]
)
def test_there_is_no_reader_or_writer_of_an_unknown_type(ask: Any) -> None:
    """The request raises NotFound, before the first message."""
    with pytest.raises(NotFound, match="the definition of a/msg/X is not known"):
        ask(registry(B="int8 a"))


def test_names_may_be_short() -> None:
    """``pkg/Name`` means ``pkg/msg/Name`` everywhere."""
    types = TypeRegistry()
    types.add("geometry_msgs/Twist", TWIST)
    assert types.knows("geometry_msgs/msg/Twist")
    assert types.knows("geometry_msgs/Twist")
    assert types.zero("geometry_msgs/Twist") == types.zero("geometry_msgs/msg/Twist")
    assert types.definition("geometry_msgs/Twist") == TWIST


def test_contained_types_are_known_too() -> None:
    """A text defines all types in it."""
    types = TypeRegistry()
    types.add("geometry_msgs/msg/Twist", TWIST)
    assert types.knows("geometry_msgs/msg/Vector3")
    assert (
        types.to_json("geometry_msgs/msg/Vector3", types.zero("geometry_msgs/Vector3"))
        == b'{"x":0.0,"y":0.0,"z":0.0}'
    )


def test_unknown_types_are_reported() -> None:
    """A request raises NotFound; the check whether it is known is false, for invalid names too."""
    types = TypeRegistry()
    assert not types.knows("a/msg/B")
    assert not types.knows("nonsense")
    for ask in (types.zero, types.typedefs, types.definition):
        with pytest.raises(NotFound, match="the definition of a/msg/B is not known"):
            ask("a/msg/B")


def test_a_new_text_replaces_the_former_and_the_same_changes_nothing() -> None:
    """An updated robot sends another text; registries are independent."""
    types, other = registry(B="int8 a"), registry(B="int8 a")
    types.add("a/msg/B", "int8 a")
    types.add("a/msg/B", "int16 b")
    assert types.to_json("a/msg/B", types.zero("a/msg/B")) == b'{"b":0}'
    assert other.to_json("a/msg/B", other.zero("a/msg/B")) == b'{"a":0}'


def test_a_bad_text_leaves_what_was_known() -> None:
    """An error neither adds nor removes types."""
    types = registry(B="int8 a")
    with pytest.raises(Invalid):
        types.add("a/msg/B", "nonsense")
    assert types.knows("a/msg/B")


def test_the_number_of_types_is_bounded() -> None:
    """Types of a robot cannot fill the relay's memory."""
    types = TypeRegistry()
    for number in range(4096):
        types.add(f"a/msg/T{number}", "int8 a")
    with pytest.raises(Invalid, match="has sent 4096 types already"):
        types.add("a/msg/More", "int8 a")
    types.add("a/msg/T0", "int8 b")


def test_the_texts_of_all_types_together_are_bounded() -> None:
    """Comments cannot fill the relay's memory; a text that replaces another takes its place."""
    types = TypeRegistry()
    comment = "#" * (TYPE_DEFINITION - 10)
    for number in range(64):
        types.add(f"a/msg/T{number}", f"int8 a{comment}")
    with pytest.raises(Invalid, match="has sent definitions of 16 MiB already"):
        types.add("a/msg/More", f"int8 a{comment}")
    types.add("a/msg/T0", f"int8 b{comment}")
    types.add("a/msg/T0", "int8 b")
    types.add("a/msg/More", f"int8 a{comment}")


def test_typedefs_list_every_type_once() -> None:
    """In rosapi's form: the requested type first, then all nested ones."""
    text = "Vector3[2] a\nVector3[] b\nint8 A=1\nuint8[<=5] c\nstring d 'x'\n"
    text += f"{LINE}\nMSG: geometry_msgs/Vector3\n{VECTOR}"
    types = TypeRegistry()
    types.add("geometry_msgs/msg/Thing", text)
    first, second = types.typedefs("geometry_msgs/Thing")
    assert first == {
        "type": "geometry_msgs/Thing",
        "fieldnames": ["a", "b", "c", "d"],
        "fieldtypes": ["geometry_msgs/Vector3", "geometry_msgs/Vector3", "uint8", "string"],
        "fieldarraylen": [2, 0, 0, -1],
        "examples": ["[]", "[]", "[]", "x"],
        "constnames": ["A"],
        "constvalues": ["1"],
    }
    assert second["type"] == "geometry_msgs/Vector3"


def test_a_whole_text_holds_what_the_type_contains_and_nothing_else() -> None:
    """Also for a type from another's text, and with built-in types that a robot may leave out."""
    types = TypeRegistry()
    text = f"# a comment\nTwist twist\nbuiltin_interfaces/Time at\n{LINE}\nMSG: geometry_msgs/msg/Twist\n{TWIST}\n"
    types.add("geometry_msgs/msg/Timed", text)
    assert types.full_text("geometry_msgs/Twist") == TWIST + "\n"
    whole = types.full_text("geometry_msgs/msg/Timed")
    assert whole.startswith("# a comment\nTwist twist\n")
    assert whole.count(LINE) == 3
    assert f"{LINE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n" in whole
    types.add(
        "geometry_msgs/srv/Move", f"Vector3 by\n---\nbool done\n{LINE}\nMSG: geometry_msgs/Vector3\n{VECTOR}"
    )
    assert types.full_text("geometry_msgs/srv/Move_Response") == "bool done\n"
    with pytest.raises(NotFound):
        types.full_text("geometry_msgs/msg/Wrench")
