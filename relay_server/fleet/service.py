"""What edges ask about orders to many robots: who may give them to which robots, and how they are carried out."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
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
from relay_server.access import Access, Permit, Principal
from relay_server.audit_log import AuditLog, AuditLogEntry
from relay_server.common.clock import Clock, as_twisted, with_timeout
from relay_server.common.database import AsyncDatabase
from relay_server.common.gather import bounded_gather
from relay_server.common.token_bucket import Buckets
from relay_server.control.audit import Actor
from relay_server.control.controllers import Controllers
from relay_server.events.bus import EventBus
from relay_server.fleet.order import Order, OrderAge
from relay_server.fleet.result import TaskOutcome, TaskResult
from relay_server.fleet.selection import GROUP, select_robots
from relay_server.fleet.stop import FleetStop
from relay_server.fleet.task import FleetTask
from relay_server.http_sessions.loopback_client import LoopbackClient
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.sessions.manager import (
    LOOKUP_SECONDS,
    NOT_LOOKED_UP,
    AuthorizedSession,
    SessionManager,
    ShuttingDown,
)

ROBOTS = 1000
"""Robots of one order, but for a stop, which may mean all there are."""

ORDERS = 4
"""Orders of one user at a time."""

STOPS_A_SECOND = 3 / 60
STOPS_AT_ONCE = 10
"""Orders to stop of one user that are in the audit log. What they stop is there by itself, robot by robot."""

STOP_USERS = 256
"""Users remembered for that; the longest quiet are forgotten first."""

STOP_SECONDS = 18.0
"""What a stop and a resume have, whatever the order says: they are given up by who carries them out before that, though
the database be asked first."""

LOCAL = Principal(0, "admin (local)", DEFAULT_REALM, True, 0, None)
"""Whoever may open the relay's local socket. No user can have this name: it has a space in it."""


def local_of(realm: str) -> Principal:
    """The same, for the robots of a realm."""
    return replace(LOCAL, realm=normalise(realm))


def _is_local(asker: Principal) -> bool:
    return asker.user_id == LOCAL.user_id


OWNS = Rules([Grant(Level.OWNER, source=LOCAL.name)])
"""What he may do on every robot."""


@dataclass(frozen=True)
class FleetPlan:
    """An order, and which robots it means.

    :param missed: why it may mean others, which nobody could look up
    :param stopping: those that are being stopped already, and what comes of it
    :param sent: a moment before which it can't have been given, the relay's monotonic nanoseconds, where one is known
    """

    order: Order
    asker: Principal
    address: str
    robots: dict[str, RobotRecord]
    unmatched: list[str]
    missed: str = ""
    stopping: Mapping[str, Deferred[TaskResult]] = field(default_factory=dict)
    sent: int | None = None

    @property
    def dating(self) -> OrderAge:
        """How old it is."""
        return OrderAge(self.order, self.sent)

    def actor(self, robot: RobotState) -> Actor:
        """Who gives it, as the record of control of a robot knows him."""
        if _is_local(self.asker):
            return Actor(LOCAL.name, "cli", address=self.address)
        name = robot.name_of(self.asker.name, self.asker.realm)
        return Actor(name, f"user:{name}", self.asker.user_id, self.address)

    def told(self) -> dict[str, Any]:
        """The first line of the answer."""
        head = {"do": self.order.do, "robots": list(self.robots), "unmatched": self.unmatched}
        return {**head, "missed": self.missed} if self.missed else head


