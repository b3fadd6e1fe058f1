"""Orders to modules: a real database, and a robot in memory that answers when the test says so."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any, cast

import pytest
import pytest_twisted
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_db.queries import ModuleReportRecord
from relay_protocol import link
from relay_protocol.errors import NotFound, Unavailable
from relay_protocol.rights import Decision
from relay_server.cluster.homes import RobotHomes
from relay_server.cluster.relays import RelayInfo
from relay_server.common.concurrency import shield
from relay_server.common.database import AsyncDatabase
from relay_server.modules.report_store import RETRY_SECONDS, STORE_SECONDS
from relay_server.modules.robot_modules import ANSWER_SECONDS, MAX_PENDING, NotOrdered, RobotModules
from relay_server.modules.schemas import LogQuery, ModuleOrderResult, ModuleStatus
from relay_server.modules.service import MAX_WAITING, REFUSAL_SECONDS, ModuleUser
from tests.worlds.relay import World
from tests.worlds.robot_links import until
from tests.worlds.session_manager import SessionsWorld

REPORT = link.Modules(modules=[link.ModuleInfo(name="base", kind="command", state="stopped")])


TWO = link.Modules(
    modules=[link.ModuleInfo(name=name, kind="command", state="stopped") for name in ("arm", "base")]
)


class GatedDatabase:
    """A database. One of its queries waits at a gate: a write before it is done, a read with its result."""

    def __init__(self, database: AsyncDatabase, name: str) -> None:
        self._database = database
        self._name = name
        self._opened: Deferred[None] = Deferred()
        self.waiting = 0

    def open(self) -> None:
        self._opened.callback(None)

    async def read(self, query: Any, *arguments: Any, **options: Any) -> Any:
        result = await self._database.read(query, *arguments, **options)
        await self._pass(query)
        return result

    async def write(self, query: Any, *arguments: Any, **options: Any) -> Any:
        await self._pass(query)
        return await self._database.write(query, *arguments, **options)

    async def _pass(self, query: Any) -> None:
        if query.__name__ == self._name and not self._opened.called:
            self.waiting += 1
            await shield(self._opened)


class ModuleOrders:
    """Orders of the command line to the module base of rover, which is online."""

    def __init__(self, front: SessionsWorld) -> None:
        self.front = front
        self.world = front.world
        self.service = front.module_service()
        self.user = ModuleUser(
            self.world.robot, "root", "cli:root", "local", None, lambda _: Decision(True, "")
        )
        self.connect()

    @property
    def modules(self) -> RobotModules:
        return self.world.modules.of(self.world.robot)

    def connect(self) -> None:
        self.world.robot_comes(["json"])
        self.modules.message_received(REPORT)

    async def sent(self) -> link.OrderModule:
        """The next order that the robot gets."""
        await until(lambda: bool(self.world.control.all(link.OrderModule)))
        (order,) = self.world.control.take(link.OrderModule)
        return order  # type: ignore[no-any-return]

    def answer(self, order: link.OrderModule, error: str = "") -> None:
        self.modules.message_received(link.ModuleOrdered(request=order.request, error=error))

    def give(self, action: link.ModuleAction, name: str = "base") -> Deferred[ModuleOrderResult]:
        return Deferred.fromCoroutine(self.service.order(self.user, name, action))

    async def give_unanswered(self, action: link.ModuleAction) -> link.OrderModule:
        """An order that is pending, since the robot does not answer in time."""
        result = self.give(action)
        order = await self.sent()
        self.world.clock.advance(ANSWER_SECONDS + 0.1)
        assert (await result).pending
        return order

    async def pending(self) -> list[bool]:
        """Of each pending order, whether it is a start."""
        stored = await self.front.store.read(queries.module_orders, self.user.robot.robot_id)
        return [each.start for each in stored if each.refused_at is None]

    async def base(self) -> ModuleStatus:
        """The module as a client sees it."""
        return await self.service.module(self.user, "base")

    async def restart_relay(self) -> None:
        """Another relay process on the same database; the robot is not connected to it yet."""
        await self.front.module_reports.stop()
        self.world = World()
        self.front.world = self.world
        self.service = self.front.module_service()
        self.user = self.user._replace(robot=self.world.robot)
        await self.front.module_reports.start()

    async def audit(self) -> list[str]:
        entries = await self.front.store.read(queries.list_audit)
        return [each.action for each in entries if each.action.startswith("module.")]

    def gate(self, name: str) -> GatedDatabase:
        """Have the service's database query of this name wait."""
        gate = GatedDatabase(self.front.store, name)
        self.service._database = gate  # type: ignore[assignment]
        return gate

    def ended(self) -> list[dict[str, Any]]:
        """Events of orders that pend no longer."""
        return [each.data for each in self.front.events("module.ordered") if not each.data["pending"]]


