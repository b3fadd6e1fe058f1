"""Goals of a client that another client pursues, without the robot."""

from __future__ import annotations

from relay_protocol import link
from tests.relay_server.channel.goal_ends import offering, send
from tests.relay_server.memory import World


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
