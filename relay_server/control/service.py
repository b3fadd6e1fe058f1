"""What is asked about control without a connection to the robot: by HTTP, and on the relay's own machine."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred

from relay_db import queries
from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.rights import Level, Operation
from relay_server.access import Access, Permit, Principal
from relay_server.channels.robot_link import resolve
from relay_server.common.clock import Clock, with_timeout
from relay_server.common.database import AsyncDatabase
from relay_server.control import view
from relay_server.control.audit import Actor
from relay_server.control.commands import NotDone
from relay_server.control.controller import RobotController
from relay_server.control.controllers import Controllers
from relay_server.control.lease import LeaseClient
from relay_server.control.types import ControlReply, acts_for
from relay_server.http_sessions.control_requests import PendingControlRequests, take_control
from relay_server.http_sessions.pool import SessionPool
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.sessions.manager import LOOKUP_SECONDS, NOT_LOOKED_UP, AuthorizedSession, SessionManager

CONFIRM_SECONDS = 15.0
"""So long it is waited for a stop: longer than a robot has to confirm that it stands, by when the database has had as
long to keep the order. The stop itself goes on."""

NOT_CONFIRMED = (
    f"the stop is not confirmed: within {CONFIRM_SECONDS:g} s the robot has not answered, and the database has not "
    "kept the order for when it does"
)

NO_CONTROL = "you have no control of this robot"

NOT_ALL_KNOWN = f"the database has not told within {LOOKUP_SECONDS:g} s which robots there are"


class NoControl(Refused):
    """What is asked is for the user who has control of the robot, or asks for it."""

    code = "no_control"


class StopResult(NamedTuple):
    """What became of a stop.

    :param done: whether the robot has done it; else it will as soon as it can be reached
    :param stopped: as :func:`relay_server.control.view.stopped` tells
    :param failed: what the robot could not do, though it is stopped
    """

    done: bool
    stopped: dict[str, Any] | None
    failed: str = ""


class TakeResult(NamedTuple):
    """What became of taking control.

    :param answer: without success while who has control is asked for it
    :param control: as :meth:`ControlService.control` tells
    """

    answer: ControlReply
    control: dict[str, Any]


class StopAllResult(NamedTuple):
    """What became of a stop of many.

    :param robots: for each ``robot``, ``done`` and, where something failed, ``reason``
    :param missed: why others that there may be were not stopped
    """

    robots: list[dict[str, Any]]
    missed: str = ""


class ControlService:
    """Control of robots for users who may have no connection to them, or several.

    :param guests: who takes control by HTTP has it by the connection that is kept for him there
    """

    def __init__(
        self,
        clock: Clock,
        desk: SessionManager,
        access: Access,
        desks: Controllers,
        registry: RobotRegistry,
        store: AsyncDatabase,
        guests: SessionPool,
    ) -> None:
        self._clock = clock
        self._desk = desk
        self._access = access
        self._desks = desks
        self._registry = registry
        self._store = store
        self._guests = guests
        self._wishes = PendingControlRequests()

    # --- by HTTP ------------------------------------------------------------------------------------------

    async def control(self, principal: Principal, robot: str, address: str) -> dict[str, Any]:
        """Who moves a robot.

        :raises NotFound: no such robot, or no right on it
        """
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
            return _shown(self._of(admission), admission.permit)

    async def take(
        self, principal: Principal, robot: str, why: str, address: str, seconds: float = 0.0
    ) -> TakeResult:
        """Take control, or ask who has it for it, by the connection that is kept for the principal's token.

        :param seconds: an answer to a request is waited for so long
        :raises NotFound: as :meth:`control`
        :raises SwitchboardError: as :func:`relay_server.http_sessions.control_requests.take_control`, or
            there is no room for him
        """
        with self._wishes.made(principal, robot) as wish:
            async with self._guests.at(principal, robot, address) as guest:
                answer = await take_control(self._clock, guest, wish, why, seconds)
                return TakeResult(answer, _shown(guest.session.desk, guest.session.permit))

    async def let_go(self, principal: Principal, robot: str, address: str) -> None:
        """Give back what that connection has of control, or asks for. Where it has nothing, nothing is done.

        :raises NotFound: as :meth:`control`
        :raises Unavailable: nobody can say whether he has a right on the robot
        """
        self._wishes.withdraw(principal, robot)
        there = self._guests.there(principal, robot)
        if there is None:
            await self._stoppable(principal, robot, address)
            return
        guest, leave = there
        try:
            guest.session.desk.release(guest.session, "")
        finally:
            leave()

    async def release(self, principal: Principal, robot: str, why: str, address: str) -> ControlReply:
        """Give control back, or a request for it; an owner takes control from anybody.

        :raises NotFound: as :meth:`control`
        :raises NoControl: the user neither has control nor asks for it
        """
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
            desk, actor = self._of(admission), _actor(principal, admission.robot, address)
            lease = desk.lease
            held, request = lease.holder or lease.coming, lease.request
            answer = None
            asks = request is not None and acts_for(admission.permit, request.client)
            owner = admission.permit.rules.level is Level.OWNER
            if request is not None and asks:
                answer = desk.release(request.client, why, actor)
            if held is not None and (acts_for(admission.permit, held.client) or owner):
                answer = desk.release(held.client, why, actor)
            if answer is None:
                raise NoControl(NO_CONTROL)
            return _accepted(answer)

    async def grant(
        self, principal: Principal, robot: str, why: str, address: str, client: int = 0
    ) -> ControlReply:
        """Hand control over to who asks for it.

        :param client: the number of the connection that is meant, 0 for whoever asks
        :raises NotFound: as :meth:`control`
        :raises NoControl: the user has no control
        :raises NotDone: nobody asks for it, or not the one who is meant
        """
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
            desk = self._of(admission)
            return _accepted(desk.grant(_needed_holder(desk, admission), why, client))

    async def refuse(
        self, principal: Principal, robot: str, why: str, address: str, client: int = 0
    ) -> ControlReply:
        """Keep control.

        :param client: as for :meth:`grant`
        :raises NotFound: as :meth:`control`
        :raises NoControl: the user has no control
        :raises NotDone: nobody asks for it, or not the one who is meant
        """
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
            desk = self._of(admission)
            return _accepted(desk.refuse(_needed_holder(desk, admission), why, client))

    async def stop(self, principal: Principal, robot: str, why: str, address: str) -> StopResult:
        """Stop a robot; everybody with any right on it may.

        :raises NotFound: as :meth:`control`
        :raises Unavailable: it can't be reached, and the order can't be kept; or nobody can say whether he may
        """
        there = await self._stoppable(principal, robot, address)
        desk = self._desks.of(there)
        stopping = desk.stopping.stop(_actor(principal, there, address), why)
        try:
            done, failed = await with_timeout(self._clock, CONFIRM_SECONDS, stopping, NOT_CONFIRMED), ""
        except NotDone as error:
            done, failed = False, str(error)
        return StopResult(done, view.stopped(desk.standing), failed)

    async def _stoppable(self, principal: Principal, robot: str, address: str) -> RobotState:
        """A robot the principal has any right on; the database is asked only where that is not known here."""
        for there in self._registry:
            named = there.name == robot and principal.realm in there.realms
            if named and self._access.knows(principal, there.robot_id):
                return there
        looked_up = self._desk.admit(principal, robot, address)
        with self._admitted(
            await with_timeout(self._clock, LOOKUP_SECONDS, looked_up, NOT_LOOKED_UP)
        ) as admission:
            return admission.robot

    async def resume(self, principal: Principal, robot: str, why: str, address: str, sent: int) -> None:
        """Let a robot move again; for who controls it, and owners.

        :param sent: a moment before which it can't have been asked for, the relay's monotonic nanoseconds
        :raises NotFound: as :meth:`control`
        :raises Refused: the principal is neither
        :raises StoppedSince: the robot may have been stopped after that
        :raises NotDone: the robot says that it can't
        :raises Unavailable: it can't be reached
        """
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
            desk = self._of(admission)
            owner = admission.permit.rules.level is Level.OWNER
            if not owner and _own_holder(desk, admission) is None:
                raise Refused("only who has control of the robot, and its owners, may resume it")
            await desk.stopping.resume(_actor(principal, admission.robot, address), why, sent)

    async def suppress(self, principal: Principal, robot: str, resource: str, ms: int, address: str) -> None:
        """Have a topic obey all connections of the principal and nobody else, for moments.

        :raises NotFound: as :meth:`control`
        :raises Refused: no right to
        :raises Invalid: no such time, or no name
        :raises SwitchboardError: the robot has not done it
        """
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
            topic = self._judged(admission, Operation.SUPPRESS, resource)
            sources = [
                session.number
                for session in self._desk.sessions_of(admission.robot.robot_id)
                if session.user == principal.user_id
            ]
            actor = _actor(principal, admission.robot, address)
            await self._of(admission).subsuming.suppress(actor, sources, topic, ms)

    async def inhibit(
        self, principal: Principal, robot: str, resource: str, ms: int, hold: bool, address: str
    ) -> None:
        """Have a topic say nothing, or its last value, for a time, and no longer than the principal has the right.

        :raises SwitchboardError: as :meth:`suppress`
        """
        admission = await self._desk.admit(principal, robot, address)
        permit, subsuming = admission.permit, self._of(admission).subsuming
        over = partial(self._desk.turn_away, admission)
        try:
            topic = self._judged(admission, Operation.INHIBIT, resource)
            actor = _actor(principal, admission.robot, address)
            inhibited = subsuming.inhibit(actor, topic, ms, hold, permit, over)
        except SwitchboardError:
            over()
            raise
        # The permit is kept for as long, to hear of another right or of its end.
        permit.on_change = lambda: subsuming.ends(
            permit, lambda topic: permit.judge(Operation.INHIBIT, topic).allowed
        )
        permit.on_revoke = lambda error: subsuming.ends(permit, lambda topic: False)
        await inhibited

    # --- on the relay's own machine -----------------------------------------------------------------------

    async def stop_here(self, robot: str | None, why: str, by: str) -> StopAllResult:
        """Stop a robot, or all there are: side by side, since no robot must wait for another.

        Those that have been here since the relay began are told before the database is asked for the others.

        :param robot: its name for the whole relay
        :param by: who is at the machine
        :raises NotFound: no such robot
        :raises Unavailable: the robot is not known here, and the database does not answer
        """
        given: dict[int, tuple[str, Deferred[dict[str, Any]]]] = {}

        def stop(robots: Iterable[RobotState]) -> None:
            for each in robots:
                if each.robot_id not in given:
                    stopping = self._desks.of(each).stopping
                    told = self._told(each.full, stopping.stop(_local(by), why))
                    given[each.robot_id] = (each.full, Deferred.fromCoroutine(told))

        stop([each for each in self._registry if robot in (None, each.full)])
        missed = ""
        if robot is None or not given:
            try:
                stop(await with_timeout(self._clock, LOOKUP_SECONDS, self._meant(robot), NOT_ALL_KNOWN))
            except Unavailable as error:
                if not given:
                    raise
                missed = str(error)
        return StopAllResult([await told for _, told in sorted(given.values(), key=itemgetter(0))], missed)

    async def _told(self, robot: str, stopping: Deferred[bool]) -> dict[str, Any]:
        try:
            return {
                "robot": robot,
                "done": await with_timeout(self._clock, CONFIRM_SECONDS, stopping, NOT_CONFIRMED),
            }
        except SwitchboardError as error:
            return {"robot": robot, "done": False, "reason": str(error)}

    async def resume_here(self, robot: str, why: str, by: str, sent: int) -> None:
        """Let a robot move again.

        :param sent: as of :meth:`resume`
        :raises NotFound: no such robot
        :raises SwitchboardError: it has not done it
        """
        for each in await self._meant(robot):
            await self._desks.of(each).stopping.resume(_local(by), why, sent)

    async def _meant(self, robot: str | None) -> list[RobotState]:
        records = await self._store.read(queries.list_robots)
        found = [record for record in records if robot in (None, record.full)]
        if robot is not None and not found:
            raise NotFound(f"there is no robot '{robot}'; see 'switchboard robot list'")
        return [self._registry.presence(each.id, each.name, each.realm) for each in found]

    # --- rights -------------------------------------------------------------------------------------------

    @contextmanager
    def _admitted(self, admission: AuthorizedSession) -> Iterator[AuthorizedSession]:
        try:
            yield admission
        finally:
            self._desk.turn_away(admission)

    def _of(self, admission: AuthorizedSession) -> RobotController:
        return self._desks.of(admission.robot)

    @staticmethod
    def _judged(admission: AuthorizedSession, operation: Operation, resource: str) -> str:
        topic = resolve(resource)
        verdict = admission.permit.judge(operation, topic)
        if not verdict.allowed:
            raise Refused(verdict.reason)
        return topic


def _accepted(answer: ControlReply) -> ControlReply:
    """An answer with success.

    :raises NotDone: it has none
    """
    if not answer.success:
        raise NotDone(answer.message)
    return answer


def _shown(desk: RobotController, permit: Permit) -> dict[str, Any]:
    """Who moves a robot, for all connections of who has this permit."""
    user, holder = permit.principal.user_id, desk.lease.holder
    asker = view.ControlReader(permit.rules, lambda client: client.user == user)
    mine = holder is not None and asker.mine(holder.client)
    return view.control(desk, asker, holder.client.number if holder is not None and mine else None)


def _own_holder(desk: RobotController, admission: AuthorizedSession) -> LeaseClient | None:
    """The connection of the principal that has control, if one has, and its token is for that."""
    holder = desk.lease.holder
    mine = holder is not None and acts_for(admission.permit, holder.client)
    return holder.client if holder is not None and mine else None


def _needed_holder(desk: RobotController, admission: AuthorizedSession) -> LeaseClient:
    """The same where there must be one.

    :raises NoControl: there is none
    """
    holder = _own_holder(desk, admission)
    if holder is None:
        raise NoControl(NO_CONTROL)
    return holder


def _actor(principal: Principal, robot: RobotState, address: str) -> Actor:
    name = robot.name_of(principal.name, principal.realm)
    return Actor(name, f"user:{name}", principal.user_id, address)


def _local(by: str) -> Actor:
    return Actor(by, f"cli:{by}", address="local")
