"""Types in rosapi."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_server.common import cpu_quota
from relay_server.common.concurrency import AT_A_TIME
from relay_server.relay_node import rosapi
from relay_server.relay_node.interfaces import TOPICS, TYPE_NAMES
from tests.worlds.relay import STRING, TRIGGER, TWIST, Person, World
from tests.worlds.relay_node_calls import ask, begin

DOCK = "a_msgs/action/Dock"
TWIST_STAMPED = (
    "Twist twist\n"
    + "=" * 80
    + "\nMSG: geometry_msgs/msg/Twist\nVector3 linear\nVector3 angular\n"
    + "=" * 80
    + "\nMSG: geometry_msgs/msg/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
)


def define(world: World, type_name: str, text: str) -> None:
    """The robot answers with the definition."""
    assert type_name in [each.type for each in world.link.take(link.GetType)]
    world.channel.message(link.TypeDefinition(type=type_name, text=text))


@pytest.mark.parametrize(
    ("service", "type_name", "text", "first", "fields"),
    [
        ("message_details", "a_msgs/Thing", "uint8[3] a\n", "a_msgs/Thing", ["a"]),
        ("message_details", "a_msgs/msg/Thing", "uint8[3] a\n", "a_msgs/Thing", ["a"]),
        ("service_request_details", "a_msgs/Do", "int8 a\n---\nint8 b\n", "a_msgs/Do_Request", ["a"]),
        ("service_response_details", "a_msgs/srv/Do", "int8 a\n---\nint8 b\n", "a_msgs/Do_Response", ["b"]),
        (
            "action_goal_details",
            "a_msgs/Dock",
            "int8 a\n---\nint8 b\n---\nint8 c\n",
            "a_msgs/Dock_Goal",
            ["a"],
        ),
        ("action_result_details", DOCK, "int8 a\n---\nint8 b\n---\nint8 c\n", "a_msgs/Dock_Result", ["b"]),
        (
            "action_feedback_details",
            DOCK,
            "int8 a\n---\nint8 b\n---\nint8 c\n",
            "a_msgs/Dock_Feedback",
            ["c"],
        ),
    ],
)
def test_details_of_an_unknown_type_come_from_the_robots_definition(
    world: World, viewer: Person, service: str, type_name: str, text: str, first: str, fields: list[str]
) -> None:
    """It is requested once, then cached."""
    got = begin(viewer, f"/rosapi/{service}", {"type": type_name})
    (asked,) = world.link.all(link.GetType)
    define(world, asked.type, text)
    (typedef,) = got()["typedefs"]
    assert typedef["type"] == first
    assert typedef["fieldnames"] == fields
    assert ask(viewer, f"/rosapi/{service}", {"type": type_name})["typedefs"] == [typedef]
    assert not world.link.all(link.GetType)


def test_definitions_follow_in_depth_first_order(world: World, viewer: Person) -> None:
    """Each type is listed once, where it appears first."""
    got = begin(viewer, "/rosapi/message_details", {"type": TWIST})
    world.define(TWIST)
    assert [each["type"] for each in got()["typedefs"]] == ["geometry_msgs/Twist", "geometry_msgs/Vector3"]


def test_a_type_the_robot_does_not_have_is_empty_for_messages_and_an_error_for_the_rest(
    world: World, viewer: Person
) -> None:
    """As in rosapi."""
    got = begin(viewer, "/rosapi/message_details", {"type": "a_msgs/None"})
    world.channel.message(
        link.Failed(request="get_type", reference="a_msgs/msg/None", reason="not installed")
    )
    assert got() == {"typedefs": []}
    viewer.says("call_service", service="/rosapi/service_request_details", args={"type": "a_msgs/None"})
    world.channel.message(
        link.Failed(request="get_type", reference="a_msgs/srv/None", reason="not installed")
    )
    (reply,) = viewer.received("service_response")
    assert reply["values"] == "type a_msgs/srv/None: not installed"


def test_an_invalid_definition_is_reported(world: World, viewer: Person) -> None:
    """It is not treated as a missing type."""
    viewer.says("call_service", service="/rosapi/message_details", args={"type": "a_msgs/Odd"})
    define(world, "a_msgs/msg/Odd", "this is no definition")
    (reply,) = viewer.received("service_response")
    assert "unusable" in reply["values"]


@pytest.mark.parametrize(
    "args", [None, {}, {"type": 7}, {"type": None}, [], [7], "text", {"type": "///"}, [""]]
)
def test_invalid_arguments_are_explained(viewer: Person, args: Any) -> None:
    """Never by an internal error."""
    values = ask(viewer, "/rosapi/message_details", args)
    assert values == "give 'type', a string" or "is not a type name" in values


def test_types_of_another_kind_are_explained(viewer: Person) -> None:
    """A service has no message details."""
    assert ask(viewer, "/rosapi/message_details", {"type": TRIGGER}) == f"{TRIGGER} is no message type"
    assert ask(viewer, "/rosapi/action_goal_details", {"type": TRIGGER}) == f"{TRIGGER} is no action type"
    assert ask(viewer, "/rosapi/service_request_details", [STRING]) == f"{STRING} is no service type"


def test_the_relays_own_types_are_described_without_the_robot(world: World, viewer: Person) -> None:
    """Those of its topics and services, and those of rosapi."""
    status = ask(viewer, "/rosapi/message_details", {"type": "switchboard_msgs/Status"})["typedefs"]
    assert status[0]["fieldnames"][:2] == ["robot", "state"]
    assert status[1]["type"] == "switchboard_msgs/Client"
    ping = ask(viewer, "/rosapi/service_response_details", {"type": "switchboard_msgs/srv/Ping"})["typedefs"]
    assert ping[0]["fieldnames"] == ["relay_time_ns", "robot_rtt_ms"]
    topics = ask(viewer, "/rosapi/service_response_details", {"type": "rosapi_msgs/Topics"})["typedefs"]
    assert topics[0]["fieldnames"] == ["topics", "types"]
    assert not world.link.all(link.GetType)


def test_raw_types_wait_for_definitions_and_say_what_fails(world: World, operator: Person) -> None:
    """A type that the robot does not have spoils no other; nested types have rosapi's names."""
    got = begin(operator, "/rosapi/topics_and_raw_types")
    assert {each.type for each in world.link.all(link.GetType)} == {STRING, TWIST}
    world.channel.message(
        link.TypeDefinition(type=TWIST, text=f"int8 a\n{'=' * 80}\nMSG: a_msgs/msg/B\nint8 b\n")
    )
    world.channel.message(link.Failed(request="get_type", reference=STRING, reason="not installed"))
    answer = got()
    assert answer["topics"] == ["/chatter", "/cmd_vel", *TOPICS]
    chatter, cmd_vel, *_, status = answer["typedefs_full_text"]
    assert chatter == f"# no definition: type {STRING}: not installed"
    assert cmd_vel == f"int8 a\n{'=' * 80}\nMSG: a_msgs/B\nint8 b\n"
    assert status.startswith("string robot\n")


