"""Services that clients offer: only the client that was called may answer, and every caller gets one answer."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.channels import service_calls
from relay_server.channels.encodings import PayloadCodec
from tests.worlds.relay import ADD, Person, World

REQUEST, RESPONSE = f"{ADD}_Request", f"{ADD}_Response"


def offering(world: World, encodings: tuple[str, ...] = ("cdr", "json")) -> Person:
    """A robot on which a client offers ``/add``."""
    world.robot_comes(encodings=encodings)
    person = world.person()
    world.robot_joins()
    person.says("set_level", level="error")
    person.says("advertise_service", service="add", type="example_interfaces/AddTwoInts")
    world.channel.message(link.AdvertisedService(service="/add", type=ADD))
    world.define(ADD)
    return person


def graph_calls(world: World, id: str = "1", **more: Any) -> None:
    """A node of the robot calls the service with 2 and 3."""
    fields = {"cdr": world.cdr(REQUEST, a=2, b=3)} | more
    world.channel.message(link.CallService(id=id, service="/add", type=ADD, **fields))


def responses(world: World) -> list[link.ServiceResponse]:
    """Responses that the robot received."""
    return world.link.take(link.ServiceResponse)


def test_a_call_from_the_graph_is_answered_by_the_client(world: World) -> None:
    """The robot speaks CDR and the client JSON. The id is the relay's own."""
    person = offering(world)
    graph_calls(world, "s1")
    (call,) = person.received("call_service")
    id = call.pop("id")
    assert call == {"op": "call_service", "service": "add", "args": {"a": 2, "b": 3}}
    assert id != "s1"
    person.says("service_response", service="add", id=id, values={"sum": 5}, result=True)
    (response,) = responses(world)
    assert (response.id, response.result, response.reason) == ("s1", True, "")
    assert world.fields(RESPONSE, response.cdr) == {"sum": 5}


@pytest.mark.parametrize("values", [{"values": {}}, {}, {"values": None}])
def test_missing_fields_get_their_defaults(world: World, values: dict[str, Any]) -> None:
    """``result`` is true by default."""
    person = offering(world)
    graph_calls(world)
    (call,) = person.received("call_service")
    person.says("service_response", service="add", id=call["id"], **values)
    assert world.fields(RESPONSE, responses(world)[0].cdr) == {"sum": 0}


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        ({"values": "out of numbers"}, "out of numbers"),
        ({"values": {"code": 7}}, '{"code":7}'),
        ({}, "the client that offers /add could not do it"),
        ({"values": "x" * 9999}, "x" * 4096),
    ],
)
def test_a_client_may_refuse_a_call(world: World, said: dict[str, Any], reason: str) -> None:
    """The reason is passed to the robot and cut to a limit."""
    person = offering(world)
    graph_calls(world)
    (call,) = person.received("call_service")
    person.says("service_response", service="add", id=call["id"], result=False, **said)
    (response,) = responses(world)
    assert (response.result, response.reason) == (False, reason)


@pytest.mark.parametrize("values", [{"sum": "five"}, {"total": 5}, "5", {"sum": 2**70}, [1, 2], 7])
def test_a_nonsensical_answer_is_reported_to_client_and_robot(world: World, values: Any) -> None:
    """It ends the call."""
    person = offering(world)
    graph_calls(world)
    (call,) = person.received("call_service")
    person.says("service_response", service="add", id=call["id"], values=values)
    (response,) = responses(world)
    assert not response.result
    assert response.reason.startswith("the client that offers /add gave a wrong answer: ")
    (status,) = person.received("status")
    assert status["id"] == call["id"]
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert not responses(world)
    assert "no call or goal with the id" in person.received("status")[0]["msg"]


