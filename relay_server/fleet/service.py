"""Orders to many robots: rights, selection of robots, and how the orders are carried out."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_db import queries
from relay_db.names import normalise
from relay_db.queries import RobotRecord
from relay_protocol.clocks import now_ns
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.realms import DEFAULT_REALM, full_name
from relay_protocol.rights import Grant, Level, Rules
from relay_server.access import LOOKUP_SECONDS, NOT_LOOKED_UP, Access, Permit, Principal
from relay_server.audit_log import AuditLog, AuditLogEntry
from relay_server.cluster.fleet_orders import OrderForwarding
from relay_server.common.clock import Clock, as_twisted
from relay_server.common.concurrency import bounded_gather, with_timeout
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import Buckets
from relay_server.control.actor import Actor, user_actor
from relay_server.control.service import ControlService
from relay_server.control.stopping import StopIds
from relay_server.events.bus import EventBus
from relay_server.fleet.order import (
    GROUP,
    FleetOrderStart,
    Order,
    OrderAge,
    RobotGroupInfo,
    TaskOutcome,
    TaskResult,
    select_robots,
)
from relay_server.fleet.task import FleetStop, FleetTask
from relay_server.in_process_sessions.in_process_port import InProcessPort
from relay_server.modules.service import ModuleService, action_of, user_of
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.sessions.manager import (
    Admission,
    SessionManager,
    ShuttingDown,
)

MAX_ROBOTS = 1000
"""Robots of one order, except for a stop, which may be for all robots."""

MAX_ORDERS = 4
"""Orders of one user at a time."""

STOPS_PER_SECOND = 3 / 60
STOPS_BURST = 10
"""Stops of one user that enter the audit log: per second in the long run, and at once. The robots' own
entries are written in any case."""

STOP_USERS = 256
"""Users remembered for that limit; those that were quiet longest are forgotten first."""

STOP_OR_RESUME_SECONDS = 19.0
"""Time for a stop and a resume, whatever the order says: longer than the control service takes for them, even if the
database is asked first."""

ELSEWHERE_SECONDS = 5.0
"""Seconds in which another relay must answer an order to stop. After that the order is stored in the database too."""

LOCAL = Principal(0, "admin (local)", DEFAULT_REALM, True, 0, None)
"""Stands for any client of the relay's local socket. No user can have this name, since it contains a space."""


def local_principal(realm: str) -> Principal:
    """The local administrator, for the robots of one realm."""
    return replace(LOCAL, realm=normalise(realm))


def _is_local(principal: Principal) -> bool:
    return principal.user_id == LOCAL.user_id


LOCAL_RULES = Rules([Grant(Level.OWNER, source=LOCAL.name)])
"""The local administrator's rights on every robot."""


@dataclass(frozen=True)
class FleetPlan:
    """An order and its robots.

    :param missed: why the order may be for more robots, which could not be looked up
    :param stopping: results of the robots that are being stopped already
    :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`; ``None``: unknown
    :param forwarded: whether another relay has sent it, as its robot is here
    """

    order: Order
    principal: Principal
    address: str
    robots: dict[str, RobotRecord]
    unmatched: list[str]
    missed: str = ""
    stopping: Mapping[str, Deferred[TaskResult]] = field(default_factory=dict)
    earliest_sent: int | None = None
    forwarded: bool = False

    @property
    def age(self) -> OrderAge:
        return OrderAge(self.order, self.earliest_sent)

    @property
    def sender(self) -> Actor:
        """The user, by the name in their own realm."""
        if _is_local(self.principal):
            return Actor(LOCAL.name, "cli", address=self.address)
        return user_actor(self.principal.name, self.principal.user_id, self.address)

    def actor(self, robot: RobotState) -> Actor:
        """The user, as a robot's audit entries name them."""
        if _is_local(self.principal):
            return self.sender
        name = robot.name_of(self.principal.name, self.principal.realm)
        return user_actor(name, self.principal.user_id, self.address)

    @property
    def start(self) -> FleetOrderStart:
        """The first line of the HTTP response."""
        return FleetOrderStart(self.order.do, list(self.robots), self.unmatched, self.missed)


