"""Actions that are asked to cancel their goals, in memory; the rest of it is in the tests of the helm."""

from __future__ import annotations

import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol import link
from relay_protocol.link import MotionPolicy
from robot_client.motion.goal_canceller import HEARD_WITHIN, PATIENCE, GoalCanceller
from robot_client.motion.guard_protocol import CANCEL
from robot_client.platforms.base import GraphView
from robot_client.platforms.memory import MemoryPlatform
from tests.robot_client.breaking import broken

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
        self.sweep = GoalCanceller(policy, self.platform, self.clock, lambda topic: False)

    def ask(self, action: str) -> Deferred[bytes]:
        self.asked.append(action)
        return Deferred()


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_a_stop_that_can_not_read_the_graph_asks_what_moved_the_robot_before_it(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also the first since the robot was resumed; who stopped it is told that others may be there."""
    scene.sweep.actions()
    monkeypatch.setattr(scene.platform, "graph", broken)
    told: list[list[str]] = []
    scene.sweep.stop().addCallback(told.append)
    assert scene.asked == [SPIN]
    scene.clock.advance(HEARD_WITHIN)
    assert told == [["which actions there are could not be found out"]]
    assert scene.sweep.late() != []


def test_what_has_not_answered_is_asked_again_though_the_graph_can_not_be_read(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every second, as it was seen last."""
    scene.sweep.actions()
    scene.sweep.begin()
    monkeypatch.setattr(scene.platform, "graph", broken)
    for times in range(1, 4):
        scene.sweep.again()
        scene.clock.advance(PATIENCE)
        assert scene.asked == [SPIN] * times
