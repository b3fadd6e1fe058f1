"""Runs the ROS node of a service until a signal, and publishes its ``/diagnostics``."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol, TypeVar

import click
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.exceptions import NameValidationException
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

from relay_protocol.errors import Invalid, Unavailable
from robot_client.addresses import CHECK_SECONDS, AddressWatch, own_addresses, read_interfaces_again
from robot_client.platforms.ros2.errors import check_namespace, in_one_line
from robot_client.platforms.ros2.executor import make_executor
from robot_client.platforms.ros2.transport import on_this_machine, without_shared_memory
from robot_client.ros_log import ensure_log_folder
from robot_client.services.health import Level, ServiceFinding

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""For states: late subscribers get the last one."""

REPORT_SECONDS = 1.0
"""Interval of ``/diagnostics`` without changes, seconds."""

_SPIN_SECONDS = 0.1
"""Seconds until a signal is noticed, at most."""


class Service(Protocol):
    """A service, created with its node."""

    def finding(self) -> ServiceFinding:
        """Its state; called often."""

    def close(self) -> None:
        """Release resources other than the node."""


S = TypeVar("S", bound=Service)


def _never(service: Service) -> bool:
    return False


def run(name: str, namespace: str, build: Callable[[Any], S], is_busy: Callable[[S], bool] = _never) -> None:
    """Run a service until SIGINT or SIGTERM. Prints READY when its topics exist.

    Like the daemon's nodes it uses no shared memory, so that a frozen service blocks no other node. Like them it is
    made again when the machine's addresses have changed (:mod:`robot_client.address_changes`), once it is not busy.

    :param name: of the node
    :param namespace: before all its names; empty for none
    :param build: creates the service
    :param is_busy: whether it would lose something if it were made again now
    :raises click.BadParameter: invalid namespace
    :raises Invalid: invalid topic name
    :raises Unavailable: ROS 2 does not start, or the service cannot
    """
    with _stop_requested() as stop:
        _run_node(name, namespace, build, is_busy, stop, lambda: click.echo("READY"))
        while not stop:
            read_interfaces_again()
            try:
                _run_node(name, namespace, build, is_busy, stop, _note_addresses)
            except Unavailable as error:
                click.echo(f"{error}; it is tried again", err=True)
                time.sleep(CHECK_SECONDS)


def _run_node(
    name: str,
    namespace: str,
    build: Callable[[Any], S],
    is_busy: Callable[[S], bool],
    stop: _StopRequested,
    ready: Callable[[], object],
) -> None:
    """Run a service until it is stopped or the machine has other addresses."""
    addresses = AddressWatch(frozenset if on_this_machine(os.environ) else own_addresses)
    with _node(name, namespace) as (node, executor):
        try:
            service = build(node)
        except NameValidationException as error:
            raise Invalid(in_one_line(error)) from None
        with contextlib.closing(service):
            health = HealthReporter(node, service.finding)
            health.report()
            ready()

            def nodes() -> list[str]:
                return [each for each in node.get_node_names() if each != name]

            while not stop and (is_busy(service) or not addresses.changed(nodes)):
                executor.spin_once(timeout_sec=_SPIN_SECONDS)
                health.report_if_due()


def _note_addresses() -> None:
    click.echo("The machine's addresses have changed, so the ROS node was made again.", err=True)


class HealthReporter:
    """Publishes findings on ``/diagnostics``: at once when the level changes, else every :data:`REPORT_SECONDS`."""

    def __init__(self, node: Any, finding: Callable[[], ServiceFinding]) -> None:
        self._node = node
        self._finding = finding
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._reported_level = Level.STALE
        self._due = True
        node.create_timer(REPORT_SECONDS, self._set_due)

    def report_if_due(self) -> None:
        """Publish the state if its level has changed or a report is due."""
        found = self._finding()
        if self._due or found.level is not self._reported_level:
            self._publish(found)

    def report(self) -> None:
        """Publish the state now."""
        self._publish(self._finding())

    def _set_due(self) -> None:
        self._due = True

    def _publish(self, found: ServiceFinding) -> None:
        if found.level is not self._reported_level and found.level is not Level.OK:
            self._node.get_logger().warning(found.message)
        self._reported_level, self._due = found.level, False
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
    """Signals only set a flag; the loop ends at a safe point."""
    stop = _StopRequested()

    def request_stop(*_: object) -> None:
        stop.requested = True

    before = {number: signal.signal(number, request_stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