def test_only_the_client_that_was_asked_may_answer(world: World) -> None:
    """Answers of other clients, from other robots and under unknown ids are refused; the call goes on."""
    person, other, elsewhere = offering(world), world.person(), World()
    stranger = offering(elsewhere)
    other.says("set_level", level="error")
    other.says("advertise_service", service="/other", type=ADD)
    graph_calls(world)
    (call,) = person.received("call_service")
    for wrong in (other, stranger):
        wrong.says("service_response", service="add", id=call["id"], values={"sum": 6})
        (status,) = wrong.received("status")
        assert status["msg"] == f"no call or goal with the id '{call['id']}' waits for you"
    for id in ("1", 1, None, "x" * 500):
        person.says("service_response", service="add", id=id, values={"sum": 6})
    assert len(person.received("status")) == 4
    # A result of a goal does not answer a call.
    person.says("action_result", action="add", id=call["id"], values={"sum": 6})
    assert "no call or goal with the id" in person.received("status")[0]["msg"]
    assert not responses(world)
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert world.fields(RESPONSE, responses(world)[0].cdr) == {"sum": 5}


def test_calls_to_a_client_that_leaves_fail_at_once(world: World) -> None:
    """Unadvertising, leaving and a lost right answer each waiting call at once."""

    def unadvertises(person: Person) -> None:
        person.says("unadvertise_service", service="/add")

    def leaves(person: Person) -> None:
        person.session.end()

    def is_denied(person: Person) -> None:
        person.context.permit.rules = Rules([Grant(Level.VIEWER)])
        person.context.permit.on_change()

    for way, words in (
        (unadvertises, "the client that offered /add has withdrawn it"),
        (is_denied, "the client that offered /add may not do so any more"),
        (leaves, "the client that offered /add has left"),
    ):
        fresh = World()
        person = offering(fresh)
        graph_calls(fresh, "a")
        graph_calls(fresh, "b")
        way(person)
        answers = responses(fresh)
        assert [each.id for each in answers] == ["a", "b"]
        assert [(each.result, each.reason) for each in answers] == [(False, words)] * 2
        fresh.clock.advance(100)
        assert not responses(fresh)
        assert not fresh.channel.client_calls._graph_calls


@pytest.mark.parametrize(("timeout", "seconds"), [(0.0, 30), (2.5, 2.5)])
def test_a_call_is_given_up_after_its_time(world: World, timeout: float, seconds: float) -> None:
    """The default is 30 s. A later answer is ignored, without an error."""
    person = offering(world)
    graph_calls(world, timeout=timeout)
    world.wait(seconds - 0.1, person)
    assert not responses(world)
    world.wait(0.2, person)
    (response,) = responses(world)
    assert response.reason == f"the client that offers /add did not answer within {seconds:g} s"
    (call,) = person.received("call_service")
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert not responses(world)
    assert not person.received("status")


def test_a_call_keeps_its_place_until_the_client_can_have_read_it(world: World) -> None:
    """Callers that give up early cannot exceed the limit, and the place is not leaked."""
    person = offering(world)
    for number in range(service_calls.MAX_WAITING):
        graph_calls(world, str(number), timeout=0.1)
    world.wait(1, person)
    assert len(responses(world)) == service_calls.MAX_WAITING
    graph_calls(world, "more")
    (response,) = responses(world)
    assert response.reason == "256 calls and goals wait for the client that offers /add"
    assert len(person.received("call_service")) == service_calls.MAX_WAITING
    world.wait(service_calls.ABANDONED_SECONDS, person)
    graph_calls(world, "later")
    assert len(person.received("call_service")) == 1


