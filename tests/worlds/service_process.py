"""Shared by tests of services in the graph: a service as a process, and a node of the test."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor

from robot_client.platforms.ros2.transport import without_shared_memory
from robot_client.services.main import COMMAND
from tests.worlds.processes import BIN, Process
from tests.worlds.waiting import wait_for


class TopicWatcher:
    """A node that stores the newest message of each of its topics."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
            rclpy.init(context=self._context, domain_id=domain)
            self.node = rclpy.create_node("onlooker", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.heard: dict[str, list[Any]] = {}

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def watch(self, topic: str, kind: type, qos: Any = 10) -> None:
        """Subscribes to a topic."""
        self.heard[topic] = []
        self.node.create_subscription(kind, topic, self.heard[topic].append, qos)

    def until(
        self, what: str, fact: Callable[[], Any], meanwhile: Callable[[], object] = lambda: None
    ) -> Any:
        """Spins the node until a condition holds, with a repeated action; returns the condition's value."""

        def turn() -> Any:
            meanwhile()
            self._executor.spin_once(timeout_sec=0.05)
            return fact()

        return wait_for(what, turn)

    def newest(self, topic: str, like: Callable[[Any], Any] = lambda _: True, **more: Any) -> Any:
        """The first message from now on that fits."""
        heard = self.heard[topic]
        heard.clear()
        return self.until(
            f"a message on {topic}", lambda: next((each for each in heard if like(each)), None), **more
        )

    def watch_health(self) -> None:
        """Subscribes to ``/diagnostics``."""
        self.watch("/diagnostics", DiagnosticArray, 50)

    def health(
        self, name: str, like: Callable[[Any], Any], meanwhile: Callable[[], object] = lambda: None
    ) -> Any:
        """A node's diagnostic status, as soon as it fits."""

        def found() -> DiagnosticStatus | None:
            said = [status for each in self.heard["/diagnostics"] for status in each.status]
            return next((each for each in reversed(said) if each.name == name and like(each)), None)

        return self.until(f"diagnostics of {name}", found, meanwhile)


@contextlib.contextmanager
def service(domain: int, folder: Path, *words: str) -> Iterator[Process]:
    """A running service that has printed READY; ended by SIGTERM, with exit code 0."""
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    # OpenCV's solver has threads that a fork does not copy, and waits for them.
    fresh = [sys.executable, "-m", "robot_client.services.main"]
    command = fresh if words[0] in ("markers", "faces") else [str(BIN / COMMAND)]
    process = Process([*command, *words], folder, words[0], environment)
    try:
        process.wait_to_say("READY")
        yield process
    finally:
        code = process.stop()
    assert code == 0, process.log.read_text()
