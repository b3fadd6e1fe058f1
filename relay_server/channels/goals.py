"""Goals: sent by clients and by the robot's graph, executed by the robot and by clients that offer actions."""

from __future__ import annotations

import enum
import itertools
from abc import ABC, abstractmethod
from typing import NamedTuple, Protocol

from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import jsontext, link, rosbridge
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_server.channels.encodings import PayloadCodec
from relay_server.channels.link_state import ChannelLinkPort, RobotLinkState
from relay_server.channels.members import ChannelMember, ClientMember, RequestContext
from relay_server.channels.offered_services import OfferedService, OfferedServices, Provider
from relay_server.channels.service_calls import PendingRequest, PendingRequests, refusal_reason


class GoalStatusCode(enum.IntEnum):
    """How a goal ended: values of ``action_msgs/msg/GoalStatus``, and 0 for a goal that never began."""

    NEVER_BEGAN = 0
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


STATUSES = frozenset(GoalStatusCode)


class GoalResult(NamedTuple):
    """How a goal ended.

    :param body: the result, see :class:`PayloadCodec`; ``None``: there is none
    :param reason: why there is none
    """

    status: int
    body: bytes | None = None
    reason: str = ""


class GoalRequester(Protocol):
    """Receives feedback and the end of a goal that it has sent."""

    def feedback(self, values: bytes) -> None:
        """Feedback has come, JSON."""

    def warn(self, reason: str) -> None:
        """Feedback was left out."""

    def ended(self, status: int, result: bool, values: bytes) -> None:
        """The goal has ended; called once.

        :param values: JSON: the result, or a string with the reason why there is none
        """


class ActionGoal(ABC):
    """A goal from its request to its end.

    :param wants_feedback: whether the requester has requested feedback
    """

    def __init__(self, action: str, wants_feedback: bool) -> None:
        self.action = action
        self.type = ""
        self.wants_feedback = wants_feedback
        self.starting: Deferred[None] | None = None
        self.executor: Executor | None = None
        self.over = False
        self._cancelled = False

    def cancel(self) -> None:
        """Cancel the goal; its end is still reported."""
        if not self.over:
            self._cancel_once()

    def feedback_received(self, body: bytes) -> None:
        """Feedback has come.

        :param body: see :class:`PayloadCodec`
        """
        if self.wants_feedback and not self.over:
            self.send_feedback(body)

    def end(self, result: GoalResult) -> None:
        """Report the end of the goal; a second end is ignored."""
        if not self.over:
            self.over = True
            self.send_result(result)

    def abandon(self) -> None:
        """The requester is gone: cancel the goal, and report no end."""
        if self.over:
            return
        self.over = True
        self._cancel_once()
        if self.executor is not None:
            self.executor.forget()

    def _cancel_once(self) -> None:
        if self._cancelled:
            return
        self._cancelled = True
        if self.executor is not None:
            self.executor.cancel()
        elif self.starting is not None:
            self.starting.cancel()

    @abstractmethod
    def send_feedback(self, body: bytes) -> None:
        """Send feedback to the requester."""

    @abstractmethod
    def send_result(self, result: GoalResult) -> None:
        """Send the end of the goal to the requester."""


class Executor(Protocol):
    """Executes a goal: the robot, or a client that offers the action."""

    def cancel(self) -> None:
        """Cancel the goal."""

    def forget(self) -> None:
        """The end of the goal is not needed any more."""


class ClientGoal(ActionGoal):
    """A goal that a client sent."""

    def __init__(
        self,
        member: ClientMember,
        requester: GoalRequester,
        codec: PayloadCodec,
        action: str,
        wants_feedback: bool,
    ) -> None:
        super().__init__(action, wants_feedback)
        self.member = member
        self._requester = requester
        self._codec = codec

    def send_feedback(self, body: bytes) -> None:
        """Send feedback as JSON; feedback that can't be converted is left out, with a warning."""
        try:
            values = self._codec.to_client(f"{self.type}_Feedback", body)
        except SwitchboardError as error:
            self._requester.warn(f"feedback of {self.action} is left out: {error}")
            return
        self._requester.feedback(values)

    def send_result(self, result: GoalResult) -> None:
        """Send the result as JSON, or the reason why there is none."""
        if result.body is None:
            self._requester.ended(result.status, False, jsontext.encode(result.reason))
            return
        try:
            values = self._codec.to_client(f"{self.type}_Result", result.body)
        except SwitchboardError as error:
            self._requester.ended(
                GoalStatusCode.ABORTED,
                False,
                jsontext.encode(f"the result of {self.action} can't be read: {error}"),
            )
        else:
            self._requester.ended(result.status, True, values)


