"""The node of a service is made again when the machine has other addresses, in a real graph."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest

from robot_client import addresses
from robot_client.services import node_runner
from robot_client.services.health import Level, ServiceFinding
from tests.worlds.ros_domains import free_domain


class Service:
    """A service that is stopped by its second node, or moves to another network in its first."""

    def __init__(self, world: World, node: Any) -> None:
        self._world = world
        world.nodes.append(node.get_fully_qualified_name())

    def finding(self) -> ServiceFinding:
        if len(self._world.nodes) == 1:
            self._world.address = "10.9.0.7"
        else:
            os.kill(os.getpid(), signal.SIGTERM)
        return ServiceFinding(Level.OK, "works", {})

    def close(self) -> None:
        self._world.closed += 1


class World:
    """A machine with an address."""

    def __init__(self) -> None:
        self.address = "10.0.0.5"
        self.nodes: list[str] = []
        self.closed = 0


def test_a_service_is_made_again_with_its_name(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """It is ready once, and its first node is closed."""
    world = World()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain()))
    monkeypatch.setattr(node_runner, "on_this_machine", lambda environment: False)
    monkeypatch.setattr(node_runner, "own_addresses", lambda: frozenset({world.address}))
    monkeypatch.setattr(addresses, "CHECK_SECONDS", 0.2)
    node_runner.run("watch", "lab", lambda node: Service(world, node))
    assert (world.nodes, world.closed) == (["/lab/watch"] * 2, 2)
    printed = capfd.readouterr()
    assert printed.out == "READY\n"
    assert "addresses have changed" in printed.err
