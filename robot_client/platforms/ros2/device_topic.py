"""The state of the robot's computer as a ROS topic, for programs of the graph."""

from __future__ import annotations

from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile

from relay_protocol import link
from robot_client.device_state.rules import RULES

TOPIC = "device_state"
"""Of type ``diagnostic_msgs/msg/DiagnosticArray``: a status for each component. Late subscribers get the latest."""

_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class DeviceTopic:
    """Publishes the state.

    :param node: of its own, as a topic of the daemon's node is hidden from the graph that the relay sees
    """

    def __init__(self, node: Any) -> None:
        # Imported here, as a robot without these messages has a daemon, too; it has no such topic.
        from diagnostic_msgs.msg import DiagnosticArray

        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, TOPIC, _LATCHED)

    def publish(self, state: link.DeviceReport) -> None:
        """Publish a state."""
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        for component, value in state.readings.items():
            critical = state.critical.get(component, False)
            unit = RULES[component].unit
            message.status.append(
                DiagnosticStatus(
                    level=DiagnosticStatus.ERROR if critical else DiagnosticStatus.OK,
                    name=component,
                    message="critical" if critical else "",
                    values=[KeyValue(key="value", value=f"{value:g}"), KeyValue(key="unit", value=unit)],
                )
            )
        self._publisher.publish(message)