class OwnGoal(ActionGoal):
    """A goal of a client for one of the relay's own actions; feedback and result are JSON."""

    def __init__(self, requester: GoalRequester, action: str, wants_feedback: bool) -> None:
        super().__init__(action, wants_feedback)
        self._requester = requester

    def send_feedback(self, body: bytes) -> None:
        """Send feedback as it is."""
        self._requester.feedback(body)

    def send_result(self, result: GoalResult) -> None:
        """Send the result as it is, or the reason why there is none."""
        if result.body is None:
            self._requester.ended(result.status, False, jsontext.encode(result.reason))
        else:
            self._requester.ended(result.status, True, result.body)


class GraphGoal(ActionGoal):
    """A goal of the robot's graph for an action that a client offers.

    :param origin: the link over which it came; its id is valid on this link only
    """

    def __init__(self, message: link.SendActionGoal, origin: ChannelLinkPort, codec: PayloadCodec) -> None:
        super().__init__(message.action, message.feedback)
        self._id = message.id
        self._origin = origin
        self._codec = codec

    def send_feedback(self, body: bytes) -> None:
        """Send the newest feedback, so that a client that sends too much does not break the robot's link."""
        self._origin.send_newest(
            f"feedback {self._id}", link.ActionFeedback(id=self._id, **self._codec.values(body))
        )

    def send_result(self, result: GoalResult) -> None:
        """Send the result, or the reason why there is none."""
        fields = {} if result.body is None else self._codec.values(result.body)
        try:
            self._origin.send(
                link.ActionResult(
                    id=self._id,
                    status=result.status,
                    result=result.body is not None,
                    reason=result.reason,
                    **fields,
                )
            )
        except Unavailable as error:
            result = failed(result.status, str(error))
            self._origin.send(
                link.ActionResult(id=self._id, status=result.status, result=False, reason=result.reason)
            )


def start_error(failure: Failure, action: str) -> GoalResult:
    """The end of a goal that could not be started."""
    if failure.check(CancelledError):
        return GoalResult(GoalStatusCode.CANCELED, None, "the goal was cancelled before it began")
    if failure.check(SwitchboardError):
        return GoalResult(GoalStatusCode.NEVER_BEGAN, None, failure.getErrorMessage())
    return GoalResult(
        GoalStatusCode.NEVER_BEGAN, None, f"the relay failed on this goal of {action}; see its log"
    )


def failed(status: int, reason: str) -> GoalResult:
    """An end without a result; the status "succeeded" becomes "aborted"."""
    return GoalResult(GoalStatusCode.ABORTED if status == GoalStatusCode.SUCCEEDED else status, None, reason)


ROBOT_GOALS = 1024
"""Most goals that one robot executes, and most goals of its graph that clients execute."""


class RobotExecution:
    """A goal that the robot executes, under an id that the relay gave it."""

    def __init__(
        self, id: str, goal: ActionGoal, link_state: RobotLinkState, table: dict[str, RobotExecution]
    ) -> None:
        self.id = id
        self.goal = goal
        self._link_state = link_state
        self._table = table

    def cancel(self) -> None:
        """Cancel the goal."""
        self._link_state.send(link.CancelActionGoal(id=self.id))

    def forget(self) -> None:
        """The end of the goal is not needed any more; the robot bounds the number of its goals."""
        self._table.pop(self.id, None)


class ClientExecution(PendingRequest):
    """A goal that a client executes."""

    def __init__(
        self, pending: PendingRequests, offered: OfferedService, args: bytes, goal: ActionGoal
    ) -> None:
        super().__init__(pending.new_id(), offered, args)
        self.goal = goal
        self._pending = pending

    def cancel(self) -> None:
        """Cancel the goal."""
        self.offered.member.port.cancel_action_goal(self.offered.written, self.id)

    def forget(self) -> None:
        """The end of the goal is not needed any more."""
        self._pending.abandon(self)

    def withdrawn(self, reason: str) -> None:
        """The client will never answer."""
        self.goal.end(GoalResult(GoalStatusCode.ABORTED, None, reason))