@pytest.fixture
def orders(front: SessionsWorld) -> ModuleOrders:
    return ModuleOrders(front)


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize("case", ["answered", "refused", "unanswered", "lost", "offline"])
async def test_an_order_is_in_the_audit_log_once(orders: ModuleOrders, case: str) -> None:
    if case == "unanswered":
        await orders.give_unanswered("start")
    else:
        if case == "offline":
            orders.world.robot_goes()
        result = orders.give("start")
        outcome: list[object] = []
        result.addBoth(outcome.append)
        if case in ("answered", "refused"):
            orders.answer(await orders.sent(), "" if case == "answered" else "it is locked")
        elif case == "lost":
            await orders.sent()
            orders.world.robot_goes()
        await until(lambda: bool(outcome))
    assert await orders.audit() == ["module.start"]
    assert await orders.pending() == ([] if case in ("answered", "refused") else [True])


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize("case", ["no report", "busy"])
async def test_an_order_that_can_not_be_sent_is_refused_and_not_kept(orders: ModuleOrders, case: str) -> None:
    if case == "no report":
        # Robots of others send no list of modules.
        orders.world.robot_goes()
        orders.world.robot_comes(["json"])
    else:
        for _ in range(MAX_PENDING):
            orders.modules.measure().addErrback(lambda _: None)
    with pytest.raises(NotOrdered if case == "no report" else Unavailable) as refusal:
        await orders.give("start")
    assert ("reported no modules" if case == "no report" else "to answer already") in str(refusal.value)
    assert await orders.pending() == []


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize("why", ["is offline", "did not answer in time", "lost its connection"])
async def test_a_pending_order_has_its_cause(orders: ModuleOrders, why: str) -> None:
    if why == "is offline":
        orders.world.robot_goes()
    result = orders.give("stop")
    if why != "is offline":
        await orders.sent()
    if why == "did not answer in time":
        orders.world.clock.advance(ANSWER_SECONDS + 0.1)
    elif why != "is offline":
        orders.world.robot_goes()
    done = await result
    assert done.pending
    assert f"robot rover {why}" in done.why


class OtherRelay:
    """Homes of a cluster with one other relay.

    :param known: whether this relay knows that the robot is connected there
    """

    relay = RelayInfo("two", "10.0.0.2", 9092, "1.0", 0.0)

    def __init__(self, *, known: bool) -> None:
        self.known = known

    def elsewhere(self, robot_id: int) -> RelayInfo | None:
        return self.relay if self.known else None

    def other(self, relay: str) -> RelayInfo | None:
        return self.relay if relay == "two" else None


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize("action", ["start", "stop", "restart"])
@pytest.mark.parametrize("case", ["known", "unknown", "link still open"])
async def test_an_order_to_a_robot_at_another_relay_is_refused_and_not_kept(
    orders: ModuleOrders, case: str, action: link.ModuleAction
) -> None:
    """Also one that this relay does not know of yet: the robot has connected there, by the database."""
    orders.service._homes = cast(RobotHomes, OtherRelay(known=case == "known"))
    await orders.front.store.write(queries.claim_home_relay, orders.user.robot.robot_id, "two")
    if case != "link still open":
        orders.world.robot_goes()
    if case == "unknown" and action == "restart":
        # It never waits, so that the database is not asked.
        expected = "is offline"
    else:
        expected = "connected to another relay (10.0.0.2:9092); send the order again"
    result = orders.give(action)
    await until(lambda: bool(result.called or orders.world.control.all(link.OrderModule)))
    assert orders.world.control.all(link.OrderModule) == []
    with pytest.raises(Unavailable, match=re.escape(expected)):
        await result
    assert await orders.pending() == []
    assert await orders.audit() == []


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize("home", ["three", ""])
async def test_an_order_waits_for_a_robot_whose_relay_is_gone(orders: ModuleOrders, home: str) -> None:
    orders.service._homes = cast(RobotHomes, OtherRelay(known=False))
    await orders.front.store.write(queries.claim_home_relay, orders.user.robot.robot_id, home)
    orders.world.robot_goes()
    assert (await orders.give("stop")).pending
    assert await orders.pending() == [False]