class FleetService:
    """Has orders carried out.

    :param clock_ns: monotonic nanoseconds
    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        front: SessionManager,
        access: Access,
        registry: RobotRegistry,
        desks: Controllers,
        store: AsyncDatabase,
        journal: EventBus,
        audit: AuditLog,
        *,
        clock_ns: Callable[[], int] = now_ns,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._clock = clock
        self._front = front
        self._access = access
        self._registry = registry
        self._halting = FleetStop(desks, registry)
        self._store = store
        self._journal = journal
        self._audit = audit
        self._clock_ns = clock_ns
        self._wall = wall
        self._orders: Counter[int] = Counter()
        self._stops = Buckets(STOPS_A_SECOND, STOPS_AT_ONCE, STOP_USERS, clock.seconds)

    async def groups(self, asker: Principal) -> list[dict[str, Any]]:
        """Groups of robots, with those the asker has a right on; the others are not told of."""
        mine = {each.name for each in await self._mine(asker)}
        groups = await self._store.read(queries.list_robot_groups, asker.realm)
        told = (
            {"name": each.name, "robots": [name for name in each.robots if name in mine]} for each in groups
        )
        return [each for each in told if each["robots"]]

    async def plan(self, asker: Principal, order: Order, address: str, sent: int | None = None) -> FleetPlan:
        """Find out which robots an order means.

        A stop is on its way to those that are here, and known to be the asker's, before the database is asked for the
        others; where that does not answer these are all that are meant.

        :param sent: a moment before which it can't have been given, the relay's monotonic nanoseconds
        :raises Invalid: the order makes no sense, or means too many
        :raises NotFound: it means no robot the asker has a right on
        :raises MomentNeeded: it moves one of them, or lets it move again, and no moment is named
        :raises TooOld: it moves one of them, and may be too old
        :raises Unavailable: the database does not answer
        """
        order.check()
        told = self._at_once(asker, order, address) if order.do == "stop" else {}
        mine = {name: robot for name, (robot, _) in told.items()}
        groups: dict[str, Collection[str]] = {}
        missed = ""
        try:
            looked_up = with_timeout(
                self._clock, LOOKUP_SECONDS, self._looked_up(asker, order), NOT_LOOKED_UP
            )
            others, groups = await looked_up
            mine |= {each.name: each for each in others}
        except Unavailable as error:
            if not told:
                raise
            missed = str(error)
            self.log.error("an order to stop goes to those that are here alone: {reason}", reason=missed)
        found = select_robots(order.robots, mine, groups)
        if not found.robots:
            raise NotFound("the order means no robot that you have a right on")
        if order.do != "stop" and len(found.robots) > ROBOTS:
            raise Invalid(f"the order means {len(found.robots)} robots; it may mean {ROBOTS} at most")
        robots = {name: mine[name] for name in found.robots}
        known = (self._registry.find(each.id) for each in robots.values())
        OrderAge(order, sent).check([robot for robot in known if robot is not None], self._clock_ns())
        stopping = {name: stopping for name, (_, stopping) in told.items()}
        return FleetPlan(order, asker, address, robots, found.unmatched, missed, stopping, sent)

    def _at_once(
        self, asker: Principal, order: Order, address: str
    ) -> dict[str, tuple[RobotRecord, Deferred[TaskResult]]]:
        """Stop what an order means by names and patterns, is here, and is known to be the asker's."""
        here = {
            each.name: RobotRecord(each.robot_id, each.name, each.realm, "")
            for each in self._registry
            if each.control is not None
            and asker.realm in each.realms
            and (_is_local(asker) or self._access.knows(asker, each.robot_id))
        }
        robots = {name: here[name] for name in select_robots(order.robots, here, {}).robots}
        plan = FleetPlan(order, asker, address, robots, [])
        return {
            name: (robot, Deferred.fromCoroutine(self._one(plan, robot))) for name, robot in robots.items()
        }

    async def _looked_up(
        self, asker: Principal, order: Order
    ) -> tuple[list[RobotRecord], dict[str, Collection[str]]]:
        robots = await self._mine(asker)
        if not any(each.startswith(GROUP) for each in order.robots):
            return robots, {}
        groups = await self._store.read(queries.list_robot_groups, asker.realm)
        return robots, {each.name: each.robots for each in groups}

    async def carry_out(
        self, plan: FleetPlan, begin: Callable[[], None], tell: Callable[[TaskResult], Awaitable[None]]
    ) -> None:
        """Do it on all robots, some at a time. Who waits for this and gives up ends it.

        :param begin: called when it begins
        :param tell: is given each result; the next robot has its turn when it has taken that
        :raises Unavailable: the asker has too many orders under way, or it can't be put on record
        """
        counted: Counter[bool] = Counter()

        async def one(name: str) -> None:
            told = plan.stopping.get(name)
            result = await (self._one(plan, plan.robots[name]) if told is None else told)
            counted[result.outcome.ok] += 1
            await tell(result)

        async def begun(doing: Awaitable[None]) -> None:
            try:
                await doing
            finally:
                self._tell_of_end(plan, counted)

        if plan.order.do == "stop":
            begin()
            await begun(self._stop(plan, one))
            return
        with self._place(plan.asker):
            await self._record(plan)
            begin()
            await begun(bounded_gather(plan.robots, one))

    async def _stop(self, plan: FleetPlan, one: Callable[[str], Awaitable[None]]) -> None:
        """Nothing is as urgent: whoever can be told is told at once, and only then it is put on record."""
        told = [
            name for name, each in plan.robots.items() if name in plan.stopping or self._halting.online(each)
        ]
        # These by the rights of this moment, which the plan has just looked up; the others are judged in their turn.
        stopping = Deferred.fromCoroutine(bounded_gather(told, one, at_once=len(told)))
        try:
            if self._stops.take(plan.asker.user_id):
                self._audit.append(self._entry(plan))
        finally:
            # Who has hung up by now has had them told all the same.
            await stopping
        await bounded_gather([name for name in plan.robots if name not in set(told)], one)

    async def _one(self, plan: FleetPlan, robot: RobotRecord) -> TaskResult:
        began = self._clock.seconds()
        running = Deferred.fromCoroutine(self._done(plan, robot))
        order = plan.order
        seconds = STOP_SECONDS if order.do in ("stop", "resume") else order.timeout
        running.addTimeout(seconds, as_twisted(self._clock), _too_late(order.do))
        try:
            outcome = await running
        except SwitchboardError as error:
            outcome = TaskOutcome(False, str(error))
        except CancelledError:
            running.cancel()
            raise
        except Exception:
            self.log.failure("an order failed on {robot}", robot=robot.full)
            outcome = TaskOutcome(False, "the relay failed on this order; its log tells more")
        return TaskResult(robot.name, outcome, self._clock.seconds() - began)

    async def _done(self, plan: FleetPlan, robot: RobotRecord) -> TaskOutcome:
        order = plan.order
        if order.do == "stop" and self._halting.online(robot):
            return await self._halting.stop(robot, plan.actor(self._there(robot)), order.why)
        if order.do in ("stop", "resume"):
            return await self._halted(plan, robot)
        return await self._errand(plan, robot)

    async def _halted(self, plan: FleetPlan, record: RobotRecord) -> TaskOutcome:
        """Stop a robot or let it move again, by the asker's rights as they stand when its turn comes."""
        order, halting, actor = plan.order, self._halting, plan.actor(self._there(record))
        try:
            admission = await self._admit(plan, record)
        except Unavailable:
            if order.do != "stop":
                raise
            # Nobody can say that he may not, and the plan says that he may.
            return await halting.stop(record, actor, order.why)
        try:
            if order.do == "stop":
                return await halting.stop(record, actor, order.why)
            return await halting.resume(record, admission.permit, actor, order.why, plan.dating.since)
        finally:
            self._front.turn_away(admission)

    async def _errand(self, plan: FleetPlan, record: RobotRecord) -> TaskOutcome:
        admission = await self._admit(plan, record)
        if not self._front.accepting:
            self._front.turn_away(admission)
            raise ShuttingDown("the relay is going down")
        # However late its turn comes, it is as old as it is.
        client = LoopbackClient(undated=plan.dating.since)
        session = self._front.open(admission, client, self._clock_ns())

        def young() -> None:
            plan.dating.check_turn(session.robot, self._clock_ns())

        try:
            client.begin(session)
            return await FleetTask(self._clock, session, client, plan.order, young).run()
        finally:
            session.end(orderly=True)

    async def _admit(self, plan: FleetPlan, record: RobotRecord) -> AuthorizedSession:
        if not _is_local(plan.asker):
            return await self._front.admit(plan.asker, record.name, plan.address)
        return AuthorizedSession(Permit(LOCAL, record.id, OWNS), self._there(record), plan.address)

    def _there(self, record: RobotRecord) -> RobotState:
        return self._registry.presence(record.id, record.name, record.realm)

    async def _mine(self, asker: Principal) -> list[RobotRecord]:
        if _is_local(asker):
            return await self._store.read(queries.list_robots, asker.realm)
        return [record for record, _ in await self._access.robots(asker)]

    @contextmanager
    def _place(self, asker: Principal) -> Iterator[None]:
        if self._orders[asker.user_id] >= ORDERS:
            raise Unavailable(f"{ORDERS} orders of yours are under way already; wait until one is done")
        self._orders[asker.user_id] += 1
        try:
            yield
        finally:
            self._orders[asker.user_id] -= 1
            self._orders += Counter()

    async def _record(self, plan: FleetPlan) -> None:
        """Put on record what is ordered, before it is done.

        :raises Unavailable: it can't be
        """
        entry = self._entry(plan)
        await self._store.write(
            queries.append_audit,
            at=entry.at,
            actor=entry.actor,
            action=entry.action,
            target=entry.target,
            origin=entry.origin,
            data=entry.data,
        )

    def _entry(self, plan: FleetPlan) -> AuditLogEntry:
        """What the audit log says of an order; never what services are given, which may be secret."""
        order = plan.order
        return AuditLogEntry(
            self._wall(),
            plan.asker.name if _is_local(plan.asker) else f"user:{plan.asker.full}",
            f"fleet.{order.do}",
            ", ".join(full_name(each, plan.asker.realm) for each in order.robots),
            plan.address,
            {"robots": len(plan.robots), "what": order.subject, "why": order.why},
            tuple(each.id for each in plan.robots.values()),
        )

    def _tell_of_end(self, plan: FleetPlan, counted: Counter[bool]) -> None:
        asker = plan.asker
        self._journal.event(
            "fleet.done",
            f"user:{asker.name}",
            cause=f"fleet:{asker.full}",
            user_id=asker.user_id,
            what=f"{plan.order.do} {plan.order.subject}".strip(),
            robots=len(plan.robots),
            ok=counted[True],
            failed=counted[False],
        )


def _too_late(do: str) -> Callable[[Any, float], Any]:
    """What is told of an order of this kind that has taken too long."""

    def told(result: Any, seconds: float) -> Any:
        if not isinstance(result, Failure):
            return result
        result.trap(CancelledError)
        if do == "publish":
            raise Unavailable(f"it was not done within {seconds:g} s")
        # The robot may have it: nothing takes it back.
        raise Unavailable(f"no answer within {seconds:g} s; it may still happen")

    return told