def test_raw_types_are_of_just_this_type(world: World, operator: Person) -> None:
    """A type that is known as a part of another is requested by itself."""
    got = begin(operator, "/rosapi/message_details", {"type": "geometry_msgs/TwistStamped"})
    define(world, "geometry_msgs/msg/TwistStamped", TWIST_STAMPED)
    assert len(got()["typedefs"]) == 3
    raw = begin(operator, "/rosapi/topics_and_raw_types")
    world.define(STRING, TWIST)
    world.clock.advance(0)
    assert raw()["typedefs_full_text"][1].startswith("Vector3 linear\n")


def test_so_many_types_are_asked_for_at_a_time(world: World, operator: Person) -> None:
    """This protects the robot; a caller that leaves ends its requests."""
    topics = {f"/t{n}": link.Topic(types=[f"a_msgs/msg/T{n}"]) for n in range(100)}
    topics["/time"] = link.Topic(types=["builtin_interfaces/msg/Time"])
    world.registry.graph(world.robot, link.Graph(full=True, topics=dict(topics)))
    got = begin(operator, "/rosapi/topics_and_raw_types")
    assert len(world.link.all(link.GetType)) == AT_A_TIME
    while asked := world.link.take(link.GetType):
        assert len(asked) <= AT_A_TIME
        for each in asked:
            world.channel.message(link.TypeDefinition(type=each.type, text="int8 a\n"))
    texts = got()["typedefs_full_text"]
    assert texts.count("int8 a\n") == 101
    other = world.person()
    world.registry.graph(world.robot, link.Graph(topics={"/u": link.Topic(types=["b_msgs/msg/U"])}))
    begin(other, "/rosapi/topics_and_raw_types")
    other.session.end()


