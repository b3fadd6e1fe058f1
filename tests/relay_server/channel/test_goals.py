"""Goals: whoever asks for one is told of its end exactly once, whoever pursues it."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.channel import errands
from relay_server.channel import goals as module
from relay_server.channel.bodies import Bodies
from tests.relay_server.memory import FIBONACCI, Person, World

GOAL, RESULT, FEEDBACK = (f"{FIBONACCI}_{part}" for part in ("Goal", "Result", "Feedback"))
FAILS = "the client that offers /fib could not do it"


def with_action(world: World, encodings: tuple[str, ...] = ("cdr", "json")) -> Person:
    """A robot that counts, and an operator who wants to hear errors."""
    world.robot_comes(encodings=encodings)
    person = world.person()
    world.robot_joins()
    world.robot.graph.actions["/count"] = link.Service(types=[FIBONACCI], providers=["/counter"])
    person.says("set_level", level="error")
    if "cdr" in encodings:
        person.says("send_action_goal", action="/count", id="first", args={"order": 1})
        world.define()
        finish(world, sequence=[0])
        person.client.take()
    return person


def finish(world: World, status: int = 4, **result: Any) -> None:
    """The robot is done with what it was sent."""
    for goal in world.link.take(link.SendActionGoal):
        body = world.cdr(RESULT, **result)
        world.channel.message(link.ActionResult(id=goal.id, status=status, result=True, cdr=body))


def send(person: Person, id: Any = "g", action: str = "/count", **more: Any) -> None:
    """The client sends a goal."""
    person.says("send_action_goal", action=action, id=id, **{"args": {"order": 3}, **more})


def offering(world: World, encodings: tuple[str, ...] = ("cdr", "json")) -> Person:
    """A client that offers ``/fib``."""
    person = with_action(world, encodings)
    person.says("advertise_action", action="fib", type="example_interfaces/Fibonacci")
    world.channel.message(link.AdvertisedAction(action="/fib", type=FIBONACCI))
    return person


def graph_sends(world: World, id: str = "1", **more: Any) -> None:
    """A node of the robot sends a goal."""
    fields = {"cdr": world.cdr(GOAL, order=3), "feedback": True} | more
    world.channel.message(link.SendActionGoal(id=id, action="/fib", type=FIBONACCI, **fields))


def results(world: World) -> list[link.ActionResult]:
    """What the robot was told of ends."""
    return world.link.take(link.ActionResult)


# --- the robot pursues ------------------------------------------------------------------------------------


def test_a_goal_goes_to_the_robot_and_its_result_comes_back(world: World) -> None:
    """CDR there, JSON here, under the client's own id."""
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
    """An action the mirror does not know yet can be tried with its type; without one it does not exist."""
    person = with_action(world)
    send(person, action="/new")
    (end,) = person.hears("action_result")
    assert (end["status"], end["result"]) == (0, False)
    assert end["values"] == "action /new does not exist on robot rover"
    send(person, action="/new", action_type="example_interfaces/Fibonacci")
    assert world.link.all(link.SendActionGoal)[0].type == FIBONACCI


def test_feedback_comes_only_to_those_who_asked(world: World) -> None:
    """And what can't be read is left out."""
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
    told = [each for each in person.client.take() if each["op"] != "status"]
    assert told == [
        {"op": "action_feedback", "action": "/count", "id": "with", "values": {"sequence": [0, 1]}}
    ]
    finish(world)
    assert len(person.hears("action_result")) == 2
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
def test_failures_are_told_in_words(world: World, said: dict[str, Any], status: int, values: str) -> None:
    """Rejected, aborted, without a reason, or with a result nobody can read."""
    person = with_action(world)
    send(person)
    (goal,) = world.link.all(link.SendActionGoal)
    world.channel.message(link.ActionResult(id=goal.id, **said))
    (end,) = person.hears("action_result")
    assert (end["status"], end["result"]) == (status, False)
    assert values in end["values"]
    world.channel.message(link.ActionResult(id=goal.id, **said))
    assert not person.client.take()


