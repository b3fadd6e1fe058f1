"""A client of actions that also works when an answer is late or lost.

An action is three services and two topics, each of which the middleware discovers by itself. A server that has not
discovered the reader of an answer yet drops that answer (https://github.com/ros2/rmw_fastrtps/issues/842). The topic
of states is kept for late joiners, so it says in the end what became of a goal.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from unique_identifier_msgs.msg import UUID


class GoalClient(ActionClient):  # type: ignore[misc]  # rclpy is untyped
    """A client that passes on feedback after the result too, and the states of goals.

    Feedback and results are separate endpoints, and an executor takes one of each at a time: rclpy would
    drop feedback that the result has overtaken. The user of a goal ends both by :meth:`forget`. All methods
    belong to the executor's thread.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        # rclpy's own constructor makes it known to the executor.
        self._watched: dict[bytes, Callable[[int], None]] = {}
        super().__init__(*args, **options)

    def watch(self, goal_id: bytes, on_status: Callable[[int], None]) -> None:
        """Call a function with each state of a goal that the server publishes.

        :param on_status: gets a constant of action_msgs/msg/GoalStatus, also several times the same
        """
        self._watched[goal_id] = on_status

    def forget(self, goal_id: bytes) -> None:
        """Pass on nothing more of a goal."""
        self._watched.pop(goal_id, None)
        self._feedback_callbacks.pop(goal_id, None)

    def accept(self, goal_id: bytes, answer: Any) -> None:
        """Take a goal as accepted whose states the server publishes.

        :param answer: the future that :meth:`send_goal_async` returned
        """
        response = self._action_type.Impl.SendGoalService.Response(accepted=True)
        answer.set_result(ClientGoalHandle(self, UUID(uuid=list(goal_id)), response))

    async def execute(self, taken_data: Any) -> None:
        """See rclpy's :class:`Waitable`."""
        if "goal" in taken_data and taken_data["goal"][0] not in self._pending_goal_requests:
            del taken_data["goal"]  # its state came earlier; rclpy would warn
        await super().execute(taken_data)
        if "status" in taken_data:
            for each in taken_data["status"].status_list:
                on_status = self._watched.get(bytes(each.goal_info.goal_id.uuid))
                if on_status is not None:
                    on_status(each.status)

    def _remove_pending_result_request(self, future: Any) -> None:
        callbacks = dict(self._feedback_callbacks)
        super()._remove_pending_result_request(future)
        for goal_id, callback in callbacks.items():
            self._feedback_callbacks.setdefault(goal_id, callback)
