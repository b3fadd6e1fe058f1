"""Goals: asked for by clients and by the robot's graph, pursued by the robot and by clients that offer actions."""

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
from relay_server.channels.advertisements import ClientAdvertisement, ClientAdvertisements, Provider
from relay_server.channels.payloads import PayloadCodec
from relay_server.channels.robot_link import (
    ChannelPort,
    Publisher,
    RequestContext,
    RobotLinkState,
    Subscriber,
)
from relay_server.channels.service_calls import PendingRequest, PendingRequests, reason_in


class GoalStatusCode(enum.IntEnum):
    """How a goal ended: ``action_msgs/msg/GoalStatus``, and 0 for one that never began."""

    NEVER_BEGAN = 0
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


STATUSES = frozenset(GoalStatusCode)


class GoalResult(NamedTuple):
    """How a goal ended.

    :param body: the result, see :class:`PayloadCodec`; ``None`` when there is none
    :param reason: why there is none
    """

    status: int
    body: bytes | None = None
    reason: str = ""


class GoalRequester(Protocol):
    """A session, as one of its goals uses it."""

    def feedback(self, values: bytes) -> None:
        """How far the goal has come, JSON."""

    def unreadable(self, words: str) -> None:
        """Something that came of the goal can't be handed on, and why."""

    def ended(self, status: int, result: bool, values: bytes) -> None:
        """The goal is over; called once.

        :param values: JSON: the result, or a string that says why there is none
        """


class ActionGoal(ABC):
    """One goal from its asking to its end.

    :param wants_feedback: whether the asker does
    """

    def __init__(self, action: str, wants_feedback: bool) -> None:
        self.action = action
        self.type = ""
        self.wants_feedback = wants_feedback
        self.beginning: Deferred[None] | None = None
        self.pursuer: Executor | None = None
        self.over = False
        self._cancelled = False

    def cancel(self) -> None:
        """The asker wants it no more; its end still comes."""
        if not self.over:
            self._withdraw()

    def progress(self, body: bytes) -> None:
        """Feedback has come, a body."""
        if self.wants_feedback and not self.over:
            self.tell_feedback(body)

    def end(self, end: GoalResult) -> None:
        """It is over; whatever comes later is passed over."""
        if not self.over:
            self.over = True
            self.tell_end(end)

    def abandon(self) -> None:
        """The asker has gone: cancel it, and tell nobody of its end."""
        if self.over:
            return
        self.over = True
        self._withdraw()
        if self.pursuer is not None:
            self.pursuer.forget()

    def _withdraw(self) -> None:
        if self._cancelled:
            return
        self._cancelled = True
        if self.pursuer is not None:
            self.pursuer.cancel()
        elif self.beginning is not None:
            self.beginning.cancel()

    @abstractmethod
    def tell_feedback(self, body: bytes) -> None:
        """Hand feedback to the asker."""

    @abstractmethod
    def tell_end(self, end: GoalResult) -> None:
        """Hand the end to the asker."""


class Executor(Protocol):
    """Who pursues a goal."""

    def cancel(self) -> None:
        """The goal is not wanted any more."""

    def forget(self) -> None:
        """Nor is its end."""


class ClientGoal(ActionGoal):
    """A goal that a client asked for."""

    def __init__(
        self, member: Publisher, asker: GoalRequester, bodies: PayloadCodec, action: str, wants_feedback: bool
    ) -> None:
        super().__init__(action, wants_feedback)
        self.member = member
        self._asker = asker
        self._bodies = bodies

    def tell_feedback(self, body: bytes) -> None:
        """In JSON; what can't be read is left out."""
        try:
            values = self._bodies.to_client(f"{self.type}_Feedback", body)
        except SwitchboardError as error:
            self._asker.unreadable(f"feedback of {self.action} is left out: {error}")
            return
        self._asker.feedback(values)

    def tell_end(self, end: GoalResult) -> None:
        """In JSON, or in words."""
        if end.body is None:
            self._asker.ended(end.status, False, jsontext.encode(end.reason))
            return
        try:
            values = self._bodies.to_client(f"{self.type}_Result", end.body)
        except SwitchboardError as error:
            self._asker.ended(
                GoalStatusCode.ABORTED,
                False,
                jsontext.encode(f"the result of {self.action} can't be read: {error}"),
            )
        else:
            self._asker.ended(end.status, True, values)


