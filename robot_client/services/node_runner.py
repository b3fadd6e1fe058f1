"""What all services share in the graph: a node, the loop that serves it, its end by a signal, and ``/diagnostics``."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import click
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.exceptions import NameValidationException
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

from relay_protocol.errors import Invalid, Unavailable
from robot_client.platforms.ros2.errors import check_namespace, in_one_line
from robot_client.platforms.ros2.executor import make_executor
from robot_client.platforms.ros2.transport import without_shared_memory
from robot_client.ros_log import ensure_log_folder
from robot_client.services.health import Level, ServiceFinding

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""For states: who comes late is told the last one."""

TOLD_EVERY = 1.0
"""Seconds between two findings on ``/diagnostics``, when nothing changes."""

_LONGEST_TURN = 0.1
"""Seconds; how long a signal may wait to be seen."""


class Service(Protocol):
    """What a service is in the graph, made with its node."""

    def finding(self) -> ServiceFinding:
        """How it is; asked often."""

    def close(self) -> None:
        """Let go of what it has beside the node."""


def run(name: str, namespace: str, build: Callable[[Any], Service]) -> None:
    """Serve one service until SIGINT or SIGTERM. Prints READY when its topics are there.

    Like the daemon's nodes it shares no memory with others, so that nobody is held up when it freezes.

    :param name: of the node
    :param namespace: before all its names; empty for none
    :param build: makes the service
    :raises click.BadParameter: there can be no such namespace
    :raises Invalid: a topic can't have such a name
    :raises Unavailable: ROS 2 does not start, or the service lacks something
    """
    with _stop_requested() as stop, _node(name, namespace) as (node, executor):
        try:
            service = build(node)
        except NameValidationException as error:
            raise Invalid(in_one_line(error)) from None
        with contextlib.closing(service):
            health = HealthReporter(node, service.finding)
            health.tell()
            click.echo("READY")
            while not stop:
                executor.spin_once(timeout_sec=_LONGEST_TURN)
                health.look()


class HealthReporter:
    """Puts findings on ``/diagnostics``: when the level changes at once, else every :data:`TOLD_EVERY` seconds."""

    def __init__(self, node: Any, finding: Callable[[], ServiceFinding]) -> None:
        self._node = node
        self._finding = finding
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._told = Level.STALE
        self._due = True
        node.create_timer(TOLD_EVERY, self._mark)

    def look(self) -> None:
        """Tell what is new, or due."""
        found = self._finding()
        if self._due or found.level is not self._told:
            self._tell(found)

    def tell(self) -> None:
        """Tell how it is now."""
        self._tell(self._finding())

    def _mark(self) -> None:
        self._due = True

    def _tell(self, found: ServiceFinding) -> None:
        if found.level is not self._told and found.level is not Level.OK:
            self._node.get_logger().warning(found.message)
        self._told, self._due = found.level, False
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes((found.level,)),
                name=self._name,
                message=found.message,
                values=[KeyValue(key=key, value=value) for key, value in found.values.items()],
            )
        ]
        self._publisher.publish(message)


@contextlib.contextmanager
def _node(name: str, namespace: str) -> Iterator[tuple[Any, Any]]:
    try:
        check_namespace(namespace)
    except Invalid as error:
        raise click.BadParameter(str(error)) from None
    ensure_log_folder()
    context = rclpy.Context()
    try:
        with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
            rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
            node: Any = rclpy.create_node(
                name, context=context, namespace=namespace, start_parameter_services=False
            )
    except Unavailable:
        raise
    except Exception as error:
        raise Unavailable(f"ROS 2 does not start: {error}") from error
    executor = make_executor("events", context)
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)


class _StopRequested:
    def __init__(self) -> None:
        self.requested = False

    def __bool__(self) -> bool:
        return self.requested


@contextlib.contextmanager
def _stop_requested() -> Iterator[_StopRequested]:
    """Signals only set a mark: the loop ends by itself, at a place where all is in order."""
    stop = _StopRequested()

    def note(*_: object) -> None:
        stop.requested = True

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
