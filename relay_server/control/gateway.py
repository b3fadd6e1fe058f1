"""Control for callers that name a robot: over HTTP, and on the relay's own machine."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred

from relay_db import queries
from relay_protocol.errors import NotFound, SwitchboardError, Unavailable
from relay_protocol.rights import Operation
from relay_server.access import LOOKUP_SECONDS, NOT_LOOKED_UP, Access, Permit, Principal
from relay_server.common.clock import Clock
from relay_server.common.concurrency import with_timeout
from relay_server.common.database import AsyncDatabase
from relay_server.control import view
from relay_server.control.actor import Actor, local_actor, user_actor
from relay_server.control.controller import RobotController
from relay_server.control.service import ControlService, StopResult
from relay_server.control.types import ControlReply
from relay_server.control.view import ControlInfo
from relay_server.in_process_sessions.control_requests import PendingControlRequests, take_control
from relay_server.in_process_sessions.pool import InProcessSessionPool, RobotCaller
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.sessions.manager import SessionManager

NOT_ALL_KNOWN = f"the database has not returned the list of robots within {LOOKUP_SECONDS:g} s"


class TakeResult(NamedTuple):
    """The outcome of taking control.

    :param answer: without success while the holder has not answered the request
    :param control: as of :meth:`ControlGateway.control`
    """

    answer: ControlReply
    control: ControlInfo


class StopAllResult(NamedTuple):
    """The outcome of a stop of many robots.

    :param robots: for each robot ``robot``, ``done``, ``stopped`` (see :class:`StopResult`), and ``reason`` where
        something failed; without ``stopped`` where it is not known to be stopped
    :param missed: why further robots, if there are any, were not stopped
    """

    robots: list[dict[str, Any]]
    missed: str = ""


class ControlGateway:
    """Finds the robot and the caller's rights on it, then asks the :class:`ControlService`.

    :param in_process_sessions: control taken over HTTP belongs to the session pooled here for the token
    """

    def __init__(
        self,
        clock: Clock,
        control: ControlService,
        *,
        sessions: SessionManager,
        access: Access,
        registry: RobotRegistry,
        database: AsyncDatabase,
        in_process_sessions: InProcessSessionPool,
    ) -> None:
        self._clock = clock
        self._control = control
        self._sessions = sessions
        self._access = access
        self._registry = registry
        self._database = database
        self._in_process_sessions = in_process_sessions
        self._pending_requests = PendingControlRequests()

    # --- over HTTP ----------------------------------------------------------------------------------------

    async def control(self, principal: Principal, robot: str, address: str) -> ControlInfo:
        """The state of control of a robot.

        :raises NotFound: no such robot, or no right on it
        """
        async with self._sessions.admitted(principal, robot, address) as admission:
            return _control_info(self._control.controllers.of(admission.robot), admission.permit)

    async def take(
        self, principal: Principal, robot: str, why: str, address: str, seconds: float = 0.0
    ) -> TakeResult:
        """Take control, or request it from its holder, with the session pooled for the principal's token.

        :param seconds: time for the holder to answer a request
        :raises NotFound: as of :meth:`control`
        :raises SwitchboardError: as of
            :func:`relay_server.in_process_sessions.control_requests.take_control`, or the pool is full
        """
        with self._pending_requests.add(principal, robot) as pending:
            async with self._in_process_sessions.at(RobotCaller(principal, robot, address)) as pooled:
                answer = await take_control(self._clock, self._control, pooled, pending, why, seconds)
                return TakeResult(answer, _control_info(pooled.client.controller, pooled.client.permit))

    async def release_own(self, principal: Principal, robot: str, address: str) -> None:
        """Release control that the token's session has, or withdraw its request; do nothing if it has neither.

        :raises NotFound: as of :meth:`control`
        :raises Unavailable: the database does not answer whether the principal has a right on the robot
        """
        self._pending_requests.withdraw(principal, robot)
        found = self._in_process_sessions.find(principal, robot)
        if found is None:
            await self._find_stoppable(principal, robot, address)
            return
        pooled, leave = found
        try:
            self._control.release(pooled.client, "")
        finally:
            leave()

    async def release(self, principal: Principal, robot: str, why: str, address: str) -> ControlReply:
        """See :meth:`ControlService.release_for`.

        :raises NotFound: as of :meth:`control`
        """
        async with self._sessions.admitted(principal, robot, address) as admission:
            actor = _actor(principal, admission.robot, address)
            return self._control.release_for(admission.robot, admission.permit, actor, why)

    async def grant(
        self, principal: Principal, robot: str, why: str, address: str, client: int = 0
    ) -> ControlReply:
        """See :meth:`ControlService.grant_for`.

        :raises NotFound: as of :meth:`control`
        """
        async with self._sessions.admitted(principal, robot, address) as admission:
            return self._control.grant_for(admission.robot, admission.permit, why, client)

    async def refuse(
        self, principal: Principal, robot: str, why: str, address: str, client: int = 0
    ) -> ControlReply:
        """See :meth:`ControlService.refuse_for`.

        :raises NotFound: as of :meth:`control`
        """
        async with self._sessions.admitted(principal, robot, address) as admission:
            return self._control.refuse_for(admission.robot, admission.permit, why, client)

    async def stop(
        self, principal: Principal, robot: str, why: str, address: str, stop_id: str = ""
    ) -> StopResult:
        """Stop a robot; any right on it is enough.

        :raises NotFound: as of :meth:`control`
        :raises Unavailable: the robot can't be reached and the stop can't be stored, or the database does not answer
            whether the principal has a right on it
        """
        found = await self._find_stoppable(principal, robot, address)
        return await self._control.stop(found, _actor(principal, found, address), why, stop_id)

    async def _find_stoppable(self, principal: Principal, robot: str, address: str) -> RobotState:
        """A robot that the principal has any right on. The database is asked only if memory does not show the right."""
        for known in self._registry:
            if known.name == robot and self._access.may_stop_at_once(principal, known):
                return known
        looked_up = self._sessions.admit(principal, robot, address)
        admission = await with_timeout(self._clock, LOOKUP_SECONDS, looked_up, NOT_LOOKED_UP)
        self._sessions.release(admission)
        return admission.robot

    async def resume(
        self, principal: Principal, robot: str, why: str, address: str, earliest_sent: int
    ) -> None:
        """See :meth:`ControlService.resume`.

        :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`
        :raises NotFound: as of :meth:`control`
        """
        async with self._sessions.admitted(principal, robot, address) as admission:
            actor = _actor(principal, admission.robot, address)
            await self._control.resume(admission.robot, admission.permit, actor, why, earliest_sent)

    async def suppress(self, principal: Principal, robot: str, resource: str, ms: int, address: str) -> None:
        """Let a topic obey all sessions of the principal, and no others, for a time.

        :raises NotFound: as of :meth:`control`
        :raises SwitchboardError: as of :meth:`ControlService.suppress`
        """
        async with self._sessions.admitted(principal, robot, address) as admission:
            sources = [
                client.number
                for client in self._sessions.clients_of(admission.robot.robot_id)
                if client.user == principal.user_id
            ]
            actor = _actor(principal, admission.robot, address)
            await self._control.suppress(admission.robot, admission.permit, actor, sources, resource, ms)

    async def inhibit(
        self, principal: Principal, robot: str, resource: str, ms: int, hold: bool, address: str
    ) -> None:
        """Have a topic deliver nothing, or its last value, for a time, at most while the principal has the right.

        :raises NotFound: as of :meth:`control`
        :raises SwitchboardError: as of :meth:`ControlService.inhibit`
        """
        admission = await self._sessions.admit(principal, robot, address)
        permit, target = admission.permit, admission.robot
        ended = partial(self._sessions.release, admission)
        try:
            actor = _actor(principal, target, address)
            _, inhibited = self._control.inhibit(target, permit, actor, resource, ms, hold, permit, ended)
        except SwitchboardError:
            ended()
            raise
        # The permit is kept during the inhibition, so that changed rights end it.
        permit.on_change = lambda: self._control.end_inhibitions(
            target, permit, lambda topic: permit.decide(Operation.INHIBIT, topic).allowed
        )
        permit.on_revoke = lambda error: self._control.end_inhibitions(target, permit, lambda topic: False)
        await inhibited

    # --- on the relay's own machine -----------------------------------------------------------------------

    async def stop_locally(self, robot: str | None, why: str, by: str, stop_id: str = "") -> StopAllResult:
        """Stop one robot, or all concurrently, so that none waits for another.

        Robots known in memory are stopped before the database is asked for others.

        :param robot: its full name; ``None`` for all
        :param by: user of the operating system
        :raises NotFound: no such robot
        :raises Unavailable: the robot is not known in memory, and the database does not answer
        """
        outcomes: dict[int, tuple[str, Deferred[dict[str, Any]]]] = {}

        def stop(robots: Iterable[RobotState]) -> None:
            for each in robots:
                if each.robot_id not in outcomes:
                    stopping = self._control.stop(each, local_actor(by), why, stop_id)
                    outcome = self._stop_outcome(each.full, stopping)
                    outcomes[each.robot_id] = (each.full, Deferred.fromCoroutine(outcome))

        stop([each for each in self._registry if robot in (None, each.full)])
        missed = ""
        if robot is None or not outcomes:
            try:
                stop(
                    await with_timeout(
                        self._clock, LOOKUP_SECONDS, self._find_in_database(robot), NOT_ALL_KNOWN
                    )
                )
            except Unavailable as error:
                if not outcomes:
                    raise
                missed = str(error)
        return StopAllResult(
            [await outcome for _, outcome in sorted(outcomes.values(), key=itemgetter(0))], missed
        )

    async def _stop_outcome(self, robot: str, stopping: Deferred[StopResult]) -> dict[str, Any]:
        try:
            result = await stopping
        except SwitchboardError as error:
            return {"robot": robot, "done": False, "reason": str(error)}
        outcome = {"robot": robot, "done": result.done, "stopped": result.stopped}
        return {**outcome, "reason": result.sentence(robot)} if result.failed else outcome

    async def resume_locally(self, robot: str, why: str, by: str, earliest_sent: int) -> None:
        """Let a robot move again.

        :param earliest_sent: as of :meth:`resume`
        :raises NotFound: no such robot
        :raises SwitchboardError: it has not resumed
        """
        for each in await self._find_in_database(robot):
            await self._control.resume_locally(each, local_actor(by), why, earliest_sent)

    async def _find_in_database(self, robot: str | None) -> list[RobotState]:
        records = await self._database.read(queries.list_robots)
        found = [record for record in records if robot in (None, record.full)]
        if robot is not None and not found:
            raise NotFound(f"there is no robot '{robot}'; see 'switchboard robot list'")
        return [self._registry.robot(each.id, each.name, each.realm) for each in found]


def _control_info(controller: RobotController, permit: Permit) -> ControlInfo:
    """The state of control; all sessions of the user count as the caller's."""
    user, holder = permit.principal.user_id, controller.lease.holder
    reader = view.ControlReader(permit.rules, lambda client: client.user == user)
    mine = holder is not None and reader.mine(holder.client)
    return view.control(controller, reader, holder.client.number if holder is not None and mine else None)


def _actor(principal: Principal, robot: RobotState, address: str) -> Actor:
    name = robot.name_of(principal.name, principal.realm)
    return user_actor(name, principal.user_id, address)
