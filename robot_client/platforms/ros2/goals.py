"""Goals sent to actions of the robot: without blocking, each with exactly one outcome."""

from __future__ import annotations

import enum
import uuid
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.serialization import serialize_message
from twisted.internet.defer import Deferred
from unique_identifier_msgs.msg import UUID

from relay_protocol.errors import Unavailable
from robot_client.platforms.base import ABORTED, CANCELED, NOT_STARTED, SUCCEEDED, GoalOutcome, OnSample
from robot_client.platforms.ros2.action_client import GoalClient
from robot_client.platforms.ros2.errors import error_text
from robot_client.platforms.ros2.executor import ReactorBridge, Spinner
from robot_client.platforms.ros2.graph import endpoint_ids
from robot_client.platforms.ros2.types import Types, parse
from robot_client.twisted_types import DelayedCall, ReactorClock

FEEDBACK_GRACE = 0.05
"""Seconds that a result waits for feedback it has overtaken."""

DISCOVERY_POLL = 0.02
"""Seconds between checks for an action whose client was just created."""

DISCOVERY_SECONDS = 1.0
"""Seconds in which an action must be reached."""

CHECK_INTERVAL = 0.25
GONE_SECONDS = 1.0
"""Seconds for which the server of a goal may be unreachable before the goal is given up."""

CANCELLED_ACCEPT_SECONDS = 5.0
"""Seconds in which a server must accept a goal that was cancelled meanwhile."""

RESULT_SECONDS = 1.0
"""Seconds after its end in which the result of a goal must arrive, before it is requested again."""

RESULT_REQUESTS = 5
"""Requests for one result, after which the goal is given up. Servers of rclcpp and rclpy keep results for 10 s."""

MAX_UNANSWERED = 8
"""Most unanswered cancel requests for one goal; rclpy would keep them for ever."""

IDLE_SECONDS = 30.0
"""Seconds after which an unused client is destroyed."""

MAX_GOALS = 2000
"""Most open goals, cancelled ones included."""

_STATUS = "/_action/status"
_ENDS = frozenset((SUCCEEDED, CANCELED, ABORTED))


class RosGoals:
    """All goals of one node.

    :param get_spinner: returns the spinner of the node for actions
    :param clock: for timers
    """

    def __init__(
        self, get_spinner: Callable[[], Spinner], bridge: ReactorBridge, types: Types, clock: ReactorClock
    ) -> None:
        self.bridge = bridge
        self._get_spinner = get_spinner
        self.clock = clock
        self._types = types
        self._clients: dict[tuple[str, str], _ActionClient] = {}
        self._check_timer: DelayedCall | None = None
        self.closed = False
        """Whether the executor has stopped."""

    def send_goal(self, action: str, type: str, body: bytes, on_feedback: OnSample | None) -> RosGoal:
        """See :meth:`robot_client.platforms.base.Platform.send_goal`."""
        kind = self._types.action(type)
        message = parse(body, kind.Goal, f"goal of type {type}")
        if sum(len(each.goals) for each in self._clients.values()) >= MAX_GOALS:
            raise Unavailable(f"{MAX_GOALS} goals are open on this robot; wait until some end")
        client = self._clients.get((action, type))
        if client is None:
            ros = GoalClient(self.spinner.node, kind, action)
            client = self._clients[action, type] = _ActionClient(ros, action)
        goal = RosGoal(self, client, message, on_feedback)
        client.goals.add(goal)
        if self._check_timer is None:
            self._check_timer = self.clock.callLater(CHECK_INTERVAL, self._check)
        goal.start()
        return goal

    @property
    def spinner(self) -> Spinner:
        """Spinner of the node for actions."""
        return self._get_spinner()

    def remove_idle(self) -> None:
        """Destroy clients that were not used for :data:`IDLE_SECONDS`."""
        now = self.clock.seconds()
        for key, client in list(self._clients.items()):
            if not client.goals and now - client.used > IDLE_SECONDS:
                del self._clients[key]
                self.spinner.call(client.ros.destroy)

    def close(self) -> bool:
        """Cancel and give up all goals; returns whether there were any."""
        goals = [goal for client in self._clients.values() for goal in client.goals]
        for goal in goals:
            goal.abandon("the robot is shutting down")
        if self._check_timer is not None and self._check_timer.active():
            self._check_timer.cancel()
        return bool(goals)

    def destroy(self) -> None:
        """Destroy all clients."""
        for client in self._clients.values():
            self.spinner.call(client.ros.destroy)
        self._clients.clear()
        self.closed = True

    def servers(self, action: str) -> frozenset[bytes]:
        """GIDs of an action's servers."""
        return endpoint_ids(self.spinner.node.get_publishers_info_by_topic(action + _STATUS))

    def _check(self) -> None:
        self._check_timer = None
        for client in self._clients.values():
            if client.goals:
                servers = self.servers(client.action)
                for goal in list(client.goals):
                    goal.check(servers)
        if any(client.goals for client in self._clients.values()):
            self._check_timer = self.clock.callLater(CHECK_INTERVAL, self._check)


