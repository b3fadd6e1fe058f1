"""A module is ready when a lifecycle node of the real graph is active."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import pytest_twisted
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from twisted.internet import reactor, task

from robot_client.modules.readiness import check_ready
from robot_client.modules.settings import ModuleSettings
from robot_client.platforms.ros2.platform import Ros2Platform

LIDAR = ModuleSettings(name="lidar", command=["lidar"], ready_lifecycle="/lidar")


@pytest.fixture
def lidar(environment: dict[str, str]) -> Iterator[LifecycleNode]:
    """A lifecycle node that is answered by a thread of its own."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = LifecycleNode("lidar", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def spin() -> None:
        try:
            executor.spin()
        except ExternalShutdownException:
            return

    thread = threading.Thread(target=spin)
    thread.start()
    yield node
    rclpy.shutdown(context=context)
    thread.join()


async def becomes(ros: Ros2Platform, ready: bool) -> None:
    while await check_ready(LIDAR, ros, frozenset()) is not ready:
        await task.deferLater(reactor, 0.05)


@pytest_twisted.ensureDeferred
async def test_lifecycle_node_is_ready_while_it_is_active(ros: Ros2Platform, lidar: LifecycleNode) -> None:
    assert not await check_ready(LIDAR, ros, frozenset())
    lidar.trigger_configure()
    assert not await check_ready(LIDAR, ros, frozenset())
    lidar.trigger_activate()
    await becomes(ros, True)
    lidar.trigger_deactivate()
    await becomes(ros, False)