@pytest_twisted.ensureDeferred
async def test_a_robot_at_another_relay_is_not_called_offline(orders: ModuleOrders) -> None:
    orders.world.robot_goes()
    orders.world.registry.set_elsewhere(orders.user.robot.robot_id, elsewhere=True)
    for request in (
        orders.service.processes(orders.user),
        orders.service.read_log(orders.user, "base", LogQuery()),
    ):
        with pytest.raises(Unavailable, match="robot rover is connected to another relay"):
            await request
    found = await orders.service.modules(orders.user)
    assert (found.online, found.current) == (True, False)


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize("error", ["", "the robot has no module 'base'"])
async def test_a_late_answer_ends_a_pending_order(orders: ModuleOrders, error: str) -> None:
    order = await orders.give_unanswered("start")
    assert (await orders.pending(), orders.ended()) == ([True], [])
    orders.answer(order, error)
    await until(lambda: bool(orders.ended()))
    assert orders.ended() == [{"module": "base", "action": "start", "pending": False, "error": error}]
    assert await orders.pending() == []
    assert await orders.audit() == ["module.start"]


@pytest_twisted.ensureDeferred
async def test_a_late_answer_ends_no_later_order(orders: ModuleOrders) -> None:
    first = await orders.give_unanswered("start")
    await orders.give_unanswered("stop")
    orders.answer(first)
    await until(lambda: bool(orders.ended()))
    assert await orders.pending() == [False]


@pytest_twisted.ensureDeferred
async def test_a_late_answer_ends_an_order_that_was_carried_out_on_return(orders: ModuleOrders) -> None:
    orders.world.robot_goes()
    assert (await orders.give("stop")).pending
    orders.connect()
    order = await orders.sent()
    assert order.action == "stop"
    orders.world.clock.advance(ANSWER_SECONDS + 0.1)
    assert await orders.pending() == [False]
    orders.answer(order)
    await until(lambda: bool(orders.ended()))
    assert await orders.pending() == []


@pytest_twisted.ensureDeferred
async def test_a_pending_order_that_the_robot_refuses_is_shown_with_its_reason(orders: ModuleOrders) -> None:
    """Until the next order; by a later relay process, too."""
    orders.world.robot_goes()
    assert (await orders.give("start")).pending
    orders.connect()
    orders.answer(await orders.sent(), "its settings are wrong")
    await until(lambda: bool(orders.ended()))
    assert "its settings are wrong" in orders.ended()[0]["error"]
    await orders.restart_relay()
    base = await orders.base()
    assert base.pending is None
    assert base.refused is not None
    assert (base.refused.action, base.refused.by) == ("start", "root")
    assert "its settings are wrong" in base.refused.why
    assert (await orders.give("stop")).pending
    base = await orders.base()
    assert (base.refused, base.pending is not None) == (None, True)


@pytest_twisted.ensureDeferred
async def test_a_refusal_is_shown_for_a_day_and_not_carried_out_again(orders: ModuleOrders) -> None:
    orders.world.robot_goes()
    await orders.give("start")
    for error in ("it is locked", ""):
        orders.connect()
        if error:
            orders.answer(await orders.sent(), error)
            await until(lambda: bool(orders.ended()))
        orders.world.robot_goes()
    assert (await orders.base()).refused is not None
    assert orders.world.control.all(link.OrderModule) == []
    orders.world.clock.advance(REFUSAL_SECONDS + 1)
    assert (await orders.base()).refused is None


@pytest_twisted.ensureDeferred
async def test_modules_of_a_robot_that_is_offline_are_known_after_a_restart(orders: ModuleOrders) -> None:
    orders.world.clock.advance(60.0)
    orders.world.registry.seen(orders.world.robot)
    seen = orders.world.robot.last_seen
    orders.world.robot_goes()
    await orders.restart_relay()
    found = await orders.service.modules(orders.user)
    assert (found.online, found.current, found.reported_at) == (False, False, seen)
    assert [(each.name, each.state) for each in found.modules] == [("base", "stopped")]
    assert (await orders.give("start")).pending
    with pytest.raises(NotFound, match="its last report has no module 'kitchen'; it has base"):
        await orders.service.order(orders.user, "kitchen", "start")
    orders.connect()
    found = await orders.service.modules(orders.user)
    assert (found.online, found.current) == (True, True)


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize(("at", "state"), [(1.9e9, "failed"), (5.0, "stopped")])
async def test_an_offline_robot_shows_the_newest_report_that_a_relay_has_stored(
    orders: ModuleOrders, at: float, state: str
) -> None:
    """It may have been connected to another relay of the cluster."""
    orders.world.robot_goes()
    await orders.front.module_reports.stop()
    failed = '[{"name": "base", "kind": "command", "state": "failed"}]'
    report = ModuleReportRecord(orders.user.robot.robot_id, at, failed)
    await orders.front.store.write(queries.store_module_reports, [report])
    assert (await orders.base()).state == state


