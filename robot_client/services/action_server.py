"""An action server for nodes that work by callbacks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer


class CallbackActionServer(ActionServer):  # type: ignore[misc]  # rclpy is untyped
    """An action server whose goals go on until :meth:`finish`, without a coroutine that waits.

    rclpy has goals run in such a coroutine; the events executor runs a waiting coroutine again and again, which takes a
    whole core.

    :param node: of rclpy
    :param options: as of rclpy's, such as ``goal_callback``
    """

    def __init__(self, node: Any, action_type: Any, action_name: str, **options: Any) -> None:
        super().__init__(node, action_type, action_name, _never, **options)

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """Run a callback only where one is given, by :meth:`finish`."""
        if execute_callback is not None:
            super().notify_execute(goal_handle, execute_callback)

    def finish(self, goal_handle: Any, end: Callable[[Any], Any]) -> None:
        """End a goal after the callback that runs now.

        :param end: sets the state of the goal's handle, and returns the result
        """
        self.notify_execute(goal_handle, end)


def _never(_: Any) -> Any:
    raise AssertionError("goals are ended by finish()")
