"""Service calls to the robot: each is answered exactly once."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.channels import encodings
from relay_server.channels import service_calls as module
from relay_server.sessions import service_calls as session_module
from tests.worlds.relay import TRIGGER, Person, World

YES = b"\x00\x01\x00\x00\x01\x00\x00\x00\x03\x00\x00\x00ok\x00"


def at_work(world: World) -> Person:
    """A robot with known types, and an operator."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("call_service", service="/reset", id="first")
    world.define()
    answer(world)
    person.client.take()
    return person


def answer(world: World, **fields: Any) -> None:
    """The robot answers the call."""
    for call in world.link.take(link.CallService):
        said = {"result": True, "cdr": link.to_base64(YES)} | fields
        world.channel.message(link.ServiceResponse(id=call.id, **said))


def test_an_answer_comes_back_as_json_with_the_clients_id(world: World) -> None:
    """Ids may be strings, numbers or missing; the service name is the client's spelling."""
    person = at_work(world)
    for id in ("a", 7, 10**30, None):
        person.says("call_service", service="reset", **({} if id is None else {"id": id}))
    assert [call.service for call in world.link.all(link.CallService)] == ["/reset"] * 4
    answer(world)
    replies = person.received("service_response")
    assert [reply.get("id") for reply in replies] == ["a", 7, 10**30, None]
    assert all(reply["service"] == "reset" and reply["result"] is True for reply in replies)
    assert replies[0]["values"] == {"success": True, "message": "ok"}


def test_the_type_is_asked_for_before_the_first_call(world: World) -> None:
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    for number in range(3):
        person.says("call_service", service="/reset", id=number)
    assert world.link.all(link.GetType) == [link.GetType(type=TRIGGER)]
    assert not world.link.all(link.CallService)
    world.define()
    answer(world)
    assert [reply["id"] for reply in person.received("service_response")] == [0, 1, 2]


def test_a_call_ends_by_time(world: World) -> None:
    """The robot gets the client's timeout, and the relay gives up shortly after."""
    person = at_work(world)
    person.says("call_service", service="/reset", id=1, timeout=2.5)
    (call,) = world.link.all(link.CallService)
    assert call.timeout == 2.5
    world.clock.advance(2.5)
    assert not person.received("service_response")
    world.clock.advance(module.GRACE)
    (reply,) = person.received("service_response")
    assert (reply["result"], reply["values"]) == (False, "service /reset did not answer within 2.5 s")
    answer(world)
    assert not person.received("service_response")


@pytest.mark.parametrize("timeout", [None, 0, -1, 1e300])
def test_odd_timeouts_are_taken_within_reason(world: World, timeout: float | None) -> None:
    """Missing, zero and negative values mean the default; the maximum is one hour."""
    person = at_work(world)
    person.says("call_service", service="/reset", timeout=timeout)
    assert world.link.all(link.CallService)[0].timeout == (3600 if timeout == 1e300 else 30)


def test_a_call_to_a_robot_that_never_defines_the_type_ends(world: World) -> None:
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("call_service", service="/reset", timeout=1)
    for _ in range(4):
        world.clock.advance(1)
    (reply,) = person.received("service_response")
    assert reply["result"] is False
    assert not person.session.service_calls._calls


def test_a_lost_robot_ends_its_calls(world: World) -> None:
    """At once and with a reason."""
    person = at_work(world)
    person.says("call_service", service="/reset")
    world.robot_goes()
    (reply,) = person.received("service_response")
    assert (reply["result"], reply["values"]) == (False, "robot rover lost its connection during the call")
    person.says("call_service", service="/reset", type="std_srvs/Trigger")
    assert person.received("service_response")[0]["values"] == "robot rover is offline"


def test_failures_are_reported_in_the_robots_words(world: World) -> None:
    """These are a result of false, with or without a reason, and an unreadable answer."""
    person = at_work(world)
    for fields in (
        {"result": False, "reason": "it is stuck", "cdr": None},
        {"result": False, "cdr": None},
        {"cdr": link.to_base64(b"\x00\x01\x00\x00\xff\xff\xff\xff\xff\xff\xff\xff")},
        {"cdr": "no base64!"},
    ):
        person.says("call_service", service="/reset")
        answer(world, **fields)
    replies = person.received("service_response")
    assert [reply["result"] for reply in replies] == [False] * 4
    assert [reply["values"] for reply in replies[:2]] == ["it is stuck", "service /reset failed"]
    assert all(reply["values"].startswith("the robot's answer can't be read") for reply in replies[2:])