def test_an_aborted_goal_may_have_a_result(world: World) -> None:
    """Its status says how it ended."""
    person = with_action(world)
    send(person)
    finish(world, status=6, sequence=[0])
    (end,) = person.hears("action_result")
    assert (end["status"], end["result"], end["values"]) == (6, True, {"sequence": [0]})


def test_a_goal_the_robot_can_not_take_never_began(world: World) -> None:
    """``failed`` ends it as well."""
    person = with_action(world)
    send(person)
    (goal,) = world.link.all(link.SendActionGoal)
    world.channel.message(link.Failed(what="send_action_goal", ref=goal.id, reason="too many goals"))
    world.channel.message(link.Failed(what="send_action_goal", ref="99", reason="too many goals"))
    (end,) = person.hears("action_result")
    assert (end["status"], end["values"]) == (0, "too many goals")


def test_a_goal_is_cancelled_by_the_clients_id(world: World) -> None:
    """The robot is asked once; the result still comes."""
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
    (end,) = person.hears("action_result")
    assert (end["id"], end["status"]) == ("b", 5)


def test_a_goal_cancelled_before_it_began_never_reaches_the_robot(world: World) -> None:
    """While its type is fetched, say."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    send(person, action_type=FIBONACCI)
    person.says("cancel_action_goal", action="/count", id="g")
    (end,) = person.hears("action_result")
    assert (end["status"], end["result"]) == (5, False)
    assert end["values"] == "the goal was cancelled before it began"
    world.define()
    assert not world.link.all(link.SendActionGoal)
    assert not person.client.take()


def test_a_lost_robot_ends_its_goals(world: World) -> None:
    """At once, in words; and a goal for a robot that is away is refused."""
    person = with_action(world)
    send(person, "a")
    world.robot_goes()
    send(person, "b")
    first, second = person.hears("action_result")
    assert (first["status"], first["values"]) == (6, "robot rover lost its connection during the goal")
    assert (second["status"], second["values"]) == (0, "robot rover is offline")
    world.robot_comes()
    world.robot_joins()
    assert not world.link.all(link.SendActionGoal)


def test_a_goal_waits_while_the_channel_opens(world: World) -> None:
    """And ends in words when it does not."""
    world.robot_comes()
    person = world.person()
    send(person, "early", action_type=FIBONACCI)
    world.robot_joins()
    world.define()
    assert len(world.link.all(link.SendActionGoal)) == 1
    world.channel.link_lost(world.link)
    person.hears("action_result")
    send(person, "late", action_type=FIBONACCI)
    world.wait(31, person)
    (end,) = person.hears("action_result")
    assert end["values"] == "robot rover did not answer within 30 s"


def test_goals_have_no_timeout_of_their_own(world: World) -> None:
    """A walk may take an hour."""
    person = with_action(world)
    send(person)
    world.wait(3700, person)
    assert not person.hears("action_result")
    finish(world)
    assert len(person.hears("action_result")) == 1


def test_goals_of_a_client_that_leaves_are_cancelled(world: World) -> None:
    """Nobody hears of their ends; their places are free."""
    person, other = with_action(world), world.person()
    send(person, "a")
    send(other, "b")
    a, _ = world.link.all(link.SendActionGoal)
    person.session.end()
    assert world.link.all(link.CancelActionGoal) == [link.CancelActionGoal(id=a.id)]
    finish(world)
    assert [end["id"] for end in other.hears("action_result")] == ["b"]
    assert not world.channel.goals._at_robot


def test_goals_on_one_robot_are_bounded(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """All clients together."""
    monkeypatch.setattr(module, "ROBOT_GOALS", 2)
    person = with_action(world)
    for id in "abc":
        send(person, id)
    (end,) = person.hears("action_result")
    assert (end["id"], end["values"]) == ("c", "2 goals are under way on this robot already")


def test_a_robot_of_json_gets_and_gives_json(world: World) -> None:
    """Args, feedback and result."""
    person = with_action(world, ("json",))
    send(person, feedback=True)
    (goal,) = world.link.all(link.SendActionGoal)
    assert (goal.cdr, bytes(goal.args)) == (None, b'{"order":3}')  # type: ignore[arg-type]
    values = msgspec.Raw(b'{ "sequence": [1] }')
    world.channel.message(link.ActionFeedback(id=goal.id, values=values))
    world.channel.message(link.ActionResult(id=goal.id, status=4, result=True, values=values))
    assert [each["values"] for each in person.client.take()] == [{"sequence": [1]}] * 2


# --- a client pursues what the graph asks for -------------------------------------------------------------


def test_a_goal_of_the_graph_is_pursued_by_the_client(world: World) -> None:
    """Goal, feedback and result, under an id of the relay's own."""
    person = offering(world)
    graph_sends(world, "g1")
    (goal,) = person.hears("send_action_goal")
    id = goal.pop("id")
    assert id != "g1"
    assert goal == {
        "op": "send_action_goal", "action": "fib", "action_type": FIBONACCI, "args": {"order": 3}, "feedback": True
    }  # fmt: skip
    person.says("action_feedback", action="fib", id=id, values={"sequence": [0]})
    person.says("action_feedback", action="fib", id=id, values={"sequence": [0, 1]})
    told = world.link.take(link.ActionFeedback)
    assert [each.id for each in told] == ["g1", "g1"]
    assert world.fields(FEEDBACK, told[1].cdr) == {"sequence": [0, 1]}
    person.says("action_result", action="fib", id=id, values={"sequence": [0, 1, 1]}, result=True)
    (end,) = results(world)
    assert (end.id, end.status, end.result, end.reason) == ("g1", 4, True, "")
    assert world.fields(RESULT, end.cdr) == {"sequence": [0, 1, 1]}
    assert not person.hears("status")


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
    """By status where it names one; nobody has succeeded without a result."""
    person = offering(world)
    graph_sends(world)
    (goal,) = person.hears("send_action_goal")
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
def test_a_client_that_ends_a_goal_in_nonsense_is_told(world: World, said: dict[str, Any]) -> None:
    """The goal is aborted."""
    person = offering(world)
    graph_sends(world)
    (goal,) = person.hears("send_action_goal")
    person.says("action_result", action="fib", id=goal["id"], **said)
    (end,) = results(world)
    assert (end.status, end.result) == (6, False)
    assert end.reason.startswith("the client that offers /fib gave an unfit result: ")
    (status,) = person.hears("status")
    assert status["id"] == goal["id"]


