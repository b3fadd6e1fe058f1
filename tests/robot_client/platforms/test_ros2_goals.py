"""Goals the platform has actions of a real graph pursue, with either executor."""

from __future__ import annotations

import threading

import pytest
import pytest_twisted
from example_interfaces.action import Fibonacci
from rclpy.serialization import deserialize_message, serialize_message
from twisted.internet import reactor

from relay_protocol.errors import Invalid, NotFound
from relay_protocol.link import MotionPolicy
from robot_client.motion.goal_canceller import GoalCanceller
from robot_client.platforms.base import ABORTED, CANCELED, NEVER_BEGAN, SUCCEEDED, GoalOutcome
from robot_client.platforms.ros2 import platform as ros2
from robot_client.platforms.ros2.goals import RosGoal
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer, until

FIBONACCI = "example_interfaces/action/Fibonacci"


class Wanted:
    """A goal, what was heard of it, and how it ended."""

    def __init__(
        self, ros: Ros2Platform, action: str, order: int = 5, listen: bool = True, type: str = FIBONACCI
    ):
        body = bytes(serialize_message(Fibonacci.Goal(order=order)))
        self.fed: list[list[int]] = []
        self.outcomes: list[GoalOutcome] = []
        self.goal: RosGoal = ros.pursue(action, type, body, self.feed if listen else None)
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
    """A goal's feedback comes while it is pursued, and its result at the end, with the type from the graph too."""
    await serve(ros, peer, "/count", "count")
    for type in (FIBONACCI, "example_interfaces/Fibonacci", ""):
        wanted = Wanted(ros, "/count", 5, type=type)
        status, body, reason, _ = await wanted.end()
        assert (status, reason) == (SUCCEEDED, "")
        assert list(deserialize_message(body, Fibonacci.Result).sequence) == [0, 1, 1, 2, 3]
        assert all(each == [0, 1, 1, 2, 3][: len(each)] for each in wanted.fed)


@pytest_twisted.ensureDeferred
async def test_feedback_comes_only_when_asked(ros: Ros2Platform, peer: Peer) -> None:
    """Who does not ask for feedback gets none; who does gets it in order."""
    await serve(ros, peer, "/forever", "forever")
    silent, heard = Wanted(ros, "/forever", 6, listen=False), Wanted(ros, "/forever", 6)
    await until(lambda: len(heard.fed) > 4)
    assert all(each == [0, 1, 1, 2, 3, 5][: len(each)] for each in heard.fed)
    assert heard.fed == sorted(heard.fed)
    assert silent.fed == []
    for wanted in (silent, heard):
        wanted.goal.cancel()
        assert (await wanted.end()).status == CANCELED


@pytest_twisted.ensureDeferred
async def test_cancelled_goal_ends_with_its_result(ros: Ros2Platform, peer: Peer) -> None:
    """A goal that is cancelled while it runs ends canceled, with the result the server gave."""
    await serve(ros, peer, "/forever", "forever")
    wanted = Wanted(ros, "/forever", 3)
    await until(lambda: wanted.fed)
    wanted.goal.cancel()
    wanted.goal.cancel()
    status, body, _, _ = await wanted.end()
    assert status == CANCELED
    assert list(deserialize_message(body, Fibonacci.Result).sequence) == [0, 1, 1]


@pytest_twisted.ensureDeferred
async def test_goal_can_be_cancelled_before_it_is_taken(ros: Ros2Platform, peer: Peer) -> None:
    """A goal that is cancelled while its server still thinks about it is cancelled as soon as it is taken."""
    await serve(ros, peer, "/late", "late")
    first = Wanted(ros, "/late", 3)
    await first.end()
    thought = len(peer.told("thinks", "/late"))
    wanted = Wanted(ros, "/late", 3)
    await until(lambda: len(peer.told("thinks", "/late")) > thought)
    wanted.goal.cancel()
    assert wanted.outcomes == []
    # This server had pursued it before it looked at the cancellation; what counts is that there is one end.
    assert (await wanted.end()).status in (SUCCEEDED, CANCELED)
    assert len(wanted.outcomes) == 1