class GraphGoal(ActionGoal):
    """A goal of the robot's graph for an action that a client offers.

    :param origin: the link it came over, the only one on which its id means anything
    """

    def __init__(self, message: link.SendActionGoal, origin: ChannelPort, bodies: PayloadCodec) -> None:
        super().__init__(message.action, message.feedback)
        self._id = message.id
        self._origin = origin
        self._bodies = bodies

    def tell_feedback(self, body: bytes) -> None:
        """The newest counts: a client that tells more than the robot's link takes must not break the link."""
        self._origin.newest(
            f"feedback {self._id}", link.ActionFeedback(id=self._id, **self._bodies.values(body))
        )

    def tell_end(self, end: GoalResult) -> None:
        """With the result, or with the reason for none."""
        fields = {} if end.body is None else self._bodies.values(end.body)
        try:
            self._origin.send(
                link.ActionResult(
                    id=self._id, status=end.status, result=end.body is not None, reason=end.reason, **fields
                )
            )
        except Unavailable as error:
            end = failed(end.status, str(error))
            self._origin.send(
                link.ActionResult(id=self._id, status=end.status, result=False, reason=end.reason)
            )


def why_not_begun(failure: Failure, action: str) -> GoalResult:
    """What the asker is told of a goal that could not be begun."""
    if failure.check(CancelledError):
        return GoalResult(GoalStatusCode.CANCELED, None, "the goal was cancelled before it began")
    if failure.check(SwitchboardError):
        return GoalResult(GoalStatusCode.NEVER_BEGAN, None, failure.getErrorMessage())
    return GoalResult(
        GoalStatusCode.NEVER_BEGAN, None, f"the relay failed on this goal of {action}; its log tells more"
    )


def failed(status: int, reason: str) -> GoalResult:
    """An end without a result: nobody can have succeeded without one."""
    return GoalResult(GoalStatusCode.ABORTED if status == GoalStatusCode.SUCCEEDED else status, None, reason)


ROBOT_GOALS = 1024
"""Goals under way on one robot, and again goals of its graph."""


class RobotExecution:
    """A goal that the robot pursues, under an id of the relay's."""

    def __init__(
        self, id: str, goal: ActionGoal, wire: RobotLinkState, table: dict[str, RobotExecution]
    ) -> None:
        self.id = id
        self.goal = goal
        self._wire = wire
        self._table = table

    def cancel(self) -> None:
        """The goal is not wanted any more."""
        self._wire.send(link.CancelActionGoal(id=self.id))

    def forget(self) -> None:
        """Nor is its end; the robot knows its own bounds."""
        self._table.pop(self.id, None)


class ClientExecution(PendingRequest):
    """A goal that a client pursues."""

    def __init__(
        self, errands: PendingRequests, offer: ClientAdvertisement, args: bytes, goal: ActionGoal
    ) -> None:
        super().__init__(errands.new_id(), offer, args)
        self.goal = goal
        self._errands = errands

    def cancel(self) -> None:
        """The goal is not wanted any more."""
        self.offer.member.say(rosbridge.cancel_action_goal(self.offer.written, self.id))

    def forget(self) -> None:
        """Nor is its end."""
        self._errands.fade(self)

    def withdrawn(self, reason: str) -> None:
        """The client will never answer."""
        self.goal.end(GoalResult(GoalStatusCode.ABORTED, None, reason))