@pytest_twisted.ensureDeferred
async def test_a_robot_that_has_connected_and_not_reported_yet_shows_what_was_known(
    orders: ModuleOrders,
) -> None:
    orders.world.robot_goes()
    await orders.restart_relay()
    orders.world.robot_comes(["json"])
    found = await orders.service.modules(orders.user)
    assert (found.online, found.current, [each.name for each in found.modules]) == (True, False, ["base"])


@pytest_twisted.ensureDeferred
async def test_a_stored_report_that_can_not_be_read_is_none(orders: ModuleOrders) -> None:
    """Another version of the relay may have written it. This one starts, and the robot's next report counts."""
    orders.world.robot_goes()
    await orders.front.module_reports.stop()
    report = ModuleReportRecord(orders.user.robot.robot_id, 1.9e9, '[{"name": 7}]')
    await orders.front.store.write(queries.store_module_reports, [report])
    await orders.restart_relay()
    found = await orders.service.modules(orders.user)
    assert (found.reported_at, found.modules) == (None, [])
    orders.connect()
    assert (await orders.base()).state == "stopped"


@pytest_twisted.ensureDeferred
async def test_reports_are_stored_soon_after_they_have_come(orders: ModuleOrders) -> None:
    """A relay that is killed loses those of a second."""
    orders.world.clock.advance(STORE_SECONDS)
    found = None
    for _ in range(2000):
        found = await orders.front.store.read(queries.module_report, orders.user.robot.robot_id)
        if found is not None:
            break
    assert found is not None
    assert '"base"' in found.modules


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize("later", ["stopped", "running"])
async def test_a_report_that_could_not_be_stored_is_stored_later(orders: ModuleOrders, later: str) -> None:
    """Or the one that has come meanwhile."""
    written: list[str] = []

    async def write(query: Any, reports: list[ModuleReportRecord]) -> None:
        written.extend(each.modules for each in reports)
        if len(written) == 1:
            raise Unavailable("the database does not answer")

    orders.front.module_reports._database = SimpleNamespace(write=write)  # type: ignore[assignment]
    orders.world.clock.advance(STORE_SECONDS)
    orders.world.clock.advance(RETRY_SECONDS - 0.1)
    assert len(written) == 1
    if later == "running":
        running = link.ModuleInfo(name="base", kind="command", state="running")
        orders.modules.message_received(link.Modules(modules=[running]))
    orders.world.clock.advance(0.2)
    first, second = written
    assert '"stopped"' in first
    assert f'"{later}"' in second
    orders.world.clock.advance(60.0)
    assert len(written) == 2


@pytest_twisted.ensureDeferred
async def test_modules_of_a_robot_that_never_reported_any_are_not_known(orders: ModuleOrders) -> None:
    orders.front.world = orders.world = World()
    orders.service = orders.front.module_service()
    orders.user = orders.user._replace(robot=orders.world.robot)
    found = await orders.service.modules(orders.user)
    assert (found.reported_at, found.modules) == (None, [])
    with pytest.raises(NotFound, match="has never reported its modules"):
        await orders.base()
    # The name may be right. If it is not, the refusal is shown.
    assert (await orders.give("start")).pending
    assert (await orders.base()).state == "unknown"
    orders.world.robot_comes(["json"])
    orders.modules.message_received(link.Modules(modules=[]))
    orders.answer(await orders.sent(), "the robot has no module 'base'; it has none")
    await until(lambda: bool(orders.ended()))
    base = await orders.base()
    assert (base.state, base.refused is not None) == ("unknown", True)


@pytest_twisted.ensureDeferred
async def test_the_ros_topic_has_an_order_that_a_connected_robot_does_not_answer(
    orders: ModuleOrders,
) -> None:
    def pending() -> bool:
        (base,) = orders.service.latest_modules(orders.user).modules
        return base.pending is not None

    assert not pending()
    await until(lambda: not orders.service._reading_orders)
    assert not pending()
    await orders.give_unanswered("start")
    await until(pending)


