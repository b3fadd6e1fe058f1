"""Actions the platform offers to a real graph, with either executor."""

from __future__ import annotations

import pytest
import pytest_twisted
from example_interfaces.action import Fibonacci
from rclpy.serialization import deserialize_message, serialize_message
from twisted.internet import reactor, task

from relay_protocol.errors import Invalid
from robot_client.platforms.base import ABORTED, CANCELED, SUCCEEDED, AdvertisementHandle, ServedGoal
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.platforms.ends import node
from tests.robot_client.ros import Peer, until

FIBONACCI = "example_interfaces/action/Fibonacci"


def result(*sequence: int) -> bytes:
    return bytes(serialize_message(Fibonacci.Result(sequence=sequence)))


def feedback(*sequence: int) -> bytes:
    return bytes(serialize_message(Fibonacci.Feedback(sequence=sequence)))


class Client:
    """Somebody at the relay who pursues goals."""

    def __init__(self, ros: Ros2Platform, action: str) -> None:
        self.orders: list[int] = []
        self.goals: list[ServedGoal] = []
        self.unwanted: list[ServedGoal] = []
        self.offer: AdvertisementHandle = ros.act(
            action, "example_interfaces/Fibonacci", self.take, self.unwanted.append
        )

    def take(self, body: bytes, goal: ServedGoal) -> None:
        self.orders.append(deserialize_message(body, Fibonacci.Goal).order)
        self.goals.append(goal)


async def given_a_goal(ros: Ros2Platform, peer: Peer, action: str, order: int = 1) -> Client:
    """A client that offers an action, once a node's goal has come to it."""
    client = Client(ros, action)
    peer.record.clear()
    peer.do("send", action, order)
    await until(lambda: client.goals)
    return client


@pytest_twisted.ensureDeferred
async def test_goal_is_pursued(ros: Ros2Platform, peer: Peer) -> None:
    """A node's goal comes as CDR; feedback reaches the node in order, and the result with its status."""
    action = "/pursued"
    client = await given_a_goal(ros, peer, action, 5)
    assert client.offer.type == FIBONACCI
    assert client.orders == [5]
    for number in range(5):
        client.goals[0].feedback(feedback(*range(number)))
    await until(lambda: len(peer.told("feedback", action)) == 5)  # the result would overtake it
    client.goals[0].finish(SUCCEEDED, result(0, 1, 1))
    await until(lambda: peer.told("result", action))
    assert peer.told("taken", action)[0]["accepted"] is True
    assert [each["sequence"] for each in peer.told("feedback", action)] == [
        [*range(each)] for each in range(5)
    ]
    done = peer.told("result", action)[0]
    assert (done["status"], done["sequence"]) == (SUCCEEDED, [0, 1, 1])
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_goals_are_pursued_side_by_side(ros: Ros2Platform, peer: Peer) -> None:
    """Goals that are under way hold up neither each other nor the executor, and end in any order."""
    client, action = Client(ros, "/many"), "/many"
    peer.record.clear()
    for order in range(6):
        peer.do("send", action, order)
    await until(lambda: len(client.goals) == 6)
    assert ros.trouble() is None
    by_order = dict(zip(client.orders, client.goals, strict=True))
    for order in (3, 5, 0, 1, 4, 2):
        by_order[order].finish(SUCCEEDED, result(order))
        await until(
            lambda order=order: [each for each in peer.told("result", action) if each["order"] == order]
        )
    assert [each["sequence"] for each in peer.told("result", action)] == [[3], [5], [0], [1], [4], [2]]
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_cancel_comes_to_the_client(ros: Ros2Platform, peer: Peer) -> None:
    """A node's wish to cancel is told to the client, whose canceled result reaches the node."""
    action = "/cancelled"
    client = await given_a_goal(ros, peer, action)
    await until(lambda: peer.told("taken", action))
    peer.do("cancel", action)
    await until(lambda: client.unwanted)
    assert client.unwanted == client.goals
    client.goals[0].finish(CANCELED, result(7))
    await until(lambda: peer.told("result", action))
    done = peer.told("result", action)[0]
    assert (done["status"], done["sequence"]) == (CANCELED, [7])
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_a_goal_without_ears_is_told_of_before_its_end_is_wished_for(ros: Ros2Platform) -> None:
    """A goal waits a moment for somebody to listen to feedback; it comes all the same, and before its cancel."""
    action = "/deaf"
    told: list[str] = []
    offer = ros.act(
        action, FIBONACCI, lambda _, goal: told.append("goal"), lambda goal: told.append("cancel")
    )
    kinds = Fibonacci.Impl
    with node("deaf") as deaf:
        send = deaf.create_client(kinds.SendGoalService, f"{action}/_action/send_goal")
        cancel = deaf.create_client(kinds.CancelGoalService, f"{action}/_action/cancel_goal")
        await until(lambda: send.service_is_ready() and cancel.service_is_ready())
        send.call_async(kinds.SendGoalService.Request())

        def wished() -> bool:
            cancel.call_async(kinds.CancelGoalService.Request())
            return "cancel" in told

        await until(wished)
    assert told[:2] == ["goal", "cancel"]
    offer.close()


