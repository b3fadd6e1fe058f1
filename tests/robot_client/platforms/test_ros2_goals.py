"""Goals that the platform sends to actions of a real graph, with either executor."""

from __future__ import annotations

import threading
from typing import Any

import pytest
import pytest_twisted
from example_interfaces.action import Fibonacci
from rclpy.serialization import deserialize_message, serialize_message
from twisted.internet import reactor

from relay_protocol.errors import Invalid, NotFound
from relay_protocol.link import MotionPolicy
from robot_client.motion.goal_canceller import GoalCanceller
from robot_client.platforms.base import ABORTED, CANCELED, NOT_STARTED, SUCCEEDED, GoalOutcome
from robot_client.platforms.ros2 import goals
from robot_client.platforms.ros2 import platform as ros2
from robot_client.platforms.ros2.action_client import GoalClient
from robot_client.platforms.ros2.goals import RosGoal
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer, until

FIBONACCI = "example_interfaces/action/Fibonacci"


class SentGoal:
    """A goal, its feedback and its outcome."""

    def __init__(
        self, ros: Ros2Platform, action: str, order: int = 5, listen: bool = True, type: str = FIBONACCI
    ):
        body = bytes(serialize_message(Fibonacci.Goal(order=order)))
        self.fed: list[list[int]] = []
        self.outcomes: list[GoalOutcome] = []
        self.goal: RosGoal = ros.send_goal(action, type, body, self.feed if listen else None)
        self.goal.result.addCallback(self.outcomes.append)

    def feed(self, body: bytes) -> None:
        self.fed.append(list(deserialize_message(body, Fibonacci.Feedback).sequence))

    async def end(self) -> GoalOutcome:
        await until(lambda: self.outcomes)
        return self.outcomes[0]


async def serve(ros: Ros2Platform, peer: Peer, action: str, kind: str) -> None:
    if not [each for each in peer.record if each.get("done") == "act " + action]:
        peer.do("act", action, kind)
        peer.record.append({"done": "act " + action})
    await until(lambda: action in ros.graph().actions)


@pytest_twisted.ensureDeferred
async def test_goal_succeeds(ros: Ros2Platform, peer: Peer) -> None:
    """With feedback, and with the type from the graph too."""
    await serve(ros, peer, "/count", "count")
    for type in (FIBONACCI, "example_interfaces/Fibonacci", ""):
        wanted = SentGoal(ros, "/count", 5, type=type)
        status, body, reason, _ = await wanted.end()
        assert (status, reason) == (SUCCEEDED, "")
        assert list(deserialize_message(body, Fibonacci.Result).sequence) == [0, 1, 1, 2, 3]
        assert all(each == [0, 1, 1, 2, 3][: len(each)] for each in wanted.fed)


@pytest_twisted.ensureDeferred
async def test_feedback_arrives_only_on_request(ros: Ros2Platform, peer: Peer) -> None:
    """In order."""
    await serve(ros, peer, "/forever", "forever")
    silent, heard = SentGoal(ros, "/forever", 6, listen=False), SentGoal(ros, "/forever", 6)
    await until(lambda: len(heard.fed) > 4)
    assert all(each == [0, 1, 1, 2, 3, 5][: len(each)] for each in heard.fed)
    assert heard.fed == sorted(heard.fed)
    assert silent.fed == []
    for wanted in (silent, heard):
        wanted.goal.cancel()
        assert (await wanted.end()).status == CANCELED


@pytest_twisted.ensureDeferred
async def test_cancelled_goal_ends_with_its_result(ros: Ros2Platform, peer: Peer) -> None:
    await serve(ros, peer, "/forever", "forever")
    wanted = SentGoal(ros, "/forever", 3)
    await until(lambda: wanted.fed)
    wanted.goal.cancel()
    wanted.goal.cancel()
    status, body, _, _ = await wanted.end()
    assert status == CANCELED
    assert list(deserialize_message(body, Fibonacci.Result).sequence) == [0, 1, 1]


