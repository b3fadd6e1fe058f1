"""One relay and one robot for tests that leave them intact; others start their own. A browser."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, expect

from tests.worlds.browser import chromium
from tests.worlds.bystanders import Watcher, bystanders
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

MESH = bytes(range(256)) * 2048
"""Bytes of ``package://rover_description/meshes/base.stl``, which need more than one part."""

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
        """Waits until the relay knows the robot's graph, which follows its registration."""
        self.robot.wait_online()
        with self.relay.connect("rover", self.viewer) as client:
            wait_for("its graph is known", lambda: {"/odom", "/scan", "/cmd_vel"} <= topics_of(client))

    def left_alone(self) -> int:
        """Waits until earlier tests have no effect: no controller, a standing robot, no commands.

        :returns: monotonic nanoseconds; later commands are those of this test
        """
        wait_for("nobody has control", lambda: self._holder() is None)
        wait_for("the robot is left alone", lambda: not self.robot.moving() and self._untold())
        return time.monotonic_ns()

    def _holder(self) -> Any:
        with self.relay.connect("rover", self.viewer) as client:
            client.send(op="subscribe", topic="/relay/control")
            return client.until(op="publish", topic="/relay/control")["msg"]["holder"]

    def _untold(self) -> bool:
        """Whether the last command is so old that the daemon repeats no zero velocity."""
        last = max((each["t"] for each in self.robot.events("command")), default=0)
        return bool(time.monotonic_ns() - last > QUIET_NS)

    @contextmanager
    def operating(self) -> Iterator[Client]:
        """An operator's connection that receives errors."""
        with self.relay.connect("rover", self.operator) as client:
            client.send(op="set_level", level="error")
            yield client

    @contextmanager
    def over_http(self) -> Iterator[httpx.Client]:
        """Requests of the operator to the robot's resources."""
        with httpx.Client(
            base_url=f"http://127.0.0.1:{self.relay.http_port}/api/v1/robots/rover",
            headers={"Authorization": f"Bearer {self.operator}"},
            timeout=90,
        ) as client:
            yield client


def topics_of(client: Client) -> set[str]:
    """The topics a client sees."""
    return set(client.call("/rosapi/topics")["values"]["topics"])


def install_mesh(prefix: Path) -> None:
    """Installs the package ``rover_description`` with the mesh :data:`MESH`."""
    index = prefix / "share/ament_index/resource_index/packages"
    meshes = prefix / "share/rover_description/meshes"
    for folder in (index, meshes):
        folder.mkdir(parents=True)
    (index / "rover_description").touch()
    (meshes / "base.stl").write_bytes(MESH)


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """The world shared by most end-to-end tests."""
    relay = Relay(tmp_path_factory.mktemp("world"))
    try:
        prefix = relay.folder / "prefix"
        install_mesh(prefix)
        paths = os.pathsep.join(filter(None, [str(prefix), os.environ.get("AMENT_PREFIX_PATH")]))
        robot = Robot(relay, "rover", camera=True, daemon_env={"AMENT_PREFIX_PATH": paths})
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
    """One Chromium for all tests of a module, which wait for a page's state."""
    expect.set_options(timeout=60_000)
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def watchers(world: World) -> Iterator[list[Watcher]]:
    """Two bystanders for all tests of a module: the same connections from the first attack to the last."""
    with bystanders(world.relay, "rover", world.viewer, world.operator) as found:
        yield found
