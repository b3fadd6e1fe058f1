"""The daemon's nodes in the robot's ROS 2 graph, and the threads that serve them."""

from __future__ import annotations

from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from relay_protocol.errors import Unavailable
from robot_client.platforms.ros2.executor import Spinner, make_executor
from robot_client.platforms.ros2.transport import without_shared_memory

_DEVICE = "device_"
"""Prefix of the name of the node of the computer: names that begin as the daemon's own are hidden from the graph."""
_ACTIONS = "_actions"
"""Suffix of the name of the node for actions."""


class Nodes:
    """One node, and another one for actions if they need it.

    :param name: of the node
    :param executor: ``events`` or ``single``
    :param sim_time: whether the clocks of the nodes follow ``/clock``
    """

    main: Spinner

    def __init__(self, name: str, executor: str, sim_time: bool) -> None:
        self.names = (name, name + _ACTIONS)
        self.kind = executor
        self._sim_time = sim_time
        self._context: Any = None
        self._for_actions: Spinner | None = None
        self._for_device: Any = None

    def start(self) -> None:
        """Create the node; its executor does not spin yet.

        :raises Unavailable: ROS 2 does not start
        """
        self._context = rclpy.Context()
        try:
            with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
                rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
                self.main = self._create(self.names[0], self.kind)
        except Unavailable:
            raise
        except Exception as error:
            raise Unavailable(f"ROS 2 does not start: {error}") from error

    def for_actions(self) -> Spinner:
        """The node for actions, created on first use.

        Action servers and clients are waitables. If one is destroyed while an event for it waits in an
        EventsExecutor, the process crashes (rclpy 7.1): the executor calls Python without holding the GIL.
        """
        if self.kind != "events":
            return self.main
        if self._for_actions is None:
            self._for_actions = self._create(self.names[1], "single")
            self._for_actions.start()
        return self._for_actions

    def for_device(self) -> Any:
        """The node of the robot's computer, created on first use. It only publishes, so nothing serves it."""
        if self._for_device is None:
            self._for_device = self._create_node(_DEVICE + self.names[0])
        return self._for_device

    def fault(self) -> str | None:
        """See :meth:`~robot_client.platforms.ros2.executor.Spinner.fault`, of either executor."""
        fault = self.main.fault()
        if fault is None and self._for_actions is not None:
            fault = self._for_actions.fault()
        return fault

    def stop(self) -> None:
        """Stop the executors; the node for actions is destroyed."""
        if self._for_actions is not None:
            spinner, self._for_actions = self._for_actions, None
            spinner.stop()
            spinner.node.destroy_node()
        self.main.stop()

    def destroy(self) -> None:
        """Leave the graph."""
        device, self._for_device = self._for_device, None
        if device is not None:
            device.destroy_node()
        self.main.node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _create(self, name: str, executor: str) -> Spinner:
        # A steady clock: the node's clock stops when a simulation pauses.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        return Spinner(make_executor(executor, self._context), self._create_node(name), steady)

    def _create_node(self, name: str) -> Any:
        return rclpy.create_node(
            name,
            context=self._context,
            start_parameter_services=False,
            enable_rosout=False,
            parameter_overrides=[Parameter("use_sim_time", value=self._sim_time)],
        )
