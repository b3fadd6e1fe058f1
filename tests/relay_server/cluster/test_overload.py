"""When an overloaded relay asks robots to dial others, and which ones."""

from __future__ import annotations

from typing import Any

import pytest
from twisted.internet.task import Clock

from relay_protocol.errors import Unavailable
from relay_server.cluster.overload import (
    AGAIN_SECONDS,
    CHECK_SECONDS,
    MOST_CHECKS,
    OVERLOAD,
    OverloadRelief,
)
from relay_server.robots.registry import RobotState


class Link:
    """The control link of a robot."""

    def __init__(self, robot: RobotState) -> None:
        self._robot = robot
        self.reasons: list[str] = []

    def close(self, reason: str) -> None:
        self.reasons.append(reason)
        self._robot.control_link = None


class Scene:
    """A relay with 40 robots, the last of them offline. Two have users."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.robots = [RobotState(number, f"r{number}", "lab1") for number in range(1, 41)]
        self.links: dict[int, Any] = {}
        for each in self.robots[:-1]:
            self.links[each.robot_id] = each.control_link = Link(each)  # type: ignore[assignment]
        self.robots[6].users, self.robots[8].users, self.robots[9].users = 2, 1, 3
        self.cpu = 1.0
        self.others: list[float] = [0.9, 0.2]
        self.relief = OverloadRelief(self.clock, self.robots, lambda: self.cpu, self._others)
        self.relief.stays = lambda robot: robot.robot_id == 10
        self.relief.start()

    async def _others(self) -> list[float]:
        if not self.others:
            raise Unavailable("the bus is gone")
        return self.others

    def asked(self, checks: int = MOST_CHECKS) -> list[int]:
        """The robots asked meanwhile."""
        for each in self.links.values():
            each.reasons.clear()
        for _ in range(checks):
            self.clock.advance(CHECK_SECONDS)
        return [number for number, each in self.links.items() if each.reasons == [OVERLOAD]]


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_used_robots_are_asked_first_and_those_that_are_driven_not(scene: Scene) -> None:
    """One in twenty. The load must be high again before more are asked."""
    assert scene.asked(MOST_CHECKS - 1) == []
    assert scene.asked(1) == [7]
    assert scene.asked(MOST_CHECKS - 1) == []
    assert scene.asked(1) == [9]
    assert scene.asked() == [1]


def test_a_robot_that_comes_back_is_not_asked_again(scene: Scene) -> None:
    assert scene.asked() == [7]
    scene.robots[6].control_link = scene.links[7]
    assert scene.asked() == [9]
    scene.relief.stays = lambda robot: robot.robot_id != 7
    assert scene.asked() == []
    scene.cpu = 0.0
    scene.clock.advance(AGAIN_SECONDS)
    scene.cpu = 1.0
    assert scene.asked() == [7]


@pytest.mark.parametrize("others", [[], [0.6, 0.9]])
def test_no_robot_is_asked_while_no_other_relay_has_room(scene: Scene, others: list[float]) -> None:
    scene.others = others
    assert scene.asked() == []
    scene.others = [0.4]
    assert scene.asked() == [7]


def test_a_short_load_is_no_overload(scene: Scene) -> None:
    for _ in range(3):
        assert scene.asked(MOST_CHECKS - 1) == []
        scene.cpu = 0.3
        assert scene.asked(1) == []
        scene.cpu = 0.9
    scene.relief.stop()
    scene.relief.stop()
    assert scene.asked() == []
