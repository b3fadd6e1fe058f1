"""Goals that the relay sends to the robot's actions."""

from __future__ import annotations

from typing import Any

import pytest
from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from relay_protocol import link
from robot_client.channel.action_goals import CANCEL_INTERVAL
from robot_client.channel.handler import MAX_OPEN
from robot_client.platforms.base import ABORTED, CANCELED, NOT_STARTED, SUCCEEDED, GoalOutcome
from tests.worlds.memory_platform import MemoryGoalHandle
from tests.worlds.robot_channel import ChannelWorld

BODY = b"\0\1\0\0body"
CDR = link.to_base64(BODY)


@pytest.fixture
def world() -> ChannelWorld:
    made = ChannelWorld()
    made.platform.actions.add("/drive")
    return made


def begin(world: ChannelWorld, id: str = "g", feedback: bool = True) -> MemoryGoalHandle:
    world.channel.handle(
        link.SendActionGoal(id=id, action="/drive", type="pkg/action/Drive", feedback=feedback, cdr=CDR)
    )
    return world.platform.goals[-1]


def test_goal_is_executed_and_its_result_sent_once(world: ChannelWorld) -> None:
    """With feedback, by the goal's id."""
    goal = begin(world)
    assert (goal.action, goal.body) == ("/drive", BODY)
    goal.send_feedback(BODY)
    goal.result.callback(GoalOutcome(SUCCEEDED, BODY))
    goal.send_feedback(BODY)
    assert world.writer.sent == [
        link.ActionFeedback(id="g", cdr=CDR),
        link.ActionResult(id="g", status=SUCCEEDED, result=True, cdr=CDR),
    ]


def test_feedback_is_sent_only_on_request(world: ChannelWorld) -> None:
    begin(world, feedback=False).send_feedback(BODY)
    assert world.writer.sent == []


@pytest.mark.parametrize("status", [CANCELED, ABORTED])
def test_cancelled_and_aborted_goals_have_their_result(world: ChannelWorld, status: int) -> None:
    begin(world).result.callback(GoalOutcome(status, BODY))
    assert world.writer.sent[-1] == link.ActionResult(id="g", status=status, result=True, cdr=CDR)


def test_goal_without_a_result_has_a_reason(world: ChannelWorld) -> None:
    """Its server has disappeared."""
    begin(world).result.callback(GoalOutcome(ABORTED, None, "its server vanished"))
    assert world.writer.sent[-1] == link.ActionResult(
        id="g", status=ABORTED, result=False, reason="its server vanished"
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [({"action": "/nowhere"}, "/nowhere"), ({"cdr": None}, "CDR"), ({"cdr": "%%"}, "base64")],
)
def test_goal_that_can_not_begin_is_answered(world: ChannelWorld, change: dict[str, Any], words: str) -> None:
    """No such action, no arguments, invalid ones: with the reason, as not started."""
    goal: dict[str, Any] = {"id": "g", "action": "/drive", "type": "pkg/action/Drive", "cdr": CDR, **change}
    answer = world.request(link.SendActionGoal(**goal))
    assert isinstance(answer, link.ActionResult)
    assert (answer.id, answer.status, answer.result) == ("g", NOT_STARTED, False)
    assert words in answer.reason


def test_second_goal_of_an_id_does_not_end_the_first(world: ChannelWorld) -> None:
    """The second fails as a request."""
    goal = begin(world)
    begin(world)
    assert isinstance(world.writer.sent[-1], link.Failed)
    assert world.writer.sent[-1].reference == "g"
    goal.result.callback(GoalOutcome(SUCCEEDED, BODY))
    assert world.writer.sent[-1].status == SUCCEEDED


def test_goals_are_bounded(world: ChannelWorld) -> None:
    for number in range(MAX_OPEN):
        begin(world, str(number))
    begin(world, "more")
    assert world.writer.sent[-1].id == "more"
    assert str(MAX_OPEN) in world.writer.sent[-1].reason
    assert len(world.platform.goals) == MAX_OPEN


def test_cancel_reaches_only_the_goal_of_its_id(world: ChannelWorld) -> None:
    """An unknown id is ignored."""
    first, second = begin(world, "a"), begin(world, "b")
    world.channel.handle(link.CancelActionGoal(id="b"))
    world.channel.handle(link.CancelActionGoal(id="c"))
    assert (first.cancelled, second.cancelled) == (False, True)
    assert world.writer.sent == []


def test_cancel_requests_of_the_relay_pass_once_a_second(world: ChannelWorld) -> None:
    """Cancels by a stop or a change of control are not limited."""
    goal = begin(world, "a")
    for _ in range(100):
        world.channel.handle(link.CancelActionGoal(id="a"))
    assert goal.cancel_requests == 1
    world.channel.cancel_goals(only_moving=False)
    assert goal.cancel_requests == 2
    world.clock.advance(CANCEL_INTERVAL)
    world.channel.handle(link.CancelActionGoal(id="a"))
    assert goal.cancel_requests == 3
    goal.result.callback(GoalOutcome(CANCELED, BODY))
    second = begin(world, "a")
    world.channel.handle(link.CancelActionGoal(id="a"))
    assert second.cancel_requests == 1


def test_full_link_keeps_the_newest_feedback(world: ChannelWorld) -> None:
    """One of each goal; it is sent before the result."""
    first, second = begin(world, "a"), begin(world, "b")
    world.channel.pause()
    for number in range(100):
        first.send_feedback(BODY + bytes([number]))
        second.send_feedback(BODY + bytes([number]))
    assert world.writer.sent == []
    second.result.callback(GoalOutcome(SUCCEEDED, BODY))
    world.channel.resume()
    newest = link.to_base64(BODY + bytes([99]))
    assert world.writer.sent == [
        link.ActionFeedback(id="b", cdr=newest),
        link.ActionResult(id="b", status=SUCCEEDED, result=True, cdr=CDR),
        link.ActionFeedback(id="a", cdr=newest),
    ]


def test_too_large_result_is_replaced_by_the_reason(world: ChannelWorld) -> None:
    """It would close the whole link."""
    goal = begin(world)
    goal.send_feedback(bytes(2**24))
    goal.result.callback(GoalOutcome(SUCCEEDED, bytes(2**24)))
    assert len(world.writer.sent) == 1
    assert (world.writer.sent[0].status, world.writer.sent[0].result) == (SUCCEEDED, False)
    assert "16777216 bytes" in world.writer.sent[0].reason


def test_goal_ends_after_an_unexpected_error(world: ChannelWorld) -> None:
    """The answer has no internals of the platform."""
    goal = begin(world)
    goal.result.errback(Failure(RuntimeError("secret internals")))
    assert world.writer.sent[-1].status == ABORTED
    assert "secret" not in world.writer.sent[-1].reason


def test_end_of_the_channel_cancels_all_goals(world: ChannelWorld) -> None:
    """No result is sent any more."""
    goals = [begin(world, str(number)) for number in range(3)]
    world.channel.close()
    assert all(goal.cancelled for goal in goals)
    goals[0].send_feedback(BODY)
    goals[1].result.callback(GoalOutcome(CANCELED, BODY))
    assert world.writer.sent == []


def test_too_large_response_is_a_failed_call(world: ChannelWorld) -> None:
    late: Deferred[bytes] = Deferred()
    world.platform.services["/map"] = lambda request: late
    world.request(link.CallService(id="7", service="/map", type="t", cdr=""))
    late.callback(bytes(2**24))
    assert world.writer.sent[-1].result is False
    assert "16777216 bytes" in world.writer.sent[-1].reason