@pytest_twisted.ensureDeferred
async def test_a_pending_order_is_not_sent_once_its_opposite_is_accepted(orders: ModuleOrders) -> None:
    """Its turn comes after an order that takes the robot long."""
    orders.modules.message_received(TWO)
    orders.world.robot_goes()
    for name in ("arm", "base"):
        assert (await orders.give("start", name)).pending
        orders.world.clock.advance(1.0)
    orders.connect()
    orders.modules.message_received(TWO)
    arm = await orders.sent()
    stopping = orders.give("stop")
    stop = await orders.sent()
    orders.answer(stop)
    assert not (await stopping).pending
    orders.answer(arm)
    await until(lambda: len(orders.ended()) == 2)
    # An order that is still to be sent is sent before this.
    await orders.service.modules(orders.user)
    assert [(each.module, each.action) for each in (arm, stop)] == [("arm", "start"), ("base", "stop")]
    assert orders.world.control.all(link.OrderModule) == []
    assert await orders.pending() == []


@pytest_twisted.ensureDeferred
async def test_an_order_that_comes_between_check_and_sending_is_sent_later(orders: ModuleOrders) -> None:
    orders.world.robot_goes()
    assert (await orders.give("start")).pending
    orders.world.clock.advance(1.0)
    gate = orders.gate("_denial")
    orders.connect()
    await until(lambda: gate.waiting == 1)
    stopping = orders.give("stop")
    # Without its turn it would be written before this.
    await orders.front.store.write(queries.remove_refused_module_orders, orders.user.robot.robot_id, 0.0)
    assert await orders.audit() == ["module.start"]
    gate.open()
    start = await orders.sent()
    stop = await orders.sent()
    assert (start.action, stop.action) == ("start", "stop")
    for each in (start, stop):
        orders.answer(each)
    assert not (await stopping).pending
    assert await orders.pending() == []


@pytest_twisted.ensureDeferred
async def test_an_order_is_not_pending_if_a_later_one_was_carried_out(orders: ModuleOrders) -> None:
    starting = orders.give("start")
    start = await orders.sent()
    orders.world.clock.advance(1.0)
    stopping = orders.give("stop")
    orders.answer(await orders.sent())
    assert not (await stopping).pending
    orders.world.clock.advance(ANSWER_SECONDS)
    with pytest.raises(Unavailable, match="did not answer in time; a later order has replaced this one"):
        await starting
    assert await orders.pending() == []
    orders.answer(start)
    orders.world.robot_goes()
    orders.connect()
    await orders.base()
    assert orders.world.control.all(link.OrderModule) == []


@pytest_twisted.ensureDeferred
async def test_orders_that_wait_for_their_turn_are_limited(orders: ModuleOrders) -> None:
    """Those that wait may be refused at once when their turn comes."""
    gate = orders.gate("_write_order")
    first = orders.give("start")
    await until(lambda: gate.waiting == 1)
    waiting = [
        Deferred.fromCoroutine(orders.service.order(orders.user, "kitchen", "start", limited=False))
        for _ in range(MAX_WAITING)
    ]
    with pytest.raises(Unavailable, match="has 32 orders waiting"):
        await orders.service.order(orders.user, "base", "stop", limited=False)
    gate.open()
    orders.answer(await orders.sent())
    assert not (await first).pending
    for each in waiting:
        with pytest.raises(NotFound):
            await each
    stopping = orders.give("stop")
    orders.answer(await orders.sent())
    assert not (await stopping).pending


@pytest_twisted.ensureDeferred
async def test_an_order_that_is_stored_as_its_robot_comes_back_is_carried_out(orders: ModuleOrders) -> None:
    orders.world.robot_goes()
    gate = orders.gate("_write_order")
    giving = orders.give("start")
    await until(lambda: gate.waiting == 1)
    orders.connect()
    gate.open()
    assert (await giving).pending
    orders.answer(await orders.sent())
    await until(lambda: bool(orders.ended()))
    assert await orders.pending() == []


@pytest_twisted.ensureDeferred
async def test_pending_orders_are_sent_once_to_a_robot_that_leaves_and_comes_back(
    orders: ModuleOrders,
) -> None:
    orders.modules.message_received(TWO)
    orders.world.robot_goes()
    for name in ("arm", "base"):
        assert (await orders.give("start", name)).pending
    sent = []
    for _ in range(2):
        orders.connect()
        orders.modules.message_received(TWO)
        sent.append(await orders.sent())
        assert await orders.pending() == [True, True]
        orders.world.robot_goes()
    orders.connect()
    orders.modules.message_received(TWO)
    for _ in range(2):
        sent.append(await orders.sent())
        orders.answer(sent[-1])
    await until(lambda: len(orders.ended()) == 2)
    assert [each.module for each in sent] == ["arm", "arm", "arm", "base"]
    assert await orders.pending() == []
    assert orders.world.control.all(link.OrderModule) == []


