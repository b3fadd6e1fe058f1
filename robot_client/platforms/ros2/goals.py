"""Goals the ROS 2 platform has actions of the robot pursue: never blocking, each ending in exactly one outcome."""

from __future__ import annotations

import enum
import uuid
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.action import ActionClient
from rclpy.serialization import serialize_message
from twisted.internet.defer import Deferred
from unique_identifier_msgs.msg import UUID

from relay_protocol.errors import Unavailable
from robot_client.platforms.base import ABORTED, CANCELED, NEVER_BEGAN, SUCCEEDED, GoalOutcome, OnSample
from robot_client.platforms.ros2.errors import in_words
from robot_client.platforms.ros2.executor import ReactorBridge, Spinner
from robot_client.platforms.ros2.types import Types, parse
from robot_client.twisted_types import DelayedCall, ReactorClock

STRAGGLERS = 0.05
"""Seconds the result of a goal waits for feedback that it has overtaken."""

LOOK = 0.02
"""Seconds between looks for an action whose client was just made."""

APPEAR = 1.0
"""Seconds an action has to be reached."""

WATCH = 0.25
GONE = 1.0
"""Seconds the server of a goal may be out of reach before the goal is given up."""

UNHEARD = 5.0
"""Seconds a server has to take a goal that nobody wants any more."""

MAX_UNANSWERED = 8
"""Wishes to cancel one goal that may wait for their answers; rclpy would keep those that nobody answers."""

IDLE = 30.0
MAX_GOALS = 2000
"""Goals at a time, those among them that nobody waits for any more."""

_STATUS = "/_action/status"
_ENDS = frozenset((SUCCEEDED, CANCELED, ABORTED))


class RosGoals:
    """All goals of one node.

    :param place: gives the node, by what turns its executor, when it is needed
    :param clock: timers and seconds
    """

    def __init__(
        self, place: Callable[[], Spinner], hop: ReactorBridge, types: Types, clock: ReactorClock
    ) -> None:
        self.hop = hop
        self._place = place
        self.clock = clock
        self._types = types
        self._clients: dict[tuple[str, str], _ActionClient] = {}
        self._watching: DelayedCall | None = None
        self.left = False
        """Whether the executor turns no more."""

    def pursue(self, action: str, type: str, body: bytes, on_feedback: OnSample | None) -> RosGoal:
        """Begin one; see :meth:`robot_client.platforms.base.Platform.pursue`."""
        kind = self._types.action(type)
        message = parse(body, kind.Goal, f"goal of type {type}")
        if sum(len(each.goals) for each in self._clients.values()) >= MAX_GOALS:
            raise Unavailable(f"{MAX_GOALS} goals are under way on this robot; wait until some end")
        client = self._clients.get((action, type))
        if client is None:
            ros = FeedbackSafeClient(self.spinner.node, kind, action)
            client = self._clients[action, type] = _ActionClient(ros, action)
        goal = RosGoal(self, client, message, on_feedback)
        client.goals.add(goal)
        if self._watching is None:
            self._watching = self.clock.callLater(WATCH, self._watch)
        goal.begin()
        return goal

    @property
    def spinner(self) -> Spinner:
        """The node they are on, and what turns its executor."""
        return self._place()

    def sweep(self) -> None:
        """Destroy the clients nobody used for a while."""
        now = self.clock.seconds()
        for key, client in list(self._clients.items()):
            if not client.goals and now - client.used > IDLE:
                del self._clients[key]
                self.spinner.do(client.ros.destroy)

    def close(self) -> bool:
        """Cancel and give up everything; whether anything was under way."""
        goals = [goal for client in self._clients.values() for goal in client.goals]
        for goal in goals:
            goal.abandon("the robot is shutting down")
        if self._watching is not None and self._watching.active():
            self._watching.cancel()
        return bool(goals)

    def leave(self) -> None:
        """Destroy all clients."""
        for client in self._clients.values():
            self.spinner.do(client.ros.destroy)
        self._clients.clear()
        self.left = True

    def servers(self, action: str) -> frozenset[bytes]:
        """Who serves an action, by identities that a server that was started anew does not share."""
        return frozenset(
            bytes(bytearray(each.endpoint_gid))
            for each in self.spinner.node.get_publishers_info_by_topic(action + _STATUS)
        )

    def _watch(self) -> None:
        self._watching = None
        for client in self._clients.values():
            if client.goals:
                servers = self.servers(client.action)
                for goal in list(client.goals):
                    goal.check(servers)
        if any(client.goals for client in self._clients.values()):
            self._watching = self.clock.callLater(WATCH, self._watch)


