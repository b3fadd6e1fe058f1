"""The state of the robot's computer in its ROS 2 graph."""

from __future__ import annotations

import pytest
import pytest_twisted
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import deserialize_message

from relay_protocol import link
from robot_client.platforms.ros2.health import DIAGNOSTICS
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer, until
from tests.worlds.ros_endpoints import seen

LATCHED = link.QoS(depth=1, durability="transient_local", reliability="reliable")


@pytest.mark.parametrize("ros", ["events"], indirect=True)
@pytest_twisted.ensureDeferred
async def test_programs_of_the_graph_read_the_state(ros: Ros2Platform, peer: Peer) -> None:
    """Also when they come later, and after the graph was joined again."""
    state = link.DeviceReport(
        at=1.0, readings={"cpu": 95.5, "signal": -61.0}, critical={"cpu": True, "signal": False}
    )
    ros.publish_device(state)
    for _ in range(2):
        found: list[bytes] = []
        graph = await seen(ros, lambda graph: "/device_state" in graph.topics)
        assert graph.topics["/device_state"].types == [DIAGNOSTICS]
        source = ros.subscribe("/device_state", DIAGNOSTICS, LATCHED, found.append, lambda: None)
        await until(lambda found=found: bool(found))
        statuses = {each.name: each for each in deserialize_message(found[0], DiagnosticArray).status}
        assert [(each.level, each.message) for each in statuses.values()] == [
            (b"\x02", "critical"),
            (b"\0", ""),
        ]
        assert [(each.key, each.value) for each in statuses["signal"].values] == [
            ("value", "-61"),
            ("unit", "dBm"),
        ]
        source.close()
        ros.renew()
