"""Control, stop and resume of robots: the only entry, by whatever path a request arrives (SPEC 1.7).

Websocket clients come from :mod:`relay_server.relay_node.control`, HTTP and the admin socket from
:mod:`relay_server.control.gateway`, orders to many robots from :mod:`relay_server.fleet`. Motion commands that
acquire control are checked one by one in :meth:`relay_server.control.controller.RobotController.acquire_by_command`.
Stops that the command line or another relay has stored in the database are read by
:meth:`relay_server.control.controllers.Controllers.read_stored_stops`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from twisted.internet.defer import Deferred

from relay_protocol.errors import Refused
from relay_protocol.rights import Level, Operation
from relay_server.access import Permit
from relay_server.channels.names import resolve
from relay_server.common.clock import Clock
from relay_server.common.concurrency import with_timeout
from relay_server.common.errors import NotDone
from relay_server.control import view
from relay_server.control.actor import Actor
from relay_server.control.controller import RobotController
from relay_server.control.controllers import Controllers
from relay_server.control.lease import LeaseClient
from relay_server.control.stopping import StopIncomplete
from relay_server.control.suppression import ignore
from relay_server.control.types import ControlReply, acts_for
from relay_server.control.view import StopInfo, StopValues
from relay_server.robots.registry import RobotState

CONFIRM_SECONDS = 15.0
"""Time for the answer to a stop: longer than a robot has to confirm, so that the database has had this time to store
the stop as well. After it, the stop itself continues."""

NOT_CONFIRMED = (
    f"the stop is not confirmed: within {CONFIRM_SECONDS:g} s neither has the robot answered nor the database stored "
    "the stop. Stop the robot again, or on site"
)

NO_CONTROL = "you have no control of this robot"


class StopResult(NamedTuple):
    """The outcome of a stop.

    :param done: whether the robot has confirmed it and done all of it
    :param stopped: as :func:`relay_server.control.view.stopped` shows it
    :param failed: what the stopped robot could not do of it, in its words; empty if it has not reported anything
    """

    done: bool
    stopped: StopInfo | None
    failed: str = ""

    def sentence(self, robot: str) -> str:
        """The outcome for display, by whatever path the stop came.

        :param robot: its name
        """
        if self.failed:
            return str(StopIncomplete(robot, self.failed))
        state = "is stopped" if self.done else "will be stopped as soon as it can be reached"
        return f"robot {robot} {state}"

    def values(self, robot: str) -> StopValues:
        """The answer of the service ``/relay/stop``.

        :param robot: its name
        """
        return {
            "success": not self.failed,
            "message": self.sentence(robot),
            "done": self.done,
            "stopped": self.stopped,
        }


class NoControl(Refused):
    """The user neither has control of the robot nor has requested it, where the operation needs that."""

    code = "no_control"


class ControlClient(LeaseClient, Protocol):
    """A client connection that can request control of its robot."""

    robot: RobotState
    controller: RobotController


class ControlService:
    """Checks and carries out every request about control, stop and resume.

    A session is the caller's own connection to the robot. Callers without one act for all sessions of their user,
    within the scope of their token.
    """

    def __init__(self, clock: Clock, controllers: Controllers) -> None:
        self._clock = clock
        self.controllers = controllers

    # --- control, by a session ----------------------------------------------------------------------------

    async def take(self, client: ControlClient, why: str) -> ControlReply:
        """Take control of a free robot, or request it from its holder.

        :raises Refused: no right to control, or too many requests
        :raises Unavailable: the robot is offline, or does not confirm
        """
        return await client.controller.take(client, why)

    def release(self, client: ControlClient, why: str) -> ControlReply:
        """Release control that this session has, or withdraw its request."""
        return client.controller.release(client, why)

    def grant(self, client: ControlClient, why: str, requester: int = 0) -> ControlReply:
        """Hand control over to the session that has requested it.

        :param requester: number of the session that is meant, 0 for any
        """
        return client.controller.grant(client, why, requester)

    def refuse(self, client: ControlClient, why: str, requester: int = 0) -> ControlReply:
        """Keep control.

        :param requester: as for :meth:`grant`
        """
        return client.controller.refuse(client, why, requester)

    # --- control, for all sessions of a user --------------------------------------------------------------

    def release_for(self, robot: RobotState, permit: Permit, actor: Actor, why: str) -> ControlReply:
        """Release control that any session of the user has, or withdraw a request; an owner releases any holder.

        :raises NoControl: the user neither has control nor has requested it
        """
        controller = self.controllers.of(robot)
        lease = controller.lease
        holder, request = lease.holder or lease.pending_holder, lease.request
        reply = None
        if request is not None and acts_for(permit, request.client):
            reply = controller.release(request.client, why, actor)
        if holder is not None and (acts_for(permit, holder.client) or permit.rules.level is Level.OWNER):
            reply = controller.release(holder.client, why, actor)
        if reply is None:
            raise NoControl(NO_CONTROL)
        return _require_success(reply)

    def grant_for(self, robot: RobotState, permit: Permit, why: str, requester: int = 0) -> ControlReply:
        """Hand control over, for the session of the user that has it.

        :param requester: as for :meth:`grant`
        :raises NoControl: the user has no control
        :raises NotDone: there is no such request
        """
        controller = self.controllers.of(robot)
        return _require_success(controller.grant(_require_holder(controller, permit), why, requester))

    def refuse_for(self, robot: RobotState, permit: Permit, why: str, requester: int = 0) -> ControlReply:
        """Keep control; parameters and errors as of :meth:`grant_for`."""
        controller = self.controllers.of(robot)
        return _require_success(controller.refuse(_require_holder(controller, permit), why, requester))

    # --- stop and resume ----------------------------------------------------------------------------------

    def stop(self, robot: RobotState, actor: Actor, why: str, stop_id: str = "") -> Deferred[StopResult]:
        """Stop a robot. Any client with a right on it may; the caller has checked that.

        The order is sent when this returns, see :meth:`relay_server.control.stopping.StopController.stop`.

        :param stop_id: see :class:`relay_server.control.stopping.StopIds`
        :returns: fires within :data:`CONFIRM_SECONDS`. Fails with :class:`Unavailable` when the stop could neither be
            sent nor be stored, or when that is not known by then
        """
        return Deferred.fromCoroutine(self._stop(self.controllers.of(robot), actor, why, stop_id))

    async def _stop(self, controller: RobotController, actor: Actor, why: str, stop_id: str) -> StopResult:
        stopping = controller.stopping.stop(actor, why, stop_id)
        done, failed = False, ""
        try:
            done = await with_timeout(self._clock, CONFIRM_SECONDS, stopping, NOT_CONFIRMED)
        except StopIncomplete as error:
            failed = error.reason
        return StopResult(done, view.stopped(controller.snapshot), failed)

    async def resume(
        self,
        robot: RobotState,
        permit: Permit,
        actor: Actor,
        why: str,
        earliest_sent: int,
        session: LeaseClient | None = None,
    ) -> None:
        """Let a stopped robot move again, for its holder and its owners.

        :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`
        :param session: the caller's session; where given, only it counts as holder
        :raises Refused: the caller is neither holder nor owner
        :raises StoppedSince: the robot may have been stopped after ``earliest_sent``
        :raises NotDone: the robot reports that it can't resume
        :raises Unavailable: the robot can't be reached
        """
        controller = self.controllers.of(robot)
        holder = controller.lease.holder
        if session is not None:
            holds = controller.lease.held_by(session)
        else:
            holds = holder is not None and acts_for(permit, holder.client)
        if permit.rules.level is not Level.OWNER and not holds:
            raise Refused("only the holder of control and the robot's owners may resume it")
        await controller.stopping.resume(actor, why, earliest_sent)

    async def resume_locally(self, robot: RobotState, actor: Actor, why: str, earliest_sent: int) -> None:
        """Let a stopped robot move again, for the operator of the relay's own machine; no right is needed.

        Parameters and errors as of :meth:`resume`.
        """
        await self.controllers.of(robot).stopping.resume(actor, why, earliest_sent)

    # --- suppression and inhibition -----------------------------------------------------------------------

    async def suppress(
        self, robot: RobotState, permit: Permit, actor: Actor, sources: list[int], topic: str, ms: int
    ) -> str:
        """Let only these sources command a topic for a time.

        :param sources: numbers of sessions
        :param ms: 50 to 200 milliseconds, or 0 to end it
        :returns: the topic's full name
        :raises Refused: no right to suppress it
        :raises Invalid: ``ms`` is out of range, or the name is not valid
        :raises Unavailable: too many topics are suppressed, or the robot does not answer
        """
        topic = _checked_topic(permit, Operation.SUPPRESS, topic)
        await self.controllers.of(robot).suppression.suppress(actor, sources, topic, ms)
        return topic

    def inhibit(
        self,
        robot: RobotState,
        permit: Permit,
        actor: Actor,
        topic: str,
        ms: int,
        hold: bool,
        owner: object,
        ended: Callable[[], None] = ignore,
    ) -> tuple[str, Deferred[None]]:
        """Have a topic deliver nothing, or its last value, for a time.

        :param ms: at most 60,000 milliseconds; 0 ends it
        :param hold: deliver the last value in place of each new one
        :param owner: its end ends the inhibition, by :meth:`end_inhibitions`
        :param ended: called when it has ended, for any reason
        :returns: the topic's full name, and a deferred that fires when the robot has confirmed
        :raises Refused: no right to inhibit it
        :raises Invalid: ``ms`` is out of range, or the name is not valid
        :raises Unavailable: too many topics are inhibited
        """
        topic = _checked_topic(permit, Operation.INHIBIT, topic)
        inhibiting = self.controllers.of(robot).suppression.inhibit(actor, topic, ms, hold, owner, ended)
        return topic, inhibiting

    def end_inhibitions(self, robot: RobotState, owner: object, allowed: Callable[[str], bool]) -> None:
        """End the inhibitions of an owner that has left, or whose rights have changed.

        :param allowed: whether the owner may still inhibit a topic
        """
        self.controllers.of(robot).suppression.end_of(owner, allowed)


def _checked_topic(permit: Permit, operation: Operation, resource: str) -> str:
    topic = resolve(resource)
    decision = permit.decide(operation, topic)
    if not decision.allowed:
        raise Refused(decision.reason)
    return topic


def _require_success(reply: ControlReply) -> ControlReply:
    """:raises NotDone: the reply is no success"""
    if not reply.success:
        raise NotDone(reply.message)
    return reply


def _require_holder(controller: RobotController, permit: Permit) -> LeaseClient:
    """The user's session that has control.

    :raises NoControl: there is none, or the scope of the token does not allow it
    """
    holder = controller.lease.holder
    if holder is None or not acts_for(permit, holder.client):
        raise NoControl(NO_CONTROL)
    return holder.client
