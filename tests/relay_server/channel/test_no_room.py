"""A robot's link that has no room for what clients ask: who asked is told in words, and nothing stays behind."""

from __future__ import annotations

from relay_protocol import link
from relay_server.channels import goals, service_calls
from tests.relay_server.channel import goal_ends
from tests.relay_server.channel.goal_ends import finish, graph_sends, results, with_action
from tests.relay_server.channel.test_calls import answer, at_work
from tests.relay_server.channel.test_serving import graph_calls, offering, responses
from tests.relay_server.memory import World


def test_a_call_is_refused_in_words(world: World) -> None:
    """However many are; the next one passes when there is room again."""
    person = at_work(world)
    world.link.full = True
    for number in range(service_calls.PENDING + 1):
        person.says("call_service", service="/reset", id=number)
        (reply,) = person.hears("service_response")
        assert (reply["id"], reply["result"], reply["values"]) == (number, False, "no room")
    world.link.full = False
    person.says("call_service", service="/reset", id="a")
    answer(world)
    assert person.hears("service_response")[0]["result"] is True


def test_a_goal_is_refused_in_words(world: World) -> None:
    """It counts no longer among those under way."""
    person = with_action(world)
    world.link.full = True
    for number in range(goals.ROBOT_GOALS + 1):
        goal_ends.send(person, number)
        (end,) = person.hears("action_result")
        assert (end["id"], end["status"], end["values"]) == (number, 0, "no room")
    world.link.full = False
    goal_ends.send(person)
    finish(world, sequence=[0])
    assert person.hears("action_result")[0]["result"] is True


def test_the_graph_is_told_that_an_answer_has_no_room(world: World) -> None:
    """A caller does not wait for one that will not come."""
    person = offering(world)
    graph_calls(world, "s1")
    (call,) = person.hears("call_service")
    world.link.full = True
    person.says("service_response", service="add", id=call["id"], values={"sum": 5}, result=True)
    (response,) = responses(world)
    assert (response.id, response.result, response.reason) == ("s1", False, "no room")


def test_the_graph_is_told_that_a_result_has_no_room(world: World) -> None:
    """The goal has not succeeded for a node that gets no result."""
    person = goal_ends.offering(world)
    graph_sends(world, "7")
    (goal,) = person.hears("send_action_goal")
    world.link.full = True
    person.says("action_result", action="fib", id=goal["id"], values={"sequence": [0]}, status=4, result=True)
    (end,) = results(world)
    assert (end.id, end.status, end.result, end.reason) == ("7", 6, False, "no room")
    assert not world.link.all(link.CancelActionGoal)