class FleetService:
    """Plans orders and carries them out.

    :param forwarding: sends orders to robots that are at other relays
    :param clock_ns: monotonic nanoseconds
    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        sessions: SessionManager,
        access: Access,
        registry: RobotRegistry,
        control: ControlService,
        store: AsyncDatabase,
        bus: EventBus,
        audit: AuditLog,
        modules: ModuleService,
        *,
        forwarding: OrderForwarding,
        clock_ns: Callable[[], int] = now_ns,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._clock = clock
        self._sessions = sessions
        self._access = access
        self._registry = registry
        self._control = control
        self._fleet_stop = FleetStop(control, registry)
        self._modules = modules
        self._forwarding = forwarding
        self._store = store
        self._bus = bus
        self._audit = audit
        self._clock_ns = clock_ns
        self._wall = wall
        self._orders: Counter[int] = Counter()
        self._ids = StopIds()
        self._stops = Buckets(STOPS_PER_SECOND, STOPS_BURST, STOP_USERS, clock.seconds)

    async def groups(self, principal: Principal) -> list[RobotGroupInfo]:
        """Groups of robots, with those robots that the user has a right on; groups without any are left out."""
        mine = {each.name for each in await self._robots_of(principal)}
        groups = await self._store.read(queries.list_robot_groups, principal.realm)
        seen = (
            RobotGroupInfo(name=each.name, robots=[name for name in each.robots if name in mine])
            for each in groups
        )
        return [each for each in seen if each["robots"]]

    async def plan(
        self,
        principal: Principal,
        order: Order,
        address: str,
        earliest_sent: int | None = None,
        *,
        forwarded: bool = False,
    ) -> FleetPlan:
        """Find the robots of an order.

        A stop is sent at once to robots that are online and known to be the user's, before the database is
        asked for the others. If the database does not answer, the stop is for these alone.

        :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`; ``None``: unknown
        :raises Invalid: the order makes no sense, or is for too many robots
        :raises NotFound: it matches no robot that the user has a right on
        :raises FreshnessTokenRequired: it moves a robot, or lets one move again, and its age is unknown
        :raises FreshnessTokenExpired: it moves a robot, and may be too old
        :raises Unavailable: the database does not answer
        """
        order.check()
        stopped = self._stop_online(principal, order, address) if order.do == "stop" else {}
        mine = {name: robot for name, (robot, _) in stopped.items()}
        groups: dict[str, Collection[str]] = {}
        missed = ""
        try:
            looked_up = with_timeout(
                self._clock, LOOKUP_SECONDS, self._look_up(principal, order), NOT_LOOKED_UP
            )
            others, groups = await looked_up
            mine |= {each.name: each for each in others}
        except Unavailable as error:
            if not stopped:
                raise
            missed = str(error)
            self.log.error("an order to stop reaches only robots that are online: {reason}", reason=missed)
        found = select_robots(order.robots, mine, groups)
        if not found.robots:
            raise NotFound("the order matches no robot that you have a right on")
        if order.do != "stop" and len(found.robots) > MAX_ROBOTS:
            raise Invalid(f"the order is for {len(found.robots)} robots; it may be for {MAX_ROBOTS} at most")
        robots = {name: mine[name] for name in found.robots}
        known = (self._registry.find(each.id) for each in robots.values())
        OrderAge(order, earliest_sent).check(
            [robot for robot in known if robot is not None], self._clock_ns()
        )
        stopping = {name: stopping for name, (_, stopping) in stopped.items()}
        return FleetPlan(
            order,
            principal,
            address,
            robots,
            found.unmatched,
            missed,
            stopping,
            earliest_sent,
            forwarded,
        )

    def _stop_online(
        self, principal: Principal, order: Order, address: str
    ) -> dict[str, tuple[RobotRecord, Deferred[TaskResult]]]:
        """Stop the robots that match by name or pattern, are online, also at another relay, and are known to be the
        user's.
        """
        here = {
            each.name: RobotRecord(each.robot_id, each.name, each.realm, "")
            for each in self._registry
            if (each.control_link is not None or each.elsewhere) and self._may_stop_at_once(principal, each)
        }
        robots = {name: here[name] for name in select_robots(order.robots, here, {}).robots}
        plan = FleetPlan(order, principal, address, robots, [])
        return {
            name: (robot, Deferred.fromCoroutine(self._run_one(plan, robot)))
            for name, robot in robots.items()
        }

    def _may_stop_at_once(self, principal: Principal, robot: RobotState) -> bool:
        if _is_local(principal):
            return principal.realm in robot.realms
        return self._access.may_stop_at_once(principal, robot)

    async def _look_up(
        self, principal: Principal, order: Order
    ) -> tuple[list[RobotRecord], dict[str, Collection[str]]]:
        robots = await self._robots_of(principal)
        if not any(each.startswith(GROUP) for each in order.robots):
            return robots, {}
        groups = await self._store.read(queries.list_robot_groups, principal.realm)
        return robots, {each.name: each.robots for each in groups}

    async def carry_out(
        self,
        plan: FleetPlan,
        on_begin: Callable[[], None],
        on_result: Callable[[TaskResult], Awaitable[None]],
    ) -> None:
        """Carry out an order on all robots, some at a time. Cancelling the caller ends it.

        :param on_begin: called when it begins
        :param on_result: gets each result; the next robot's turn comes when it is done with it
        :raises Unavailable: the user has too many orders in progress, or the audit entry cannot be written
        """
        counted: Counter[bool] = Counter()

        async def one(name: str) -> None:
            stopping = plan.stopping.get(name)
            result = await (self._run_one(plan, plan.robots[name]) if stopping is None else stopping)
            counted[result.outcome.ok] += 1
            await on_result(result)

        async def begun(doing: Awaitable[None]) -> None:
            try:
                await doing
            finally:
                self._publish_end(plan, counted)

        if plan.order.do == "stop":
            on_begin()
            if self._ids.is_duplicate(plan.sender, plan.order.stop_id):
                # The other path of the same press reports it.
                await self._stop(plan, one, audited=True)
            else:
                await begun(self._stop(plan, one, audited=False))
            return
        # The relay that has forwarded an order counts it.
        with nullcontext() if plan.forwarded else self._order_slot(plan.principal):
            await self._write_audit(plan)
            on_begin()
            await begun(bounded_gather(plan.robots, one))

    async def _stop(self, plan: FleetPlan, one: Callable[[str], Awaitable[None]], *, audited: bool) -> None:
        """Robots that are online are stopped at once, and only then is the audit entry written."""
        online = [
            name
            for name, each in plan.robots.items()
            if name in plan.stopping or self._fleet_stop.online(each)
        ]
        # The plan has just looked up the rights on these. The others are judged when their turn comes.
        stopping = Deferred.fromCoroutine(bounded_gather(online, one, at_once=len(online)))
        try:
            if not audited and self._stops.take(plan.principal.user_id):
                self._audit.append(self._audit_entry(plan))
        finally:
            # The stops are finished even if the client has hung up.
            await stopping
        await bounded_gather([name for name in plan.robots if name not in set(online)], one)

    async def _run_one(self, plan: FleetPlan, robot: RobotRecord) -> TaskResult:
        began = self._clock.seconds()
        running = Deferred.fromCoroutine(self._dispatch(plan, robot))
        order = plan.order
        seconds = STOP_OR_RESUME_SECONDS if order.do in ("stop", "resume") else order.timeout
        running.addTimeout(seconds, as_twisted(self._clock), _timeout_error(order.do))
        try:
            outcome = await running
        except SwitchboardError as error:
            outcome = TaskOutcome(False, str(error))
        except CancelledError:
            running.cancel()
            raise
        except Exception:
            self.log.failure("an order failed on {robot}", robot=robot.full)
            outcome = TaskOutcome(False, "the relay failed on this order; see its log")
        return TaskResult(robot.name, outcome, self._clock.seconds() - began)

    async def _dispatch(self, plan: FleetPlan, robot: RobotRecord) -> TaskOutcome:
        order = plan.order
        if order.do == "stop" and self._fleet_stop.online(robot):
            return await self._fleet_stop.stop(
                robot, plan.actor(self._state_of(robot)), order.why, order.stop_id
            )
        if not plan.forwarded:
            outcome = await self._at_home(plan, robot)
            if outcome is not None:
                return outcome
        if order.do in ("stop", "resume"):
            return await self._stop_or_resume(plan, robot)
        return await self._run_task(plan, robot)

    async def _at_home(self, plan: FleetPlan, robot: RobotRecord) -> TaskOutcome | None:
        """The outcome at the relay that the robot is connected to.

        :returns: ``None``: it is connected to no other relay, or that does not answer an order to stop
        """
        sending = self._forwarding.send(plan.principal, plan.address, plan.order, robot, plan.earliest_sent)
        if plan.order.do != "stop":
            return await sending
        try:
            late = "the relay that the robot is connected to does not answer"
            return await with_timeout(self._clock, ELSEWHERE_SECONDS, sending, late)
        except Unavailable as error:
            self.log.warn("a stop of {robot} is stored: {reason}", robot=robot.full, reason=str(error))
            return None

    async def _stop_or_resume(self, plan: FleetPlan, record: RobotRecord) -> TaskOutcome:
        """Stop a robot or let it move again, by the user's rights when its turn comes."""
        order, stopping, actor = plan.order, self._fleet_stop, plan.actor(self._state_of(record))
        try:
            admission = await self._admit(plan, record)
        except Unavailable:
            if order.do != "stop":
                raise
            # The rights cannot be looked up now; the plan has found that the user may.
            return await stopping.stop(record, actor, order.why, order.stop_id)
        try:
            if order.do == "stop":
                return await stopping.stop(record, actor, order.why, order.stop_id)
            return await stopping.resume(record, admission.permit, actor, order.why, plan.age.earliest_sent)
        finally:
            self._sessions.release(admission)

    async def _run_task(self, plan: FleetPlan, record: RobotRecord) -> TaskOutcome:
        admission = await self._admit(plan, record)
        if not self._sessions.accepting:
            self._sessions.release(admission)
            raise ShuttingDown("the relay is going down")
        if plan.order.do == "module":
            try:
                return await self._order_module(plan, admission)
            finally:
                self._sessions.release(admission)
        # Commands are as old as the order, however late the robot's turn comes.
        port = InProcessPort(undated=plan.age.earliest_sent)
        session = self._sessions.open_in_process(admission, port)

        def check_age() -> None:
            plan.age.check_turn(admission.robot, self._clock_ns())

        try:
            port.begin(session)
            return await FleetTask(self._clock, self._control, port, plan.order, check_age).run()
        finally:
            session.end(orderly=True)

    async def _order_module(self, plan: FleetPlan, admission: Admission) -> TaskOutcome:
        order, robot = plan.order, admission.robot
        actor = plan.actor(robot)
        user = user_of(robot, admission.permit, plan.address)._replace(actor=actor.source, user_id=actor.user)
        done = await self._modules.order(user, order.module, action_of(order.action), limited=False)
        if done.pending:
            return TaskOutcome(
                True, f"{done.why}; the {order.action} is pending until it answers or is back", pending=True
            )
        return TaskOutcome(True)

    async def _admit(self, plan: FleetPlan, record: RobotRecord) -> Admission:
        if not _is_local(plan.principal):
            return await self._sessions.admit(plan.principal, record.name, plan.address)
        return Admission(Permit(LOCAL, record.id, LOCAL_RULES), self._state_of(record), plan.address)

    def _state_of(self, record: RobotRecord) -> RobotState:
        return self._registry.robot(record.id, record.name, record.realm)

    async def _robots_of(self, principal: Principal) -> list[RobotRecord]:
        if _is_local(principal):
            return await self._store.read(queries.list_robots, principal.realm)
        return [record for record, _ in await self._access.robots(principal)]

    @contextmanager
    def _order_slot(self, principal: Principal) -> Iterator[None]:
        if self._orders[principal.user_id] >= MAX_ORDERS:
            raise Unavailable(f"you have {MAX_ORDERS} orders in progress; wait until one is done")
        self._orders[principal.user_id] += 1
        try:
            yield
        finally:
            self._orders[principal.user_id] -= 1
            self._orders += Counter()

    async def _write_audit(self, plan: FleetPlan) -> None:
        """Write the audit entry before the order is carried out.

        :raises Unavailable: it cannot be written
        """
        entry = self._audit_entry(plan)
        await self._store.write(
            queries.append_audit,
            at=entry.at,
            actor=entry.actor,
            action=entry.action,
            target=entry.target,
            origin=entry.origin,
            data=entry.data,
        )

    def _audit_entry(self, plan: FleetPlan) -> AuditLogEntry:
        """The audit entry of an order. Arguments of services are left out, since they may be secret."""
        order = plan.order
        return AuditLogEntry(
            self._wall(),
            plan.principal.name if _is_local(plan.principal) else f"user:{plan.principal.full}",
            f"fleet.{order.do}",
            ", ".join(full_name(each, plan.principal.realm) for each in order.robots),
            plan.address,
            {"robots": len(plan.robots), "what": order.subject, "why": order.why},
            tuple(each.id for each in plan.robots.values()),
        )

    def _publish_end(self, plan: FleetPlan, counted: Counter[bool]) -> None:
        principal = plan.principal
        self._bus.publish(
            "fleet.done",
            source=f"user:{principal.name}",
            # The command line knows all realms, so no realm's administrators are notified of its orders.
            realm=None if _is_local(principal) else principal.realm,
            what=f"{plan.order.do} {plan.order.subject}".strip(),
            robots=len(plan.robots),
            ok=counted[True],
            failed=counted[False],
        )


def _timeout_error(do: str) -> Callable[[Any, float], Any]:
    """Makes the error of an order of this kind that took too long."""

    def to_error(result: Any, seconds: float) -> Any:
        if not isinstance(result, Failure):
            return result
        result.trap(CancelledError)
        if do == "publish":
            raise Unavailable(f"not done within {seconds:g} s")
        # The robot may have received it, and nothing takes it back.
        raise Unavailable(f"no answer within {seconds:g} s; it may still happen")

    return to_error