class ActionGoals:
    """All goals of one channel; the requester of each gets its end exactly once."""

    log = Logger()

    def __init__(
        self,
        link_state: RobotLinkState,
        codec: PayloadCodec,
        offered_services: OfferedServices,
        pending: PendingRequests,
    ) -> None:
        self._link_state = link_state
        self._codec = codec
        self._offered_services = offered_services
        self._pending = pending
        self._ids = itertools.count(1)
        self._on_robot: dict[str, RobotExecution] = {}
        self._of_graph: dict[str, GraphGoal] = {}
        self._of_clients: set[ClientGoal] = set()

    # --- goals of clients ---------------------------------------------------------------------------------

    def create(
        self, member: ClientMember, requester: GoalRequester, action: str, wants_feedback: bool
    ) -> ClientGoal:
        """Create a goal of a client, to be started with :meth:`begin`."""
        goal = ClientGoal(member, requester, self._codec, action, wants_feedback)
        self._of_clients = {each for each in self._of_clients if not each.over}
        self._of_clients.add(goal)
        return goal

    async def begin(self, goal: ClientGoal, type_name: str, args: bytes, context: RequestContext) -> None:
        """Send a goal to the client that offers the action, else to the robot.

        :param type_name: as the client gave it; the type in the graph has precedence
        :param args: JSON, an object or a list of the fields in order; may be empty
        :raises NotFound: no such action
        :raises Invalid: the arguments do not fit its type
        :raises Refused: it moves the robot, and may be too old by the time it can be sent
        :raises Unavailable: the link to the robot is lost, or it executes too many goals already
        """
        offered = self._offered_services.find_usable(goal.action)
        known = offered.type if offered is not None else self._link_state.robot.graph.action_type(goal.action)
        goal.type = known or type_name
        if not goal.type:
            raise NotFound(f"action {goal.action} does not exist on robot {self._link_state.robot.name}")
        await self._codec.ready(goal.type)
        context.check_age()
        body = self._codec.from_client(f"{goal.type}_Goal", args)
        if offered is None:
            self._execute_on_robot(goal, body, context)
        else:
            self._execute_on_client(goal, offered, body)

    def forget(self, member: ChannelMember) -> None:
        """Cancel the goals of a client that has left."""
        for goal in list(self._of_clients):
            if goal.member is member:
                self._of_clients.discard(goal)
                goal.abandon()

    def _execute_on_robot(self, goal: ClientGoal, body: bytes, context: RequestContext) -> None:
        if len(self._on_robot) >= ROBOT_GOALS:
            raise Unavailable(f"{ROBOT_GOALS} goals are under way on this robot already")
        if self._link_state.link is None:
            raise Unavailable(f"robot {self._link_state.robot.name} is not connected")
        execution = RobotExecution(str(next(self._ids)), goal, self._link_state, self._on_robot)
        goal.executor = self._on_robot[execution.id] = execution
        message = link.SendActionGoal(
            id=execution.id,
            action=goal.action,
            type=goal.type,
            feedback=goal.wants_feedback,
            source=context.source,
            stamp=context.earliest_sent,
            **self._codec.args(body),
        )
        try:
            self._link_state.send(message)
        except Unavailable:
            goal.executor = None
            execution.forget()
            raise

    def _execute_on_client(self, goal: ActionGoal, offered: OfferedService, body: bytes) -> None:
        self._offered_services.check(offered)
        args = self._codec.to_client(f"{offered.type}_Goal", body)
        execution = ClientExecution(self._pending, offered, args, goal)
        self._pending.add(execution)
        goal.type = offered.type
        goal.executor = execution
        offered.member.port.send_action_goal(
            offered.written, execution.id, offered.written_type, args, goal.wants_feedback
        )

    # --- answers of the robot -----------------------------------------------------------------------------

    def robot_feedback(self, message: link.ActionFeedback) -> None:
        """Feedback of a goal that the robot executes."""
        execution = self._on_robot.get(message.id)
        if execution is None:
            return
        goal = execution.goal
        try:
            goal.feedback_received(
                self._codec.from_robot(f"{goal.type}_Feedback", message.cdr, message.values)
            )
        except SwitchboardError as error:
            self.log.warn(
                "feedback of {action} can't be read: {reason}", action=goal.action, reason=str(error)
            )

    def robot_result(self, message: link.ActionResult) -> None:
        """The end of a goal that the robot executes."""
        execution = self._on_robot.pop(message.id, None)
        if execution is None:
            return
        goal, status = execution.goal, message.status
        if status not in STATUSES:
            status = GoalStatusCode.ABORTED
        if not message.result:
            goal.end(failed(status, message.reason or f"action {goal.action} failed"))
            return
        try:
            body = self._codec.from_robot(f"{goal.type}_Result", message.cdr, message.values)
        except SwitchboardError as error:
            goal.end(GoalResult(GoalStatusCode.ABORTED, None, f"the robot's result can't be read: {error}"))
        else:
            goal.end(GoalResult(status, body))

    def robot_refused(self, id: str, reason: str) -> None:
        """The robot refuses a goal."""
        execution = self._on_robot.pop(id, None)
        if execution is not None:
            execution.goal.end(GoalResult(GoalStatusCode.NEVER_BEGAN, None, reason))

    def lost(self) -> None:
        """The link is lost: the robot cancels its goals, and goals of its graph have no requester any more."""
        executions = self._on_robot.copy()
        self._on_robot.clear()
        name = self._link_state.robot.name
        for execution in executions.values():
            execution.goal.end(
                GoalResult(GoalStatusCode.ABORTED, None, f"robot {name} lost its connection during the goal")
            )
        graph_goals, self._of_graph = self._of_graph, {}
        for goal in graph_goals.values():
            goal.abandon()

    # --- goals of the graph -------------------------------------------------------------------------------

    def goal_from_graph(self, message: link.SendActionGoal) -> None:
        """The graph sends a goal for an action that a client offers."""
        origin = self._link_state.link
        if origin is None:
            return
        self._of_graph = {id: goal for id, goal in self._of_graph.items() if not goal.over}
        goal = GraphGoal(message, origin, self._codec)
        if message.id in self._of_graph or len(self._of_graph) >= ROBOT_GOALS:
            goal.end(
                GoalResult(
                    GoalStatusCode.NEVER_BEGAN, None, "the id is in use, or too many goals are under way"
                )
            )
            return
        self._of_graph[message.id] = goal
        goal.starting = Deferred.fromCoroutine(self._serve(goal, message))
        goal.starting.addErrback(self.start_failed, goal)

    def cancel_from_graph(self, message: link.CancelActionGoal) -> None:
        """The graph cancels a goal."""
        goal = self._of_graph.get(message.id)
        if goal is not None:
            goal.cancel()

    async def _serve(self, goal: GraphGoal, message: link.SendActionGoal) -> None:
        offered = self._offered_services.find_usable(goal.action)
        if offered is None:
            raise NotFound(f"no client offers the action {goal.action}")
        await self._codec.ready(offered.type)
        body = self._codec.from_robot(f"{offered.type}_Goal", message.cdr, message.args)
        self._execute_on_client(goal, offered, body)

    def start_failed(self, failure: Failure, goal: ActionGoal) -> None:
        """A goal could not be started."""
        goal.end(start_error(failure, goal.action))
        if not failure.check(SwitchboardError, CancelledError):
            self.log.failure("a goal of {action} failed", failure, action=goal.action)

    # --- answers of clients -------------------------------------------------------------------------------

    def client_feedback(self, member: Provider, message: rosbridge.ActionFeedback) -> None:
        """Feedback of a goal that a client executes.

        :raises Refused: the client has no goal of this id
        :raises Invalid: the values do not fit the type
        """
        execution = self._pending.find(member, message.id, ClientExecution)
        values = bytes(message.values or b"")
        execution.goal.feedback_received(
            self._codec.from_client(f"{execution.offered.type}_Feedback", values)
        )

    def client_result(self, member: Provider, message: rosbridge.ActionResult) -> None:
        """The end of a goal that a client executes.

        :raises Refused: the client has no goal of this id
        :raises Invalid: the values do not fit the type, or the status is unknown; the requester gets the reason too
        """
        execution = self._pending.find(member, message.id, ClientExecution)
        self._pending.remove(execution)
        try:
            end = self._client_goal_result(execution.offered, message)
        except SwitchboardError as error:
            words = f"the client that offers {execution.offered.name} gave a wrong result: {error}"
            execution.goal.end(GoalResult(GoalStatusCode.ABORTED, None, words))
            raise
        execution.goal.end(end)

    def _client_goal_result(self, offered: OfferedService, message: rosbridge.ActionResult) -> GoalResult:
        status = message.status
        if status is None:
            status = GoalStatusCode.SUCCEEDED if message.result else GoalStatusCode.ABORTED
        if status not in STATUSES or (message.result and status == GoalStatusCode.NEVER_BEGAN):
            raise Invalid(f"status {status} is none of 4 (succeeded), 5 (canceled), 6 (aborted)")
        text = bytes(message.values or b"")
        if not message.result:
            return failed(
                status, refusal_reason(text) or f"the client that offers {offered.name} could not do it"
            )
        return GoalResult(status, self._codec.from_client(f"{offered.type}_Result", text))