@pytest_twisted.ensureDeferred
async def test_canceled_without_being_asked_is_an_abort(ros: Ros2Platform, peer: Peer) -> None:
    """A client that says canceled of a goal nobody cancelled, or any other status, has aborted it."""
    client, action = Client(ros, "/given_up"), "/given_up"
    peer.record.clear()
    for number, status in enumerate((CANCELED, ABORTED, 0, 99)):
        peer.do("send", action, number)
        await until(lambda number=number: len(client.goals) > number)
        client.goals[number].finish(status, None)
        await until(lambda number=number: len(peer.told("result", action)) > number)
    assert [each["status"] for each in peer.told("result", action)] == [ABORTED] * 4
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_bytes_that_are_no_result_end_nothing(ros: Ros2Platform, peer: Peer) -> None:
    """Bytes that are no feedback or result are refused in words, and the goal goes on."""
    action = "/odd"
    client = await given_a_goal(ros, peer, action)
    with pytest.raises(Invalid, match="no feedback"):
        client.goals[0].feedback(b"\0")
    with pytest.raises(Invalid, match="no result"):
        client.goals[0].finish(SUCCEEDED, b"\0\1\2")
    client.goals[0].finish(SUCCEEDED, result(1))
    client.goals[0].finish(ABORTED, None)
    client.goals[0].feedback(feedback(1))
    await until(lambda: peer.told("result", action))
    assert peer.told("result", action)[0]["status"] == SUCCEEDED
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_withdrawn_action_aborts_its_goals(ros: Ros2Platform, peer: Peer) -> None:
    """Who waits for a goal of an action that is withdrawn hears that it was aborted; it can be offered again."""
    action = "/withdrawn"
    client = await given_a_goal(ros, peer, action)
    client.offer.close()
    await until(lambda: peer.told("result", action))
    assert peer.told("result", action)[0]["status"] == ABORTED
    again = Client(ros, action)

    def pursued() -> bool:
        for goal in again.goals:
            goal.finish(SUCCEEDED, result(2))
        return len(peer.told("result", action)) > 1

    # The former server may still take the first of them; it rejects it.
    await until(lambda: peer.do("send", action, 2) or pursued())
    assert peer.told("result", action)[1]["status"] == SUCCEEDED
    again.offer.close()
    node = ros._nodes.for_actions().node
    served = ros._node.get_service_names_and_types_by_node
    await until(lambda: not [name for name, _ in served(node.get_name(), "/") if name.startswith(action)])


@pytest_twisted.ensureDeferred
async def test_open_goals_cost_nothing(ros: Ros2Platform, peer: Peer) -> None:
    """The executor's thread sleeps while a goal is pursued elsewhere."""
    client = await given_a_goal(ros, peer, "/idle")
    await task.deferLater(reactor, 0.2)
    spinner = ros._nodes.for_actions()
    assert not spinner._work
    assert not getattr(spinner._executor, "_tasks", [])
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_an_events_executor_has_nothing_that_ends_the_process_when_it_goes(
    ros: Ros2Platform, peer: Peer
) -> None:
    """A waitable that goes while something for it waits there does so; actions are on a node of their own for it."""
    before = set(ros._node.waitables)
    client = Client(ros, "/apart")
    goal = ros.pursue("/nobody", FIBONACCI, bytes(serialize_message(Fibonacci.Goal())), None)
    sink = ros.advertise("/said", "std_msgs/msg/String", False, None)
    source = ros.subscribe("/said", "std_msgs/msg/String", None, lambda body: None, lambda: None)
    if ros._nodes.kind == "events":
        assert set(ros._node.waitables) == before
        assert [name for name in ros.graph().nodes if "switchboard_test" in name] == []
        with pytest.raises(Invalid, match="somebody at the relay offers"):
            Client(ros, "/apart")
    goal.cancel()
    for each in (client.offer, sink, source):
        each.close()


@pytest_twisted.ensureDeferred
async def test_an_action_can_be_offered_again_at_once(ros: Ros2Platform, peer: Peer) -> None:
    """The one that is on its way out is nobody else's."""
    for _ in range(3):
        client = Client(ros, "/again")
        client.offer.close()