def test_raw_types_are_bounded(world: World, operator: Person, monkeypatch: pytest.MonkeyPatch) -> None:
    """Large types on many topics of a robot do not fill the relay's memory."""
    monkeypatch.setattr(rosapi, "RAW_CHARACTERS", 60)
    got = begin(operator, "/rosapi/topics_and_raw_types")
    world.define(STRING, TWIST)
    chatter, cmd_vel, *_, status = got()["typedefs_full_text"]
    assert chatter == "string data\n"
    assert "left out" in cmd_vel
    assert "left out" in status


def test_interfaces_are_asked_for_once(world: World, operator: Person, viewer: Person) -> None:
    """For any number of callers; the relay's own are included, in order."""
    first = begin(operator, "/rosapi/interfaces")
    second = begin(viewer, "/rosapi/interfaces")
    assert len(world.link.all(link.GetInterfaces)) == 1
    world.channel.message(link.Interfaces(types=["z_msgs/msg/Z", "a_msgs/msg/A"]))
    reported = {"interfaces": ["a_msgs/msg/A", *TYPE_NAMES, "z_msgs/msg/Z"]}
    assert first() == reported
    world.clock.advance(0)
    assert second() == reported
    assert ask(operator, "/rosapi/interfaces") == reported
    assert len(world.link.all(link.GetInterfaces)) == 1


def test_interfaces_that_the_robot_does_not_list(world: World, operator: Person) -> None:
    """Refused, lost or unanswered requests give a reason; the next caller requests again."""
    operator.says("call_service", service="/rosapi/interfaces")
    world.channel.message(link.Failed(request="get_interfaces", reference="", reason="too many"))
    (reply,) = operator.received("service_response")
    assert reply["values"] == "robot rover does not list its types: too many"
    operator.says("call_service", service="/rosapi/interfaces")
    for _ in range(31):
        world.clock.advance(1.0)
        operator.answers_pings()
    (reply,) = operator.received("service_response")
    assert "did not answer within 30 s" in reply["values"]
    operator.says("call_service", service="/rosapi/interfaces")
    assert len(world.link.all(link.GetInterfaces)) == 3
    world.robot_goes()
    (reply,) = operator.received("service_response")
    assert "lost its connection" in reply["values"]
    assert "is offline" in ask(operator, "/rosapi/interfaces")
    world.channel.message(link.Interfaces(types=["a_msgs/msg/A"]))


def test_a_robot_without_interface_list_shows_those_of_its_graph(world: World) -> None:
    """As far as the caller may use them."""
    world.robot_comes(["json"])
    person = world.person(deny=("*:/cmd_vel",))
    world.robot_joins()
    assert ask(person, "/rosapi/interfaces")["interfaces"] == sorted({*TYPE_NAMES, STRING, TRIGGER})
    assert not world.link.all(link.GetInterfaces)


def test_answers_to_many_callers_of_one_type_are_made_in_turns(world: World, operator: Person) -> None:
    """One answer of the robot does not make the relay do all callers' work at once; beyond the quota it is
    refused.
    """
    type_name = {"type": "geometry_msgs/TwistStamped"}
    first = begin(operator, "/rosapi/message_details", type_name)
    begin(operator, "/rosapi/message_details", type_name)
    define(world, "geometry_msgs/msg/TwistStamped", TWIST_STAMPED)
    assert len(first()["typedefs"]) == 3
    operator.context.quota.user.requests.spend(2 * cpu_quota.REQUESTS_RESERVE)
    world.clock.advance(0)
    refused = operator.received("service_response")[0]["values"]
    assert refused.startswith("too much at once")


def test_so_many_questions_of_one_user_for_all_types_may_wait(world: World, operator: Person) -> None:
    """Another user still has room, and so has this one when the answers have arrived."""
    for number in range(rosapi.SURVEYS):
        operator.says("call_service", service="/rosapi/topics_and_raw_types", id=number)
    assert "types of all topics wait already" in ask(operator, "/rosapi/topics_and_raw_types")
    other = begin(world.person(user=8), "/rosapi/topics_and_raw_types")
    world.define()
    world.clock.advance(0)
    assert other()["topics"]
    assert len(operator.received("service_response")) == rosapi.SURVEYS
    assert ask(operator, "/rosapi/topics_and_raw_types")["topics"]
