"""Goals of one client that another client executes, without the robot."""

from __future__ import annotations

from relay_protocol import link
from tests.worlds.goal_peers import offering, send
from tests.worlds.relay import World


def test_a_client_executes_a_goal_of_another_without_the_robot(world: World) -> None:
    """Arguments are completed first; feedback, cancelling and results work."""
    person, requester = offering(world), world.person()
    send(requester, 1, "/fib", args={}, feedback=True)
    (goal,) = person.received("send_action_goal")
    assert (goal["args"], goal["feedback"]) == ({"order": 0}, True)
    person.says("action_feedback", action="fib", id=goal["id"], values={"sequence": [0]})
    assert requester.received("action_feedback")[0]["values"] == {"sequence": [0]}
    requester.says("cancel_action_goal", action="/fib", id=1)
    assert [each["id"] for each in person.received("cancel_action_goal")] == [goal["id"]]
    person.says("action_result", action="fib", id=goal["id"], status=5, values={})
    assert requester.client.take() == [
        {"op": "action_result", "action": "/fib", "id": 1, "status": 5, "result": True, "values": {"sequence": []}}
    ]  # fmt: skip
    assert not world.link.all(link.SendActionGoal)


def test_failures_of_goals_between_clients_come_back_with_a_reason(world: World) -> None:
    """These are invalid arguments, an invalid result, and a client that leaves."""
    person, requester = offering(world), world.person()
    send(requester, 1, "/fib", args={"speed": 1})
    assert "speed" in requester.received("action_result")[0]["values"]
    send(requester, 2, "/fib")
    (goal,) = person.received("send_action_goal")
    person.says("action_result", action="fib", id=goal["id"], values={"sequence": 7})
    assert "gave a wrong result" in requester.received("action_result")[0]["values"]
    send(requester, 3, "/fib")
    person.session.end()
    (end,) = requester.received("action_result")
    assert (end["status"], end["values"]) == (6, "the client that offered /fib has left")


def test_an_asker_that_leaves_cancels_its_goals_with_the_client(world: World) -> None:
    """Cancelling is sent once, and the result is ignored."""
    person, requester = offering(world), world.person()
    send(requester, 1, "/fib")
    (goal,) = person.received("send_action_goal")
    requester.session.end()
    assert len(person.received("cancel_action_goal")) == 1
    person.says("action_result", action="fib", id=goal["id"], status=5)
    assert not person.received("status")
    assert not world.channel.goals._pending._by_client


def test_a_goal_between_clients_outlives_the_robots_link(world: World) -> None:
    """The robot takes no part in it."""
    person, requester = offering(world), world.person()
    send(requester, 1, "/fib")
    (goal,) = person.received("send_action_goal")
    world.channel.link_lost(world.link)
    assert not person.received("cancel_action_goal")
    person.says("action_result", action="fib", id=goal["id"], values={})
    assert requester.received("action_result")[0]["result"] is True
