"""Parameters through rosapi: calls of the nodes' own services, with the caller's right on each."""

from __future__ import annotations

import json
from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Level
from relay_server.common.concurrency import AT_A_TIME
from relay_server.relay_node import params
from relay_server.relay_node.params import ALL_SECONDS, SURVEYS, SURVEYS_OF_USER
from tests.worlds.relay import Person, World
from tests.worlds.relay_node_calls import answers, ask, asked, begin, fails, parameter_services


@pytest.fixture
def person(world: World) -> Person:
    """An operator without rights on the arm, on a robot that speaks JSON."""
    world.robot_comes(["json"])
    world.registry.graph(
        world.robot, link.Graph(services=parameter_services("/base") | parameter_services("/arm"))
    )
    operator = world.person(deny=("call:/arm/*",))
    world.robot_joins()
    return operator


def value(kind: int, **fields: Any) -> dict[str, Any]:
    """An answer of get_parameters."""
    return {"values": [{"type": kind, **fields}]}


@pytest.mark.parametrize("name", ["/base:speed", "base:speed"])
def test_a_parameter_is_got_from_its_node(world: World, person: Person, name: str) -> None:
    """Its value is JSON text."""
    got = begin(person, "/rosapi/get_param", {"name": name})
    assert answers(world, "/base/get_parameters", value(3, double_value=0.5)) == {"names": ["speed"]}
    assert got() == {"value": "0.5", "successful": True, "reason": ""}


@pytest.mark.parametrize(
    ("default", "given"),
    [("", "null"), ("7", "7"), ('"a"', '"a"'), ("words", '"words"'), ("[1, 2]", "[1,2]")],
)
@pytest.mark.parametrize("nothing", [value(0), {"values": []}])
def test_unset_field_has_the_default(
    world: World, person: Person, default: str, given: str, nothing: Any
) -> None:
    """The default is JSON text; without a default it is a failure."""
    got = begin(person, "/rosapi/get_param", ["/base:none", default])
    answers(world, "/base/get_parameters", nothing)
    answer = got()
    assert answer["value"] == given
    assert answer["successful"] is bool(default)
    assert ("is not set" in answer["reason"]) is not bool(default)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("/arm:speed", "is denied to you"),
        ("/none:speed", "there is no node /none with parameters"),
        ("speed", "write <node>:<parameter>"),
        ("/:x", "write <node>:<parameter>"),
        ("/base:", "write <node>:<parameter>"),
    ],
)
def test_unavailable_resource_is_refused_with_the_reason(
    world: World, person: Person, name: str, reason: str
) -> None:
    """The robot receives no request."""
    for service, extra in (("get_param", {}), ("set_param", {"value": "1"}), ("delete_param", {})):
        answer = ask(person, f"/rosapi/{service}", {"name": name, **extra})
        assert answer["successful"] is False
        assert reason in answer["reason"]
    assert not asked(world)


def test_a_viewer_has_no_parameters(world: World, person: Person) -> None:
    """Parameter services need the right to call, which viewers lack."""
    viewer = world.person(Level.VIEWER)
    answer = ask(viewer, "/rosapi/get_param", {"name": "/base:speed"})
    assert answer["successful"] is False
    assert "needs the level operator" in answer["reason"]
    assert ask(viewer, "/rosapi/get_param_names") == {"names": []}
    assert not asked(world)
    reader = world.person(Level.VIEWER, allow=("call:/base/get_parameters",))
    got = begin(reader, "/rosapi/get_param", {"name": "/base:speed"})
    answers(world, "/base/get_parameters", value(1, bool_value=True))
    assert got()["value"] == "true"
    assert ask(reader, "/rosapi/set_param", {"name": "/base:speed", "value": "1"})["successful"] is False


@pytest.mark.parametrize(
    ("exists", "answer"), [(True, value(2, integer_value=1)), (False, value(0)), (False, {"values": []})]
)
def test_has_param_asks_the_node(world: World, person: Person, exists: bool, answer: Any) -> None:
    got = begin(person, "/rosapi/has_param", {"name": "/base:x"})
    answers(world, "/base/get_parameters", answer)
    assert got() == {"exists": exists}


def test_has_param_is_false_for_what_is_not_there_or_not_shown(person: Person) -> None:
    """A hidden parameter is not distinguished from a missing one."""
    for name in ("/arm:x", "/none:x", "nonsense"):
        assert ask(person, "/rosapi/has_param", {"name": name}) == {"exists": False}


@pytest.mark.parametrize(
    ("text", "sent"),
    [
        ("true", {"type": 1, "bool_value": True}),
        ("0.5", {"type": 3, "double_value": 0.5}),
        ('"a"', {"type": 4, "string_value": "a"}),
        ("NaN", {"type": 3, "double_value": None}),
    ],
)
def test_a_parameter_is_set_by_json_text(world: World, person: Person, text: str, sent: Any) -> None:
    """The node's answer is returned."""
    got = begin(person, "/rosapi/set_param", {"name": "/base:x", "value": text})
    request = answers(
        world, "/base/set_parameters", {"results": [{"successful": False, "reason": "read only"}]}
    )
    assert request == {"parameters": [{"name": "x", "value": sent}]}
    assert got() == {"successful": False, "reason": "read only"}


