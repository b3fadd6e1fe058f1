"""Goals of the robot's graph that a client executes: each ends exactly once."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.channels import goals as module
from relay_server.channels import service_calls
from relay_server.channels.encodings import PayloadCodec
from tests.worlds.goal_peers import FEEDBACK, RESULT, graph_sends, offering, results
from tests.worlds.relay import FIBONACCI, Person, World

FAILS = "the client that offers /fib could not do it"


@pytest.mark.parametrize("spelled", ["example_interfaces/Fibonacci", FIBONACCI])
def test_a_goal_of_the_graph_is_executed_by_the_client(world: World, spelled: str) -> None:
    """Goal, feedback and result have the relay's own id. Name and type have the client's latest spelling."""
    person = offering(world)
    person.says("advertise_action", action="fib", type=spelled)
    graph_sends(world, "g1")
    (goal,) = person.received("send_action_goal")
    id = goal.pop("id")
    assert id != "g1"
    assert goal == {
        "op": "send_action_goal", "action": "fib", "action_type": spelled, "args": {"order": 3}, "feedback": True
    }  # fmt: skip
    person.says("action_feedback", action="fib", id=id, values={"sequence": [0]})
    person.says("action_feedback", action="fib", id=id, values={"sequence": [0, 1]})
    reported = world.link.take(link.ActionFeedback)
    assert [each.id for each in reported] == ["g1", "g1"]
    assert world.fields(FEEDBACK, reported[1].cdr) == {"sequence": [0, 1]}
    person.says("action_result", action="fib", id=id, values={"sequence": [0, 1, 1]}, result=True)
    (end,) = results(world)
    assert (end.id, end.status, end.result, end.reason) == ("g1", 4, True, "")
    assert world.fields(RESULT, end.cdr) == {"sequence": [0, 1, 1]}
    assert not person.received("status")


@pytest.mark.parametrize(
    ("said", "status", "result", "reason"),
    [
        ({"values": {}}, 4, True, ""),
        ({"status": 4}, 4, True, ""),
        ({"status": 5, "values": {"sequence": [0]}}, 5, True, ""),
        ({"status": 6, "values": {}}, 6, True, ""),
        ({"result": False, "values": "stuck"}, 6, False, "stuck"),
        ({"result": False, "status": 5}, 5, False, FAILS),
        ({"result": False, "status": 0}, 0, False, FAILS),
        ({"result": False, "status": 4}, 6, False, FAILS),
    ],
)
def test_how_a_client_ends_a_goal(
    world: World, said: dict[str, Any], status: int, result: bool, reason: str
) -> None:
    """The status of the result counts; without a result no goal succeeds."""
    person = offering(world)
    graph_sends(world)
    (goal,) = person.received("send_action_goal")
    person.says("action_result", action="fib", id=goal["id"], **said)
    (end,) = results(world)
    assert (end.status, end.result, end.reason) == (status, result, reason)


@pytest.mark.parametrize(
    "said",
    [
        {"values": {"sum": 1}},
        {"values": "done"},
        {"status": 99},
        {"status": 0},
        {"values": {"sequence": ["x"]}},
    ],
)
def test_a_nonsensical_result_of_a_goal_is_reported_to_the_client(world: World, said: dict[str, Any]) -> None:
    """The goal is aborted."""
    person = offering(world)
    graph_sends(world)
    (goal,) = person.received("send_action_goal")
    person.says("action_result", action="fib", id=goal["id"], **said)
    (end,) = results(world)
    assert (end.status, end.result) == (6, False)
    assert end.reason.startswith("the client that offers /fib gave a wrong result: ")
    (status,) = person.received("status")
    assert status["id"] == goal["id"]


def test_feedback_that_does_not_fit_is_refused_and_the_goal_goes_on(world: World) -> None:
    """The client gets an error."""
    person = offering(world)
    graph_sends(world)
    (goal,) = person.received("send_action_goal")
    person.says("action_feedback", action="fib", id=goal["id"], values={"sum": 1})
    assert "sum" in person.received("status")[0]["msg"]
    assert not world.link.all(link.ActionFeedback)
    person.says("action_result", action="fib", id=goal["id"])
    assert results(world)[0].result


def test_only_the_client_that_was_asked_executes_a_goal(world: World) -> None:
    """Feedback and results of other clients or with unknown ids are refused; the goal goes on."""
    person, other = offering(world), world.person()
    elsewhere = World()
    stranger = offering(elsewhere)
    other.says("set_level", level="error")
    graph_sends(world)
    (goal,) = person.received("send_action_goal")
    for wrong in (other, stranger):
        for op in ("action_feedback", "action_result"):
            wrong.says(op, action="fib", id=goal["id"], values={"sequence": [6]})
            assert "no call or goal with the id" in wrong.received("status")[0]["msg"]
    for id in ("1", None):
        person.says("action_result", action="fib", id=id)
    person.says("service_response", service="fib", id=goal["id"])
    assert len(person.received("status")) == 3
    assert not results(world)
    assert not world.link.all(link.ActionFeedback)
    person.says("action_result", action="fib", id=goal["id"])
    assert len(results(world)) == 1


def test_the_graph_cancels_a_goal(world: World) -> None:
    """The client is asked once, and its result is returned."""
    person = offering(world)
    graph_sends(world, "g1")
    (goal,) = person.received("send_action_goal")
    for id in ("g1", "g1", "unknown"):
        world.channel.message(link.CancelActionGoal(id=id))
    assert person.received("cancel_action_goal") == [
        {"op": "cancel_action_goal", "action": "fib", "id": goal["id"]}
    ]
    person.says("action_result", action="fib", id=goal["id"], status=5, values={"sequence": [0]})
    (end,) = results(world)
    assert (end.id, end.status, end.result) == ("g1", 5, True)
    world.channel.message(link.CancelActionGoal(id="g1"))
    assert not person.received("cancel_action_goal")


def test_a_client_that_leaves_lets_no_goal_wait(world: World) -> None:
    """It unadvertises, loses the right, or disconnects."""

    def unadvertises(person: Person) -> None:
        person.says("unadvertise_action", action="/fib")

    def is_denied(person: Person) -> None:
        person.context.permit.rules = Rules([Grant(Level.OPERATOR, (), ("provide:*",))])
        person.context.permit.on_change()

    def leaves(person: Person) -> None:
        person.session.end()

    for way in (unadvertises, is_denied, leaves):
        fresh = World()
        person = offering(fresh)
        graph_sends(fresh, "a")
        graph_sends(fresh, "b")
        way(person)
        ends = results(fresh)
        assert [(end.id, end.status, end.result) for end in ends] == [("a", 6, False), ("b", 6, False)]
        assert "the client that offered /fib" in ends[0].reason
        assert len(fresh.link.all(link.UnadvertiseAction)) == 1


def test_a_lost_robot_cancels_what_its_graph_asked_for(world: World) -> None:
    """The client's result is ignored and never sent on the next link."""
    person = offering(world)
    graph_sends(world, "g1")
    (goal,) = person.received("send_action_goal")
    world.robot_goes()
    assert [each["id"] for each in person.received("cancel_action_goal")] == [goal["id"]]
    world.robot_comes()
    world.robot_joins()
    world.define()
    person.says("action_feedback", action="fib", id=goal["id"], values={})
    person.says("action_result", action="fib", id=goal["id"], status=5, values={})
    assert not results(world)
    assert not world.link.all(link.ActionFeedback)
    assert not person.received("status")


