"""What the relay itself offers in every robot's graph."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.local import rosapi
from tests.relay_server.memory import STRING, TRIGGER, TWIST, Person, World


def ask(person: Person, service: str, args: Any = None) -> Any:
    """The answer's values, or its words when the call failed."""
    person.says("call_service", service=service, **({} if args is None else {"args": args}))
    (reply,) = person.hears("service_response")
    return reply["values"]


@pytest.fixture
def viewer(world: World) -> Person:
    """Somebody who sees all but /secret and /vault, and may call nothing."""
    world.robot_comes()
    person = world.person(Level.VIEWER, deny=("*:/secret", "*:/vault/*"))
    world.robot_joins()
    return person


@pytest.fixture
def operator(world: World, viewer: Person) -> Person:
    """Somebody who may call too, except in the vault."""
    return world.person(Level.OPERATOR, deny=("*:/secret", "*:/vault/*"))


ANSWERS: list[tuple[str, Any, Any]] = [
    (
        "topics",
        None,
        {
            "topics": ["/chatter", "/cmd_vel", "/relay/status"],
            "types": [STRING, TWIST, "switchboard_msgs/msg/Status"],
        },
    ),
    ("topics_for_type", {"type": "std_msgs/String"}, {"topics": ["/chatter"]}),
    ("topic_type", {"topic": "chatter"}, {"type": STRING}),
    ("topic_type", {"topic": "/secret"}, {"type": ""}),
    ("topic_type", ["/cmd_vel"], {"type": TWIST}),
    ("publishers", {"topic": "/chatter"}, {"publishers": ["/talker"]}),
    ("publishers", {"topic": "/secret"}, {"publishers": []}),
    ("subscribers", {"topic": "/cmd_vel"}, {"subscribers": ["/base"]}),
    ("services", None, {"services": ["/reset"]}),
    ("services_for_type", {"type": TRIGGER}, {"services": ["/reset"]}),
    ("service_type", {"service": "reset"}, {"type": TRIGGER}),
    ("service_type", {"service": "/vault/open"}, {"type": ""}),
    ("service_node", {"service": "/reset"}, {"node": "/base"}),
    ("service_node", {"service": "/vault/open"}, {"node": ""}),
    ("service_providers", {"service": "/reset"}, {"providers": ["/base"]}),
    ("service_providers", {"service": "reset"}, {"providers": ["/base"]}),
    ("service_providers", {"service": "vault/open"}, {"providers": []}),
    ("service_providers", {"service": "std_srvs/Trigger"}, {"providers": ["/base"]}),
    ("nodes", None, {"nodes": ["/base", "/logger", "/talker", "/vault"]}),
    (
        "node_details",
        {"node": "/base"},
        {"subscribing": ["/cmd_vel"], "publishing": [], "services": ["/reset"]},
    ),
    ("node_details", {"node": "vault"}, {"subscribing": [], "publishing": [], "services": []}),
    ("get_ros_version", None, {"version": 2, "distro": "jazzy"}),
]


@pytest.mark.parametrize(("service", "args", "answer"), ANSWERS)
def test_rosapi_answers_from_the_mirror_what_the_caller_may_use(
    operator: Person, service: str, args: Any, answer: Any
) -> None:
    """Names with and without slash; what is denied is absent, not refused."""
    assert ask(operator, f"/rosapi/{service}", args) == answer


def test_what_one_may_not_call_is_not_shown(viewer: Person) -> None:
    """A viewer calls nothing of the robot, and sees no service; the relay's own are open to everyone."""
    assert ask(viewer, "/rosapi/services") == {"services": []}
    assert ask(viewer, "/rosapi/topics")["topics"] == ["/chatter", "/cmd_vel", "/relay/status"]


def test_details_of_types_come_from_the_robots_definitions(world: World, operator: Person) -> None:
    """Asked for once, then kept."""
    for service, type_name in (
        ("message_details", "geometry_msgs/Twist"),
        ("service_request_details", "std_srvs/Trigger"),
        ("service_response_details", "std_srvs/Trigger"),
    ):
        operator.says("call_service", service=f"/rosapi/{service}", args={"type": type_name}, id=service)
    world.define(TWIST, TRIGGER)
    details = {reply["id"]: reply["values"]["typedefs"] for reply in operator.hears("service_response")}
    assert [each["type"] for each in details["message_details"]] == [
        "geometry_msgs/Twist",
        "geometry_msgs/Vector3",
    ]
    assert details["message_details"][1]["fieldnames"] == ["x", "y", "z"]
    assert details["service_request_details"][0]["fieldnames"] == []
    assert details["service_response_details"][0]["fieldnames"] == ["success", "message"]


