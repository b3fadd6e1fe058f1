"""Requests to cancel goals, in memory; whole stops are in test_stop_goals.py."""

from __future__ import annotations

import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol import link
from relay_protocol.link import MotionPolicy
from robot_client.motion.goal_canceller import ANSWER_SECONDS, STOP_SECONDS, GoalCanceller
from robot_client.motion.guard_protocol import CANCEL
from robot_client.platforms.base import GraphView
from tests.worlds.memory_platform import MemoryPlatform
from tests.worlds.robot_failures import broken

SPIN, TALK = "/robot1/spin", "/robot1/talk"


class Scene:
    """A robot with an action that moves it, and one that does not; neither answers."""

    def __init__(self) -> None:
        self.clock = Clock()
        view = GraphView(actions={name: link.Service(types=["t"]) for name in (SPIN, TALK)})
        self.platform = MemoryPlatform(view)
        self.asked: list[str] = []
        for action in view.actions:
            self.platform.services[action + CANCEL] = lambda _, action=action: self.ask(action)
        policy = MotionPolicy(actions=["*/spin"])
        self.goal_canceller = GoalCanceller(policy, self.platform, self.clock)

    def ask(self, action: str) -> Deferred[bytes]:
        self.asked.append(action)
        return Deferred()


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_stop_with_an_unreadable_graph_cancels_at_the_actions_seen_before(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also in the first stop after a resume; the result says that others may exist."""
    scene.goal_canceller.actions()
    monkeypatch.setattr(scene.platform, "graph", broken)
    results: list[list[str]] = []
    scene.goal_canceller.stop().addCallback(results.append)
    assert scene.asked == [SPIN]
    scene.clock.advance(STOP_SECONDS)
    assert results == [["the robot's actions could not be read from the graph"]]
    assert scene.goal_canceller.problems() != []


def test_unanswered_request_is_repeated_with_an_unreadable_graph(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every second."""
    scene.goal_canceller.actions()
    scene.goal_canceller.begin_stopped()
    monkeypatch.setattr(scene.platform, "graph", broken)
    for times in range(1, 4):
        scene.goal_canceller.retry()
        scene.clock.advance(ANSWER_SECONDS)
        assert scene.asked == [SPIN] * times
