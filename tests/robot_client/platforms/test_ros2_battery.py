"""The charge of a robot with ROS 2."""

from __future__ import annotations

import math
from typing import Any

import pytest
import pytest_twisted
from rclpy.serialization import serialize_message
from sensor_msgs.msg import BatteryState

from relay_protocol.link import Topic
from robot_client.alerts import ignore_alert
from robot_client.platforms.base import GraphView, OnSample
from robot_client.platforms.ros2.health import BATTERY, BatteryReader
from robot_client.platforms.ros2.platform import Ros2Platform
from robot_client.platforms.ros2.types import Types
from tests.robot_client.ros import Peer, until


@pytest.mark.parametrize("ros", ["events"], indirect=True, scope="module")
@pytest_twisted.ensureDeferred
async def test_battery_is_found(ros: Ros2Platform, peer: Peer) -> None:
    assert ros.battery() is None
    peer.do("battery", "/battery_state", 0.75)
    await until(lambda: ros.graph() and ros.battery() is not None)
    assert ros.battery() == pytest.approx(0.75)


def test_malformed_battery_sample_is_no_charge() -> None:
    listeners: list[OnSample] = []
    battery = BatteryReader(Types(), lambda topic, on_sample: listeners.append(on_sample), ignore_alert)
    battery.update(GraphView(topics={"/battery": Topic(types=[BATTERY], publishers=["/driver"])}))
    listeners[0](b"\0\1\0\0\xff")
    assert battery.charge() is None


def test_charge_out_of_range_is_reported_in_words() -> None:
    """Once, until it is in range again or not measured; it counts as unknown."""
    listeners: list[OnSample] = []
    alerts: list[tuple[Any, ...]] = []

    def alert(*what: Any, over: bool = False) -> None:
        alerts.append((*what, over))

    battery = BatteryReader(Types(), lambda topic, on_sample: listeners.append(on_sample), alert)
    battery.update(GraphView(topics={"/battery": Topic(types=[BATTERY], publishers=["/driver"])}))

    def charge(value: float) -> float | None:
        listeners[0](bytes(serialize_message(BatteryState(percentage=value))))
        return battery.charge()

    assert charge(0.5) == 0.5
    assert charge(math.nan) is None
    assert alerts == []
    assert charge(87.0) is None
    assert charge(86.0) is None
    assert alerts == [
        (
            "warning",
            "/battery reports a charge of 87, which is not from 0 to 1; it counts as unknown. "
            "Publish 'percentage' as a fraction, and NaN when it is not measured",
            "module",
            "battery topic",
            False,
        )
    ]
    assert charge(1.0) == 1.0
    assert alerts[1:] == [
        ("info", "the charge that /battery reports is in range again", "module", "battery topic", True)
    ]
    for value in (-1.0, math.inf):
        assert charge(value) is None
    assert len(alerts) == 3