class FeedbackSafeClient(ActionClient):  # type: ignore[misc]  # rclpy is untyped
    """A client of an action that goes on telling of feedback when the result has come.

    The two come by different ways, and an executor takes one of each in a turn: rclpy would drop the feedback that the
    result has overtaken. Who uses it ends the telling by :meth:`hush`.
    """

    def _remove_pending_result_request(self, future: Any) -> None:
        told = dict(self._feedback_callbacks)
        super()._remove_pending_result_request(future)
        for goal_id, tell in told.items():
            self._feedback_callbacks.setdefault(goal_id, tell)

    def hush(self, goal_id: bytes) -> None:
        """Tell nothing more of a goal."""
        self._feedback_callbacks.pop(goal_id, None)


class _ActionClient:
    """What goals for one action share."""

    def __init__(self, ros: Any, action: str) -> None:
        self.ros = ros
        self.action = action
        self.goals: set[RosGoal] = set()
        self.used = 0.0


class _State(enum.Enum):
    LOOKING = "looking for the server"
    ASKED = "waiting for the server to take it"
    RUNNING = "taken"
    ENDED = "ended"


class RosGoal:
    """One goal, from looking for its server to its end; see :class:`robot_client.platforms.base.GoalHandle`."""

    def __init__(
        self, goals: RosGoals, client: _ActionClient, message: Any, on_feedback: OnSample | None
    ) -> None:
        self.id = uuid.uuid4().bytes
        self.result: Deferred[GoalOutcome] = Deferred()
        self._goals = goals
        self._client = client
        self._message = message
        self._on_feedback = on_feedback
        self._state = _State.LOOKING
        self._unwanted = False
        """Set on the reactor's thread, and read on the executor's as well."""
        self._handle: Any = None
        self._servers: frozenset[bytes] = frozenset()
        self._since = self._seen = goals.clock.seconds()
        self._pending: list[Any] = []
        self._asked: deque[Any] = deque()
        self._given: Any = None
        self._abandoned = False
        """These three are of the executor's thread: when it is abandoned nothing comes to the reactor's any more."""

    def begin(self) -> None:
        """Look for the server; give it the goal once it is there."""
        if self._state is not _State.LOOKING:
            return
        action = self._client.action
        if self._client.ros.server_is_ready():
            self._state = _State.ASKED
            self._servers = self._goals.servers(action)
            self._seen = self._goals.clock.seconds()
            self._goals.spinner.do(self._send)
        elif self._goals.clock.seconds() - self._since > APPEAR:
            self._end(NEVER_BEGAN, f"the action {action} can't be reached; its node is gone or silent")
        else:
            self._goals.clock.callLater(LOOK, self.begin)

    def cancel(self) -> None:
        """Want it no more; a server that has not taken it yet is told as soon as it has.

        One that was told is told again: it may have refused, or not have heard.
        """
        if self._state is _State.ENDED:
            return
        if not self._unwanted:
            self._unwanted = True
            self._since = self._goals.clock.seconds()
        if self._state is _State.LOOKING:
            self._end(NEVER_BEGAN, "the goal was cancelled before it began")
        elif self._state is _State.RUNNING:
            self._goals.spinner.do(self._ask)

    def abandon(self, reason: str) -> None:
        """Cancel it, once more if it was, and don't wait."""
        self._goals.spinner.do(self._leave)
        certain = self._state is _State.LOOKING
        self._end(NEVER_BEGAN if self._handle is None else ABORTED, reason, certain=certain)

    def check(self, servers: frozenset[bytes]) -> None:
        """Give up when the server it was given to has gone, even if another one has come.

        :param servers: those of the action now
        """
        if self._state not in (_State.ASKED, _State.RUNNING):
            return
        now, action = self._goals.clock.seconds(), self._client.action
        if self._servers & servers or (not self._servers and servers):
            self._seen = now
        if now - self._seen > GONE:
            if self._state is _State.ASKED:
                self._lose(NEVER_BEGAN, f"the action {action} vanished before it took the goal")
            else:
                self._lose(ABORTED, f"the action {action} vanished before the goal ended")
        elif self._unwanted and self._state is _State.ASKED and now - self._since > UNHEARD:
            self._lose(NEVER_BEGAN, f"the action {action} did not answer, and the goal was cancelled")

    def _lose(self, status: int, reason: str) -> None:
        """Give up a goal that may go on."""
        self._end(status, reason, certain=False)

    # --- in the executor's thread

    def _send(self) -> None:
        # A stop may have come since it was asked for, and must not be followed by a movement.
        if self._unwanted or self._abandoned:
            self._goals.hop.put(self._failed, "it was cancelled before it began")
            return
        tell = self._fed if self._on_feedback is not None else None
        try:
            future = self._client.ros.send_goal_async(self._message, tell, UUID(uuid=list(self.id)))
        except Exception as error:
            self._goals.hop.put(self._failed, in_words(error))
            return
        self._pending.append(future)
        future.add_done_callback(self._guarded(self._taken))

    def _taken(self, future: Any) -> None:
        handle = future.result()
        if handle.accepted:
            result = handle.get_result_async()
            self._pending.append(result)
            result.add_done_callback(self._guarded(self._done))
            self._given = handle
            if self._abandoned:
                handle.cancel_goal_async()
        self._goals.hop.put(self._answered, handle)

    def _ask(self) -> None:
        if len(self._asked) == MAX_UNANSWERED:
            self._asked.popleft().cancel()
        self._asked.append(self._given.cancel_goal_async())

    def _leave(self) -> None:
        self._abandoned = True
        if self._given is not None:
            self._given.cancel_goal_async()

    def _done(self, future: Any) -> None:
        response = future.result()
        body = bytes(serialize_message(response.result))
        self._goals.hop.put(self._arrived, (response.status, body))

    def _fed(self, message: Any) -> None:
        body = bytes(serialize_message(message.feedback))
        self._goals.hop.put(self._feed, body, len(body))

    def _guarded(self, step: Callable[[Any], None]) -> Callable[[Any], None]:
        def run(future: Any) -> None:
            if future.cancelled():
                return
            try:
                step(future)
            except Exception as error:
                self._goals.hop.put(self._failed, in_words(error))

        return run

    def _forget(self) -> None:
        if self._handle is not None:
            self._client.ros.hush(bytes(self._handle.goal_id.uuid))
        for future in (*self._pending, *self._asked):
            if not future.done():
                future.cancel()  # rclpy would keep it for ever

    # --- in the reactor's thread

    def _answered(self, handle: Any) -> None:
        if self._state is _State.ENDED and self._goals.left:
            return  # what is cancelled after the farewell reaches nobody
        if self._state is _State.ENDED:
            self._goals.spinner.do(self._client.ros.hush, bytes(handle.goal_id.uuid))
            if handle.accepted:  # given up, and taken after all: nobody would ever end it
                self._goals.spinner.do(handle.cancel_goal_async)
        elif not handle.accepted:
            self._end(NEVER_BEGAN, f"the action {self._client.action} rejected the goal")
        else:
            self._state, self._handle = _State.RUNNING, handle
            if self._unwanted:
                self._goals.spinner.do(self._ask)

    def _feed(self, body: bytes) -> None:
        if self._state is not _State.ENDED and self._on_feedback is not None:
            self._on_feedback(body)

    def _arrived(self, found: tuple[int, bytes]) -> None:
        status, body = found
        if status in _ENDS:
            # Feedback that was said before the result may come after it.
            wait = STRAGGLERS if self._on_feedback is not None else 0.0
            self._goals.clock.callLater(wait, self._end, status, "", body)
        else:
            self._end(ABORTED, f"the action {self._client.action} does not know the goal any more")

    def _failed(self, reason: str) -> None:
        status = NEVER_BEGAN if self._handle is None else ABORTED
        self._end(status, f"the goal for {self._client.action} failed: {reason}", certain=not self._pending)

    def _end(self, status: int, reason: str, body: bytes | None = None, certain: bool = True) -> None:
        if self._state is _State.ENDED:
            return
        waiting = self._state is _State.ASKED
        self._state = _State.ENDED
        self._client.goals.discard(self)
        self._client.used = self._goals.clock.seconds()
        if not waiting:  # else it is heard out, to be cancelled if it is taken after all
            self._goals.spinner.do(self._forget)
        self.result.callback(GoalOutcome(status, body, reason, certain))
