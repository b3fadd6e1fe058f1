"""Goals that the relay asks the robot to pursue."""

from __future__ import annotations

from typing import Any

import pytest
from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from relay_protocol import link
from robot_client.channel.action_goals import ASK_EVERY
from robot_client.channel.parts import MAX_OPEN
from robot_client.platforms.base import ABORTED, CANCELED, NEVER_BEGAN, SUCCEEDED, GoalOutcome
from robot_client.platforms.memory import MemoryGoal
from tests.robot_client.scene import Scene

BODY = b"\0\1\0\0body"
CDR = link.to_base64(BODY)


@pytest.fixture
def scene() -> Scene:
    made = Scene()
    made.platform.actions.add("/drive")
    return made


def begin(scene: Scene, id: str = "g", feedback: bool = True) -> MemoryGoal:
    scene.channel.handle(
        link.SendActionGoal(id=id, action="/drive", type="pkg/action/Drive", feedback=feedback, cdr=CDR)
    )
    return scene.platform.goals[-1]


def test_goal_is_pursued_and_told(scene: Scene) -> None:
    """Feedback and the result come with the goal's id, the result once."""
    goal = begin(scene)
    assert (goal.action, goal.body) == ("/drive", BODY)
    goal.feed(BODY)
    goal.result.callback(GoalOutcome(SUCCEEDED, BODY))
    goal.feed(BODY)
    assert scene.wire.said == [
        link.ActionFeedback(id="g", cdr=CDR),
        link.ActionResult(id="g", status=SUCCEEDED, result=True, cdr=CDR),
    ]


def test_feedback_is_sent_only_when_asked_for(scene: Scene) -> None:
    """Without the wish for feedback none goes out."""
    begin(scene, feedback=False).feed(BODY)
    assert scene.wire.said == []


@pytest.mark.parametrize("status", [CANCELED, ABORTED])
def test_other_ends_have_their_result_too(scene: Scene, status: int) -> None:
    """A goal that was cancelled or aborted comes with the result the server gave."""
    begin(scene).result.callback(GoalOutcome(status, BODY))
    assert scene.wire.said[-1] == link.ActionResult(id="g", status=status, result=True, cdr=CDR)


def test_goal_without_a_result_has_a_reason(scene: Scene) -> None:
    """A goal that vanished with its server ends without a result, in words."""
    begin(scene).result.callback(GoalOutcome(ABORTED, None, "its server vanished"))
    assert scene.wire.said[-1] == link.ActionResult(
        id="g", status=ABORTED, result=False, reason="its server vanished"
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [({"action": "/nowhere"}, "/nowhere"), ({"cdr": None}, "CDR"), ({"cdr": "%%"}, "base64")],
)
def test_goal_that_can_not_begin_is_answered(scene: Scene, change: dict[str, Any], words: str) -> None:
    """No such action, no arguments, senseless ones: each is answered with the reason, as never begun."""
    goal: dict[str, Any] = {"id": "g", "action": "/drive", "type": "pkg/action/Drive", "cdr": CDR, **change}
    answer = scene.ask(link.SendActionGoal(**goal))
    assert isinstance(answer, link.ActionResult)
    assert (answer.id, answer.status, answer.result) == ("g", NEVER_BEGAN, False)
    assert words in answer.reason


def test_second_goal_of_an_id_does_not_end_the_first(scene: Scene) -> None:
    """An id that is in use fails as a request; the goal under way goes on."""
    goal = begin(scene)
    begin(scene)
    assert isinstance(scene.wire.said[-1], link.Failed)
    assert scene.wire.said[-1].ref == "g"
    goal.result.callback(GoalOutcome(SUCCEEDED, BODY))
    assert scene.wire.said[-1].status == SUCCEEDED


def test_goals_are_bounded(scene: Scene) -> None:
    """A goal over the bound is refused in words."""
    for number in range(MAX_OPEN):
        begin(scene, str(number))
    begin(scene, "more")
    assert scene.wire.said[-1].id == "more"
    assert str(MAX_OPEN) in scene.wire.said[-1].reason
    assert len(scene.platform.goals) == MAX_OPEN