def test_queue_for_a_client_is_bounded_in_bytes(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls of others must not disconnect a client that reads slowly."""
    person = offering(world)
    monkeypatch.setattr(service_calls, "MAX_WAITING_BYTES", 30)
    graph_calls(world, "a")
    graph_calls(world, "b")
    graph_calls(world, "c")
    (response,) = responses(world)
    assert response.id == "c"
    assert "too large for the client that offers /add" in response.reason
    for call in person.received("call_service"):
        person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    graph_calls(world, "d")
    assert len(person.received("call_service")) == 1


def test_calls_that_wait_for_the_type_are_bounded_and_kept_in_order(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot may call before it has sent the type's definition."""
    monkeypatch.setattr(service_calls, "MAX_GRAPH_CALLS", 3)
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("advertise_service", service="/add", type=ADD)
    for id in "abcd":
        body = link.to_base64(b"\x00\x01\x00\x00" + ord(id).to_bytes(8, "little") + bytes(8))
        world.channel.message(link.CallService(id=id, service="/add", type=ADD, cdr=body))
    (response,) = responses(world)
    assert (response.id, response.reason) == ("d", "3 calls from the graph are under way already")
    world.define()
    assert [call["args"]["a"] for call in person.received("call_service")] == [97, 98, 99]


def test_a_robot_without_the_type_gets_an_error(world: World) -> None:
    """The client does not receive the call."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("advertise_service", service="/add", type=ADD)
    world.channel.message(link.CallService(id="a", service="/add", type=ADD, cdr="AAEAAA=="))
    world.channel.message(link.Failed(request="get_type", reference=ADD, reason="not installed"))
    (response,) = responses(world)
    assert (response.id, response.result) == ("a", False)
    assert "not installed" in response.reason
    assert not person.received("call_service")


@pytest.mark.parametrize("cdr", ["no base64!", "AAEAAA==", "", None])
def test_an_unreadable_request_gets_an_error(world: World, cdr: str | None) -> None:
    """It is not passed to the client. A request without a body has default values."""
    person = offering(world)
    graph_calls(world, cdr=cdr)
    if cdr is None:
        assert person.received("call_service")[0]["args"] == {"a": 0, "b": 0}
    else:
        assert not responses(world)[0].result
        assert not person.received("call_service")


def test_a_call_of_a_service_without_a_server_is_answered(world: World) -> None:
    """The service may be withdrawn while the call is under way."""
    person = offering(world)
    person.says("unadvertise_service", service="/add")
    graph_calls(world)
    assert responses(world)[0].reason == "no client offers the service /add"


def test_a_robot_that_is_lost_gets_no_answer_on_its_next_link(world: World) -> None:
    """Ids start again on the new link, so the client's answer is ignored."""
    person = offering(world)
    graph_calls(world, "s1")
    (call,) = person.received("call_service")
    world.robot_goes()
    world.robot_comes()
    world.robot_joins()
    world.define()
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert not responses(world)
    assert not person.received("status")
    graph_calls(world, "s1")
    (call,) = person.received("call_service")
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert [each.id for each in responses(world)] == ["s1"]


def test_a_robot_of_json_calls_with_json(world: World) -> None:
    """Arguments and values are decoded and encoded, never passed on unread."""
    person = offering(world, ("json",))
    for raw, result in ((b'{ "a": 1 }', True), (b"{nonsense", False)):
        world.channel.message(link.CallService(id="a", service="/add", type=ADD, args=msgspec.Raw(raw)))
        for call in person.received("call_service"):
            assert call["args"] == {"a": 1}
            person.says("service_response", service="add", id=call["id"], values={"sum": 5})
        (response,) = responses(world)
        assert response.result is result
        if result:
            assert response.cdr is None
            assert json.loads(bytes(response.values)) == {"sum": 5}  # type: ignore[arg-type]


# --- clients that call clients ----------------------------------------------------------------------------


def test_a_client_calls_another_without_the_robot(world: World) -> None:
    """Lists and defaults are completed to an object, in the answer too."""
    person, caller = offering(world), world.person()
    for args, seen in (([2, 3], {"a": 2, "b": 3}), ({"b": 3}, {"a": 0, "b": 3}), (None, {"a": 0, "b": 0})):
        caller.says("call_service", service="add", id=7, args=args)
        (call,) = person.received("call_service")
        assert call["args"] == seen
        assert call["id"] != 7
        person.says("service_response", service="add", id=call["id"], values={})
        (answer,) = caller.received("service_response")
        assert answer == {
            "op": "service_response", "service": "add", "id": 7, "result": True, "values": {"sum": 0}
        }  # fmt: skip
    assert not world.link.all(link.CallService)


def test_a_client_may_call_itself(world: World) -> None:
    person = offering(world)
    person.says("call_service", service="/add", id="mine", args={"a": 1})
    call, *_ = (json.loads(each) for each in person.client.sent)
    person.says("service_response", service="add", id=call["id"], values={"sum": 1})
    assert person.received("service_response")[0]["values"] == {"sum": 1}


def test_failures_of_calls_between_clients_come_back_with_a_reason(world: World) -> None:
    """These are invalid arguments, a refusal, an invalid answer, a timeout, and a client that leaves."""
    person, caller = offering(world), world.person()

    def call(**more: Any) -> str:
        caller.says("call_service", service="/add", **more)
        asked = person.received("call_service")
        return str(asked[0]["id"]) if asked else ""

    def reply() -> Any:
        (answer,) = caller.received("service_response")
        assert answer["result"] is False
        return answer["values"]

    assert not call(args={"c": 1})
    assert "c" in reply()
    person.says("service_response", service="add", id=call(), result=False, values="no more numbers")
    assert reply() == "no more numbers"
    person.says("service_response", service="add", id=call(), values={"sum": []})
    assert "gave a wrong answer" in reply()
    call(timeout=2)
    world.clock.advance(2)
    assert reply() == "the client that offers /add did not answer within 2 s"
    call()
    person.session.end()
    assert reply() == "the client that offered /add has left"
    caller.says("call_service", service="/add")
    assert reply() == "service /add does not exist on robot rover"


def test_a_call_between_clients_outlives_the_robots_link(world: World) -> None:
    """The robot takes no part in it; a new call needs the robot online."""
    person, caller = offering(world), world.person()
    caller.says("call_service", service="/add")
    world.channel.link_lost(world.link)
    (call,) = person.received("call_service")
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert caller.received("service_response")[0]["values"] == {"sum": 5}
    world.robot_goes()
    caller.says("call_service", service="/add")
    assert caller.received("service_response")[0]["values"] == "robot rover is offline"


def test_calling_a_client_is_judged_like_any_call(world: World) -> None:
    """The right to call the service's name is checked."""
    person, viewer = offering(world), world.person(Level.VIEWER)
    denied = world.person(Level.OWNER, deny=("call:/add",))
    for each in (viewer, denied):
        each.says("call_service", service="add")
        assert each.received("service_response")[0]["result"] is False
    assert not person.received("call_service")


def test_a_caller_that_leaves_frees_what_it_may(world: World) -> None:
    """The answer is ignored. Reconnecting cannot fill a client's places."""
    person = offering(world)
    for _ in range(2):
        caller = world.person()
        for number in range(200):
            caller.says("call_service", service="/add", id=number, timeout=3600)
        caller.session.end()
    calls = person.received("call_service")
    assert len(calls) == service_calls.MAX_WAITING
    for call in calls:
        person.says("service_response", service="add", id=call["id"], values={})
    assert not person.received("status")
    assert not world.channel.client_calls._pending._by_client


def test_service_offered_later_by_the_robot_is_called_there(world: World) -> None:
    """The client's failed offer does not hide it."""
    person, caller = offering(world), world.person()
    world.robot_goes()
    world.robot_comes()
    world.robot_joins()
    world.define()
    world.robot.graph.services["/add"] = link.Service(types=[ADD], providers=["/adder"])
    world.channel.message(link.Failed(request="advertise_service", reference="/add", reason="it is taken"))
    caller.says("call_service", service="/add")
    assert len(world.link.all(link.CallService)) == 1
    assert not person.received("call_service")


def test_answers_too_large_for_a_robot_are_refused(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot would have to close its link, which all clients share."""
    person = offering(world)
    graph_calls(world)
    monkeypatch.setattr("relay_server.channels.encodings.LARGEST", 3)
    (call,) = person.received("call_service")
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert "a robot takes at most 3" in responses(world)[0].reason


def test_a_fault_of_the_relay_is_answered_too(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """A defect must not leave a caller without an answer."""
    offering(world)

    def broken(*_: object) -> bytes:
        raise RuntimeError("defect")

    monkeypatch.setattr(PayloadCodec, "from_robot", broken)
    monkeypatch.setattr(service_calls.ClientServiceCalls.log, "failure", lambda *_, **__: None)
    graph_calls(world)
    assert responses(world)[0].reason == "the relay failed on this call; see its log"