@pytest_twisted.ensureDeferred
async def test_goal_cancelled_before_it_was_sent_is_not_sent(ros: Ros2Platform, peer: Peer) -> None:
    """However busy the executor was, no movement begins after the stop that cancelled it."""
    await serve(ros, peer, "/count", "count")
    await Wanted(ros, "/count", 5).end()
    free = threading.Event()
    ros._goals.spinner.do(free.wait, 10)
    wanted = Wanted(ros, "/count", 7)
    wanted.goal.cancel()
    free.set()
    status, _, reason, certain = await wanted.end()
    assert (status, certain) == (NEVER_BEGAN, True)
    assert "cancelled before it began" in reason
    await Wanted(ros, "/count", 6).end()
    assert 7 not in [each["order"] for each in peer.told("began", "/count")]


@pytest_twisted.ensureDeferred
async def test_goal_cancelled_at_once_never_begins(ros: Ros2Platform, peer: Peer) -> None:
    """A goal that is cancelled before its server was found ends at once."""
    wanted = Wanted(ros, "/nobody_there", 3)
    wanted.goal.cancel()
    assert wanted.outcomes[0].status == NEVER_BEGAN
    assert "cancelled before it began" in wanted.outcomes[0].reason


@pytest_twisted.ensureDeferred
async def test_all_goals_of_an_action_are_cancelled_whoever_gave_them(ros: Ros2Platform, peer: Peer) -> None:
    """One request without a goal's id is enough; where there is no goal left it is no error."""
    await serve(ros, peer, "/swept", "forever")
    wanted = [Wanted(ros, "/swept", 3), Wanted(ros, "/swept", 3)]
    await until(lambda: all(each.fed for each in wanted))
    sweep = GoalCanceller(MotionPolicy(actions=["/swept"]), ros, reactor, lambda topic: False)
    for _ in range(2):
        assert await sweep.stop() == []
        assert sweep.late() == []
        assert [(await each.end()).status for each in wanted] == [CANCELED, CANCELED]
    sweep.end()


@pytest_twisted.ensureDeferred
async def test_rejected_goal_never_began(ros: Ros2Platform, peer: Peer) -> None:
    """A goal the server rejects has no result, and words that say so."""
    await serve(ros, peer, "/reject", "reject")
    assert await Wanted(ros, "/reject").end() == GoalOutcome(
        NEVER_BEGAN, None, "the action /reject rejected the goal"
    )


@pytest_twisted.ensureDeferred
async def test_aborted_goal_has_its_result(ros: Ros2Platform, peer: Peer) -> None:
    """An aborted goal comes with the result the server gave."""
    await serve(ros, peer, "/abort", "abort")
    status, body, _, _ = await Wanted(ros, "/abort", 4).end()
    assert status == ABORTED
    assert list(deserialize_message(body, Fibonacci.Result).sequence) == [0, 1, 1, 2]


@pytest_twisted.ensureDeferred
async def test_action_that_is_not_there_is_not_waited_for(ros: Ros2Platform) -> None:
    """A goal for an action nobody serves ends in words after a second; without a type it can't even begin."""
    status, body, reason, _ = await Wanted(ros, "/nowhere").end()
    assert (status, body) == (NEVER_BEGAN, None)
    assert "/nowhere can't be reached" in reason
    with pytest.raises(NotFound, match="no action /unheard"):
        Wanted(ros, "/unheard", type="")


@pytest_twisted.ensureDeferred
async def test_server_that_vanishes_is_not_waited_for(ros: Ros2Platform, peer: Peer) -> None:
    """A goal whose server is taken away ends aborted, with the reason."""
    peer.do("act", "/doomed", "forever")
    await until(lambda: "/doomed" in ros.graph().actions)
    wanted = Wanted(ros, "/doomed", 3)
    await until(lambda: wanted.fed)
    peer.do("unact", "/doomed")
    status, body, reason, certain = await wanted.end()
    assert (status, body, certain) == (ABORTED, None, False)
    assert "/doomed vanished" in reason