def test_a_whole_number_becomes_what_the_parameter_is(world: World, person: Person) -> None:
    """JavaScript writes 1.0 as 1, and a node accepts no integer for a double."""
    got = begin(person, "/rosapi/set_param", {"name": "/base:x", "value": "1"})
    answers(world, "/base/get_parameters", value(3, double_value=0.5))
    request = answers(world, "/base/set_parameters", {"results": [{"successful": True, "reason": ""}]})
    assert request["parameters"][0]["value"] == {"type": 3, "double_value": 1}
    assert got() == {"successful": True, "reason": ""}


def test_changes_of_parameters_are_recorded(world: World, person: Person) -> None:
    """Changes that the node refused are not."""
    notes: list[Any] = []
    person.context.activity = lambda kind, **data: notes.append((kind, data))
    for service, extra, done in (
        ("set_param", {"value": "true"}, False),
        ("set_param", {"value": "true"}, True),
        ("delete_param", {}, True),
    ):
        got = begin(person, f"/rosapi/{service}", {"name": "base:x", **extra})
        answers(world, "/base/set_parameters", {"results": [{"successful": done, "reason": ""}]})
        assert got()["successful"] is done
    assert notes == [("param.set", {"param": "/base:x", "deleted": deleted}) for deleted in (False, True)]


def test_without_a_known_type_a_whole_number_is_an_integer(world: World, person: Person) -> None:
    """The node may not report it, or the caller may not ask."""
    writer = world.person(Level.VIEWER, allow=("call:/base/set_parameters",))
    got = begin(writer, "/rosapi/set_param", {"name": "/base:x", "value": "1"})
    request = answers(world, "/base/set_parameters", {"results": [{"successful": True, "reason": ""}]})
    assert request["parameters"][0]["value"] == {"type": 2, "integer_value": 1}
    assert got()["successful"]


@pytest.mark.parametrize("text", ["", "{", "null", "{}", "[[1]]", "[null]", "nan", "[" * 100])
def test_invalid_values_are_refused_with_a_reason(world: World, person: Person, text: str) -> None:
    """The node receives no request to set them."""
    got = begin(person, "/rosapi/set_param", {"name": "/base:x", "value": text})
    if asked(world):
        answers(world, "/base/get_parameters", value(0))
    assert got()["successful"] is False
    assert not asked(world)


def test_delete_sets_to_nothing(world: World, person: Person) -> None:
    """As in ROS 2."""
    got = begin(person, "/rosapi/delete_param", {"name": "/base:x"})
    request = answers(world, "/base/set_parameters", {"results": [{"successful": True, "reason": ""}]})
    assert request == {"parameters": [{"name": "x", "value": {"type": 0}}]}
    assert got() == {"successful": True, "reason": ""}


@pytest.mark.parametrize(
    "nonsense", [None, 7, {}, {"values": 7}, {"values": [7]}, {"values": [{"type": 99}]}]
)
def test_a_nonsensical_answer_of_a_node_is_reported(world: World, person: Person, nonsense: Any) -> None:
    """Robots are not trusted."""
    got = begin(person, "/rosapi/get_param", {"name": "/base:x"})
    answers(world, "/base/get_parameters", nonsense)
    answer = got()
    assert answer["successful"] is False
    assert answer["reason"]


@pytest.mark.parametrize("nonsense", [None, {}, {"results": []}, {"results": [7]}, {"results": [{}]}])
def test_a_nonsensical_answer_to_setting_is_reported(world: World, person: Person, nonsense: Any) -> None:
    got = begin(person, "/rosapi/set_param", {"name": "/base:x", "value": "true"})
    answers(world, "/base/set_parameters", nonsense)
    assert got()["successful"] is False


def test_a_silent_node_is_reported(world: World, person: Person) -> None:
    """With a reason, within some seconds."""
    got = begin(person, "/rosapi/get_param", {"name": "/base:x", "default_value": "3"})
    world.clock.pump([1.0] * 8)
    answer = got()
    assert answer["successful"] is False
    assert answer["value"] == "3"
    assert "did not answer within 5 s" in answer["reason"]


def test_names_are_those_of_all_nodes_one_may_ask(world: World, person: Person) -> None:
    """The nodes are asked concurrently; the arm is denied."""
    world.registry.graph(world.robot, link.Graph(services=parameter_services("/camera")))
    got = begin(person, "/rosapi/get_param_names")
    assert sorted(service for service, _ in asked(world)) == [
        "/base/list_parameters",
        "/camera/list_parameters",
    ]
    answers(world, "/camera/list_parameters", {"result": {"names": ["b", "a.x", 7]}})
    answers(world, "/base/list_parameters", {"result": {"names": ["speed"]}})
    assert got() == {"names": ["/base:speed", "/camera:b", "/camera:a.x"]}


