"""Draining a relay before it ends."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol.errors import NotFound, Unavailable
from relay_server.cluster.admin import ClusterAdmin
from relay_server.cluster.drain import DRAINING, MOVE_SECONDS, Drain, DrainState
from relay_server.robots.registry import RobotState


class Link:
    """A robot's link that records why it was closed."""

    def __init__(self, robot: RobotState, closed: list[str]) -> None:
        self._robot = robot
        self._closed = closed

    def close(self, reason: str) -> None:
        assert reason == DRAINING
        self._closed.append(self._robot.name)
        self._robot.control_link = None


class Scene:
    """Three robots: the first is in use and the last is offline.

    :ivar closed: robots that were asked to reconnect, in order
    :ivar reasons: with which all clients were closed
    """

    def __init__(self, *, others: bool | None = True) -> None:
        self.clock = Clock()
        self.closed: list[str] = []
        self.reasons: list[str] = []
        self.robots = [RobotState(number, f"r{number}", "") for number in range(4)]
        self.robots[0].users = 1
        for robot in self.robots[:-1]:
            link: Any = Link(robot, self.closed)
            robot.control_link = link
        self.others = Deferred[bool]()
        self.drain = Drain(self.clock, self.robots, lambda: self.others)
        if others is not None:
            self.others.callback(others)
        self.drain.close_clients = [self.reasons.append]

    def begins(self) -> list[Any]:
        """Begins to drain; returns the result when there is one."""
        results: list[Any] = []
        Deferred.fromCoroutine(self.drain.begin()).addBoth(results.append)
        return results

    def run(self, seconds: float) -> None:
        self.clock.pump([0.1] * round(seconds / 0.1))


def test_robots_are_asked_one_after_another_then_clients_are_closed() -> None:
    """Robots without clients come first. A second order to drain changes nothing."""
    scene = Scene()
    assert scene.begins() == scene.begins() == [None]
    assert scene.closed == ["r1"]
    assert scene.drain.state == DrainState(robots=2, done=False)
    scene.run(1)
    assert scene.closed == ["r1", "r2", "r0"]
    assert scene.reasons == []
    for robot in scene.robots[:-1]:
        robot.elsewhere = True
    scene.run(0.2)
    assert scene.reasons == [DRAINING]
    assert scene.drain.state == DrainState(robots=0, done=True)


def test_robots_that_reach_no_other_relay_are_not_waited_for_for_ever() -> None:
    scene = Scene()
    scene.begins()
    scene.run(MOVE_SECONDS - 1)
    assert scene.reasons == []
    scene.run(2)
    assert scene.reasons == [DRAINING]


def test_the_only_relay_is_not_drained() -> None:
    scene = Scene(others=False)
    (failure,) = scene.begins()
    assert failure.check(Unavailable)
    assert "no other relay" in failure.getErrorMessage()
    assert not scene.drain.begun
    (alone,) = [Deferred.fromCoroutine(ClusterAdmin(None).drain())]
    alone.addErrback(lambda failure: failure.trap(NotFound))
    assert alone.result is NotFound


def test_a_relay_that_asks_the_others_already_counts_as_drained() -> None:
    """So two that are drained at the same time do not count on each other."""
    scene = Scene(others=None)
    results = scene.begins()
    assert (scene.drain.begun, scene.closed, results) == (True, [], [])
    scene.others.callback(False)
    assert (scene.drain.begun, scene.closed) == (False, [])
