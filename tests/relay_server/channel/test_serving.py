"""Calls of services that clients offer: only the client that was asked answers, and every caller is answered once."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.channels import service_calls
from relay_server.channels.payloads import PayloadCodec
from tests.relay_server.memory import ADD, Person, World

REQUEST, RESPONSE = f"{ADD}_Request", f"{ADD}_Response"


def offering(world: World, encodings: tuple[str, ...] = ("cdr", "json")) -> Person:
    """A robot in whose graph a client offers ``/add``; its statuses are told."""
    world.robot_comes(encodings=encodings)
    person = world.person()
    world.robot_joins()
    person.says("set_level", level="error")
    person.says("advertise_service", service="add", type="example_interfaces/AddTwoInts")
    world.channel.message(link.AdvertisedService(service="/add", type=ADD))
    world.define(ADD)
    return person


def graph_calls(world: World, id: str = "1", **more: Any) -> None:
    """A node of the robot calls it with 2 and 3."""
    fields = {"cdr": world.cdr(REQUEST, a=2, b=3)} | more
    world.channel.message(link.CallService(id=id, service="/add", type=ADD, **fields))


def responses(world: World) -> list[link.ServiceResponse]:
    """What the robot was answered."""
    return world.link.take(link.ServiceResponse)


def test_a_call_from_the_graph_is_answered_by_the_client(world: World) -> None:
    """CDR there, JSON here; the service as the client writes it; an id of the relay's own."""
    person = offering(world)
    graph_calls(world, "s1")
    (call,) = person.hears("call_service")
    id = call.pop("id")
    assert call == {"op": "call_service", "service": "add", "args": {"a": 2, "b": 3}}
    assert id != "s1"
    person.says("service_response", service="add", id=id, values={"sum": 5}, result=True)
    (response,) = responses(world)
    assert (response.id, response.result, response.reason) == ("s1", True, "")
    assert world.fields(RESPONSE, response.cdr) == {"sum": 5}


@pytest.mark.parametrize("values", [{"values": {}}, {}, {"values": None}])
def test_missing_fields_get_their_defaults(world: World, values: dict[str, Any]) -> None:
    """``result`` is true unless it is said otherwise."""
    person = offering(world)
    graph_calls(world)
    (call,) = person.hears("call_service")
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
def test_a_client_that_says_no(world: World, said: dict[str, Any], reason: str) -> None:
    """Its words go to the robot, not without end."""
    person = offering(world)
    graph_calls(world)
    (call,) = person.hears("call_service")
    person.says("service_response", service="add", id=call["id"], result=False, **said)
    (response,) = responses(world)
    assert (response.result, response.reason) == (False, reason)


@pytest.mark.parametrize("values", [{"sum": "five"}, {"total": 5}, "5", {"sum": 2**70}, [1, 2], 7])
def test_a_client_that_answers_nonsense_is_told_and_so_is_the_robot(world: World, values: Any) -> None:
    """The call is over with that."""
    person = offering(world)
    graph_calls(world)
    (call,) = person.hears("call_service")
    person.says("service_response", service="add", id=call["id"], values=values)
    (response,) = responses(world)
    assert not response.result
    assert response.reason.startswith("the client that offers /add gave an unfit answer: ")
    (status,) = person.hears("status")
    assert status["id"] == call["id"]
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert not responses(world)
    assert "you were asked nothing" in person.hears("status")[0]["msg"]


def test_only_the_client_that_was_asked_may_answer(world: World) -> None:
    """Neither others on this robot, nor on another, nor under ids nobody was asked; the call goes on."""
    person, other, elsewhere = offering(world), world.person(), World()
    stranger = offering(elsewhere)
    other.says("set_level", level="error")
    other.says("advertise_service", service="/other", type=ADD)
    graph_calls(world)
    (call,) = person.hears("call_service")
    for wrong in (other, stranger):
        wrong.says("service_response", service="add", id=call["id"], values={"sum": 6})
        (status,) = wrong.hears("status")
        assert status["msg"] == f"you were asked nothing under the id '{call['id']}', or it is over"
    for id in ("1", 1, None, "x" * 500):
        person.says("service_response", service="add", id=id, values={"sum": 6})
    assert len(person.hears("status")) == 4
    # An answer to a goal is none to a call.
    person.says("action_result", action="add", id=call["id"], values={"sum": 6})
    assert "you were asked nothing" in person.hears("status")[0]["msg"]
    assert not responses(world)
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert world.fields(RESPONSE, responses(world)[0].cdr) == {"sum": 5}


def test_a_client_that_leaves_lets_nobody_wait(world: World) -> None:
    """Unadvertised, gone, or without the right: each call waiting is answered at once."""

    def unadvertises(person: Person) -> None:
        person.says("unadvertise_service", service="/add")

    def leaves(person: Person) -> None:
        person.session.end()

    def is_denied(person: Person) -> None:
        person.session.permit.rules = Rules([Grant(Level.VIEWER)])
        person.session.permit.on_change()

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
        assert not fresh.channel.served._graph_calls


