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

_ACTIONS = "_actions"
"""What the name of the node for actions adds to ours."""


class Nodes:
    """One node, and another for actions where they need one.

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
        self._acting: Spinner | None = None

    def enter(self) -> None:
        """Make the node; its executor does not turn yet.

        :raises Unavailable: ROS 2 does not start
        """
        self._context = rclpy.Context()
        try:
            with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
                rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
                self.main = self._spun(self.names[0], self.kind)
        except Unavailable:
            raise
        except Exception as error:
            raise Unavailable(f"ROS 2 does not start: {error}") from error

    def for_actions(self) -> Spinner:
        """The node that actions are on, made when it is first needed.

        Action servers and clients are what rclpy calls waitables. When one goes while something for it waits in an
        EventsExecutor, that ends the process (rclpy 7.1): it calls Python without the interpreter's lock.
        """
        if self.kind != "events":
            return self.main
        if self._acting is None:
            self._acting = self._spun(self.names[1], "single")
            self._acting.start()
        return self._acting

    def trouble(self) -> str | None:
        """A sentence when an executor is stuck."""
        trouble = self.main.trouble()
        if trouble is None and self._acting is not None:
            trouble = self._acting.trouble()
        return trouble

    def stop(self) -> None:
        """Turn no more; the node for actions leaves."""
        if self._acting is not None:
            acting, self._acting = self._acting, None
            acting.stop()
            acting.node.destroy_node()
        self.main.stop()

    def leave(self) -> None:
        """Leave the graph."""
        self.main.node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _spun(self, name: str, executor: str) -> Spinner:
        node = rclpy.create_node(
            name,
            context=self._context,
            start_parameter_services=False,
            enable_rosout=False,
            parameter_overrides=[Parameter("use_sim_time", value=self._sim_time)],
        )
        # The node's clock stands still when a simulation pauses.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        return Spinner(make_executor(executor, self._context), node, steady)
