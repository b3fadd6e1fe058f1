"""Services and actions that clients of the relay advertise in the robot's ROS 2 graph."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.serialization import serialize_message

from relay_protocol.errors import Invalid
from relay_protocol.link.motion import SEND_GOAL
from robot_client.platforms.base import ABORTED, CANCELED, SUCCEEDED, OnCall, OnCancel, OnGoal
from robot_client.platforms.definitions import normalise
from robot_client.platforms.ros2 import graph
from robot_client.platforms.ros2.errors import refusals
from robot_client.platforms.ros2.executor import ReactorBridge, Spinner
from robot_client.platforms.ros2.names import check_name
from robot_client.platforms.ros2.nodes import Nodes
from robot_client.platforms.ros2.types import Interface, Types, parse
from robot_client.twisted_types import DelayedCall, ReactorClock

MAX_GOALS = 1000
"""Most open goals of one action; more are rejected."""

RESULT_SECONDS = 60
"""Seconds for which the result of a goal can be requested."""

SUBSCRIBER_SECONDS = 0.3
SUBSCRIBER_POLL = 0.02
"""Seconds a goal waits for a subscriber of the action's feedback, and between two checks: feedback that is
published before DDS has matched the goal's sender would be lost."""

LINGER = 0.5
"""Seconds in which the results of aborted goals can be read, before the action server is destroyed."""


class RosOfferedServices:
    """All advertised services and actions. Names that other nodes have are refused.

    :param clock: for timers
    """

    def __init__(self, nodes: Nodes, bridge: ReactorBridge, types: Types, clock: ReactorClock) -> None:
        self._nodes = nodes
        self._node = nodes.main.node
        self._bridge = bridge
        self._types = types
        self._clock = clock
        self._services: dict[str, RosServiceServer] = {}
        self._actions: dict[str, RosActionServer] = {}

    def advertise_service(self, service: str, type: str, on_call: OnCall) -> RosServiceServer:
        """See :meth:`robot_client.platforms.base.Platform.advertise_service`."""
        full = check_name(self._node.resolve_service_name, service, "service")
        self._check_free(f"service {service}", full, full in self._services)
        name = normalise(type, "srv")
        interface = Interface(full, name, self._types.service(name))
        with refusals(f"the service {service} as {name}"):
            server = RosServiceServer(
                self._nodes.main, self._bridge, interface, on_call, self._service_closed
            )
        self._services[full] = server
        return server

    def advertise_action(
        self, action: str, type: str, on_goal: OnGoal, on_cancel: OnCancel
    ) -> RosActionServer:
        """See :meth:`robot_client.platforms.base.Platform.advertise_action`."""
        full = check_name(self._node.resolve_topic_name, action, "action")
        former = self._actions.get(full)
        self._check_free(f"action {action}", full + SEND_GOAL, former is not None and not former.closed)
        name = normalise(type, "action")
        interface = Interface(full, name, self._types.action(name))
        if former is not None:
            former.destroy()
        spinner = self._nodes.for_actions()
        with refusals(f"the action {action} as {name}"):
            server = RosActionServer(
                spinner, self._bridge, self._clock, interface, on_goal, on_cancel, self._action_destroyed
            )
        self._actions[full] = server
        return server

    def close(self) -> bool:
        """Withdraw all; returns whether there were actions, whose aborted goals must still be sent."""
        for service in list(self._services.values()):
            service.close()
        for action in self._actions.values():
            action.close()
        return bool(self._actions)

    def destroy(self) -> None:
        """Destroy all action servers."""
        for action in list(self._actions.values()):
            action.destroy()

    def _check_free(self, what: str, service: str, advertised: bool) -> None:
        if advertised:
            raise Invalid(f"another client of the relay advertises the {what} already")
        other = graph.provider(self._node, service, self._nodes.names)
        if other is not None:
            raise Invalid(f"the robot has the {what} already: {other} provides it")

    def _service_closed(self, service: RosServiceServer) -> None:
        del self._services[service.name]

    def _action_destroyed(self, action: RosActionServer) -> None:
        if self._actions.get(action.name) is action:
            del self._actions[action.name]


class _PendingResponse(NamedTuple):
    """The placeholder that a service's callback returns; the response follows later."""

    request: Any


class RosServiceServer:
    """One advertised service.

    An executor calls a service's callback and passes what it returns to ``send_response``, with the header
    of the request. A callback that waits would block the executor, and a coroutine that waits keeps the
    single-threaded one at full load. So the callback returns at once, and ``send_response`` of this service
    stores the header instead of sending. Executors of all releases look up both on the service object.

    :param spinner: of the node that has the service
    """

    def __init__(
        self,
        spinner: Spinner,
        bridge: ReactorBridge,
        interface: Interface,
        on_call: OnCall,
        on_close: Callable[[RosServiceServer], None],
    ) -> None:
        self.name, self.type, self._class = interface
        self._spinner = spinner
        self._bridge = bridge
        self._on_call: OnCall | None = on_call
        self._on_close = on_close
        self._patched = threading.Lock()
        with self._patched:
            self._service = spinner.node.create_service(self._class, self.name, self._called)
            self._send_response = self._service.send_response
            self._service.send_response = self._responded

    def close(self) -> None:
        """Withdraw it."""
        if self._on_call is None:
            return
        self._on_call = None
        self._spinner.call(self._spinner.node.destroy_service, self._service)
        self._on_close(self)

    # --- on the executor's thread

    def _called(self, request: Any, _: Any) -> _PendingResponse:
        with self._patched:  # the first call may arrive before send_response is replaced
            return _PendingResponse(request)

    def _responded(self, pending: _PendingResponse, header: Any) -> None:
        body = bytes(serialize_message(pending.request))
        self._bridge.put(self._arrived, (body, header), len(body))

    # --- on the reactor's thread

    def _arrived(self, call: tuple[bytes, Any]) -> None:
        body, header = call
        if self._on_call is not None:
            self._on_call(body, partial(self._respond, header))

    def _respond(self, header: Any, body: bytes) -> None:
        response = parse(body, self._class.Response, f"response of type {self.type}")
        if self._on_call is not None:
            self._spinner.call(self._send_response, response, header)


