"""Charge of the robot, as its graph tells it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.serialization import deserialize_message

from relay_protocol.errors import SwitchboardError
from robot_client.platforms.base import GraphView, OnSample
from robot_client.platforms.ros2.types import Types

BATTERY = "sensor_msgs/msg/BatteryState"


class BatteryReader:
    """Listens to the first battery topic there is.

    :param listen: subscribes to a topic of type :data:`BATTERY`
    """

    def __init__(self, types: Types, listen: Callable[[str, OnSample], object]) -> None:
        self._types = types
        self._listen = listen
        self._listening = False
        self._sample: bytes | None = None

    def look(self, view: GraphView) -> None:
        """Listen to it as soon as there is one."""
        if self._listening:
            return
        topic = next(
            (
                name
                for name, each in sorted(view.topics.items())
                if BATTERY in each.types and "/_" not in name
            ),
            None,
        )
        if topic is None or not view.topics[topic].publishers:
            return
        with suppress(SwitchboardError):  # no such type here; a robot without a gauge is a robot
            self._listen(topic, self._keep)
        self._listening = True

    def charge(self) -> float | None:
        """Charge, 0 to 1, where known."""
        if self._sample is None:
            return None
        try:
            state: Any = deserialize_message(self._sample, self._types.message(BATTERY))
        except Exception:  # any node may publish anything there; rclpy's errors differ between releases
            self._sample = None
            return None
        return float(state.percentage) if 0.0 <= state.percentage <= 1.0 else None

    def _keep(self, body: bytes) -> None:
        self._sample = body
