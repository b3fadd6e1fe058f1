"""A robot's link without room for a request: the client gets an error, and no state is left."""

from __future__ import annotations

from relay_protocol import link
from relay_server.channels import goals, service_calls
from tests.relay_server.channels.test_client_service_calls import graph_calls, offering, responses
from tests.relay_server.channels.test_service_calls import answer, at_work
from tests.worlds import goal_peers
from tests.worlds.goal_peers import finish, graph_sends, results, with_action
from tests.worlds.relay import World


def test_a_call_is_refused_with_a_reason(world: World) -> None:
    """The next call passes when there is room again."""
    person = at_work(world)
    world.link.full = True
    for number in range(service_calls.MAX_CALLS + 1):
        person.says("call_service", service="/reset", id=number)
        (reply,) = person.received("service_response")
        assert (reply["id"], reply["result"], reply["values"]) == (number, False, "no room")
    world.link.full = False
    person.says("call_service", service="/reset", id="a")
    answer(world)
    assert person.received("service_response")[0]["result"] is True


def test_a_goal_is_refused_with_a_reason(world: World) -> None:
    """It no longer counts as active."""
    person = with_action(world)
    world.link.full = True
    for number in range(goals.ROBOT_GOALS + 1):
        goal_peers.send(person, number)
        (end,) = person.received("action_result")
        assert (end["id"], end["status"], end["values"]) == (number, 0, "no room")
    world.link.full = False
    goal_peers.send(person)
    finish(world, sequence=[0])
    assert person.received("action_result")[0]["result"] is True


def test_the_graph_gets_an_error_when_an_answer_has_no_room(world: World) -> None:
    """A caller must not wait for a lost answer."""
    person = offering(world)
    graph_calls(world, "s1")
    (call,) = person.received("call_service")
    world.link.full = True
    person.says("service_response", service="add", id=call["id"], values={"sum": 5}, result=True)
    (response,) = responses(world)
    assert (response.id, response.result, response.reason) == ("s1", False, "no room")


def test_the_graph_gets_an_error_when_a_result_has_no_room(world: World) -> None:
    """A node without a result must not see the goal as succeeded."""
    person = goal_peers.offering(world)
    graph_sends(world, "7")
    (goal,) = person.received("send_action_goal")
    world.link.full = True
    person.says("action_result", action="fib", id=goal["id"], values={"sequence": [0]}, status=4, result=True)
    (end,) = results(world)
    assert (end.id, end.status, end.result, end.reason) == ("7", 6, False, "no room")
    assert not world.link.all(link.CancelActionGoal)