def test_a_node_that_does_not_answer_is_left_out(world: World, person: Person) -> None:
    """A dead node delays no other result."""
    world.registry.graph(
        world.robot,
        link.Graph(
            services=parameter_services("/dead") | parameter_services("/odd") | parameter_services("/broken")
        ),
    )
    got = begin(person, "/rosapi/get_param_names")
    answers(world, "/base/list_parameters", {"result": {"names": ["speed"]}})
    answers(world, "/odd/list_parameters", {"result": 7})
    fails(world, "/broken/list_parameters", "it broke")
    world.clock.pump([1.0] * 4)
    assert got() == {"names": ["/base:speed"]}


@pytest.fixture
def crowd(world: World, person: Person) -> Person:
    """A caller on a robot with many nodes."""
    many: dict[str, link.Service | None] = {}
    for number in range(2000):
        many |= parameter_services(f"/n{number}")
    world.registry.graph(world.robot, link.Graph(services=many))
    return person


def test_so_many_nodes_are_asked_at_a_time(world: World, crowd: Person) -> None:
    """Each answer starts the next request; in the end the caller gets all names."""
    got = begin(crowd, "/rosapi/get_param_names")
    assert len(asked(world)) == AT_A_TIME
    answers(world, "/base/list_parameters", {"result": {"names": ["speed"]}})
    assert len(asked(world)) == AT_A_TIME
    for _ in range(int(ALL_SECONDS)):
        world.clock.advance(1.0)
        crowd.answers_pings()
    sent = len(asked(world))
    assert got() == {"names": ["/base:speed"]}
    world.clock.advance(1.0)
    assert len(asked(world)) == sent


def test_a_robot_that_is_lost_ends_the_asking(world: World, crowd: Person) -> None:
    """For any number of remaining nodes."""
    got = begin(crowd, "/rosapi/get_param_names")
    world.robot_goes()
    assert got() == {"names": []}


def test_the_names_are_bounded(world: World, person: Person, monkeypatch: pytest.MonkeyPatch) -> None:
    """An endless list of a robot does not fill the relay's memory."""
    monkeypatch.setattr(params, "NAMES", 3)
    world.registry.graph(world.robot, link.Graph(services=parameter_services("/camera")))
    got = begin(person, "/rosapi/get_param_names")
    answers(world, "/camera/list_parameters", {"result": {"names": ["a", "b", "c", "d"]}})
    answers(world, "/base/list_parameters", {"result": {"names": ["x" * 256, "y"]}})
    assert got() == {"names": ["/base:y", "/camera:a", "/camera:b"]}


def test_no_more_nodes_are_queried_for_a_caller_that_left(world: World, crowd: Person) -> None:
    """The answers would be discarded."""
    begin(crowd, "/rosapi/get_param_names")
    crowd.session.end()
    assert len(asked(world)) == AT_A_TIME


def test_so_many_callers_are_asked_for_at_a_time(world: World, crowd: Person) -> None:
    """Other callers get an error to retry; each finished call makes room."""
    callers = [world.person(user=100 + number) for number in range(SURVEYS)]
    for caller in callers:
        begin(caller, "/rosapi/get_param_names")
    assert "try again in a moment" in ask(crowd, "/rosapi/get_param_names")
    callers[3].session.end()
    begin(crowd, "/rosapi/get_param_names")
    assert not crowd.received("service_response")


def test_limit_per_user_leaves_room_for_others(world: World, crowd: Person) -> None:
    """For any number of connections."""
    for _ in range(SURVEYS_OF_USER):
        begin(world.person(), "/rosapi/get_param_names")
    assert "questions of yours" in ask(crowd, "/rosapi/get_param_names")
    other = world.person(user=8)
    begin(other, "/rosapi/get_param_names")
    assert not other.received("service_response")


def test_the_types_of_parameters_come_from_the_robot(world: World) -> None:
    """With CDR the node's answer is decoded by the robot's definition."""
    text = (
        "string[] names\n---\nParameterValue[] values\n"
        + "=" * 80
        + "\nMSG: rcl_interfaces/msg/ParameterValue\nuint8 type\nbool bool_value\nint64 integer_value\n"
        "float64 double_value\nstring string_value\nbyte[] byte_array_value\nbool[] bool_array_value\n"
        "int64[] integer_array_value\nfloat64[] double_array_value\nstring[] string_array_value\n"
    )
    world.robot_comes()
    world.registry.graph(world.robot, link.Graph(services=parameter_services("/base")))
    person = world.person()
    world.robot_joins()
    got = begin(person, "/rosapi/get_param", {"name": "/base:raw"})
    kind = "rcl_interfaces/srv/GetParameters"
    world.channel.message(link.TypeDefinition(type=kind, text=text))
    (call,) = world.link.all(link.CallService)
    types = world.robot.types
    asked_for = types.to_json(f"{kind}_Request", link.from_base64(call.cdr or "", "cdr"))
    assert json.loads(asked_for) == {"names": ["raw"]}
    cdr = types.from_json(f"{kind}_Response", {"values": [{"type": 5, "byte_array_value": [1, 255]}]}, 0)
    world.channel.message(link.ServiceResponse(id=call.id, result=True, cdr=link.to_base64(cdr)))
    assert got()["value"] == "[1,255]"