class _ActionClient:
    """The client that all goals of one action share."""

    def __init__(self, ros: Any, action: str) -> None:
        self.ros = ros
        self.action = action
        self.goals: set[RosGoal] = set()
        self.used = 0.0


class _State(enum.Enum):
    DISCOVERING = "waiting for the server to be discovered"
    SENT = "waiting for the server to accept it"
    ACCEPTED = "accepted"
    ENDED = "ended"


class RosGoal:
    """One goal, from the discovery of its server to its end; see :class:`robot_client.platforms.base.GoalHandle`."""

    def __init__(
        self, goals: RosGoals, client: _ActionClient, message: Any, on_feedback: OnSample | None
    ) -> None:
        self.id = uuid.uuid4().bytes
        self.result: Deferred[GoalOutcome] = Deferred()
        self._goals = goals
        self._client = client
        self._message = message
        self._on_feedback = on_feedback
        self._state = _State.DISCOVERING
        self._cancelled = False
        """Set on the reactor's thread; also read on the executor's."""
        self._handle: Any = None
        self._ended_at: float | None = None
        """When it had ended, by its server's word, or when its result was requested since."""
        self._result_requests = 1
        self._servers: frozenset[bytes] = frozenset()
        self._since = self._seen = goals.clock.seconds()
        self._pending: list[Any] = []
        self._cancel_futures: deque[Any] = deque()
        self._executor_handle: Any = None
        self._told_end = False
        self._abandoned = False
        """Used on the executor's thread, like the three before: the reactor's thread gets no events of an
        abandoned goal."""

    def start(self) -> None:
        """Send the goal once the server is discovered."""
        if self._state is not _State.DISCOVERING:
            return
        action = self._client.action
        if self._client.ros.server_is_ready():
            self._state = _State.SENT
            self._servers = self._goals.servers(action)
            self._seen = self._goals.clock.seconds()
            self._goals.spinner.call(self._send)
        elif self._goals.clock.seconds() - self._since > DISCOVERY_SECONDS:
            self._end(NOT_STARTED, f"the action {action} can't be reached; its node is gone or silent")
        else:
            self._goals.clock.callLater(DISCOVERY_POLL, self.start)

    def cancel(self) -> None:
        """Request cancellation; if the server has not accepted the goal yet, as soon as it has.

        Each call sends a request: the server may have refused an earlier one, or not have received it.
        """
        if self._state is _State.ENDED:
            return
        if not self._cancelled:
            self._cancelled = True
            self._since = self._goals.clock.seconds()
        if self._state is _State.DISCOVERING:
            self._end(NOT_STARTED, "the goal was cancelled before it was sent")
        elif self._state is _State.ACCEPTED:
            self._goals.spinner.call(self._request_cancel)

    def abandon(self, reason: str) -> None:
        """Cancel it without waiting."""
        self._goals.spinner.call(self._cancel_abandoned)
        certain = self._state is _State.DISCOVERING
        self._end(NOT_STARTED if self._handle is None else ABORTED, reason, certain=certain)

    def check(self, servers: frozenset[bytes]) -> None:
        """Give the goal up if its server has disappeared, even if there is another one now.

        :param servers: GIDs of the action's servers now
        """
        if self._state not in (_State.SENT, _State.ACCEPTED):
            return
        now, action = self._goals.clock.seconds(), self._client.action
        if self._servers & servers or (not self._servers and servers):
            self._seen = now
        if now - self._seen > GONE_SECONDS:
            if self._state is _State.SENT:
                self._lose(NOT_STARTED, f"the action {action} disappeared before it accepted the goal")
            else:
                self._lose(ABORTED, f"the action {action} disappeared before the goal ended")
        elif self._cancelled and self._state is _State.SENT and now - self._since > CANCELLED_ACCEPT_SECONDS:
            self._lose(NOT_STARTED, f"the action {action} did not answer, and the goal was cancelled")
        elif (
            self._state is _State.ACCEPTED
            and self._ended_at is not None
            and now - self._ended_at > RESULT_SECONDS
        ):
            if self._result_requests == RESULT_REQUESTS:
                self._lose(ABORTED, f"the goal has ended, but the action {action} does not send its result")
                return
            self._result_requests += 1
            self._ended_at = now
            self._goals.spinner.call(self._request_result)

    def _lose(self, status: int, reason: str) -> None:
        """Give up a goal that may still be executed."""
        self._end(status, reason, certain=False)

    # --- on the executor's thread

    def _send(self) -> None:
        # A stop may have come meanwhile; no motion may follow it.
        if self._cancelled or self._abandoned:
            self._goals.bridge.put(self._failed, "it was cancelled before it was sent")
            return
        on_feedback = self._feedback_arrived if self._on_feedback is not None else None
        try:
            future = self._client.ros.send_goal_async(self._message, on_feedback, UUID(uuid=list(self.id)))
        except Exception as error:
            self._goals.bridge.put(self._failed, error_text(error))
            return
        self._pending.append(future)
        future.add_done_callback(self._guarded(self._response_arrived))
        self._client.ros.watch(self.id, self._status_arrived)

    def _status_arrived(self, status: int) -> None:
        """The server has it, also if its answer is late, or lost."""
        answer = self._pending[0]
        if self._executor_handle is None and not answer.done():
            self._client.ros.accept(self.id, answer)
        if status in _ENDS and not self._told_end:
            self._told_end = True
            self._goals.bridge.put(self._ended_by_status, status)

    def _response_arrived(self, future: Any) -> None:
        handle = future.result()
        if handle.accepted:
            self._executor_handle = handle
            self._request_result()
            if self._abandoned:
                handle.cancel_goal_async()
        self._goals.bridge.put(self._responded, handle)

    def _request_result(self) -> None:
        result = self._executor_handle.get_result_async()
        self._pending.append(result)
        result.add_done_callback(self._guarded(self._result_arrived))

    def _request_cancel(self) -> None:
        if len(self._cancel_futures) == MAX_UNANSWERED:
            self._cancel_futures.popleft().cancel()
        self._cancel_futures.append(self._executor_handle.cancel_goal_async())

    def _cancel_abandoned(self) -> None:
        self._abandoned = True
        if self._executor_handle is not None:
            self._executor_handle.cancel_goal_async()

    def _result_arrived(self, future: Any) -> None:
        response = future.result()
        body = bytes(serialize_message(response.result))
        self._goals.bridge.put(self._handle_result, (response.status, body))

    def _feedback_arrived(self, message: Any) -> None:
        body = bytes(serialize_message(message.feedback))
        self._goals.bridge.put(self._pass_feedback, body, len(body))

    def _guarded(self, step: Callable[[Any], None]) -> Callable[[Any], None]:
        def run(future: Any) -> None:
            if future.cancelled():
                return
            try:
                step(future)
            except Exception as error:
                self._goals.bridge.put(self._failed, error_text(error))

        return run

    def _forget(self) -> None:
        self._client.ros.forget(self.id)
        for future in (*self._pending, *self._cancel_futures):
            if not future.done():
                future.cancel()  # otherwise rclpy keeps it for ever

    # --- on the reactor's thread

    def _responded(self, handle: Any) -> None:
        if self._state is _State.ENDED and self._goals.closed:
            return  # a cancel request would no longer be sent
        if self._state is _State.ENDED:
            self._goals.spinner.call(self._client.ros.forget, self.id)
            if handle.accepted:  # accepted after it was given up: nothing else would end it
                self._goals.spinner.call(handle.cancel_goal_async)
        elif not handle.accepted:
            self._end(NOT_STARTED, f"the action {self._client.action} rejected the goal")
        else:
            self._state, self._handle = _State.ACCEPTED, handle
            if self._cancelled:
                self._goals.spinner.call(self._request_cancel)

    def _ended_by_status(self, _status: int) -> None:
        self._ended_at = self._goals.clock.seconds()

    def _pass_feedback(self, body: bytes) -> None:
        if self._state is not _State.ENDED and self._on_feedback is not None:
            self._on_feedback(body)

    def _handle_result(self, found: tuple[int, bytes]) -> None:
        status, body = found
        if status in _ENDS:
            # Feedback published before the result may arrive after it.
            wait = FEEDBACK_GRACE if self._on_feedback is not None else 0.0
            self._goals.clock.callLater(wait, self._end, status, "", body)
        else:
            self._end(ABORTED, f"the action {self._client.action} no longer knows the goal")

    def _failed(self, reason: str) -> None:
        status = NOT_STARTED if self._handle is None else ABORTED
        self._end(status, f"the goal for {self._client.action} failed: {reason}", certain=not self._pending)

    def _end(self, status: int, reason: str, body: bytes | None = None, certain: bool = True) -> None:
        if self._state is _State.ENDED:
            return
        waiting = self._state is _State.SENT
        self._state = _State.ENDED
        self._client.goals.discard(self)
        self._client.used = self._goals.clock.seconds()
        if not waiting:  # else its response must still arrive, to cancel it if it is accepted
            self._goals.spinner.call(self._forget)
        self.result.callback(GoalOutcome(status, body, reason, certain))
