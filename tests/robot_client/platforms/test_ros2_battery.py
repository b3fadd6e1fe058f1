"""The charge of a robot with ROS 2."""

from __future__ import annotations

import pytest
import pytest_twisted

from relay_protocol.link import Topic
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
    battery = BatteryReader(Types(), lambda topic, on_sample: listeners.append(on_sample))
    battery.update(GraphView(topics={"/battery": Topic(types=[BATTERY], publishers=["/driver"])}))
    listeners[0](b"\0\1\0\0\xff")
    assert battery.charge() is None