@pytest.mark.parametrize(("timeout", "seconds"), [(0.0, 30), (2.5, 2.5)])
def test_a_call_is_given_up_after_its_time(world: World, timeout: float, seconds: float) -> None:
    """Thirty seconds when the robot names none; what comes later is nobody's, and no fault."""
    person = offering(world)
    graph_calls(world, timeout=timeout)
    world.wait(seconds - 0.1, person)
    assert not responses(world)
    world.wait(0.2, person)
    (response,) = responses(world)
    assert response.reason == f"the client that offers /add did not answer within {seconds:g} s"
    (call,) = person.hears("call_service")
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert not responses(world)
    assert not person.hears("status")


def test_a_call_keeps_its_place_until_the_client_can_have_read_it(world: World) -> None:
    """Callers that give up fast are no way around the bound; nor is there a leak."""
    person = offering(world)
    for number in range(service_calls.WAITING):
        graph_calls(world, str(number), timeout=0.1)
    world.wait(1, person)
    assert len(responses(world)) == service_calls.WAITING
    graph_calls(world, "more")
    (response,) = responses(world)
    assert response.reason == "256 calls and goals wait for the client that offers /add"
    assert len(person.hears("call_service")) == service_calls.WAITING
    world.wait(service_calls.PLACE_SECONDS, person)
    graph_calls(world, "later")
    assert len(person.hears("call_service")) == 1