def test_uncallable_service_is_refused_with_a_reason(world: World) -> None:
    """These are unknown services, invalid arguments and invalid names."""
    person = at_work(world)
    person.says("call_service", service="/nothing")
    person.says("call_service", service="/reset", args={"speed": 1})
    person.says("call_service", service="/reset", args=[1])
    person.says("call_service", service="no name!")
    values = [reply["values"] for reply in person.received("service_response")]
    assert values[0] == "service /nothing does not exist on robot rover"
    assert "speed" in values[1]
    assert values[2] == "std_srvs/srv/Trigger_Request has 0 arguments, not 1"
    assert "is no ROS name" in values[3]
    assert not world.link.all(link.CallService)


def test_all_goals_of_an_action_are_cancelled_by_its_hidden_service(world: World) -> None:
    """roslibjs does this, without a type. It needs the right to call the action."""
    person = at_work(world)
    world.robot.graph.actions["/walk"] = link.Service(types=["a/action/Walk"], providers=["/legs"])
    denied = world.person(deny=("call:/walk",))
    denied.says("call_service", service="/walk/_action/cancel_goal")
    assert denied.received("service_response")[0]["result"] is False
    assert not world.link.all(link.GetType)
    person.says("call_service", service="/walk/_action/cancel_goal")
    assert [asked.type for asked in world.link.all(link.GetType)] == ["action_msgs/srv/CancelGoal"]
    person.says("call_service", service="/stand/_action/cancel_goal")
    assert "does not exist" in person.received("service_response")[0]["values"]


def test_too_many_calls_of_one_client_are_refused(world: World) -> None:
    """Active calls go on; their places are free again afterwards."""
    person = at_work(world)
    for number in range(session_module.CALLS + 1):
        person.says("call_service", service="/reset", id=number)
    (reply,) = person.received("service_response")
    assert reply["values"] == "256 calls of this connection are waiting already"
    answer(world)
    assert len(person.received("service_response")) == session_module.CALLS
    person.says("call_service", service="/reset")
    assert len(world.link.all(link.CallService)) == 1


def test_calls_of_a_client_that_leaves_give_their_places_back(world: World) -> None:
    """Any timeout is possible, so reconnecting must not fill the robot's places."""
    keeper = at_work(world)
    for _ in range(module.MAX_CALLS // session_module.CALLS + 1):
        person = world.person()
        for _ in range(session_module.CALLS):
            person.says("call_service", service="/reset", timeout=3600)
        person.session.end()
        assert not person.session.service_calls._calls
    world.link.take(link.CallService)
    keeper.says("call_service", service="/reset", id="mine")
    answer(world)
    assert [reply["id"] for reply in keeper.received("service_response")] == ["mine"]
    assert not world.channel._calls._pending


def test_too_many_calls_on_one_robot_are_refused(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit is for all clients together."""
    monkeypatch.setattr(module, "MAX_CALLS", 2)
    person = at_work(world)
    for _ in range(3):
        person.says("call_service", service="/reset")
    (reply,) = person.received("service_response")
    assert reply["values"] == "2 calls are waiting on this robot already"


def test_a_request_too_large_for_a_robot_is_refused(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot would have to close its link, which all clients share."""
    person = at_work(world)
    monkeypatch.setattr(encodings, "LARGEST", 3)
    person.says("call_service", service="/reset")
    assert "a robot takes at most 3" in person.received("service_response")[0]["values"]


def test_a_robot_of_json_is_called_with_json(world: World) -> None:
    world.robot_comes(encodings=["json"])
    person = world.person()
    world.robot_joins()
    person.says("call_service", service="/own", type="a/srv/Own", args={"hard": True})
    (call,) = world.link.all(link.CallService)
    assert (call.cdr, bytes(call.args)) == (None, b'{"hard": true}')  # type: ignore[arg-type]
    answer(world, cdr=None, values=msgspec.Raw(b'{"done": 1}'))
    assert person.received("service_response")[0]["values"] == {"done": 1}


def test_a_right_that_is_revoked_ends_the_calls_that_wait(world: World) -> None:
    """At once and with a reason. The robot's answer is discarded, and calls that are still allowed go on."""
    person = at_work(world)
    for id, service in (("mine", "/reset"), ("other", "/vault/open"), ("own", "/relay/ping")):
        person.says("call_service", service=service, id=id, args={"robot": True} if id == "own" else {})
    person.context.permit.rules = Rules([Grant(Level.OPERATOR, (), ("call:/reset", "call:/relay/*"))])
    person.context.permit.on_change()
    (reply,) = person.received("service_response")
    assert (reply["id"], reply["result"]) == ("mine", False)
    assert reply["values"] == "call on /reset is denied to you by 'call:/reset'"
    answer(world)
    world.link.pings[0].callback(0.001)
    assert [each["id"] for each in person.received("service_response")] == ["other", "own"]
