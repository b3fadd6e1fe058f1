"""Modules and processes of robots for users: rights, orders, logs, measurements."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple, cast

import msgspec
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import ModuleOrderRecord
from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.rights import Decision, Operation, Rules
from relay_server.access import Permit
from relay_server.cluster.homes import RobotHomes
from relay_server.cluster.relays import RelayInfo
from relay_server.common.concurrency import detached
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import TokenBucket
from relay_server.events.bus import EventBus
from relay_server.modules.cpu_shares import CpuShares
from relay_server.modules.report_store import ModuleReportStore
from relay_server.modules.robot_modules import (
    Answer,
    ModuleRegistry,
    RequestUnanswered,
    RobotModules,
)
from relay_server.modules.schemas import (
    LogQuery,
    ModuleList,
    ModuleLogPage,
    ModuleOrderResult,
    ModuleStatus,
    PendingModuleOrder,
    ProcessList,
    RefusedModuleOrder,
)
from relay_server.robots.registry import RobotRegistry, RobotState

PROCESSES = "processes"
"""Resource of rights: the processes of a robot. A module is a resource by its name."""

NOTED_STATES = frozenset({"running", "stopped", "backing_off", "failed"})
"""States whose beginning is an event."""

REFUSAL_SECONDS = 24 * 3600.0
"""The refusal of a pending order is shown for so long, or until the next order to the module."""

MAX_WAITING = 32
"""Most orders to one robot that wait until those before them are stored and sent.

