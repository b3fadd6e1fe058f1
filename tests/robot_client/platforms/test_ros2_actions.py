"""Actions that the platform advertises in a real graph, with either executor."""

from __future__ import annotations

import pytest
import pytest_twisted
from example_interfaces.action import Fibonacci
from rclpy.serialization import deserialize_message, serialize_message
from twisted.internet import reactor, task

from relay_protocol.errors import Invalid
from robot_client.platforms.base import ABORTED, CANCELED, SUCCEEDED, AdvertisementHandle, ServedGoal
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer, until
from tests.worlds.ros_endpoints import node

FIBONACCI = "example_interfaces/action/Fibonacci"


def result(*sequence: int) -> bytes:
    return bytes(serialize_message(Fibonacci.Result(sequence=sequence)))


def feedback(*sequence: int) -> bytes:
    return bytes(serialize_message(Fibonacci.Feedback(sequence=sequence)))


class Client:
    """A client of the relay that executes goals."""

    def __init__(self, ros: Ros2Platform, action: str) -> None:
        self.orders: list[int] = []
        self.goals: list[ServedGoal] = []
        self.unwanted: list[ServedGoal] = []
        self.offer: AdvertisementHandle = ros.advertise_action(
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
async def test_goal_is_executed(ros: Ros2Platform, peer: Peer) -> None:
    """The goal is CDR; feedback reaches the node in order, then the result."""
    action = "/pursued"
    client = await given_a_goal(ros, peer, action, 5)
    assert client.offer.type == FIBONACCI
    assert client.orders == [5]
    for number in range(5):
        client.goals[0].feedback(feedback(*range(number)))
    await until(lambda: len(peer.reported("feedback", action)) == 5)  # the result would overtake it
    client.goals[0].finish(SUCCEEDED, result(0, 1, 1))
    await until(lambda: peer.reported("result", action))
    assert peer.reported("taken", action)[0]["accepted"] is True
    assert [each["sequence"] for each in peer.reported("feedback", action)] == [
        [*range(each)] for each in range(5)
    ]
    done = peer.reported("result", action)[0]
    assert (done["status"], done["sequence"]) == (SUCCEEDED, [0, 1, 1])
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_goals_are_independent(ros: Ros2Platform, peer: Peer) -> None:
    """They end in any order and block no executor."""
    client, action = Client(ros, "/many"), "/many"
    peer.record.clear()
    for order in range(6):
        peer.do("send", action, order)
    await until(lambda: len(client.goals) == 6)
    assert ros.fault() is None
    by_order = dict(zip(client.orders, client.goals, strict=True))
    for order in (3, 5, 0, 1, 4, 2):
        by_order[order].finish(SUCCEEDED, result(order))
        await until(
            lambda order=order: [each for each in peer.reported("result", action) if each["order"] == order]
        )
    assert [each["sequence"] for each in peer.reported("result", action)] == [[3], [5], [0], [1], [4], [2]]
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_cancel_request_reaches_the_client(ros: Ros2Platform, peer: Peer) -> None:
    action = "/cancelled"
    client = await given_a_goal(ros, peer, action)
    await until(lambda: peer.reported("taken", action))
    peer.do("cancel", action)
    await until(lambda: client.unwanted)
    assert client.unwanted == client.goals
    client.goals[0].finish(CANCELED, result(7))
    await until(lambda: peer.reported("result", action))
    done = peer.reported("result", action)[0]
    assert (done["status"], done["sequence"]) == (CANCELED, [7])
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_goal_is_reported_before_its_cancel_request(ros: Ros2Platform) -> None:
    """It waits a moment for a subscriber of its feedback."""
    action = "/deaf"
    reported: list[str] = []
    offer = ros.advertise_action(
        action, FIBONACCI, lambda _, goal: reported.append("goal"), lambda goal: reported.append("cancel")
    )
    kinds = Fibonacci.Impl
    with node("deaf") as deaf:
        send = deaf.create_client(kinds.SendGoalService, f"{action}/_action/send_goal")
        cancel = deaf.create_client(kinds.CancelGoalService, f"{action}/_action/cancel_goal")
        await until(lambda: send.service_is_ready() and cancel.service_is_ready())
        send.call_async(kinds.SendGoalService.Request())

        def wished() -> bool:
            cancel.call_async(kinds.CancelGoalService.Request())
            return "cancel" in reported

        await until(wished)
    assert reported[:2] == ["goal", "cancel"]
    offer.close()


@pytest_twisted.ensureDeferred
async def test_canceled_without_a_request_is_an_abort(ros: Ros2Platform, peer: Peer) -> None:
    """So is any other status."""
    client, action = Client(ros, "/given_up"), "/given_up"
    peer.record.clear()
    for number, status in enumerate((CANCELED, ABORTED, 0, 99)):
        peer.do("send", action, number)
        await until(lambda number=number: len(client.goals) > number)
        client.goals[number].finish(status, None)
        await until(lambda number=number: len(peer.reported("result", action)) > number)
    assert [each["status"] for each in peer.reported("result", action)] == [ABORTED] * 4
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_invalid_results_and_feedback_are_refused(ros: Ros2Platform, peer: Peer) -> None:
    """The goal stays open."""
    action = "/odd"
    client = await given_a_goal(ros, peer, action)
    with pytest.raises(Invalid, match="no feedback"):
        client.goals[0].feedback(b"\0")
    with pytest.raises(Invalid, match="no result"):
        client.goals[0].finish(SUCCEEDED, b"\0\1\2")
    client.goals[0].finish(SUCCEEDED, result(1))
    client.goals[0].finish(ABORTED, None)
    client.goals[0].feedback(feedback(1))
    await until(lambda: peer.reported("result", action))
    assert peer.reported("result", action)[0]["status"] == SUCCEEDED
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_withdrawn_action_aborts_its_goals(ros: Ros2Platform, peer: Peer) -> None:
    """It can be advertised again."""
    action = "/withdrawn"
    client = await given_a_goal(ros, peer, action)
    client.offer.close()
    await until(lambda: peer.reported("result", action))
    assert peer.reported("result", action)[0]["status"] == ABORTED
    again = Client(ros, action)

    def pursued() -> bool:
        for goal in again.goals:
            goal.finish(SUCCEEDED, result(2))
        return len(peer.reported("result", action)) > 1

    # The former server may still take the first of them; it rejects it.
    await until(lambda: peer.do("send", action, 2) or pursued())
    assert peer.reported("result", action)[1]["status"] == SUCCEEDED
    again.offer.close()
    node = ros._nodes.for_actions().node
    served = ros._node.get_service_names_and_types_by_node
    await until(lambda: not [name for name, _ in served(node.get_name(), "/") if name.startswith(action)])


@pytest_twisted.ensureDeferred
async def test_open_goals_cause_no_load(ros: Ros2Platform, peer: Peer) -> None:
    client = await given_a_goal(ros, peer, "/idle")
    await task.deferLater(reactor, 0.2)
    spinner = ros._nodes.for_actions()
    assert not spinner._calls
    assert not getattr(spinner._executor, "_tasks", [])
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_events_executor_has_no_waitables(ros: Ros2Platform, peer: Peer) -> None:
    """Destroying one can crash the process, so actions have a node of their own."""
    before = set(ros._node.waitables)
    client = Client(ros, "/apart")
    goal = ros.send_goal("/nobody", FIBONACCI, bytes(serialize_message(Fibonacci.Goal())), None)
    sink = ros.advertise("/said", "std_msgs/msg/String", False, None)
    source = ros.subscribe("/said", "std_msgs/msg/String", None, lambda body: None, lambda: None)
    if ros._nodes.kind == "events":
        assert set(ros._node.waitables) == before
        assert [name for name in ros.graph().nodes if "switchboard_test" in name] == []
        with pytest.raises(Invalid, match="another client of the relay advertises"):
            Client(ros, "/apart")
    goal.cancel()
    for each in (client.offer, sink, source):
        each.close()


@pytest_twisted.ensureDeferred
async def test_action_can_be_advertised_again_at_once(ros: Ros2Platform, peer: Peer) -> None:
    for _ in range(3):
        client = Client(ros, "/again")
        client.offer.close()