class _ActionServer(ActionServer):  # type: ignore[misc]  # rclpy is untyped
    """An action server whose goals are executed elsewhere.

    rclpy executes a goal in a callback that ends when the goal does; one that waits would block the
    executor. Here an accepted goal is only reported. It is executed, without waiting, when its end is known.
    """

    def __init__(self, on_accepted: Callable[[Any], None], *arguments: Any, **keywords: Any) -> None:
        self._on_accepted = on_accepted
        super().__init__(*arguments, **keywords)

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """A goal was accepted; its state is *executing*."""
        self._on_accepted(goal_handle)

    def finish(self, goal_handle: Any, execute: Callable[[Any], Any]) -> None:
        """End a goal by a callback that sets its state and returns its result."""
        super().notify_execute(goal_handle, execute)


class RosServedGoal:
    """One goal; see :class:`robot_client.platforms.base.ServedGoal`."""

    def __init__(self, action: RosActionServer, handle: Any) -> None:
        self.handle = handle
        self.reported = False
        """Whether the client was given the goal."""
        self.cancel_pending = False
        """Whether a cancel request arrived before that."""
        self.ended = False
        self._action = action

    def feedback(self, body: bytes) -> None:
        """See :meth:`robot_client.platforms.base.ServedGoal.feedback`."""
        message = parse(body, self._action.type_class.Feedback, f"feedback of type {self._action.type}")
        if not self.ended:
            self._action.spinner.call(self.handle.publish_feedback, message)

    def finish(self, status: int, body: bytes | None) -> None:
        """See :meth:`robot_client.platforms.base.ServedGoal.finish`."""
        result_class = self._action.type_class.Result
        what = f"result of type {self._action.type}"
        result = result_class() if body is None else parse(body, result_class, what)
        if not self.ended:
            self.ended = True
            self._action.end(self, status, result)


class RosActionServer:
    """One advertised action.

    :param spinner: of the node that has the action
    """

    def __init__(
        self,
        spinner: Spinner,
        bridge: ReactorBridge,
        clock: ReactorClock,
        interface: Interface,
        on_goal: OnGoal,
        on_cancel: OnCancel,
        on_destroyed: Callable[[RosActionServer], None],
    ) -> None:
        self.name, self.type, self.type_class = interface
        self._feedback_topic = f"{self.name}/_action/feedback"
        self.spinner = spinner
        self._bridge = bridge
        self._clock = clock
        self._on_goal = on_goal
        self._on_cancel = on_cancel
        self._on_destroyed = on_destroyed
        self._goals: dict[bytes, RosServedGoal] = {}
        self._destroy_timer: DelayedCall | None = None
        self.closed = False
        self._server = _ActionServer(
            self._accepted,
            spinner.node,
            self.type_class,
            self.name,
            lambda handle: self.type_class.Result(),
            goal_callback=self._accept_or_reject,
            cancel_callback=self._cancel_requested,
            result_timeout=RESULT_SECONDS,
        )

    def close(self) -> None:
        """Reject new goals and abort the open ones; the server is destroyed later."""
        if self.closed:
            return
        self.closed = True
        # Accepted goals that are not reported yet are aborted when the bridge delivers them.
        for goal in list(self._goals.values()):
            goal.finish(ABORTED, None)
        self._destroy_timer = self._clock.callLater(LINGER, self.destroy)

    def destroy(self) -> None:
        """Destroy the server now."""
        self.closed = True
        if self._destroy_timer is not None and self._destroy_timer.active():
            self._destroy_timer.cancel()
        self.spinner.call(self._server.destroy)
        self._on_destroyed(self)

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
        self.spinner.call(self._server.finish, goal.handle, execute)

    # --- on the executor's thread

    def _accept_or_reject(self, _: Any) -> Any:
        full = self.closed or len(self._goals) >= MAX_GOALS
        return GoalResponse.REJECT if full else GoalResponse.ACCEPT

    def _accepted(self, handle: Any) -> None:
        goal = RosServedGoal(self, handle)
        self._goals[_id(handle)] = goal
        self._bridge.put(self._report, goal)

    def _cancel_requested(self, handle: Any) -> Any:
        goal = self._goals.get(_id(handle))
        if goal is None:
            return CancelResponse.REJECT  # it has just ended
        self._bridge.put(self._cancel, goal)
        return CancelResponse.ACCEPT

    # --- on the reactor's thread

    def _report(self, goal: RosServedGoal, remaining: float = SUBSCRIBER_SECONDS) -> None:
        """Give the goal to the client, once its sender subscribes to the feedback.

        :param remaining: seconds to wait for that
        """
        if goal.ended:
            return
        if self.closed:
            goal.finish(ABORTED, None)
        elif remaining > 0 and not self.spinner.node.count_subscribers(self._feedback_topic):
            self._clock.callLater(SUBSCRIBER_POLL, self._report, goal, remaining - SUBSCRIBER_POLL)
        else:
            goal.reported = True
            self._on_goal(bytes(serialize_message(goal.handle.request)), goal)
            if goal.cancel_pending:
                self._cancel(goal)

    def _cancel(self, goal: RosServedGoal) -> None:
        if not goal.reported:
            goal.cancel_pending = True
        elif not goal.ended:
            self._on_cancel(goal)


def _id(handle: Any) -> bytes:
    return bytes(handle.goal_id.uuid)