The lock is passed on by nested calls: hundreds that end at once would exceed the stack.
"""

ORDERS_PER_SECOND = 5.0
ORDERS_BURST = 20
"""Orders of one user; each is written into the audit log."""


class ModuleUser(NamedTuple):
    """A user at one robot, or the command line on the relay's machine.

    :param name: as shown at this robot
    :param actor: as in the audit log
    :param address: network address, or ``local``
    :param user_id: ``None`` for the command line
    :param decide: of the right to manage a resource
    """

    robot: RobotState
    name: str
    actor: str
    address: str
    user_id: int | None
    decide: Callable[[str], Decision]

    def require(self, resource: str) -> None:
        """:raises Refused: the user may not manage this resource"""
        decision = self.decide(resource)
        if not decision.allowed:
            raise Refused(decision.reason)


class _Reported(NamedTuple):
    """What a robot has reported of a module.

    :param state: in the latest report
    :param restarts: at the latest event, or in the first report
    """

    state: str
    restarts: int


class ModuleService:
    """
    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(
        self,
        registry: ModuleRegistry,
        robots: RobotRegistry,
        database: AsyncDatabase,
        bus: EventBus,
        wall: Callable[[], float],
        reports: ModuleReportStore,
        homes: RobotHomes,
    ) -> None:
        self._registry = registry
        self._homes = homes
        self.reports = reports
        self._robots = robots
        self._database = database
        self._bus = bus
        self._wall = wall
        self._buckets: dict[int | None, TokenBucket] = {}
        self._reports: dict[int, dict[str, _Reported]] = {}
        """What was reported last of each module, by robot."""
        self._latest_orders: dict[int, list[ModuleOrderRecord]] = {}
        """Pending orders by robot, for clients that ask again and again."""
        self._reading_orders: dict[int, object] = {}
        """The read under way of each robot's orders; none once they have changed, as its result is outdated."""
        self._under_way: set[ModuleOrderRecord] = set()
        """Stored orders that were sent as they were given; they become pending if no answer comes in time."""
        registry.on_report = self._reported

    # --- users --------------------------------------------------------------------------------------------

    async def local_user(self, robot: str, by: str) -> ModuleUser:
        """The command line on the relay's machine, which may do everything.

        :param robot: full name
        :param by: user of the operating system
        :raises NotFound: no such robot
        :raises Unavailable: the database does not answer
        """
        for record in await self._database.read(queries.list_robots):
            if record.full == robot:
                state = self._robots.robot(record.id, record.name, record.realm)
                return ModuleUser(state, by, f"cli:{by}", "local", None, lambda _: Decision(True, ""))
        raise NotFound(f"there is no robot '{robot}'; see 'switchboard robot list'")

    # --- requests -----------------------------------------------------------------------------------------

    async def modules(self, user: ModuleUser) -> ModuleList:
        """The modules that the user may manage.

        :raises Unavailable: the database does not answer
        """
        return self._list(user, await self._stored(user.robot))

    async def module(self, user: ModuleUser, name: str) -> ModuleStatus:
        """One module.

        :raises NotFound: there is none of this name
        :raises Refused: no right to manage it
        :raises Unavailable: the database does not answer
        """
        user.require(name)
        for each in (await self.modules(user)).modules:
            if each.name == name:
                return each
        raise self._unknown(user, name)

    async def _stored(self, robot: RobotState) -> list[ModuleOrderRecord]:
        """The stored orders of a robot. The stored report of one that is offline is read, too."""
        if robot.control_link is None:
            await self.reports.refresh(robot.robot_id)
        return await self._database.read(queries.module_orders, robot.robot_id)

    async def order(
        self, user: ModuleUser, name: str, action: link.ModuleAction, *, limited: bool = True
    ) -> ModuleOrderResult:
        """Start, stop or restart a module.

        An order to a robot that is offline or does not answer is pending, except for a restart. The robot must have
        reported a module of this name, or never any modules.

        :param limited: whether it counts against the user's rate; an order to many robots has limits of its own
        :raises NotFound: there is none of this name
        :raises Invalid: the robot is offline, has never reported any modules, and no module can have this name
        :raises Refused: no right to manage it
        :raises NotOrdered: the robot can't carry it out, or is online and has reported no modules
        :raises Unavailable: the robot did not answer, or is offline, and the order can't wait for it, or a later one
            has replaced it; or the robot has too many orders or requests to answer, or the user gives too many; or
            the database does not answer; or the robot is connected to another relay
        """
        user.require(name)
        if limited:
            self._check_rate(user)
        if len(self._registry.of(user.robot).order_lock.waiting) >= MAX_WAITING:
            raise Unavailable(
                f"robot {user.robot.name} has {MAX_WAITING} orders waiting; try again in a moment"
            )
        # An order that is stored is also sent, and its answer ends it, when the client has left meanwhile.
        return await detached(self._order(user, name, action))

    async def _order(self, user: ModuleUser, name: str, action: link.ModuleAction) -> ModuleOrderResult:
        robot = user.robot
        modules = self._registry.of(robot)
        async with modules.order_lock:
            if robot.control_link is None:
                _check_here(robot, self._homes.elsewhere(robot.robot_id))
                await self.reports.refresh(robot.robot_id)
            self._check_known(user, name)
            if robot.control_link is None:
                _check_can_wait(robot, name, action)
                await self._database.write(self._write_order, user, name, action, True)
                return self._announced(user, name, action, f"robot {robot.name} is offline")
            modules.check_reported()
            order = await self._database.write(self._write_order, user, name, action, False)
            if order is not None:
                self._under_way.add(order)
            answer = modules.order(name, action)
        try:
            await answer
        except RequestUnanswered as error:
            # The robot may have carried it out. Done twice, a start or stop changes nothing.
            if order is None:
                raise
            # Before anything else runs: the robot may be back at once, and gets it then.
            self._under_way.discard(order)
            if not await self._database.read(queries.is_module_order_pending, order):
                raise Unavailable(f"{error}; a later order has replaced this one") from error
            result = self._announced(user, name, action, str(error))
            self._end_when_answered(modules, order, error)
            return result
        except SwitchboardError:
            await self._remove(order)
            raise
        else:
            await self._remove(order)
        finally:
            if order is not None:
                self._under_way.discard(order)
        return self._announced(user, name, action)

    async def read_log(self, user: ModuleUser, name: str, query: LogQuery) -> ModuleLogPage:
        """Lines of a module's log.

        :raises Invalid: the query has parameters that do not go together
        :raises NotFound: there is no module of this name
        :raises Refused: no right to manage it
        :raises NotOrdered: its log can't be read
        :raises Unavailable: the robot is offline, or did not answer
        """
        user.require(name)
        query.check()
        self._check_known(user, name)
        found = await self._registry.of(user.robot).read_log(name, query)
        return ModuleLogPage(lines=found.lines, previous=found.previous, next=found.next, missed=found.missed)

    async def processes(self, user: ModuleUser) -> ProcessList:
        """Measure all processes once.

        :raises Refused: no right to manage the robot's processes
        :raises Unavailable: the robot is offline, or did not answer
        """
        user.require(PROCESSES)
        return CpuShares().measured(await self._registry.of(user.robot).measure())

    def watch_processes(
        self, robot: RobotState, every: float, on_processes: Callable[[ProcessList], None]
    ) -> Callable[[], None]:
        """Measure processes again and again; see :meth:`RobotModules.watch`."""
        return self._registry.of(robot).watch(every, on_processes)

    def latest_processes(self, user: ModuleUser) -> ProcessList:
        """The latest measurement, for a client that asks about once a second; without processes at first.

        :raises Refused: no right to manage the robot's processes
        """
        user.require(PROCESSES)
        return self._registry.of(user.robot).latest_processes()

    def on_change(self, robot: RobotState, listener: Callable[[], None]) -> Callable[[], None]:
        """Call ``listener`` when the modules of a robot, or orders that wait for it, have changed.

        :returns: a function that ends this
        """
        return self._registry.of(robot).on_change(listener)

    def latest_modules(self, user: ModuleUser) -> ModuleList:
        """As :meth:`modules`, at once, for a client that asks about once a second.

        Pending orders are those that the database had when a client asked before; at first there are none.
        """
        robot = user.robot.robot_id
        orders = self._latest_orders.get(robot)
        may_differ = orders is None or orders or user.robot.control_link is None
        if may_differ and robot not in self._reading_orders:
            Deferred.fromCoroutine(self._read_orders(user.robot)).addErrback(
                lambda failure: self.log.failure("pending orders could not be read", failure)
            )
        return self._list(user, orders or ())

    async def _read_orders(self, robot: RobotState) -> None:
        reading = self._reading_orders[robot.robot_id] = object()
        try:
            found = await self._stored(robot)
            if self._reading_orders.get(robot.robot_id) is reading:
                self._latest_orders[robot.robot_id] = found
        except Unavailable:
            # The database does not answer; the next call tries again.
            pass
        finally:
            if self._reading_orders.get(robot.robot_id) is reading:
                del self._reading_orders[robot.robot_id]

    def _orders_changed(self, robot: RobotState) -> None:
        self._reading_orders.pop(robot.robot_id, None)
        self._latest_orders.pop(robot.robot_id, None)
        self._registry.of(robot).changed()

    # --- inside -------------------------------------------------------------------------------------------

    def _list(self, user: ModuleUser, orders: Iterable[ModuleOrderRecord]) -> ModuleList:
        known = self._registry.of(user.robot)
        shown_since = self._wall() - REFUSAL_SECONDS
        stored = {
            each.module: each
            for each in orders
            if (each.refused_at is None or each.refused_at >= shown_since) and each not in self._under_way
        }
        modules = {each.name: each for each in known.modules}
        for name in [each for each in stored if each not in modules]:
            modules[name] = link.ModuleInfo(name=name, kind="unknown", state="unknown")
        here = user.robot.control_link is not None
        return ModuleList(
            robot=user.robot.name,
            online=here or user.robot.elsewhere,
            current=here and known.reported,
            reported_at=known.reported_at,
            may_manage_processes=user.decide(PROCESSES).allowed,
            modules=[
                _status(each, stored.get(each.name))
                for each in modules.values()
                if user.decide(each.name).allowed
            ],
        )

    def _check_known(self, user: ModuleUser, name: str) -> None:
        """:raises NotFound: the robot has reported its modules, and this is none of them"""
        known = self._registry.of(user.robot)
        if known.reported_at is not None and all(each.name != name for each in known.modules):
            raise self._unknown(user, name)

    def _unknown(self, user: ModuleUser, name: str) -> NotFound:
        robot, known = user.robot.name, self._registry.of(user.robot)
        if known.reported_at is None:
            return NotFound(f"robot {robot} has never reported its modules, so '{name[:64]}' is not known")
        names = ", ".join(each.name for each in known.modules if user.decide(each.name).allowed) or "none"
        if user.robot.control_link is None:
            where = user.robot.absence
            return NotFound(
                f"robot {robot} is {where}, and its last report has no module '{name[:64]}'; it has {names}"
            )
        return NotFound(f"robot {robot} has no module '{name[:64]}'; it has {names}")

    def _announced(
        self, user: ModuleUser, name: str, action: link.ModuleAction, why_pending: str = ""
    ) -> ModuleOrderResult:
        """The result of an order that the robot has accepted, or that is pending. Others are notified of it."""
        pending = why_pending != ""
        self._publish(user.robot, f"user:{user.name}", name, action, pending=pending)
        self._orders_changed(user.robot)
        return ModuleOrderResult(module=name, action=action, pending=pending, why=why_pending)

    def _write_order(
        self, s: Any, user: ModuleUser, name: str, action: link.ModuleAction, pending: bool
    ) -> ModuleOrderRecord | None:
        """Write an order into the audit log, and in place of the module's stored one.

        :returns: the stored order; ``None`` for a restart, which never waits
        """
        robot, now, order = user.robot, self._wall(), None
        if action == "restart":
            queries.remove_module_order(s, robot.robot_id, name)
        else:
            order = queries.store_module_order(
                s,
                robot.robot_id,
                name,
                start=action == "start",
                user_id=user.user_id,
                by=user.name,
                at=now,
            )
        # The home of before it has connected here is not live, or is this relay.
        _check_here(robot, self._homes.other(queries.home_relay(s, robot.robot_id)))
        queries.append_audit(
            s,
            at=now,
            actor=user.actor,
            action=f"module.{action}",
            target=f"{robot.full}/{name}",
            origin=user.address,
            data={"pending": pending},
        )
        return order

    async def _remove(self, order: ModuleOrderRecord | None) -> None:
        """Remove a stored order that has ended, but none that has replaced it."""
        if order is not None:
            await self._database.write(queries.remove_module_order, order.robot_id, order.module, order.at)

    def _check_rate(self, user: ModuleUser) -> None:
        bucket = self._buckets.setdefault(
            user.user_id, TokenBucket(ORDERS_PER_SECOND, ORDERS_BURST, self._wall)
        )
        if not bucket.take():
            raise Unavailable(
                f"more than {ORDERS_PER_SECOND:g} orders to modules a second; try again in a moment"
            )

    def _publish(self, robot: RobotState, source: str, name: str, action: str, **data: Any) -> None:
        self._bus.publish("module.ordered", robot.robot_id, source, module=name, action=action, **data)

    # --- reports of robots --------------------------------------------------------------------------------

    def _reported(self, modules: RobotModules, first: bool) -> None:
        robot = modules.robot
        before = self._reports.get(robot.robot_id, {})
        now = self._reports[robot.robot_id] = {}
        for each in modules.modules:
            known = before.get(each.name, _Reported(each.state, each.restarts))
            # A report may leave out states: a crash with a short pause is seen by the restart alone.
            restarted = each.restarts > known.restarts
            noted = each.state in NOTED_STATES and (restarted or each.state != known.state)
            if noted:
                why = each.last_exit if restarted or each.state in ("backing_off", "failed") else ""
                source = f"robot:{robot.name}"
                self._bus.publish(
                    "module.changed", robot.robot_id, source, module=each.name, state=each.state, why=why
                )
            counted = each.restarts if noted else min(each.restarts, known.restarts)
            now[each.name] = _Reported(each.state, counted)
        if first:
            Deferred.fromCoroutine(self._carry_out_pending(modules)).addErrback(
                lambda failure: self.log.failure("orders to modules could not be carried out", failure)
            )

    async def _carry_out_pending(self, modules: RobotModules) -> None:
        robot = modules.robot
        connection = robot.control_link
        async with modules.order_lock:
            await self._database.write(
                queries.remove_refused_module_orders, robot.robot_id, self._wall() - REFUSAL_SECONDS
            )
            stored = await self._database.read(queries.module_orders, robot.robot_id)
        for order in stored:
            if order.refused_at is None and order not in self._under_way:
                await self._carry_out(modules, order, connection)

    async def _carry_out(self, modules: RobotModules, order: ModuleOrderRecord, connection: object) -> None:
        """Carry out a pending order over this connection, if it is still there and none has replaced the order."""
        async with modules.order_lock:
            error = await self._database.read(_denial, order)
            if error is None or modules.robot.control_link is not connection:
                return
            answer = None if error else modules.order(order.module, _action_of(order))
        try:
            if answer is not None:
                await answer
        except Unavailable as unavailable:
            # It stays until the robot answers, or is back.
            self._end_when_answered(modules, order, unavailable)
            return
        except SwitchboardError as refusal:
            error = str(refusal)
        await self._end_pending(modules, order, error)

    async def _end_pending(self, modules: RobotModules, order: ModuleOrderRecord, error: str) -> None:
        """The robot has carried out a pending order, or it is refused for this reason."""
        robot = modules.robot
        if error:
            await self._database.write(queries.refuse_module_order, order, self._wall(), error)
        else:
            await self._remove(order)
        source = f"user:{order.by}"
        self._publish(robot, source, order.module, _action_of(order), pending=False, error=error)
        self._orders_changed(robot)

    def _end_when_answered(self, modules: RobotModules, order: ModuleOrderRecord, error: Unavailable) -> None:
        """End a pending order when the robot answers too late."""

        def answered(answer: Answer) -> Deferred[None]:
            return Deferred.fromCoroutine(self._end_pending(modules, order, answer.error))

        if isinstance(error, RequestUnanswered):
            error.late.addCallback(answered).addErrback(
                lambda failure: self.log.failure("a pending order could not be ended", failure)
            )