def test_feedback_that_does_not_fit_is_refused_and_the_goal_goes_on(world: World) -> None:
    """The client is told."""
    person = offering(world)
    graph_sends(world)
    (goal,) = person.hears("send_action_goal")
    person.says("action_feedback", action="fib", id=goal["id"], values={"sum": 1})
    assert "sum" in person.hears("status")[0]["msg"]
    assert not world.link.all(link.ActionFeedback)
    person.says("action_result", action="fib", id=goal["id"])
    assert results(world)[0].result


def test_only_the_client_that_was_asked_pursues_a_goal(world: World) -> None:
    """Feedback and results of others, and under unknown ids, are refused; the goal goes on."""
    person, other = offering(world), world.person()
    elsewhere = World()
    stranger = offering(elsewhere)
    other.says("set_level", level="error")
    graph_sends(world)
    (goal,) = person.hears("send_action_goal")
    for wrong in (other, stranger):
        for op in ("action_feedback", "action_result"):
            wrong.says(op, action="fib", id=goal["id"], values={"sequence": [6]})
            assert "you were asked nothing" in wrong.hears("status")[0]["msg"]
    for id in ("1", None):
        person.says("action_result", action="fib", id=id)
    person.says("service_response", service="fib", id=goal["id"])
    assert len(person.hears("status")) == 3
    assert not results(world)
    assert not world.link.all(link.ActionFeedback)
    person.says("action_result", action="fib", id=goal["id"])
    assert len(results(world)) == 1


