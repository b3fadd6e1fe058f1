"""A node that reports regularly on ``/diagnostics``."""

from __future__ import annotations

import sys

_NODE = """
import sys
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
name, level, text, seconds = sys.argv[1:]
rclpy.init()
node = rclpy.create_node("reporting")
publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
status = DiagnosticStatus(level=getattr(DiagnosticStatus, level), name=name, message=text)
node.create_timer(float(seconds), lambda: publisher.publish(DiagnosticArray(status=[status])))
print("READY", flush=True)
rclpy.spin(node)
"""


def reporting(name: str, level: str, text: str, seconds: float) -> list[str]:
    """The command of a node that reports this status periodically.

    :param level: as in ``DiagnosticStatus``
    """
    return [sys.executable, "-c", _NODE, name, level, text, str(seconds)]
