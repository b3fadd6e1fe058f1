"""Goals that the robot executes: each client is notified of the end of its goal exactly once."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from relay_protocol import link
from relay_server.channels import goals as module
from tests.worlds.goal_peers import FEEDBACK, GOAL, RESULT, finish, send, with_action
from tests.worlds.relay import FIBONACCI, World


def test_a_goal_goes_to_the_robot_and_its_result_comes_back(world: World) -> None:
    """The robot speaks CDR and the client JSON. The client's id is kept."""
    person = with_action(world)
    send(person, 7)
    (goal,) = world.link.all(link.SendActionGoal)
    assert (goal.action, goal.type, goal.feedback) == ("/count", FIBONACCI, False)
    assert world.fields(GOAL, goal.cdr) == {"order": 3}
    finish(world, sequence=[0, 1, 1])
    assert person.client.take() == [
        {"op": "action_result", "action": "/count", "id": 7, "status": 4, "result": True,
         "values": {"sequence": [0, 1, 1]}}
    ]  # fmt: skip


@pytest.mark.parametrize("args", [[3], {"order": 3}, {"order": 3.0}])
def test_arguments_are_an_object_or_a_list(world: World, args: Any) -> None:
    """As for services."""
    person = with_action(world)
    send(person, args=args)
    assert world.fields(GOAL, world.link.all(link.SendActionGoal)[0].cdr) == {"order": 3}


def test_the_type_comes_from_the_graph_or_else_from_the_client(world: World) -> None:
    """An action that is not yet in the graph needs a type from the client."""
    person = with_action(world)
    send(person, action="/new")
    (end,) = person.received("action_result")
    assert (end["status"], end["result"]) == (0, False)
    assert end["values"] == "action /new does not exist on robot rover"
    send(person, action="/new", action_type="example_interfaces/Fibonacci")
    assert world.link.all(link.SendActionGoal)[0].type == FIBONACCI


def test_feedback_comes_only_to_clients_that_requested_it(world: World) -> None:
    """Unreadable feedback is left out."""
    person = with_action(world)
    send(person, "with", feedback=True)
    send(person, "without")
    first, second = world.link.all(link.SendActionGoal)
    assert (first.feedback, second.feedback) == (True, False)
    for goal in (first, second):
        body = world.cdr(FEEDBACK, sequence=[0, 1])
        world.channel.message(link.ActionFeedback(id=goal.id, cdr=body))
        world.channel.message(link.ActionFeedback(id=goal.id, cdr="AAEAAP////8="))
        world.channel.message(link.ActionFeedback(id=goal.id, cdr="no base64!"))
    world.channel.message(link.ActionFeedback(id="99", cdr=body))
    reported = [each for each in person.client.take() if each["op"] != "status"]
    assert reported == [
        {"op": "action_feedback", "action": "/count", "id": "with", "values": {"sequence": [0, 1]}}
    ]
    finish(world)
    assert len(person.received("action_result")) == 2
    world.channel.message(link.ActionFeedback(id=first.id, cdr=body))
    assert not person.client.take()


@pytest.mark.parametrize(
    ("said", "status", "values"),
    [
        ({"status": 6, "result": False, "reason": "it fell"}, 6, "it fell"),
        ({"status": 0, "result": False, "reason": "rejected"}, 0, "rejected"),
        ({"status": 5, "result": False}, 5, "action /count failed"),
        ({"status": 4, "result": False}, 6, "action /count failed"),
        ({"status": -9, "result": False, "reason": "odd"}, 6, "odd"),
        ({"status": 4, "result": True, "cdr": "AAEAAP////8="}, 6, "can't be read"),
        ({"status": 4, "result": True, "cdr": "no base64!"}, 6, "can't be read"),
    ],
)
def test_failures_are_reported_with_a_reason(
    world: World, said: dict[str, Any], status: int, values: str
) -> None:
    """These are rejected and aborted goals, with and without a reason, and unreadable results."""
    person = with_action(world)
    send(person)
    (goal,) = world.link.all(link.SendActionGoal)
    world.channel.message(link.ActionResult(id=goal.id, **said))
    (end,) = person.received("action_result")
    assert (end["status"], end["result"]) == (status, False)
    assert values in end["values"]
    world.channel.message(link.ActionResult(id=goal.id, **said))
    assert not person.client.take()


def test_an_aborted_goal_may_have_a_result(world: World) -> None:
    """The status says how it ended."""
    person = with_action(world)
    send(person)
    finish(world, status=6, sequence=[0])
    (end,) = person.received("action_result")
    assert (end["status"], end["result"], end["values"]) == (6, True, {"sequence": [0]})