def test_cancel_reaches_the_goal(scene: Scene) -> None:
    """Only the goal of the id is cancelled; an id that is not known is passed over."""
    first, second = begin(scene, "a"), begin(scene, "b")
    scene.channel.handle(link.CancelActionGoal(id="b"))
    scene.channel.handle(link.CancelActionGoal(id="c"))
    assert (first.cancelled, second.cancelled) == (False, True)
    assert scene.wire.said == []


def test_the_relay_can_have_a_goal_cancelled_once_a_second(scene: Scene) -> None:
    """However often it asks; who wants it to end for the robot's sake is not held up by that."""
    goal = begin(scene, "a")
    for _ in range(100):
        scene.channel.handle(link.CancelActionGoal(id="a"))
    assert goal.cancels == 1
    scene.channel.cancel_goals(only_moving=False)
    assert goal.cancels == 2
    scene.clock.advance(ASK_EVERY)
    scene.channel.handle(link.CancelActionGoal(id="a"))
    assert goal.cancels == 3
    goal.result.callback(GoalOutcome(CANCELED, BODY))
    second = begin(scene, "a")
    scene.channel.handle(link.CancelActionGoal(id="a"))
    assert second.cancels == 1


def test_full_link_keeps_the_newest_feedback(scene: Scene) -> None:
    """While the link takes nothing one feedback of each goal waits, and goes before the result."""
    first, second = begin(scene, "a"), begin(scene, "b")
    scene.channel.pause()
    for number in range(100):
        first.feed(BODY + bytes([number]))
        second.feed(BODY + bytes([number]))
    assert scene.wire.said == []
    second.result.callback(GoalOutcome(SUCCEEDED, BODY))
    scene.channel.resume()
    newest = link.to_base64(BODY + bytes([99]))
    assert scene.wire.said == [
        link.ActionFeedback(id="b", cdr=newest),
        link.ActionResult(id="b", status=SUCCEEDED, result=True, cdr=CDR),
        link.ActionFeedback(id="a", cdr=newest),
    ]


def test_result_too_large_for_the_link_ends_in_words(scene: Scene) -> None:
    """A result over the relay's limit, which would cost the whole link, is told without its bytes."""
    goal = begin(scene)
    goal.feed(bytes(2**24))
    goal.result.callback(GoalOutcome(SUCCEEDED, bytes(2**24)))
    assert len(scene.wire.said) == 1
    assert (scene.wire.said[0].status, scene.wire.said[0].result) == (SUCCEEDED, False)
    assert "16777216 bytes" in scene.wire.said[0].reason


def test_goal_that_breaks_down_ends(scene: Scene) -> None:
    """A platform that fails unforeseen gives an answer without its internals."""
    goal = begin(scene)
    goal.result.errback(Failure(RuntimeError("secret internals")))
    assert scene.wire.said[-1].status == ABORTED
    assert "secret" not in scene.wire.said[-1].reason


def test_end_of_the_channel_cancels_all(scene: Scene) -> None:
    """When the link ends nobody wants its goals any more; what becomes of them is told to nobody."""
    goals = [begin(scene, str(number)) for number in range(3)]
    scene.channel.close()
    assert all(goal.cancelled for goal in goals)
    goals[0].feed(BODY)
    goals[1].result.callback(GoalOutcome(CANCELED, BODY))
    assert scene.wire.said == []


def test_answer_too_large_for_the_link_is_told_in_words(scene: Scene) -> None:
    """A service's answer over the relay's limit is a failed call."""
    late: Deferred[bytes] = Deferred()
    scene.platform.services["/map"] = lambda request: late
    scene.ask(link.CallService(id="7", service="/map", type="t", cdr=""))
    late.callback(bytes(2**24))
    assert scene.wire.said[-1].result is False
    assert "16777216 bytes" in scene.wire.said[-1].reason