@pytest_twisted.ensureDeferred
async def test_an_order_goes_on_when_its_client_has_left(orders: ModuleOrders) -> None:
    gate = orders.gate("_write_order")
    giving = orders.give("start")
    await until(lambda: gate.waiting == 1)
    giving.addErrback(lambda _: None).cancel()
    gate.open()
    orders.answer(await orders.sent())
    await until(lambda: bool(orders.ended()))
    assert await orders.pending() == []
    assert await orders.audit() == ["module.start"]


@pytest_twisted.ensureDeferred
async def test_an_order_that_awaits_its_answer_is_not_shown_as_pending(orders: ModuleOrders) -> None:
    giving = orders.give("start")
    order = await orders.sent()
    assert await orders.pending() == [True]
    assert (await orders.base()).pending is None
    orders.world.clock.advance(ANSWER_SECONDS + 0.1)
    assert (await giving).pending
    assert (await orders.base()).pending is not None
    orders.answer(order, "it is locked")
    await until(lambda: bool(orders.ended()))


@pytest_twisted.ensureDeferred
async def test_rights_are_those_of_the_moment_at_which_a_pending_order_is_sent(orders: ModuleOrders) -> None:
    user = orders.user._replace(name="ann", user_id=orders.front.ann.id)
    orders.modules.message_received(TWO)
    robot = orders.user.robot.robot_id
    await orders.front.store.write(queries.grant_right, robot, "owner", user_id=orders.front.ann.id)
    orders.world.robot_goes()
    for name in ("arm", "base"):
        assert (await orders.service.order(user, name, "start")).pending
    orders.connect()
    orders.modules.message_received(TWO)
    arm = await orders.sent()
    await orders.front.store.write(queries.grant_right, robot, "viewer", user_id=orders.front.ann.id)
    orders.answer(arm)
    await until(lambda: len(orders.ended()) == 2)
    assert [bool(each["error"]) for each in orders.ended()] == [False, True]
    assert orders.world.control.all(link.OrderModule) == []


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize("resource", ["processes", "base"])
async def test_the_list_says_whether_the_user_may_manage_processes(
    orders: ModuleOrders, resource: str
) -> None:
    user = orders.user._replace(decide=lambda asked: Decision(asked == resource, "no right"))
    found = await orders.service.modules(user)
    assert found.may_manage_processes == (resource == "processes")
    assert [each.name for each in found.modules] == ["base"] * (resource == "base")


CRASH = "exit code 3"


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize(
    ("reports", "expected"),
    [
        ([("running", 0), ("running", 1)], [("running", CRASH)]),
        ([("running", 0), ("running", 1), ("running", 1), ("running", 3)], [("running", CRASH)] * 2),
        ([("running", 0), ("starting", 1), ("running", 1)], [("running", CRASH)]),
        ([("running", 0), ("backing_off", 0), ("backing_off", 1)], [("backing_off", CRASH)] * 2),
        ([("running", 0), ("backing_off", 0), ("running", 1)], [("backing_off", CRASH), ("running", CRASH)]),
        # A daemon that has started again counts from 0.
        ([("running", 5), ("running", 0), ("running", 1)], [("running", CRASH)]),
        ([("running", 5), ("running", 5)], []),
        ([("stopped", 0), ("running", 0), ("stopped", 0)], [("running", ""), ("stopped", "")]),
    ],
)
async def test_each_restart_of_a_module_is_an_event(
    orders: ModuleOrders, reports: list[tuple[str, int]], expected: list[tuple[str, str]]
) -> None:
    """Also of a module whose pause is so short that no report shows it."""
    for state, restarts in reports:
        info = link.ModuleInfo(
            name="arm",
            kind="command",
            state=state,
            restarts=restarts,
            last_exit=CRASH if restarts or state == "backing_off" else "",
        )
        orders.modules.message_received(link.Modules(modules=[*REPORT.modules, info]))
    events = [each.data for each in orders.front.events("module.changed")]
    assert [each["module"] for each in events] == ["arm"] * len(expected)
    assert [(each["state"], each["why"]) for each in events] == expected