class LostAnswers:
    """Loses answers of actions, as a server does that has not discovered the reader of an answer yet.

    :param kinds: ``goal`` or ``result``, once for each answer that is lost
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *kinds: str) -> None:
        self.left = list(kinds)
        taken = GoalClient.take_data

        def take(client: GoalClient) -> Any:
            data = taken(client)
            for kind in set(data) & set(self.left):
                del data[kind]
                self.left.remove(kind)
            return data

        monkeypatch.setattr(GoalClient, "take_data", take)


@pytest.mark.parametrize("lost", [["goal"], ["result"], ["goal", "result", "result"]])
@pytest_twisted.ensureDeferred
async def test_goal_whose_answers_are_lost_ends_with_its_result(
    ros: Ros2Platform, peer: Peer, lost: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """https://github.com/ros2/rmw_fastrtps/issues/842."""
    await serve(ros, peer, "/count", "count")
    answers = LostAnswers(monkeypatch, *lost)
    wanted = SentGoal(ros, "/count", 5)
    status, body, reason, _ = await wanted.end()
    assert (status, reason, answers.left) == (SUCCEEDED, "", [])
    assert list(deserialize_message(body, Fibonacci.Result).sequence) == [0, 1, 1, 2, 3]


@pytest_twisted.ensureDeferred
async def test_goal_whose_result_never_arrives_is_given_up(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    await serve(ros, peer, "/count", "count")
    answers = LostAnswers(monkeypatch, *["result"] * 9)
    monkeypatch.setattr(goals, "RESULT_SECONDS", 0.0)
    status, body, reason, certain = await SentGoal(ros, "/count", 5).end()
    assert (status, body, certain) == (ABORTED, None, False)
    assert "does not send its result" in reason
    assert len(answers.left) >= 9 - goals.RESULT_REQUESTS


@pytest_twisted.ensureDeferred
async def test_goal_that_was_given_up_is_cancelled_also_if_its_answer_is_lost(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    await serve(ros, peer, "/forever", "forever")
    answers = LostAnswers(monkeypatch, "goal")
    before = len(peer.reported("ended", "/forever"))
    wanted = SentGoal(ros, "/forever", 3)
    await until(lambda: not answers.left or wanted.goal._handle)
    wanted.goal.abandon("the robot is shutting down")
    assert (await wanted.end()).reason == "the robot is shutting down"
    await until(lambda: len(peer.reported("ended", "/forever")) > before)


@pytest_twisted.ensureDeferred
async def test_goal_can_be_cancelled_before_it_is_accepted(ros: Ros2Platform, peer: Peer) -> None:
    """The request is sent once it is."""
    await serve(ros, peer, "/late", "late")
    first = SentGoal(ros, "/late", 3)
    await first.end()
    thought = len(peer.reported("thinks", "/late"))
    wanted = SentGoal(ros, "/late", 3)
    await until(lambda: len(peer.reported("thinks", "/late")) > thought)
    wanted.goal.cancel()
    assert wanted.outcomes == []
    # This server had executed it before it checked the cancellation; only a single end matters.
    assert (await wanted.end()).status in (SUCCEEDED, CANCELED)
    assert len(wanted.outcomes) == 1


@pytest_twisted.ensureDeferred
async def test_goal_cancelled_before_it_was_sent_is_not_sent(ros: Ros2Platform, peer: Peer) -> None:
    await serve(ros, peer, "/count", "count")
    await SentGoal(ros, "/count", 5).end()
    free = threading.Event()
    ros._goals.spinner.call(free.wait, 10)
    wanted = SentGoal(ros, "/count", 7)
    wanted.goal.cancel()
    free.set()
    status, _, reason, certain = await wanted.end()
    assert (status, certain) == (NOT_STARTED, True)
    assert "cancelled before it was sent" in reason
    await SentGoal(ros, "/count", 6).end()
    assert 7 not in [each["order"] for each in peer.reported("began", "/count")]


@pytest_twisted.ensureDeferred
async def test_goal_cancelled_at_once_never_begins(ros: Ros2Platform, peer: Peer) -> None:
    wanted = SentGoal(ros, "/nobody_there", 3)
    wanted.goal.cancel()
    assert wanted.outcomes[0].status == NOT_STARTED
    assert "cancelled before it was sent" in wanted.outcomes[0].reason


@pytest_twisted.ensureDeferred
async def test_all_goals_of_an_action_are_cancelled_at_once(ros: Ros2Platform, peer: Peer) -> None:
    """Of any client; without goals it is no error."""
    await serve(ros, peer, "/swept", "forever")
    wanted = [SentGoal(ros, "/swept", 3), SentGoal(ros, "/swept", 3)]
    await until(lambda: all(each.fed for each in wanted))
    goal_canceller = GoalCanceller(MotionPolicy(actions=["/swept"]), ros, reactor)
    for _ in range(2):
        assert await goal_canceller.stop() == []
        assert goal_canceller.problems() == []
        assert [(await each.end()).status for each in wanted] == [CANCELED, CANCELED]
    goal_canceller.end()


@pytest_twisted.ensureDeferred
async def test_rejected_goal_has_not_started(ros: Ros2Platform, peer: Peer) -> None:
    await serve(ros, peer, "/reject", "reject")
    assert await SentGoal(ros, "/reject").end() == GoalOutcome(
        NOT_STARTED, None, "the action /reject rejected the goal"
    )


@pytest_twisted.ensureDeferred
async def test_aborted_goal_has_its_result(ros: Ros2Platform, peer: Peer) -> None:
    await serve(ros, peer, "/abort", "abort")
    status, body, _, _ = await SentGoal(ros, "/abort", 4).end()
    assert status == ABORTED
    assert list(deserialize_message(body, Fibonacci.Result).sequence) == [0, 1, 1, 2]


@pytest_twisted.ensureDeferred
async def test_goal_for_a_missing_action_ends_after_a_second(ros: Ros2Platform) -> None:
    status, body, reason, _ = await SentGoal(ros, "/nowhere").end()
    assert (status, body) == (NOT_STARTED, None)
    assert "/nowhere can't be reached" in reason
    with pytest.raises(NotFound, match="no action /unheard"):
        SentGoal(ros, "/unheard", type="")


@pytest_twisted.ensureDeferred
async def test_goal_ends_when_its_server_disappears(ros: Ros2Platform, peer: Peer) -> None:
    peer.do("act", "/doomed", "forever")
    await until(lambda: "/doomed" in ros.graph().actions)
    wanted = SentGoal(ros, "/doomed", 3)
    await until(lambda: wanted.fed)
    peer.do("unact", "/doomed")
    status, body, reason, certain = await wanted.end()
    assert (status, body, certain) == (ABORTED, None, False)
    assert "/doomed disappeared" in reason


@pytest_twisted.ensureDeferred
async def test_unanswered_cancel_requests_are_bounded_and_removed(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    await serve(ros, peer, "/forever", "forever")
    wanted = SentGoal(ros, "/forever", 3)
    await until(lambda: wanted.goal._handle)
    waiting = wanted.goal._client.ros._pending_cancel_requests
    with peer.frozen():
        for _ in range(3):
            wanted.goal.cancel()
        await until(lambda: len(waiting) == 3)
        monkeypatch.setattr(ros._goals, "servers", lambda action: frozenset())
        assert "disappeared" in (await wanted.end()).reason
        await until(lambda: not waiting)


@pytest_twisted.ensureDeferred
async def test_invalid_goals_are_refused(ros: Ros2Platform, peer: Peer) -> None:
    """Another type, no goal, an invalid name."""
    await serve(ros, peer, "/count", "count")
    with pytest.raises(Invalid, match="is of type example_interfaces/action/Fibonacci"):
        SentGoal(ros, "/count", type="switchboard_test_interfaces/action/Everything")
    with pytest.raises(Invalid, match="no goal of type"):
        ros.send_goal("/count", FIBONACCI, b"\0", None)
    with pytest.raises(Invalid, match="not a valid action name"):
        SentGoal(ros, "/not a name")


@pytest_twisted.ensureDeferred
async def test_idle_clients_are_destroyed(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    await serve(ros, peer, "/forever", "forever")
    await serve(ros, peer, "/count", "count")
    running = SentGoal(ros, "/forever", 3)
    await SentGoal(ros, "/count").end()
    await until(lambda: running.fed)
    kept = ros._goals.clock
    monkeypatch.setattr(
        ros._goals, "clock", type("Later", (), {"seconds": lambda _: reactor.seconds() + 1e6})()
    )
    ros._goals.remove_idle()
    monkeypatch.setattr(ros._goals, "clock", kept)
    assert [action for action, _ in ros._goals._clients] == ["/forever"]
    running.goal.cancel()
    assert (await running.end()).status == CANCELED


@pytest.mark.parametrize("executor", ["events", "single"])
@pytest_twisted.ensureDeferred
async def test_shutdown_cancels_open_goals(executor: str, environment: dict[str, str], peer: Peer) -> None:
    """Each has an outcome."""
    ros = Ros2Platform(reactor, "switchboard_brief", executor=executor)
    ros.start()
    try:
        await serve(ros, peer, "/forever", "forever")
        peer.record[:] = [each for each in peer.record if each.get("ended") != "/forever"]
        wanted = SentGoal(ros, "/forever", 3)
        await until(lambda: wanted.fed)
    finally:
        ros.stop()
    assert wanted.outcomes[0].status == ABORTED
    assert not wanted.outcomes[0].certain
    peer.until(lambda: peer.reported("ended", "/forever"))
    assert peer.reported("ended", "/forever")[0]["canceled"] is True


@pytest.mark.parametrize("executor", ["events", "single"])
@pytest_twisted.ensureDeferred
async def test_shutdown_cancels_goals_that_are_accepted_meanwhile(
    executor: str, environment: dict[str, str], peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros2, "CLOSE_SECONDS", 2.0)
    ros = Ros2Platform(reactor, "switchboard_brief", executor=executor)
    ros.start()
    try:
        await serve(ros, peer, "/later", "late_forever")
        began = len(peer.reported("began", "/later"))
        ended = len(peer.reported("ended", "/later"))
        wanted = SentGoal(ros, "/later", 3)
        await until(lambda: wanted.goal._state.name == "SENT")
        assert len(peer.reported("began", "/later")) == began
    finally:
        ros.stop()
    assert (wanted.outcomes[0].status, wanted.outcomes[0].certain) == (NOT_STARTED, False)
    peer.until(lambda: len(peer.reported("ended", "/later")) > ended)


@pytest_twisted.ensureDeferred
async def test_goal_of_an_unreachable_server_can_be_cancelled_later_by_its_id(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    await serve(ros, peer, "/forever", "forever")
    other, lost = SentGoal(ros, "/forever", 3), SentGoal(ros, "/forever", 4)
    await until(lambda: other.fed and lost.fed)
    before = len(peer.reported("ended", "/forever"))
    with monkeypatch.context() as unseen:
        unseen.setattr(ros._goals, "servers", lambda action: frozenset())
        monkeypatch.setattr(other.goal, "check", lambda servers: None)
        assert (await lost.end()).certain is False
    assert len(peer.reported("ended", "/forever")) == before
    goal_canceller = GoalCanceller(MotionPolicy(actions=["/forever"]), ros, reactor)
    assert await goal_canceller.cancel("/forever", lost.goal.id) == ""
    await until(lambda: len(peer.reported("ended", "/forever")) == before + 1)
    fed = len(other.fed)
    await until(lambda: len(other.fed) > fed)
    assert await goal_canceller.cancel("/forever", lost.goal.id) == ""
    other.goal.cancel()
    assert (await other.end()).status == CANCELED
