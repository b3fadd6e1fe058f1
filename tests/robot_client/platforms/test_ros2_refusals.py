"""Actions of a real graph that refuse to cancel their goals, as servers of rclpy do by default."""

from __future__ import annotations

import pytest
import pytest_twisted
from twisted.internet import reactor

from relay_protocol.link import MotionPolicy
from robot_client.motion.goal_canceller import GoalCanceller
from robot_client.platforms.base import CANCELED
from robot_client.platforms.ros2.goals import MAX_UNANSWERED
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer, until
from tests.worlds.ros_endpoints import seen

pytestmark = pytest.mark.parametrize("ros", ["events"], indirect=True, scope="module")


@pytest_twisted.ensureDeferred
async def test_goals_of_others_that_continue_after_a_stop_are_reported(ros: Ros2Platform, peer: Peer) -> None:
    """The response does not show the refusal; the published status does."""
    peer.do("act", "/stubborn", "stubborn forever")
    peer.do("act", "/idle/stubborn", "stubborn forever")
    await seen(ros, lambda graph: {"/stubborn", "/idle/stubborn"} <= graph.actions.keys())
    peer.do("send", "/stubborn", 3)
    await until(lambda: peer.reported("began", "/stubborn"))
    goal_canceller = GoalCanceller(MotionPolicy(actions=["*/stubborn"]), ros, reactor)
    assert await goal_canceller.stop() == []
    await until(lambda: goal_canceller.problems())
    assert goal_canceller.problems() == [
        "/stubborn refuses to cancel goals; the request is repeated every second"
    ]
    peer.do("relent", "/stubborn")

    def cancelled() -> bool:
        goal_canceller.retry()
        return not goal_canceller.problems()

    await until(cancelled)
    await until(lambda: peer.reported("ended", "/stubborn"))
    goal_canceller.end()


@pytest_twisted.ensureDeferred
async def test_refused_cancel_request_is_recognised(ros: Ros2Platform, peer: Peer) -> None:
    """Among accepted ones, ended goals and unknown goals."""
    peer.do("act", "/solid", "stubborn forever")
    await seen(ros, lambda graph: "/solid" in graph.actions)
    began: list[bytes] = []
    goal = ros.send_goal("/solid", "example_interfaces/action/Fibonacci", b"\0\1\0\0\3\0\0\0", began.append)
    await until(lambda: began)
    goal_canceller = GoalCanceller(MotionPolicy(actions=["*/solid"]), ros, reactor)
    assert await goal_canceller.cancel("/solid", goal.id) == "/solid refuses to cancel a goal"
    assert await goal_canceller.cancel_all_checked("/solid") == "/solid refuses to cancel its goals"
    assert await goal_canceller.cancel("/solid", bytes(15) + b"\1") == ""
    peer.do("relent", "/solid")
    assert await goal_canceller.cancel("/solid", goal.id) == ""
    await goal.result
    assert await goal_canceller.cancel("/solid", goal.id) == ""
    assert await goal_canceller.cancel_all_checked("/solid") == ""


@pytest_twisted.ensureDeferred
async def test_cancel_sends_a_request_every_time(ros: Ros2Platform, peer: Peer) -> None:
    """Earlier ones may have been refused."""
    peer.do("act", "/firm", "stubborn forever")
    await seen(ros, lambda graph: "/firm" in graph.actions)
    began: list[bytes] = []
    goal = ros.send_goal("/firm", "example_interfaces/action/Fibonacci", b"\0\1\0\0\3\0\0\0", began.append)
    await until(lambda: began)
    for wishes in range(1, MAX_UNANSWERED + 3):
        goal.cancel()
        await until(lambda wishes=wishes: len(peer.reported("wished", "/firm")) == wishes)
    assert all(each["refused"] for each in peer.reported("wished", "/firm"))
    peer.do("relent", "/firm")
    goal.cancel()
    assert (await goal.result).status == CANCELED