def test_the_graph_cancels_a_goal(world: World) -> None:
    """The client is asked once, and its result goes back."""
    person = offering(world)
    graph_sends(world, "g1")
    (goal,) = person.hears("send_action_goal")
    for id in ("g1", "g1", "unknown"):
        world.channel.message(link.CancelActionGoal(id=id))
    assert person.hears("cancel_action_goal") == [
        {"op": "cancel_action_goal", "action": "fib", "id": goal["id"]}
    ]
    person.says("action_result", action="fib", id=goal["id"], status=5, values={"sequence": [0]})
    (end,) = results(world)
    assert (end.id, end.status, end.result) == ("g1", 5, True)
    world.channel.message(link.CancelActionGoal(id="g1"))
    assert not person.hears("cancel_action_goal")


def test_a_client_that_leaves_lets_no_goal_wait(world: World) -> None:
    """Unadvertised, without the right, or gone."""

    def unadvertises(person: Person) -> None:
        person.says("unadvertise_action", action="/fib")

    def is_denied(person: Person) -> None:
        person.session.permit.rules = Rules([Grant(Level.OPERATOR, (), ("provide:*",))])
        person.session.permit.on_change()

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
    """The client's result is passed over, and never goes to the next link."""
    person = offering(world)
    graph_sends(world, "g1")
    (goal,) = person.hears("send_action_goal")
    world.robot_goes()
    assert [each["id"] for each in person.hears("cancel_action_goal")] == [goal["id"]]
    world.robot_comes()
    world.robot_joins()
    world.define()
    person.says("action_feedback", action="fib", id=goal["id"], values={})
    person.says("action_result", action="fib", id=goal["id"], status=5, values={})
    assert not results(world)
    assert not world.link.all(link.ActionFeedback)
    assert not person.hears("status")


def test_a_goal_nobody_wants_any_more_keeps_its_place_for_a_while(world: World) -> None:
    """As calls do; a client that never ends its goals is no leak."""
    person = offering(world)
    graph_sends(world)
    world.robot_goes()
    assert world.channel.goals._errands._of
    world.wait(errands.PLACE_SECONDS + 1, person)
    assert not world.channel.goals._errands._of


def test_a_client_that_reads_slowly_is_not_cut_for_what_others_ask(world: World) -> None:
    """Nor by those who ask and give up in a hurry."""
    person = offering(world)
    person.session.pause()
    for round in range(3):
        for number in range(300):
            graph_sends(world, f"{round}-{number}")
            world.channel.message(link.CancelActionGoal(id=f"{round}-{number}"))
        world.channel.link_lost(world.link)
        world.clock.advance(0.5)
        world.robot_joins()
    assert person.client.closed is None
    person.session.resume()
    told = person.client.take()
    assert sum(each["op"] == "send_action_goal" for each in told) == errands.WAITING
    assert sum(each["op"] == "cancel_action_goal" for each in told) == errands.WAITING