def test_a_goal_the_robot_can_not_take_never_began(world: World) -> None:
    """``failed`` ends it as well."""
    person = with_action(world)
    send(person)
    (goal,) = world.link.all(link.SendActionGoal)
    world.channel.message(link.Failed(request="send_action_goal", reference=goal.id, reason="too many goals"))
    world.channel.message(link.Failed(request="send_action_goal", reference="99", reason="too many goals"))
    (end,) = person.received("action_result")
    assert (end["status"], end["values"]) == (0, "too many goals")


def test_a_goal_is_cancelled_by_the_clients_id(world: World) -> None:
    """The robot is asked once; the result still arrives."""
    person = with_action(world)
    send(person, "a")
    send(person, "b")
    _, b = world.link.all(link.SendActionGoal)
    person.says("cancel_action_goal", action="/count", id="b")
    person.says("cancel_action_goal", action="/count", id="b")
    assert world.link.all(link.CancelActionGoal) == [link.CancelActionGoal(id=b.id)]
    assert not person.client.take()
    body = world.cdr(RESULT, sequence=[0])
    world.channel.message(link.ActionResult(id=b.id, status=5, result=True, cdr=body))
    (end,) = person.received("action_result")
    assert (end["id"], end["status"]) == ("b", 5)


def test_a_goal_cancelled_before_it_began_never_reaches_the_robot(world: World) -> None:
    """For example while its type is fetched."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    send(person, action_type=FIBONACCI)
    person.says("cancel_action_goal", action="/count", id="g")
    (end,) = person.received("action_result")
    assert (end["status"], end["result"]) == (5, False)
    assert end["values"] == "the goal was cancelled before it began"
    world.define()
    assert not world.link.all(link.SendActionGoal)
    assert not person.client.take()


def test_a_lost_robot_ends_its_goals(world: World) -> None:
    """At once and with a reason. A goal for an offline robot is refused."""
    person = with_action(world)
    send(person, "a")
    world.robot_goes()
    send(person, "b")
    first, second = person.received("action_result")
    assert (first["status"], first["values"]) == (6, "robot rover lost its connection during the goal")
    assert (second["status"], second["values"]) == (0, "robot rover is offline")
    world.robot_comes()
    world.robot_joins()
    assert not world.link.all(link.SendActionGoal)


def test_a_goal_waits_while_the_channel_opens(world: World) -> None:
    """It fails with a reason if the channel does not open."""
    world.robot_comes()
    person = world.person()
    send(person, "early", action_type=FIBONACCI)
    world.robot_joins()
    world.define()
    assert len(world.link.all(link.SendActionGoal)) == 1
    world.channel.link_lost(world.link)
    person.received("action_result")
    send(person, "late", action_type=FIBONACCI)
    world.wait(31, person)
    (end,) = person.received("action_result")
    assert end["values"] == "robot rover did not answer within 30 s"


def test_goals_have_no_timeout_of_their_own(world: World) -> None:
    """Navigation may take an hour."""
    person = with_action(world)
    send(person)
    world.wait(3700, person)
    assert not person.received("action_result")
    finish(world)
    assert len(person.received("action_result")) == 1


def test_goals_of_a_client_that_leaves_are_cancelled(world: World) -> None:
    """No client receives their results; their places are free."""
    person, other = with_action(world), world.person()
    send(person, "a")
    send(other, "b")
    a, _ = world.link.all(link.SendActionGoal)
    person.session.end()
    assert world.link.all(link.CancelActionGoal) == [link.CancelActionGoal(id=a.id)]
    finish(world)
    assert [end["id"] for end in other.received("action_result")] == ["b"]
    assert not world.channel.goals._on_robot


def test_goals_on_one_robot_are_bounded(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit is for all clients together."""
    monkeypatch.setattr(module, "ROBOT_GOALS", 2)
    person = with_action(world)
    for id in "abc":
        send(person, id)
    (end,) = person.received("action_result")
    assert (end["id"], end["values"]) == ("c", "2 goals are under way on this robot already")


def test_a_robot_of_json_gets_and_gives_json(world: World) -> None:
    """This holds for arguments, feedback and results."""
    person = with_action(world, ("json",))
    send(person, feedback=True)
    (goal,) = world.link.all(link.SendActionGoal)
    assert (goal.cdr, bytes(goal.args)) == (None, b'{"order": 3}')  # type: ignore[arg-type]
    values = msgspec.Raw(b'{ "sequence": [1] }')
    world.channel.message(link.ActionFeedback(id=goal.id, values=values))
    world.channel.message(link.ActionResult(id=goal.id, status=4, result=True, values=values))
    assert [each["values"] for each in person.client.take()] == [{"sequence": [1]}] * 2