@pytest_twisted.ensureDeferred
async def test_wishes_to_cancel_that_nobody_answers_are_not_kept(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They go with their goal when it is given up."""
    await serve(ros, peer, "/forever", "forever")
    wanted = Wanted(ros, "/forever", 3)
    await until(lambda: wanted.goal._handle)
    waiting = wanted.goal._client.ros._pending_cancel_requests
    with peer.frozen():
        for _ in range(3):
            wanted.goal.cancel()
        await until(lambda: len(waiting) == 3)
        monkeypatch.setattr(ros._goals, "servers", lambda action: frozenset())
        assert "vanished" in (await wanted.end()).reason
        await until(lambda: not waiting)


@pytest_twisted.ensureDeferred
async def test_what_makes_no_goal_is_said(ros: Ros2Platform, peer: Peer) -> None:
    """Another type than the action has, bytes that are no goal and a bad name are refused in words."""
    await serve(ros, peer, "/count", "count")
    with pytest.raises(Invalid, match="is of type example_interfaces/action/Fibonacci"):
        Wanted(ros, "/count", type="switchboard_test_interfaces/action/Everything")
    with pytest.raises(Invalid, match="no goal of type"):
        ros.pursue("/count", FIBONACCI, b"\0", None)
    with pytest.raises(Invalid, match="no action name"):
        Wanted(ros, "/not a name")


@pytest_twisted.ensureDeferred
async def test_idle_clients_are_swept(ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The client of an action nobody asked for in a while is taken away, not one with a goal under way."""
    await serve(ros, peer, "/forever", "forever")
    await serve(ros, peer, "/count", "count")
    running = Wanted(ros, "/forever", 3)
    await Wanted(ros, "/count").end()
    await until(lambda: running.fed)
    kept = ros._goals.clock
    monkeypatch.setattr(
        ros._goals, "clock", type("Later", (), {"seconds": lambda _: reactor.seconds() + 1e6})()
    )
    ros._goals.sweep()
    monkeypatch.setattr(ros._goals, "clock", kept)
    assert [action for action, _ in ros._goals._clients] == ["/forever"]
    running.goal.cancel()
    assert (await running.end()).status == CANCELED


@pytest.mark.parametrize("executor", ["events", "single"])
@pytest_twisted.ensureDeferred
async def test_leaving_cancels_what_is_under_way(
    executor: str, environment: dict[str, str], peer: Peer
) -> None:
    """A daemon that leaves cancels the goals it asked for, and each has an outcome."""
    ros = Ros2Platform(reactor, "switchboard_brief", executor=executor)
    ros.start()
    try:
        await serve(ros, peer, "/forever", "forever")
        peer.record[:] = [each for each in peer.record if each.get("ended") != "/forever"]
        wanted = Wanted(ros, "/forever", 3)
        await until(lambda: wanted.fed)
    finally:
        ros.stop()
    assert wanted.outcomes[0].status == ABORTED
    assert not wanted.outcomes[0].certain
    peer.until(lambda: peer.told("ended", "/forever"))
    assert peer.told("ended", "/forever")[0]["canceled"] is True


@pytest.mark.parametrize("executor", ["events", "single"])
@pytest_twisted.ensureDeferred
async def test_leaving_cancels_what_is_taken_meanwhile(
    executor: str, environment: dict[str, str], peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A goal that its server takes while the daemon says goodbye is cancelled; nobody can know whether it was."""
    monkeypatch.setattr(ros2, "FAREWELL", 2.0)
    ros = Ros2Platform(reactor, "switchboard_brief", executor=executor)
    ros.start()
    try:
        await serve(ros, peer, "/later", "late_forever")
        began = len(peer.told("began", "/later"))
        ended = len(peer.told("ended", "/later"))
        wanted = Wanted(ros, "/later", 3)
        await until(lambda: wanted.goal._state.name == "ASKED")
        assert len(peer.told("began", "/later")) == began
    finally:
        ros.stop()
    assert (wanted.outcomes[0].status, wanted.outcomes[0].certain) == (NEVER_BEGAN, False)
    peer.until(lambda: len(peer.told("ended", "/later")) > ended)


@pytest_twisted.ensureDeferred
async def test_goal_of_a_server_that_was_out_of_reach_can_still_be_cancelled(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is given up when the server is not seen for a second, goes on there, and is known by its id; others go on."""
    await serve(ros, peer, "/forever", "forever")
    other, lost = Wanted(ros, "/forever", 3), Wanted(ros, "/forever", 4)
    await until(lambda: other.fed and lost.fed)
    before = len(peer.told("ended", "/forever"))
    with monkeypatch.context() as unseen:
        unseen.setattr(ros._goals, "servers", lambda action: frozenset())
        monkeypatch.setattr(other.goal, "check", lambda servers: None)
        assert (await lost.end()).certain is False
    assert len(peer.told("ended", "/forever")) == before
    sweep = GoalCanceller(MotionPolicy(actions=["/forever"]), ros, reactor, lambda topic: False)
    assert await sweep.cancel("/forever", lost.goal.id) == ""
    await until(lambda: len(peer.told("ended", "/forever")) == before + 1)
    fed = len(other.fed)
    await until(lambda: len(other.fed) > fed)
    assert await sweep.cancel("/forever", lost.goal.id) == ""
    other.goal.cancel()
    assert (await other.end()).status == CANCELED