def test_goals_that_can_not_be_served_are_ended(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not offered, unreadable, an id in use, too many, a defect."""
    person = offering(world)
    world.channel.message(link.SendActionGoal(id="a", action="/other", type=FIBONACCI, cdr="AAEAAA=="))
    graph_sends(world, "b", cdr="no base64!")
    graph_sends(world, "c")
    graph_sends(world, "c")
    assert [(end.id, end.status) for end in results(world)] == [("a", 0), ("b", 0), ("c", 0)]
    monkeypatch.setattr(errands, "WAITING", 1)
    graph_sends(world, "d")
    assert results(world)[0].reason == "1 calls and goals wait for the client that offers /fib"
    monkeypatch.setattr(module, "ROBOT_GOALS", 1)
    graph_sends(world, "e")
    assert "too many goals" in results(world)[0].reason
    assert len(person.hears("send_action_goal")) == 1
    monkeypatch.setattr(module, "ROBOT_GOALS", 9)

    def broken(*_: object) -> bytes:
        raise RuntimeError("defect")

    monkeypatch.setattr(Bodies, "from_robot", broken)
    monkeypatch.setattr(module.Goals.log, "failure", lambda *_, **__: None)
    graph_sends(world, "f")
    assert results(world)[0].reason == "the relay failed on this goal of /fib; its log tells more"


def test_a_goal_of_the_graph_cancelled_while_its_type_is_fetched(world: World) -> None:
    """It never reaches the client."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("advertise_action", action="/fib", type=FIBONACCI)
    message = link.SendActionGoal(id="a", action="/fib", type=FIBONACCI, cdr="AAEAAAMAAAA=")
    world.channel.message(message)
    world.channel.message(link.CancelActionGoal(id="a"))
    assert results(world)[0].status == 5
    world.define()
    assert not person.hears("send_action_goal")


# --- clients pursue what clients ask for ------------------------------------------------------------------


def test_a_client_pursues_a_goal_of_another_without_the_robot(world: World) -> None:
    """With feedback, cancelling and a result; arguments are completed first."""
    person, asker = offering(world), world.person()
    send(asker, 1, "/fib", args={}, feedback=True)
    (goal,) = person.hears("send_action_goal")
    assert (goal["args"], goal["feedback"]) == ({"order": 0}, True)
    person.says("action_feedback", action="fib", id=goal["id"], values={"sequence": [0]})
    assert asker.hears("action_feedback")[0]["values"] == {"sequence": [0]}
    asker.says("cancel_action_goal", action="/fib", id=1)
    assert [each["id"] for each in person.hears("cancel_action_goal")] == [goal["id"]]
    person.says("action_result", action="fib", id=goal["id"], status=5, values={})
    assert asker.client.take() == [
        {"op": "action_result", "action": "/fib", "id": 1, "status": 5, "result": True, "values": {"sequence": []}}
    ]  # fmt: skip
    assert not world.link.all(link.SendActionGoal)


def test_failures_of_goals_between_clients_come_back_in_words(world: World) -> None:
    """Arguments that do not fit, nonsense, and a client that leaves."""
    person, asker = offering(world), world.person()
    send(asker, 1, "/fib", args={"speed": 1})
    assert "speed" in asker.hears("action_result")[0]["values"]
    send(asker, 2, "/fib")
    (goal,) = person.hears("send_action_goal")
    person.says("action_result", action="fib", id=goal["id"], values={"sequence": 7})
    assert "gave an unfit result" in asker.hears("action_result")[0]["values"]
    send(asker, 3, "/fib")
    person.session.end()
    (end,) = asker.hears("action_result")
    assert (end["status"], end["values"]) == (6, "the client that offered /fib has left")


def test_an_asker_that_leaves_cancels_its_goals_with_the_client(world: World) -> None:
    """Once, and the result is passed over."""
    person, asker = offering(world), world.person()
    send(asker, 1, "/fib")
    (goal,) = person.hears("send_action_goal")
    asker.session.end()
    assert len(person.hears("cancel_action_goal")) == 1
    person.says("action_result", action="fib", id=goal["id"], status=5)
    assert not person.hears("status")
    assert not world.channel.goals._errands._of


def test_a_goal_between_clients_outlives_the_robots_link(world: World) -> None:
    """Nothing of it is on the robot."""
    person, asker = offering(world), world.person()
    send(asker, 1, "/fib")
    (goal,) = person.hears("send_action_goal")
    world.channel.link_lost(world.link)
    assert not person.hears("cancel_action_goal")
    person.says("action_result", action="fib", id=goal["id"], values={})
    assert asker.hears("action_result")[0]["result"] is True
