"""One relay and one robot for the tests that break nothing; those that do start their own. A browser."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, expect
from switchboard_browser import chromium
from switchboard_client import Client
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_waiting import wait_for
from switchboard_watchers import Watcher, bystanders

QUIET_NS = 1_000_000_000
"""A daemon repeats a zero for a fifth of that."""


@dataclass
class World:
    """A relay with the robot ``rover`` and three users."""

    relay: Relay
    robot: Robot
    operator: str
    viewer: str
    stranger: str

    def wait_known(self) -> None:
        """Until the relay knows what the robot has: it is online before it has found out all of its own graph."""
        self.robot.wait_online()
        with self.relay.connect("rover", self.viewer) as client:
            wait_for("its graph is known", lambda: {"/odom", "/scan", "/cmd_vel"} <= topics_of(client))

    def left_alone(self) -> int:
        """Until what tests before this one did is over: nobody has control, the robot stands, and is told nothing.

        :returns: monotonic nanoseconds; from then on it is told what this test tells it
        """
        wait_for("nobody has control", lambda: self._holder() is None)
        wait_for("the robot is left alone", lambda: not self.robot.moving() and self._untold())
        return time.monotonic_ns()

    def _holder(self) -> Any:
        with self.relay.connect("rover", self.viewer) as client:
            client.send(op="subscribe", topic="/relay/control")
            return client.until(op="publish", topic="/relay/control")["msg"]["holder"]

    def _untold(self) -> bool:
        """Whether the last command is so old that a daemon repeats no zero of its any more."""
        last = max((each["t"] for each in self.robot.events("command")), default=0)
        return bool(time.monotonic_ns() - last > QUIET_NS)

    @contextmanager
    def operating(self) -> Iterator[Client]:
        """An operator's connection, who wants to hear errors."""
        with self.relay.connect("rover", self.operator) as client:
            client.send(op="set_level", level="error")
            yield client

    @contextmanager
    def over_http(self) -> Iterator[httpx.Client]:
        """Requests of the operator's to the robot's resources."""
        with httpx.Client(
            base_url=f"http://127.0.0.1:{self.relay.http_port}/api/v1/robots/rover",
            headers={"Authorization": f"Bearer {self.operator}"},
            timeout=90,
        ) as client:
            yield client


def topics_of(client: Client) -> set[str]:
    """The topics a client sees."""
    return set(client.call("/rosapi/topics")["values"]["topics"])


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """The world most end-to-end tests share."""
    relay = Relay(tmp_path_factory.mktemp("world"))
    try:
        robot = Robot(relay, "rover", camera=True)
        try:
            operator, viewer, stranger = (relay.user(name) for name in ("operator", "viewer", "stranger"))
            relay.cli("right", "grant", "operator", "rover", "operator")
            relay.cli("right", "grant", "viewer", "rover", "viewer")
            made = World(relay, robot, operator, viewer, stranger)
            made.wait_known()
            yield made
        finally:
            robot.stop()
    finally:
        relay.stop()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One Chromium for all tests of a module, which wait for what a page shows."""
    expect.set_options(timeout=60_000)
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def watchers(world: World) -> Iterator[list[Watcher]]:
    """Two bystanders for all tests of a module: the same connections from the first attack to the last."""
    with bystanders(world.relay, "rover", world.viewer, world.operator) as found:
        yield found
