"""Goals of one client: rights, limits, and one ``action_result`` for each."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.errors import Refused
from relay_protocol.rights import Grant, Level, Rules
from relay_server.sessions import goals as module
from relay_server.sessions.rosbridge_port import RosbridgePort
from tests.worlds.relay import FIBONACCI, Person, World

RESULT, FEEDBACK = f"{FIBONACCI}_Result", f"{FIBONACCI}_Feedback"


def at_work(world: World, **rights: Any) -> Person:
    """A robot with an action that counts, and a client."""
    world.robot_comes()
    person = world.person(**rights)
    world.robot_joins()
    world.robot.graph.actions["/count"] = link.Service(types=[FIBONACCI], providers=["/counter"])
    counting = world.person()
    send(counting)
    world.define()
    finish(world)
    counting.session.end()
    return person


def send(person: Person, id: Any = "g", **more: Any) -> None:
    """The client sends a goal."""
    named = {} if id is None else {"id": id}
    person.says("send_action_goal", **{"action": "count", "args": {"order": 3}, **named, **more})


def finish(world: World) -> None:
    """The robot ends all its goals."""
    for goal in world.link.take(link.SendActionGoal):
        body = world.cdr(RESULT, sequence=[0, 1])
        world.channel.message(link.ActionResult(id=goal.id, status=4, result=True, cdr=body))


def ends(person: Person) -> list[dict[str, Any]]:
    """Received results."""
    return person.received("action_result")


@pytest.mark.parametrize(
    ("rights", "may"),
    [
        ({"level": Level.VIEWER}, False),
        ({"level": Level.OPERATOR}, True),
        ({"level": Level.OWNER, "deny": ("call:/count",)}, False),
        ({"level": Level.VIEWER, "allow": ("call:/count",)}, True),
    ],
)
def test_a_goal_is_judged_as_a_call_of_the_action(world: World, rights: dict[str, Any], may: bool) -> None:
    """A refused one is answered, even without statuses."""
    person = at_work(world, **rights)
    send(person)
    assert bool(world.link.all(link.SendActionGoal)) is may
    if not may:
        (end,) = person.client.take()
        assert (end["op"], end["id"], end["action"]) == ("action_result", "g", "count")
        assert (end["status"], end["result"]) == (0, False)
        assert "call on /count" in end["values"]
        assert person.context.refusals == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"action": "no name!"},
        {"action": "/nothing"},
        {"action_type": "no type"},
        {"args": {"speed": 1}},
        {"args": [1, 2]},
        {"args": "three"},
        {"args": {"order": 2**40}},
    ],
)
def test_invalid_request_is_refused_with_a_reason(world: World, wrong: dict[str, Any]) -> None:
    """By an ``action_result``, and by a ``status`` if requested; the robot receives nothing."""
    person = at_work(world)
    person.says("set_level", level="error")
    send(person, 7, **wrong)
    reported = person.client.take()
    assert sorted(each["op"] for each in reported) == ["action_result", "status"]
    assert all(each["id"] == 7 for each in reported)
    (end,) = (each for each in reported if each["op"] == "action_result")
    assert (end["status"], end["result"]) == (0, False)
    assert isinstance(end["values"], str)
    assert not world.link.all(link.SendActionGoal)


@pytest.mark.parametrize("wrong", [{"feedback": "yes"}, {"fragment_size": "big"}, {"action_type": 5}])
def test_a_field_of_a_wrong_type_ends_the_goal(world: World, wrong: dict[str, Any]) -> None:
    """The client gets a result, also without ``set_level``; the robot receives nothing."""
    person = at_work(world)
    send(person, 7, **wrong)
    (end,) = person.client.take()
    assert (end["op"], end["action"], end["id"]) == ("action_result", "count", 7)
    assert (end["status"], end["result"]) == (0, False)
    assert f"$.{next(iter(wrong))}" in end["values"]
    assert not world.link.all(link.SendActionGoal)


def test_an_id_in_use_is_refused(world: World) -> None:
    """The first goal continues; the id is free after its end; other clients have ids of their own."""
    person, other = at_work(world), world.person()
    send(person)
    send(person)
    (end,) = ends(person)
    assert (end["id"], end["result"]) == ("g", False)
    assert end["values"] == "a goal of yours with the id 'g' is under way already"
    send(other)
    assert len(world.link.all(link.SendActionGoal)) == 2
    finish(world)
    assert ends(person)[0]["result"] is True
    send(person)
    assert len(world.link.all(link.SendActionGoal)) == 1


def test_goals_need_no_id_but_cancelling_does(world: World) -> None:
    """A goal without an id is answered but cannot be cancelled."""
    person = at_work(world)
    person.says("set_level", level="error")
    send(person, None)
    send(person, None)
    person.says("cancel_action_goal", action="/count")
    person.says("cancel_action_goal", action="/count", id="unknown")
    assert person.reported() == [
        "'cancel_action_goal' needs the 'id' of the goal",
        "no goal of yours with the id 'unknown' is under way",
    ]
    assert not world.link.all(link.CancelActionGoal)
    finish(world)
    assert ["id" in each for each in ends(person)] == [False, False]


def test_no_client_cancels_the_goal_of_another(world: World) -> None:
    """Ids belong to a connection."""
    person, other = at_work(world), world.person()
    send(person)
    other.says("cancel_action_goal", action="/count", id="g")
    assert not world.link.all(link.CancelActionGoal)
    person.says("cancel_action_goal", action="/count", id="g")
    assert len(world.link.all(link.CancelActionGoal)) == 1


def test_goals_of_one_client_are_bounded(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """By number and by bytes; goals over the limit are answered, and do not reach the robot."""
    person = at_work(world)
    for number in range(500):
        send(person, number)
    assert len(world.link.all(link.SendActionGoal)) == module.GOALS
    refused = ends(person)
    assert len(refused) == 500 - module.GOALS
    assert refused[0]["values"] == "64 goals of this connection are under way already"
    finish(world)
    ends(person)
    monkeypatch.setattr(module, "GOAL_BYTES", 20)
    send(person, "a")
    send(person, "b")
    (end,) = ends(person)
    assert end["id"] == "b"
    assert "too large together" in end["values"]
    finish(world)
    send(person, "c")
    assert len(world.link.all(link.SendActionGoal)) == 1


def test_a_lost_right_cancels_goals_at_once(world: World) -> None:
    """On the robot and for the client, which gets one result."""
    person = at_work(world)
    send(person)
    send(person, "other", action="/walk", action_type=FIBONACCI)
    count, walk = world.link.all(link.SendActionGoal)
    person.context.permit.rules = Rules([Grant(Level.OPERATOR, (), ("call:/count",))])
    person.context.permit.on_change()
    assert world.link.all(link.CancelActionGoal) == [link.CancelActionGoal(id=count.id)]
    (end,) = ends(person)
    assert (end["id"], end["status"], end["result"]) == ("g", 5, False)
    assert "call on /count" in end["values"] or "denied" in end["values"]
    finish(world)
    assert [each["id"] for each in ends(person)] == ["other"]
    assert walk.action == "/walk"


def test_a_revoked_permit_cancels_goals(world: World) -> None:
    """The session is closed, and the robot is asked to cancel them."""
    person = at_work(world)
    send(person)
    person.context.permit.on_revoke(Refused("your right on this robot was revoked"))
    assert person.client.closed is not None
    assert len(world.link.all(link.CancelActionGoal)) == 1
    finish(world)


def test_a_slow_client_gets_the_newest_feedback_and_every_result(world: World) -> None:
    """No feedback follows the result, and none disconnects the client."""
    person = at_work(world)
    send(person, "a", feedback=True)
    send(person, "b", feedback=True)
    a, b = world.link.all(link.SendActionGoal)
    person.rosbridge.pause()
    for number in range(5000):
        for goal in (a, b):
            body = world.cdr(FEEDBACK, sequence=[number])
            world.channel.message(link.ActionFeedback(id=goal.id, cdr=body))
    body = world.cdr(RESULT, sequence=[1])
    world.channel.message(link.ActionResult(id=a.id, status=4, result=True, cdr=body))
    person.rosbridge.resume()
    assert person.client.closed is None
    assert [(each["op"], each["id"]) for each in person.client.take()] == [
        ("action_result", "a"),
        ("action_feedback", "b"),
    ]


def test_an_unknown_encoding_is_reported_and_the_answer_is_plain(world: World) -> None:
    """Once, for any number of answers."""
    person = at_work(world)
    person.says("set_level", level="error")
    send(person, compression="zip", feedback=True)
    (status,) = person.received("status")
    assert "compression 'zip'" in status["msg"]
    (goal,) = world.link.all(link.SendActionGoal)
    body = world.cdr(FEEDBACK, sequence=[1])
    world.channel.message(link.ActionFeedback(id=goal.id, cdr=body))
    finish(world)
    assert [each["op"] for each in person.client.take()] == ["action_feedback", "action_result"]


@pytest.mark.parametrize("refused", [False, True])
def test_answers_come_in_the_form_that_was_asked_for(
    world: World, monkeypatch: pytest.MonkeyPatch, refused: bool
) -> None:
    """Errors too, for calls and for goals."""
    person = at_work(world)
    forms = []
    monkeypatch.setattr(RosbridgePort, "_send", lambda self, message, form: forms.append(form))
    if not refused:
        world.robot.graph.services["/reset"] = link.Service(types=["std_srvs/srv/Trigger"])
    name = "no name!" if refused else "/count"
    send(person, action=name, compression="cbor", fragment_size=100)
    person.says("call_service", service="/rosapi/nodes" if not refused else name, fragment_size=200)
    finish(world)
    assert [(each.compression, each.fragment_size) for each in sorted(forms)] == [
        ("cbor", 100),
        ("none", 200),
    ]


def test_a_goal_with_an_invalid_type_takes_no_place(world: World) -> None:
    """Its id and its place stay free."""
    person = at_work(world)
    for _ in range(module.GOALS + 1):
        send(person, action_type="no type")
    ends(person)
    send(person)
    assert len(world.link.all(link.SendActionGoal)) == 1
