"""Actions that the ROS 2 platform offers, pursued by somebody at the relay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.serialization import serialize_message

from robot_client.platforms.base import ABORTED, CANCELED, SUCCEEDED, OnCancel, OnGoal
from robot_client.platforms.ros2.executor import ReactorBridge, Spinner
from robot_client.platforms.ros2.types import Interface, parse
from robot_client.twisted_types import DelayedCall, ReactorClock

MAX_GOALS = 1000
"""Goals of one action at a time; more are rejected."""

KEPT = 60
"""Seconds the result of a goal can still be asked for."""

LISTENED = 0.3
LOOK = 0.02
"""Seconds a goal waits to be told of until somebody listens to the action's feedback, and between two looks: the first
feedback would be lost before DDS has matched the asker, whose request came by another way."""

LINGER = 0.5
"""Seconds in which the aborts of an action's goals can reach those who wait, before the action goes."""


class _Server(ActionServer):  # type: ignore[misc]  # rclpy is untyped
    """An action server whose goals are executed elsewhere.

    rclpy executes a goal by a callback that ends when the goal does; one that waits would hold the executor up. Here
    an accepted goal is only told of, and executed, in no time, when its end is known.
    """

    def __init__(self, on_accepted: Callable[[Any], None], *arguments: Any, **keywords: Any) -> None:
        self._on_accepted = on_accepted
        super().__init__(*arguments, **keywords)

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """A goal was accepted, and told to be executing."""
        self._on_accepted(goal_handle)

    def finish(self, goal_handle: Any, execute: Callable[[Any], Any]) -> None:
        """End a goal by a callback that sets its state and returns its result."""
        super().notify_execute(goal_handle, execute)


class RosServedGoal:
    """One goal; see :class:`robot_client.platforms.base.ServedGoal`."""

    def __init__(self, action: RosAction, handle: Any) -> None:
        self.handle = handle
        self.told = False
        self.to_be_cancelled = False
        self.ended = False
        self._action = action

    def feedback(self, body: bytes) -> None:
        """Publish how far it has come."""
        message = parse(body, self._action.kind.Feedback, f"feedback of type {self._action.type}")
        if not self.ended:
            self._action.spinner.do(self.handle.publish_feedback, message)

    def finish(self, status: int, body: bytes | None) -> None:
        """End it."""
        kind = self._action.kind.Result
        result = kind() if body is None else parse(body, kind, f"result of type {self._action.type}")
        if not self.ended:
            self.ended = True
            self._action.end(self, status, result)


class RosAction:
    """One action.

    :param spinner: of the node it is on
    """

    def __init__(
        self,
        spinner: Spinner,
        hop: ReactorBridge,
        clock: ReactorClock,
        interface: Interface,
        on_goal: OnGoal,
        on_cancel: OnCancel,
        on_gone: Callable[[RosAction], None],
    ) -> None:
        self.name, self.type, self.kind = interface
        self._feedback = f"{self.name}/_action/feedback"
        self.spinner = spinner
        self._hop = hop
        self._clock = clock
        self._on_goal = on_goal
        self._on_cancel = on_cancel
        self._on_gone = on_gone
        self._goals: dict[bytes, RosServedGoal] = {}
        self._leaving: DelayedCall | None = None
        self.closed = False
        self._server = _Server(
            self._accepted,
            spinner.node,
            self.kind,
            self.name,
            lambda handle: self.kind.Result(),
            goal_callback=self._judge,
            cancel_callback=self._cancelled,
            result_timeout=KEPT,
        )

    def close(self) -> None:
        """Take no goals any more and abort those there are; the server goes in a while."""
        if self.closed:
            return
        self.closed = True
        # What is accepted but not told of yet is on its way through the hop, and is aborted when it comes out.
        for goal in list(self._goals.values()):
            goal.finish(ABORTED, None)
        self._leaving = self._clock.callLater(LINGER, self.go)

    def go(self) -> None:
        """Take the server away now."""
        self.closed = True
        if self._leaving is not None and self._leaving.active():
            self._leaving.cancel()
        self.spinner.do(self._server.destroy)
        self._on_gone(self)

    def end(self, goal: RosServedGoal, status: int, result: Any) -> None:
        """End one of its goals."""

        def execute(handle: Any) -> Any:
            if status == SUCCEEDED:
                handle.succeed()
            elif status == CANCELED and handle.is_cancel_requested:
                handle.canceled()
            else:
                handle.abort()
            return result

        self._goals.pop(_id(goal.handle), None)
        self.spinner.do(self._server.finish, goal.handle, execute)

    # --- in the executor's thread

    def _judge(self, _: Any) -> Any:
        full = self.closed or len(self._goals) >= MAX_GOALS
        return GoalResponse.REJECT if full else GoalResponse.ACCEPT

    def _accepted(self, handle: Any) -> None:
        goal = RosServedGoal(self, handle)
        self._goals[_id(handle)] = goal
        self._hop.put(self._told, goal)

    def _cancelled(self, handle: Any) -> Any:
        goal = self._goals.get(_id(handle))
        if goal is None:
            return CancelResponse.REJECT  # it has just ended
        self._hop.put(self._on_cancel_there, goal)
        return CancelResponse.ACCEPT

    # --- in the reactor's thread

    def _told(self, goal: RosServedGoal, patience: float = LISTENED) -> None:
        if goal.ended:
            return
        if self.closed:
            goal.finish(ABORTED, None)
        elif patience > 0 and not self.spinner.node.count_subscribers(self._feedback):
            self._clock.callLater(LOOK, self._told, goal, patience - LOOK)
        else:
            goal.told = True
            self._on_goal(bytes(serialize_message(goal.handle.request)), goal)
            if goal.to_be_cancelled:
                self._on_cancel_there(goal)

    def _on_cancel_there(self, goal: RosServedGoal) -> None:
        if not goal.told:
            goal.to_be_cancelled = True
        elif not goal.ended:
            self._on_cancel(goal)


def _id(handle: Any) -> bytes:
    return bytes(handle.goal_id.uuid)
