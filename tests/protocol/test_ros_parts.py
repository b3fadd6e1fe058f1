"""Services and actions: each of their parts is a message, and arguments have several forms."""

from __future__ import annotations

import json
import struct

import cbor2
import pytest

from relay_protocol.errors import Invalid, NotFound
from relay_protocol.ros_types import TypeRegistry
from tests.worlds.ros_texts import LINE

TRIGGER = "---\nbool success\nstring message"


def test_service_arguments_come_by_name_by_order_or_not_at_all() -> None:
    """A request is an object, a list, null or missing."""
    types = TypeRegistry()
    types.add("a/srv/Add", "int32 a\nint32 b\n---\nint32 sum")
    wanted = b"\0\1\0\0" + struct.pack("<ii", 3, 4)
    for name in ("a/srv/Add", "a/Add", "a/srv/Add_Request"):
        assert types.args_from_json(name, b"[3,4]", 0) == wanted
        assert types.args_from_json(name, b'{"b":4,"a":3}', 0) == wanted
        assert types.args_from_json(name, [3, 4], 0) == wanted
        assert (
            types.args_from_json(name, None, 0)
            == types.args_from_json(name, b"null", 0)
            == bytes([0, 1]) + bytes(10)
        )
    with pytest.raises(Invalid, match="a/srv/Add_Request has 2 arguments, not 3"):
        types.args_from_json("a/srv/Add", b"[1,2,3]", 0)
    for body in (b"0", b'""', b"false"):
        with pytest.raises(Invalid, match="a/srv/Add_Request must be an object"):
            types.args_from_json("a/srv/Add", body, 0)
    with pytest.raises(Invalid, match="b must be an integer"):
        types.args_from_json("a/srv/Add", b'[1,"2"]', 0)


ACTION = "int32 order\nInner[] inners\n---\nint32[] sequence\nstring OK=yes\n---\nfloat32 done 0.5\n"
ACTION += f"{LINE}\nMSG: a/Inner\nfloat64 x\n"


def test_the_parts_of_an_action_are_messages() -> None:
    """Goal, result and feedback have type names of their own and are converted in both directions."""
    types = TypeRegistry()
    types.add("a/action/Count", ACTION)
    goal = b'{"order":5,"inners":[{"x":1.5}]}'
    for name, text in (("Goal", goal), ("Result", b'{"sequence":[0,1]}'), ("Feedback", b'{"done":0.25}')):
        part = f"a/action/Count_{name}"
        assert types.knows(part)
        assert types.to_json(part, types.from_json(part, text, 0)) == text
        assert cbor2.loads(types.to_cbor(part, types.zero(part))).keys() == json.loads(text).keys()
    assert types.knows("a/action/Count")
    assert types.to_json("a/action/Count_Feedback", types.zero("a/action/Count_Feedback")) == b'{"done":0.5}'
    assert types.definition("a/action/Count") == ACTION
    with pytest.raises(NotFound):
        types.to_json("a/action/Count", b"")


def test_goals_come_by_name_by_order_or_not_at_all() -> None:
    """Arguments of an action have the forms of a service's."""
    types = TypeRegistry()
    types.add("a/action/Count", ACTION)
    wanted = types.from_json("a/action/Count_Goal", {"order": 5, "inners": [{"x": 2.0}]}, 0)
    for name in ("a/action/Count", "a/Count", "a/action/Count_Goal"):
        assert types.args_from_json(name, b'{"inners":[{"x":2}],"order":5}', 0) == wanted
        assert types.args_from_json(name, b'[5,[{"x":2}]]', 0) == wanted
        assert types.args_from_json(name, [5, [{"x": 2}]], 0) == wanted
        assert types.args_from_json(name, None, 0) == types.zero("a/action/Count_Goal")
    with pytest.raises(Invalid, match="a/action/Count_Goal has 2 arguments, not 3"):
        types.args_from_json("a/action/Count", [1, [], 3], 0)


def test_typedefs_of_the_parts_of_actions_and_services() -> None:
    """Each part is a type of rosapi, followed by its nested types."""
    types = TypeRegistry()
    types.add("a/action/Count", ACTION)
    types.add("std_srvs/srv/Trigger", TRIGGER)
    goal, inner = types.typedefs("a/action/Count_Goal")
    assert goal == {
        "type": "a/Count_Goal",
        "fieldnames": ["order", "inners"],
        "fieldtypes": ["int32", "a/Inner"],
        "fieldarraylen": [-1, 0],
        "examples": ["0", "[]"],
        "constnames": [],
        "constvalues": [],
    }
    assert inner["type"] == "a/Inner"
    (result,) = types.typedefs("a/action/Count_Result")
    assert (result["constnames"], result["constvalues"]) == (["OK"], ["yes"])
    (feedback,) = types.typedefs("a/action/Count_Feedback")
    assert feedback["examples"] == ["0.5"]
    (response,) = types.typedefs("std_srvs/srv/Trigger_Response")
    assert response["fieldnames"] == ["success", "message"]


def test_an_empty_request_is_one_byte() -> None:
    """IDL has no empty structures."""
    types = TypeRegistry()
    types.add("std_srvs/srv/Trigger", TRIGGER)
    assert types.args_from_json("std_srvs/srv/Trigger", b"{}", 0) == b"\0\1\0\0\0"
    assert types.to_json("std_srvs/srv/Trigger_Request", b"\0\1\0\0\0") == b"{}"
    assert types.knows("std_srvs/srv/Trigger")
    assert types.knows("std_srvs/srv/Trigger_Response")