def test_what_waits_for_one_client_is_bounded_in_bytes(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Others' calls must not cut a client that reads slowly."""
    person = offering(world)
    monkeypatch.setattr(service_calls, "WAITING_BYTES", 30)
    graph_calls(world, "a")
    graph_calls(world, "b")
    graph_calls(world, "c")
    (response,) = responses(world)
    assert response.id == "c"
    assert "too large for the client that offers /add" in response.reason
    for call in person.hears("call_service"):
        person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    graph_calls(world, "d")
    assert len(person.hears("call_service")) == 1


def test_calls_that_wait_for_the_type_are_bounded_and_kept_in_order(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that calls before it has told the type."""
    monkeypatch.setattr(service_calls, "GRAPH_CALLS", 3)
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
    assert [call["args"]["a"] for call in person.hears("call_service")] == [97, 98, 99]


def test_a_robot_without_the_type_is_answered_in_words(world: World) -> None:
    """Nothing reaches the client."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("advertise_service", service="/add", type=ADD)
    world.channel.message(link.CallService(id="a", service="/add", type=ADD, cdr="AAEAAA=="))
    world.channel.message(link.Failed(what="get_type", ref=ADD, reason="not installed"))
    (response,) = responses(world)
    assert (response.id, response.result) == ("a", False)
    assert "not installed" in response.reason
    assert not person.hears("call_service")


@pytest.mark.parametrize("cdr", ["no base64!", "AAEAAA==", "", None])
def test_a_request_nobody_can_read_is_answered_in_words(world: World, cdr: str | None) -> None:
    """It is not handed to the client; without any body it is a request of defaults."""
    person = offering(world)
    graph_calls(world, cdr=cdr)
    if cdr is None:
        assert person.hears("call_service")[0]["args"] == {"a": 0, "b": 0}
    else:
        assert not responses(world)[0].result
        assert not person.hears("call_service")


def test_a_call_of_what_nobody_offers_is_answered(world: World) -> None:
    """A service taken back while the call was on its way, say."""
    person = offering(world)
    person.says("unadvertise_service", service="/add")
    graph_calls(world)
    assert responses(world)[0].reason == "no client offers the service /add"


def test_a_robot_that_is_lost_gets_no_answer_on_its_next_link(world: World) -> None:
    """Its ids begin anew there; the client's answer is passed over."""
    person = offering(world)
    graph_calls(world, "s1")
    (call,) = person.hears("call_service")
    world.robot_goes()
    world.robot_comes()
    world.robot_joins()
    world.define()
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert not responses(world)
    assert not person.hears("status")
    graph_calls(world, "s1")
    (call,) = person.hears("call_service")
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert [each.id for each in responses(world)] == ["s1"]


def test_a_robot_of_json_calls_with_json(world: World) -> None:
    """Arguments and values are written anew, not passed on unread."""
    person = offering(world, ("json",))
    for raw, result in ((b'{ "a": 1 }', True), (b"{nonsense", False)):
        world.channel.message(link.CallService(id="a", service="/add", type=ADD, args=msgspec.Raw(raw)))
        for call in person.hears("call_service"):
            assert call["args"] == {"a": 1}
            person.says("service_response", service="add", id=call["id"], values={"sum": 5})
        (response,) = responses(world)
        assert response.result is result
        if result:
            assert response.cdr is None
            assert json.loads(bytes(response.values)) == {"sum": 5}  # type: ignore[arg-type]


# --- clients that call clients ----------------------------------------------------------------------------


def test_a_client_calls_another_without_the_robot(world: World) -> None:
    """Lists and defaults are made an object first; the answer is completed as well."""
    person, caller = offering(world), world.person()
    for args, seen in (([2, 3], {"a": 2, "b": 3}), ({"b": 3}, {"a": 0, "b": 3}), (None, {"a": 0, "b": 0})):
        caller.says("call_service", service="add", id=7, args=args)
        (call,) = person.hears("call_service")
        assert call["args"] == seen
        assert call["id"] != 7
        person.says("service_response", service="add", id=call["id"], values={})
        (answer,) = caller.hears("service_response")
        assert answer == {
            "op": "service_response", "service": "add", "id": 7, "result": True, "values": {"sum": 0}
        }  # fmt: skip
    assert not world.link.all(link.CallService)


def test_a_client_may_call_itself(world: World) -> None:
    """Nothing waits for it meanwhile."""
    person = offering(world)
    person.says("call_service", service="/add", id="mine", args={"a": 1})
    call, *_ = (json.loads(each) for each in person.client.sent)
    person.says("service_response", service="add", id=call["id"], values={"sum": 1})
    assert person.hears("service_response")[0]["values"] == {"sum": 1}


def test_failures_of_calls_between_clients_come_back_in_words(world: World) -> None:
    """Arguments that do not fit, a no, nonsense, silence, and a client that leaves."""
    person, caller = offering(world), world.person()

    def call(**more: Any) -> str:
        caller.says("call_service", service="/add", **more)
        asked = person.hears("call_service")
        return str(asked[0]["id"]) if asked else ""

    def reply() -> Any:
        (answer,) = caller.hears("service_response")
        assert answer["result"] is False
        return answer["values"]

    assert not call(args={"c": 1})
    assert "c" in reply()
    person.says("service_response", service="add", id=call(), result=False, values="no more numbers")
    assert reply() == "no more numbers"
    person.says("service_response", service="add", id=call(), values={"sum": []})
    assert "gave an unfit answer" in reply()
    call(timeout=2)
    world.clock.advance(2)
    assert reply() == "the client that offers /add did not answer within 2 s"
    call()
    person.session.end()
    assert reply() == "the client that offered /add has left"
    caller.says("call_service", service="/add")
    assert reply() == "service /add does not exist on robot rover"


def test_a_call_between_clients_outlives_the_robots_link(world: World) -> None:
    """Nothing of it is on the robot; a new one needs the robot to be there."""
    person, caller = offering(world), world.person()
    caller.says("call_service", service="/add")
    world.channel.link_lost(world.link)
    (call,) = person.hears("call_service")
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert caller.hears("service_response")[0]["values"] == {"sum": 5}
    world.robot_goes()
    caller.says("call_service", service="/add")
    assert caller.hears("service_response")[0]["values"] == "robot rover is offline"


def test_calling_a_client_is_judged_like_any_call(world: World) -> None:
    """By the name of the service."""
    person, viewer = offering(world), world.person(Level.VIEWER)
    denied = world.person(Level.OWNER, deny=("call:/add",))
    for each in (viewer, denied):
        each.says("call_service", service="add")
        assert each.hears("service_response")[0]["result"] is False
    assert not person.hears("call_service")


def test_a_caller_that_leaves_frees_what_it_may(world: World) -> None:
    """The answer is passed over; nobody fills a client's places by coming and going."""
    person = offering(world)
    for _ in range(2):
        caller = world.person()
        for number in range(200):
            caller.says("call_service", service="/add", id=number, timeout=3600)
        caller.session.end()
    calls = person.hears("call_service")
    assert len(calls) == service_calls.WAITING
    for call in calls:
        person.says("service_response", service="add", id=call["id"], values={})
    assert not person.hears("status")
    assert not world.channel.served._errands._of


def test_what_the_robot_offers_after_all_is_called_there(world: World) -> None:
    """An offer the robot could not make good does not hide the robot's own service."""
    person, caller = offering(world), world.person()
    world.robot_goes()
    world.robot_comes()
    world.robot_joins()
    world.define()
    world.robot.graph.services["/add"] = link.Service(types=[ADD], providers=["/adder"])
    world.channel.message(link.Failed(what="advertise_service", ref="/add", reason="it is taken"))
    caller.says("call_service", service="/add")
    assert len(world.link.all(link.CallService)) == 1
    assert not person.hears("call_service")


def test_answers_too_large_for_a_robot_are_refused(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot would have to cut the link of everybody."""
    person = offering(world)
    graph_calls(world)
    monkeypatch.setattr("relay_server.channels.payloads.LARGEST", 3)
    (call,) = person.hears("call_service")
    person.says("service_response", service="add", id=call["id"], values={"sum": 5})
    assert "a robot takes at most 3" in responses(world)[0].reason


def test_a_fault_of_the_relay_is_answered_too(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody waits for ever on a defect."""
    offering(world)

    def broken(*_: object) -> bytes:
        raise RuntimeError("defect")

    monkeypatch.setattr(PayloadCodec, "from_robot", broken)
    monkeypatch.setattr(service_calls.ClientServiceCalls.log, "failure", lambda *_, **__: None)
    graph_calls(world)
    assert responses(world)[0].reason == "the relay failed on this call; its log tells more"
