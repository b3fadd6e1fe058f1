"""Actions of a real graph that refuse to cancel their goals, as every server of rclpy does unless told otherwise."""

from __future__ import annotations

import pytest
import pytest_twisted
from twisted.internet import reactor

from relay_protocol.link import MotionPolicy
from robot_client.motion.goal_canceller import GoalCanceller
from robot_client.platforms.base import CANCELED
from robot_client.platforms.ros2.goals import MAX_UNANSWERED
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.platforms.ends import seen
from tests.robot_client.ros import Peer, until

pytestmark = pytest.mark.parametrize("ros", ["events"], indirect=True, scope="module")


@pytest_twisted.ensureDeferred
async def test_goals_of_others_that_go_on_after_a_stop_are_told(ros: Ros2Platform, peer: Peer) -> None:
    """The server says neither yes nor no; what it publishes of its goals does, until they are cancelled."""
    peer.do("act", "/stubborn", "stubborn forever")
    peer.do("act", "/idle/stubborn", "stubborn forever")
    await seen(ros, lambda graph: {"/stubborn", "/idle/stubborn"} <= graph.actions.keys())
    peer.do("send", "/stubborn", 3)
    await until(lambda: peer.told("began", "/stubborn"))
    sweep = GoalCanceller(MotionPolicy(actions=["*/stubborn"]), ros, reactor, lambda topic: False)
    assert await sweep.stop() == []
    await until(lambda: sweep.late())
    assert sweep.late() == ["/stubborn refuses to cancel goals; it is asked again every second"]
    peer.do("relent", "/stubborn")

    def cancelled() -> bool:
        sweep.again()
        return not sweep.late()

    await until(cancelled)
    await until(lambda: peer.told("ended", "/stubborn"))
    sweep.end()


@pytest_twisted.ensureDeferred
async def test_a_goal_that_an_action_refuses_to_cancel_is_not_cancelled(
    ros: Ros2Platform, peer: Peer
) -> None:
    """It is told from one that is, from one that ends already, and from one the action does not know."""
    peer.do("act", "/solid", "stubborn forever")
    await seen(ros, lambda graph: "/solid" in graph.actions)
    began: list[bytes] = []
    goal = ros.pursue("/solid", "example_interfaces/action/Fibonacci", b"\0\1\0\0\3\0\0\0", began.append)
    await until(lambda: began)
    sweep = GoalCanceller(MotionPolicy(actions=["*/solid"]), ros, reactor, lambda topic: False)
    assert await sweep.cancel("/solid", goal.id) == "/solid refuses to cancel a goal"
    assert await sweep.cancel_surely("/solid") == "/solid refuses to cancel its goals"
    assert await sweep.cancel("/solid", bytes(15) + b"\1") == ""
    peer.do("relent", "/solid")
    assert await sweep.cancel("/solid", goal.id) == ""
    await goal.result
    assert await sweep.cancel("/solid", goal.id) == ""
    assert await sweep.cancel_surely("/solid") == ""


@pytest_twisted.ensureDeferred
async def test_a_goal_that_was_cancelled_in_vain_is_cancelled_again(ros: Ros2Platform, peer: Peer) -> None:
    """Each time somebody wants it to end: whoever wanted it first may have been refused."""
    peer.do("act", "/firm", "stubborn forever")
    await seen(ros, lambda graph: "/firm" in graph.actions)
    began: list[bytes] = []
    goal = ros.pursue("/firm", "example_interfaces/action/Fibonacci", b"\0\1\0\0\3\0\0\0", began.append)
    await until(lambda: began)
    for wishes in range(1, MAX_UNANSWERED + 3):
        goal.cancel()
        await until(lambda wishes=wishes: len(peer.told("wished", "/firm")) == wishes)
    assert all(each["refused"] for each in peer.told("wished", "/firm"))
    peer.do("relent", "/firm")
    goal.cancel()
    assert (await goal.result).status == CANCELED