def _denial(s: Any, order: ModuleOrderRecord) -> str | None:
    """Why a pending order must not be carried out now, as rights may have changed; empty if it may.

    ``None``: it is not pending any more.
    """
    if not queries.is_module_order_pending(s, order):
        return None
    if order.user_id is None:
        return ""
    grants = queries.grants_for(s, order.user_id, order.robot_id)
    decision = Rules(grants).decide(Operation.MANAGE, order.module)
    return "" if decision.allowed else decision.reason


def _check_here(robot: RobotState, other: RelayInfo | None) -> None:
    """:raises Unavailable: the robot is connected to this other relay, so that nothing must wait for it here"""
    if other is not None:
        raise Unavailable(
            f"robot {robot.name} has connected to another relay ({other.address}); send the order again"
        )


def _check_can_wait(robot: RobotState, name: str, action: link.ModuleAction) -> None:
    """:raises SwitchboardError: the order can't be pending"""
    if action == "restart":
        raise Unavailable(
            f"robot {robot.name} is offline; it takes 'start' and 'stop' for later, but no restart"
        )
    if not re.match(link.MODULE_NAME, name):
        raise Invalid(f"'{name[:64]}' is no name of a module")


def user_of(robot: RobotState, permit: Permit, address: str) -> ModuleUser:
    """A user with a permit on a robot."""
    principal = permit.principal
    return ModuleUser(
        robot,
        robot.name_of(principal.name, principal.realm),
        f"user:{principal.full}",
        address,
        principal.user_id,
        lambda resource: permit.decide(Operation.MANAGE, resource),
    )


def _status(module: link.ModuleInfo, order: ModuleOrderRecord | None) -> ModuleStatus:
    """A module with its stored order."""
    fields = msgspec.structs.asdict(module)
    if order is None:
        return ModuleStatus(**fields)
    action = _action_of(order)
    if order.refused_at is None:
        return ModuleStatus(**fields, pending=PendingModuleOrder(action=action, by=order.by, at=order.at))
    refused = RefusedModuleOrder(action=action, by=order.by, at=order.at, why=order.refusal)
    return ModuleStatus(**fields, refused=refused)


def _action_of(order: ModuleOrderRecord) -> Literal["start", "stop"]:
    return "start" if order.start else "stop"


def action_of(name: str) -> link.ModuleAction:
    """An action by its name.

    :raises Invalid: there is none of this name
    """
    if name not in ("start", "stop", "restart"):
        raise Invalid(f"'{name[:20]}' is not 'start', 'stop' or 'restart'")
    return cast(link.ModuleAction, name)