class ActionGoals:
    """All goals of one channel; the asker of each is told of its end exactly once."""

    log = Logger()

    def __init__(
        self,
        wire: RobotLinkState,
        bodies: PayloadCodec,
        offers: ClientAdvertisements,
        errands: PendingRequests,
    ) -> None:
        self._wire = wire
        self._bodies = bodies
        self._offers = offers
        self._errands = errands
        self._ids = itertools.count(1)
        self._at_robot: dict[str, RobotExecution] = {}
        self._of_graph: dict[str, GraphGoal] = {}
        self._of_clients: set[ClientGoal] = set()

    # --- clients ask --------------------------------------------------------------------------------------

    def want(self, member: Publisher, asker: GoalRequester, action: str, wants_feedback: bool) -> ClientGoal:
        """A client wants a goal: the record of it, to be begun with :meth:`begin`."""
        goal = ClientGoal(member, asker, self._bodies, action, wants_feedback)
        self._of_clients = {each for each in self._of_clients if not each.over}
        self._of_clients.add(goal)
        return goal

    async def begin(self, goal: ClientGoal, type_name: str, args: bytes, sent: RequestContext) -> None:
        """Have the robot, or the client that offers the action, pursue a goal.

        :param type_name: as the client gave it; what the graph says wins
        :param args: JSON, an object or a list of the fields in order; may be empty
        :raises NotFound: no such action
        :raises Invalid: the arguments do not fit its type
        :raises Refused: it moves the robot, and may be too old when it could be sent
        :raises Unavailable: the robot is lost, or whoever pursues goals has too many
        """
        offer = self._offers.standing(goal.action)
        known = offer.type if offer is not None else self._wire.robot.graph.action_type(goal.action)
        goal.type = known or type_name
        if not goal.type:
            raise NotFound(f"action {goal.action} does not exist on robot {self._wire.robot.name}")
        await self._bodies.ready(goal.type)
        sent.judge()
        body = self._bodies.from_client(f"{goal.type}_Goal", args)
        if offer is None:
            self._robot_pursues(goal, body, sent)
        else:
            self._client_pursues(goal, offer, body)

    def forget(self, member: Subscriber) -> None:
        """A client has gone: its goals are cancelled."""
        for goal in list(self._of_clients):
            if goal.member is member:
                self._of_clients.discard(goal)
                goal.abandon()

    def _robot_pursues(self, goal: ClientGoal, body: bytes, sent: RequestContext) -> None:
        if len(self._at_robot) >= ROBOT_GOALS:
            raise Unavailable(f"{ROBOT_GOALS} goals are under way on this robot already")
        if self._wire.link is None:
            raise Unavailable(f"robot {self._wire.robot.name} is not connected")
        pursuit = RobotExecution(str(next(self._ids)), goal, self._wire, self._at_robot)
        goal.pursuer = self._at_robot[pursuit.id] = pursuit
        message = link.SendActionGoal(
            id=pursuit.id,
            action=goal.action,
            type=goal.type,
            feedback=goal.wants_feedback,
            source=sent.source,
            stamp=sent.stamp,
            **self._bodies.args(body),
        )
        try:
            self._wire.send(message)
        except Unavailable:
            goal.pursuer = None
            pursuit.forget()
            raise

    def _client_pursues(self, goal: ActionGoal, offer: ClientAdvertisement, body: bytes) -> None:
        self._offers.check(offer)
        args = self._bodies.to_client(f"{offer.type}_Goal", body)
        pursuit = ClientExecution(self._errands, offer, args, goal)
        self._errands.add(pursuit)
        goal.type = offer.type
        goal.pursuer = pursuit
        offer.member.say(
            rosbridge.send_action_goal(
                offer.written, pursuit.id, offer.written_type, args, goal.wants_feedback
            )
        )

    # --- the robot answers --------------------------------------------------------------------------------

    def robot_feedback(self, message: link.ActionFeedback) -> None:
        """How far the robot has come with a goal."""
        pursuit = self._at_robot.get(message.id)
        if pursuit is None:
            return
        goal = pursuit.goal
        try:
            goal.progress(self._bodies.from_robot(f"{goal.type}_Feedback", message.cdr, message.values))
        except SwitchboardError as error:
            self.log.warn(
                "feedback of {action} can't be read: {reason}", action=goal.action, reason=str(error)
            )

    def robot_result(self, message: link.ActionResult) -> None:
        """The robot is done with a goal."""
        pursuit = self._at_robot.pop(message.id, None)
        if pursuit is None:
            return
        goal, status = pursuit.goal, message.status
        if status not in STATUSES:
            status = GoalStatusCode.ABORTED
        if not message.result:
            goal.end(failed(status, message.reason or f"action {goal.action} failed"))
            return
        try:
            body = self._bodies.from_robot(f"{goal.type}_Result", message.cdr, message.values)
        except SwitchboardError as error:
            goal.end(GoalResult(GoalStatusCode.ABORTED, None, f"the robot's result can't be read: {error}"))
        else:
            goal.end(GoalResult(status, body))

    def robot_refused(self, id: str, reason: str) -> None:
        """The robot can't take a goal."""
        pursuit = self._at_robot.pop(id, None)
        if pursuit is not None:
            pursuit.goal.end(GoalResult(GoalStatusCode.NEVER_BEGAN, None, reason))

    def lost(self) -> None:
        """The link is gone: the robot has cancelled what it pursued, and nobody is left who asked over it."""
        pursued = self._at_robot.copy()
        self._at_robot.clear()
        name = self._wire.robot.name
        for pursuit in pursued.values():
            pursuit.goal.end(
                GoalResult(GoalStatusCode.ABORTED, None, f"robot {name} lost its connection during the goal")
            )
        asked, self._of_graph = self._of_graph, {}
        for goal in asked.values():
            goal.abandon()

    # --- the graph asks -----------------------------------------------------------------------------------

    def graph_asks(self, message: link.SendActionGoal) -> None:
        """A goal for an action that a client offers."""
        origin = self._wire.link
        if origin is None:
            return
        self._of_graph = {id: goal for id, goal in self._of_graph.items() if not goal.over}
        goal = GraphGoal(message, origin, self._bodies)
        if message.id in self._of_graph or len(self._of_graph) >= ROBOT_GOALS:
            goal.end(
                GoalResult(
                    GoalStatusCode.NEVER_BEGAN, None, "the id is in use, or too many goals are under way"
                )
            )
            return
        self._of_graph[message.id] = goal
        goal.beginning = Deferred.fromCoroutine(self._serve(goal, message))
        goal.beginning.addErrback(self.not_begun, goal)

    def graph_cancels(self, message: link.CancelActionGoal) -> None:
        """The graph wants a goal no more."""
        goal = self._of_graph.get(message.id)
        if goal is not None:
            goal.cancel()

    async def _serve(self, goal: GraphGoal, message: link.SendActionGoal) -> None:
        offer = self._offers.standing(goal.action)
        if offer is None:
            raise NotFound(f"no client offers the action {goal.action}")
        await self._bodies.ready(offer.type)
        body = self._bodies.from_robot(f"{offer.type}_Goal", message.cdr, message.args)
        self._client_pursues(goal, offer, body)

    def not_begun(self, failure: Failure, goal: ActionGoal) -> None:
        """What was to begin a goal has failed."""
        goal.end(why_not_begun(failure, goal.action))
        if not failure.check(SwitchboardError, CancelledError):
            self.log.failure("a goal of {action} failed", failure, action=goal.action)

    # --- clients answer -----------------------------------------------------------------------------------

    def client_feedback(self, member: Provider, message: rosbridge.ActionFeedback) -> None:
        """How far a client has come with a goal.

        :raises Refused: it was not asked that
        :raises Invalid: the values do not fit the type
        """
        pursuit = self._errands.find(member, message.id, ClientExecution)
        values = bytes(message.values or b"")
        pursuit.goal.progress(self._bodies.from_client(f"{pursuit.offer.type}_Feedback", values))

    def client_result(self, member: Provider, message: rosbridge.ActionResult) -> None:
        """A client is done with a goal.

        :raises Refused: it was not asked that
        :raises Invalid: the values do not fit the type, or the status is none; the asker is told too
        """
        pursuit = self._errands.find(member, message.id, ClientExecution)
        self._errands.remove(pursuit)
        try:
            end = self._end_by_client(pursuit.offer, message)
        except SwitchboardError as error:
            words = f"the client that offers {pursuit.offer.name} gave an unfit result: {error}"
            pursuit.goal.end(GoalResult(GoalStatusCode.ABORTED, None, words))
            raise
        pursuit.goal.end(end)

    def _end_by_client(self, offer: ClientAdvertisement, message: rosbridge.ActionResult) -> GoalResult:
        status = message.status
        if status is None:
            status = GoalStatusCode.SUCCEEDED if message.result else GoalStatusCode.ABORTED
        if status not in STATUSES or (message.result and status == GoalStatusCode.NEVER_BEGAN):
            raise Invalid(f"status {status} is none of 4 (succeeded), 5 (canceled), 6 (aborted)")
        text = bytes(message.values or b"")
        if not message.result:
            return failed(status, reason_in(text) or f"the client that offers {offer.name} could not do it")
        return GoalResult(status, self._bodies.from_client(f"{offer.type}_Result", text))