def test_topics_and_raw_types_waits_for_definitions_and_leaves_out_what_fails(
    world: World, operator: Person
) -> None:
    """One type the robot does not have spoils nothing."""
    operator.says("call_service", service="/rosapi/topics_and_raw_types")
    world.define(STRING)
    world.channel.message(link.Failed(what="get_type", ref=TWIST, reason="not installed"))
    (reply,) = operator.hears("service_response")
    assert reply["values"]["typedefs_full_text"] == ["string data\n", "", ""]


@pytest.mark.parametrize("args", [None, {}, {"type": 7}, {"type": None}, [], [7], "text", {"type": "///"}])
def test_arguments_that_are_none_are_told_in_words(operator: Person, args: Any) -> None:
    """Never an internal error."""
    values = ask(operator, "/rosapi/message_details", args)
    assert values == "give 'type', a string" or "is no type name" in values


def test_no_handler_fails_inside_on_any_arguments(operator: Person) -> None:
    """Whatever is sent, the answer is an answer or a sentence."""
    for service in rosapi.SERVICES:
        for args in (None, [], {}, ["x"], {"topic": "x", "service": "x", "node": "x"}, 7):
            operator.says("call_service", service=service, args=args)
    replies = operator.hears("service_response")
    assert all("failed on this call" not in str(reply["values"]) for reply in replies)


def test_time_is_the_relays(operator: Person) -> None:
    """In ROS 2's two parts."""
    time = ask(operator, "/rosapi/get_time")["time"]
    assert time["sec"] > 1.6e9
    assert 0 <= time["nanosec"] < 10**9


def test_an_unknown_service_of_the_relay_is_judged_like_any(viewer: Person, operator: Person) -> None:
    """It does not exist; a viewer is not even told that."""
    assert "needs the level operator" in ask(viewer, "/rosapi/delete_everything")
    assert "does not exist" in ask(operator, "/rosapi/delete_everything")


def test_ping_is_answered_at_once_or_after_a_round_trip(world: World, viewer: Person) -> None:
    """The robot's round trip is the latest heartbeat's, or measured now."""
    world.robot.rtt = 0.0123
    assert ask(viewer, "/relay/ping")["robot_rtt_ms"] == 12.3
    viewer.says("call_service", service="/relay/ping", args={"robot": True})
    assert not viewer.hears("service_response")
    world.link.pings[-1].callback(0.5)
    (reply,) = viewer.hears("service_response")
    assert reply["values"]["robot_rtt_ms"] == 500
    world.robot_goes()
    assert ask(viewer, "/relay/ping", {"robot": True}) == "robot rover is offline"


def test_the_relays_status_comes_every_second_while_it_is_wanted(world: World, viewer: Person) -> None:
    """At once, then each second, under the name the client wrote; the robot is never asked."""
    viewer.says("subscribe", topic="relay/status", id="a")
    viewer.says("subscribe", topic="relay/status", id="b")
    (status,) = viewer.hears("publish")
    assert status["topic"] == "relay/status"
    assert status["msg"]["robot"] == "rover"
    assert status["msg"]["level"] == "viewer"
    assert status["msg"]["clients"] == [{"user": "ann", "since": 1.7e9}]
    assert status["msg"]["motion"]["deadline_ms"] == 500
    world.clock.pump([0.5] * 4)
    assert len(viewer.hears("publish")) == 2
    viewer.says("unsubscribe", topic="/relay/status", id="a")
    world.clock.pump([0.5] * 2)
    assert len(viewer.hears("publish")) == 1
    viewer.says("unsubscribe", topic="/relay/status", id="b")
    world.clock.pump([0.5] * 4)
    assert not viewer.hears("publish")
    assert not world.link.all(link.Subscribe)
    viewer.says("subscribe", topic="/relay/status")
    assert len(viewer.hears("publish")) == 1


def test_status_can_be_denied(viewer: Person) -> None:
    """It is a topic like any other to the judge."""
    viewer.session.permit.rules = Rules([Grant(Level.VIEWER, deny=("subscribe:/relay/*",))])
    viewer.says("set_level", level="error")
    viewer.says("subscribe", topic="/relay/status")
    assert "is denied to you" in viewer.hears("status")[0]["msg"]


def test_a_handler_of_ours_that_breaks_is_answered_without_internals(
    world: World, viewer: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The caller does not wait for ever, and learns nothing of our insides."""

    async def broken(session: Any, args: Any) -> Any:
        raise RuntimeError("the secret of our insides")

    monkeypatch.setitem(viewer.session.calling._local._services, "/relay/ping", broken)  # type: ignore[attr-defined]
    assert ask(viewer, "/relay/ping") == "the relay failed on this call; its log tells more"