def test_a_goal_without_an_owner_keeps_its_place_for_a_while(world: World) -> None:
    """As for calls: a client that never ends its goals leaks no memory."""
    person = offering(world)
    graph_sends(world)
    world.robot_goes()
    assert world.channel.goals._pending._by_client
    world.wait(service_calls.ABANDONED_SECONDS + 1, person)
    assert not world.channel.goals._pending._by_client


def test_a_client_that_reads_slowly_is_not_cut_for_what_others_ask(world: World) -> None:
    """Not even if callers ask and give up quickly."""
    person = offering(world)
    person.rosbridge.pause()
    for round in range(3):
        for number in range(300):
            graph_sends(world, f"{round}-{number}")
            world.channel.message(link.CancelActionGoal(id=f"{round}-{number}"))
        world.channel.link_lost(world.link)
        world.clock.advance(0.5)
        world.robot_joins()
    assert person.client.closed is None
    person.rosbridge.resume()
    reported = person.client.take()
    assert sum(each["op"] == "send_action_goal" for each in reported) == service_calls.MAX_WAITING
    assert sum(each["op"] == "cancel_action_goal" for each in reported) == service_calls.MAX_WAITING


def test_goals_that_can_not_be_served_are_ended(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """These are: not offered, unreadable, id in use, too many, and a defect."""
    person = offering(world)
    world.channel.message(link.SendActionGoal(id="a", action="/other", type=FIBONACCI, cdr="AAEAAA=="))
    graph_sends(world, "b", cdr="no base64!")
    graph_sends(world, "c")
    graph_sends(world, "c")
    assert [(end.id, end.status) for end in results(world)] == [("a", 0), ("b", 0), ("c", 0)]
    monkeypatch.setattr(service_calls, "MAX_WAITING", 1)
    graph_sends(world, "d")
    assert results(world)[0].reason == "1 calls and goals wait for the client that offers /fib"
    monkeypatch.setattr(module, "ROBOT_GOALS", 1)
    graph_sends(world, "e")
    assert "too many goals" in results(world)[0].reason
    assert len(person.received("send_action_goal")) == 1
    monkeypatch.setattr(module, "ROBOT_GOALS", 9)

    def broken(*_: object) -> bytes:
        raise RuntimeError("defect")

    monkeypatch.setattr(PayloadCodec, "from_robot", broken)
    monkeypatch.setattr(module.ActionGoals.log, "failure", lambda *_, **__: None)
    graph_sends(world, "f")
    assert results(world)[0].reason == "the relay failed on this goal of /fib; see its log"


def test_a_goal_of_the_graph_cancelled_while_its_type_is_fetched(world: World) -> None:
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("advertise_action", action="/fib", type=FIBONACCI)
    message = link.SendActionGoal(id="a", action="/fib", type=FIBONACCI, cdr="AAEAAAMAAAA=")
    world.channel.message(message)
    world.channel.message(link.CancelActionGoal(id="a"))
    assert results(world)[0].status == 5
    world.define()
    assert not person.received("send_action_goal")
