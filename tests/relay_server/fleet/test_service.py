"""Fleet orders as HTTP gives them: a real database, and a robot in memory."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
import pytest_twisted
from twisted.internet.defer import CancelledError, Deferred

from relay_db import queries
from relay_db.queries import RobotRecord
from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, Unavailable
from relay_server.access import LOOKUP_SECONDS, NOT_LOOKED_UP, Principal
from relay_server.audit_log import AuditLog
from relay_server.cluster.fleet_orders import NoOrderForwarding
from relay_server.common.freshness_tokens import FreshnessTokenExpired, FreshnessTokenRequired
from relay_server.control.actor import Actor
from relay_server.fleet import service as module
from relay_server.fleet.order import VALUES_BYTES, FleetOrderStart, FleetRobotResult, Order, TaskResult
from relay_server.fleet.service import LOCAL, FleetPlan, FleetService
from relay_server.in_process_sessions.one_shot_publisher import MATCHING_SECONDS, SUBSCRIBER_SECONDS
from relay_server.sessions.context import ClientContext
from tests.worlds.control import outcome
from tests.worlds.relay import MOTION, STRING, TRIGGER, MemoryClient, hangs
from tests.worlds.robot_links import until
from tests.worlds.session_manager import HERE, SessionsWorld

LATER = 1 << 62
"""Sent after all there was."""


def order(do: str, *robots: str, **fields: Any) -> Order:
    """A fleet order."""
    return msgspec.json.decode(json.dumps({"robots": robots or ("rover",), "do": do, **fields}), type=Order)


class Given:
    """An order that was given, with its results."""

    def __init__(self, running: Deferred[None], results: list[TaskResult]) -> None:
        self.running = running
        self.results = results
        self.errors: list[type[BaseException]] = []
        running.addErrback(lambda failure: self.errors.append(failure.type))

    @property
    def words(self) -> str:
        """The text of the only result."""
        (result,) = self.results
        return result.outcome.message


class Fleet:
    """Fleet orders of ann, who operates rover."""

    def __init__(self, front: SessionsWorld) -> None:
        self.front = front
        self.world = front.world
        self.bus = front.bus
        folder = Path(front.store.database.url.removeprefix("sqlite:///")).parent
        self.audit = AuditLog(self.world.clock, front.store, folder, self.bus.publish)
        self.service = self.new_service()

    def new_service(self) -> FleetService:
        """A new fleet service."""
        return FleetService(
            self.world.clock,
            self.front.service,
            self.front.access,
            self.world.registry,
            self.world.control_service,
            self.front.store,
            self.bus,
            self.audit,
            self.front.module_service(),
            forwarding=NoOrderForwarding(),
            clock_ns=self.world.now_ns,
            wall=self.front.wall,
        )

    async def ann(self) -> Principal:
        """Ann, the operator of rover."""
        principal, _ = await self.front.logged_in()
        return principal

    async def give(self, asker: Principal, given: Order, ago: float = 0.0) -> Given:
        """Gives an order and waits until it has started.

        :param ago: seconds since it was sent
        """
        plan = await self.service.plan(asker, given, HERE, self.world.now_ns() - int(ago * 1e9))
        begun: list[None] = []
        results: list[TaskResult] = []

        async def report(result: TaskResult) -> None:
            results.append(result)

        running = Deferred.fromCoroutine(self.service.carry_out(plan, lambda: begun.append(None), report))
        made = Given(running, results)
        await until(lambda: bool(begun or made.errors))
        return made

    async def works(self, given: Given) -> ClientContext:
        """The session of an order to rover, with an open channel."""
        await until(lambda: bool(self.sessions() or given.results))
        self.world.clock.advance(0)
        if self.world.control.all(link.OpenChannel):
            self.world.robot_joins()
        self.world.clock.advance(0)
        (session,) = self.sessions()
        return session

    async def calls(self) -> link.CallService:
        """The next call to rover, which sends all definitions."""

        def asked() -> bool:
            self.world.define()
            return bool(self.world.link.all(link.CallService))

        await until(asked)
        (call,) = self.world.link.take(link.CallService)
        return call

    def answers(self, call: link.CallService, **fields: Any) -> None:
        """Rover answers a call of a Trigger."""
        cdr = self.world.cdr(f"{TRIGGER}_Response", **fields)
        self.world.channel.message(link.ServiceResponse(id=call.id, result=True, cdr=cdr))

    def sessions(self) -> list[ClientContext]:
        """Open sessions of rover."""
        return self.front.service.clients_of(1)

    async def after(self, true: Callable[[], bool], step: float = 0.02) -> None:
        """Advances the clock until a condition holds."""

        def holds() -> bool:
            self.world.clock.advance(step)
            return true()

        await until(holds)


@pytest.fixture
def fleet(front: SessionsWorld) -> Fleet:
    """Rover in the database, and no clients."""
    return Fleet(front)


@pytest_twisted.ensureDeferred
async def test_an_order_means_robots_one_has_a_right_on(fleet: Fleet) -> None:
    """By any name; an order without such robots gets the same error as for unknown ones."""
    ann = await fleet.ann()
    with fleet.front.store.database.begin() as s:
        group = queries.add_robot_group(s, "all")
        for robot in queries.list_robots(s):
            queries.add_to_robot_group(s, group.id, robot.id)
    for robots in (["rover"], ["r*"], ["*"], ["group:ALL"]):
        plan = await fleet.service.plan(ann, order("stop", *robots), HERE)
        assert plan.start == FleetOrderStart("stop", ["rover"], [])
    for robots in (["hidden"], ["h*"], ["nowhere"], ["group:none"]):
        with pytest.raises(NotFound, match="no robot that you have a right on"):
            await fleet.service.plan(ann, order("stop", *robots), HERE)
    assert await fleet.service.groups(ann) == [{"name": "all", "robots": ["rover"]}]
    assert list((await fleet.service.plan(LOCAL, order("stop", "*"), "local")).robots) == ["hidden", "rover"]
    with pytest.raises(Invalid, match="needs 'service'"):
        await fleet.service.plan(ann, order("call"), HERE)


@pytest_twisted.ensureDeferred
async def test_an_order_means_a_thousand_robots_at_most(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A larger selection is refused beforehand; a stop may select all."""
    monkeypatch.setattr(module, "MAX_ROBOTS", 1)
    with pytest.raises(Invalid, match="for 2 robots; it may be for 1 at most"):
        await fleet.service.plan(LOCAL, order("resume", "*"), HERE, LATER)
    assert list((await fleet.service.plan(LOCAL, order("stop", "*"), HERE)).robots) == ["hidden", "rover"]


@pytest_twisted.ensureDeferred
async def test_a_call_is_done_by_a_session_of_the_askers(fleet: Fleet) -> None:
    """It lasts as long as the call, has the usual rights, and is audited."""
    fleet.world.robot_comes()
    given = await fleet.give(await fleet.ann(), order("call", service="reset"))
    session = await fleet.works(given)
    assert (session.name, session.address) == ("ann", HERE)
    call = await fleet.calls()
    assert (call.service, call.source) == ("/reset", session.number)
    fleet.answers(call, success=True, message="done")
    await until(lambda: bool(given.results))
    assert given.results[0].line == FleetRobotResult(
        robot="rover",
        ok=True,
        message="done",
        values={"success": True, "message": "done"},
        pending=False,
        seconds=0.0,
    )
    assert not fleet.sessions()
    assert given.running.called
    (entry,) = [
        each for each in await fleet.front.store.read(queries.list_audit) if each.action == "fleet.call"
    ]
    assert (entry.actor, entry.target, entry.origin) == ("user:ann", "rover", HERE)
    assert entry.data == {"robots": 1, "what": "reset", "why": ""}
    (event,) = fleet.front.events("fleet.done")
    assert event.data == {"realm": "default", "what": "call reset", "robots": 1, "ok": 1, "failed": 0}


@pytest_twisted.ensureDeferred
async def test_failure_is_reported(fleet: Fleet) -> None:
    """These are: offline, denied, an error in the answer, and no answer."""
    ann = await fleet.ann()
    given = await fleet.give(ann, order("call", service="/reset"))
    await until(lambda: bool(given.results))
    assert given.words == "robot rover is offline"
    fleet.world.robot_comes()
    with fleet.front.store.database.begin() as s:
        queries.grant_right(s, fleet.front.rover.id, "viewer", user_id=ann.user_id)
    await fleet.front.access.refresh()
    given = await fleet.give(ann, order("call", service="/reset"))
    await until(lambda: bool(given.results))
    assert "needs the level operator" in given.words
    given = await fleet.give(LOCAL, order("call", service="/reset"))
    await fleet.works(given)
    fleet.answers(await fleet.calls(), success=False, message="")
    await until(lambda: bool(given.results))
    assert given.words == "the service reports that it did not succeed"
    given = await fleet.give(LOCAL, order("call", service="/reset", timeout=2))
    await fleet.works(given)
    await fleet.calls()
    fleet.world.clock.advance(2)
    assert given.words == "no answer within 2 s; it may still happen"
    assert not fleet.sessions()


@pytest.mark.parametrize("service", ["/reset", "/dock/_action/send_goal"])
@pytest_twisted.ensureDeferred
async def test_a_service_that_moves_takes_control_while_it_lasts(fleet: Fleet, service: str) -> None:
    """The robot obeys the order's session during the call, and has no controller afterwards."""
    fleet.world.robot_comes()
    moving = link.MotionPolicy(services=["/reset"], actions=["/dock"])
    fleet.world.robot.description = link.Describe(motion=moving)
    given = await fleet.give(await fleet.ann(), order("call", service=service, why="tidy up", type=TRIGGER))
    session = await fleet.works(given)
    call = await fleet.calls()
    assert session.controller.lease.held_by(session)
    fleet.answers(call, success=True)
    await until(lambda: bool(given.results))
    assert given.results[0].outcome.ok
    assert [(each.holder, each.why) for each in fleet.world.control.all(link.ControlGrant)] == [
        (session.number, "tidy up"),
        (0, "released by ann"),
    ]
    assert "control.lost" not in fleet.world.record.kinds


@pytest_twisted.ensureDeferred
async def test_control_is_not_taken_from_others(fleet: Fleet) -> None:
    """Nor requested: the error names the controller, or says that it is the caller's own connection."""
    ann = await fleet.ann()
    fleet.world.robot_comes()
    fleet.world.robot.description = link.Describe(motion=link.MotionPolicy(services=["/reset"]))
    rosbridge, client = await fleet.front.opens(ann)
    holder = rosbridge.session.client
    taken = Deferred.fromCoroutine(holder.controller.take(holder, ""))
    await until(lambda: taken.called)
    mine = "another connection of yours has control of rover: release it there first"
    for asker, words in ((ann, mine), (LOCAL, "ann has control of rover")):
        given = await fleet.give(asker, order("call", service="/reset"))
        await until(lambda given=given: bool(given.results))
        assert given.words == words
    assert holder.controller.lease.held_by(holder)
    assert holder.controller.lease.request is None
    assert isinstance(client, MemoryClient)
    holder.port.end()


@pytest_twisted.ensureDeferred
async def test_a_message_waits_for_publisher_and_subscriber(fleet: Fleet) -> None:
    """After DDS has matched them it is sent, and the publisher ends."""
    fleet.world.robot_comes()
    given = await fleet.give(await fleet.ann(), order("publish", topic="/chatter", msg={"data": "hello"}))
    await fleet.works(given)
    fleet.world.define()
    (advertised,) = fleet.world.link.take(link.Advertise)
    assert (advertised.topic, advertised.type) == ("/chatter", STRING)
    await fleet.after(lambda: True, 1.0)
    fleet.world.channel.message(
        link.Advertised(number=advertised.number, topic="/chatter", type=STRING, encoding="cdr")
    )
    fleet.world.define()
    fleet.world.clock.pump([0.02] * 2)
    assert not fleet.world.link.samples
    fleet.world.clock.pump([MATCHING_SECONDS, 0.02])
    assert len(fleet.world.link.samples) == 1
    assert not given.results
    fleet.world.clock.pump([MATCHING_SECONDS, 0.02])
    await until(lambda: bool(given.results))
    assert given.results[0].outcome.ok, given.words
    assert fleet.world.link.all(link.Unadvertise)


@pytest_twisted.ensureDeferred
async def test_a_topic_without_subscribers_is_not_waited_for_long(fleet: Fleet) -> None:
    """A subscriber may join later, but there is only one message."""
    fleet.world.robot_comes()
    given = await fleet.give(await fleet.ann(), order("publish", topic="/secret", msg={"data": "hello"}))
    await fleet.works(given)
    (advertised,) = fleet.world.link.take(link.Advertise)
    fleet.world.channel.message(
        link.Advertised(number=advertised.number, topic="/secret", type=STRING, encoding="cdr")
    )
    fleet.world.define()
    fleet.world.clock.pump([0.02] * 10)
    assert not fleet.world.link.samples
    fleet.world.clock.pump([SUBSCRIBER_SECONDS, 0.02, MATCHING_SECONDS, MATCHING_SECONDS, 0.02])
    await until(lambda: bool(given.results))
    assert given.results[0].outcome.ok
    assert len(fleet.world.link.samples) == 1


@pytest_twisted.ensureDeferred
async def test_single_message_moves_no_robot(fleet: Fleet) -> None:
    """Motion commands are refused by the given type and by the known type."""
    fleet.world.robot_comes()
    assert fleet.world.robot.description is MOTION
    for fields in ({"topic": "cmd_vel"}, {"topic": "/new", "type": "geometry_msgs/Twist"}):
        given = await fleet.give(LOCAL, order("publish", **fields))
        await until(lambda given=given: bool(given.results))
        assert "counts as motion on rover" in given.words
    given = await fleet.give(LOCAL, order("publish", topic="/nothing"))
    await until(lambda: bool(given.results))
    assert given.words == "there is no topic /nothing on rover; give its type"
    fleet.world.robot_goes()
    given = await fleet.give(LOCAL, order("publish", topic="/chatter", type=STRING))
    await until(lambda: bool(given.results))
    assert given.words == "robot rover is offline"


@pytest_twisted.ensureDeferred
async def test_a_stop_is_stored_for_a_robot_that_is_offline(fleet: Fleet) -> None:
    """The stop is pending then; resuming needs an owner."""
    ann = await fleet.ann()
    given = await fleet.give(ann, order("stop", why="wet floor"))
    await until(lambda: bool(given.results))
    assert (given.results[0].outcome.ok, given.results[0].outcome.pending) == (True, True)
    given = await fleet.give(ann, order("resume"))
    await until(lambda: bool(given.results))
    assert not given.results[0].outcome.ok
    given = await fleet.give(LOCAL, order("resume"))
    await until(lambda: bool(given.results))
    assert given.results[0].outcome.ok, given.words


@pytest_twisted.ensureDeferred
async def test_caller_that_gives_up_ends_what_has_begun(fleet: Fleet) -> None:
    """Its session ends at once, and its place is free."""
    fleet.world.robot_comes()
    ann = await fleet.ann()
    orders = [await fleet.give(ann, order("call", service="/reset")) for _ in range(module.MAX_ORDERS)]
    await until(lambda: len(fleet.sessions()) == module.MAX_ORDERS)
    refused = await fleet.give(ann, order("call", service="/reset"))
    assert refused.errors == [Unavailable]
    assert not fleet.front.events("fleet.done"), "what is refused has not been done"
    for each in orders:
        each.running.cancel()
    assert not fleet.sessions()
    assert [each.errors for each in orders] == [[CancelledError]] * module.MAX_ORDERS
    again = await fleet.give(ann, order("call", service="/reset"))
    assert not again.errors
    again.running.cancel()
    assert not fleet.service._orders


@pytest_twisted.ensureDeferred
async def test_a_resume_has_as_long_as_a_stop(fleet: Fleet) -> None:
    """The robot continues it after the order's timeout, and the result without an answer does not deny that."""
    fleet.world.robot_comes()
    fleet.world.control.obeys = None
    given = await fleet.give(LOCAL, order("resume", timeout=1))
    await until(lambda: bool(fleet.world.control.all(link.Resume)))
    fleet.world.clock.advance(1.5)
    assert not given.results
    (resume,) = fleet.world.control.all(link.Resume)
    fleet.world.controllers.of(fleet.world.robot).message_received(link.OrderResult(id=resume.id))
    await until(lambda: bool(given.results))
    assert given.results[0].outcome.ok, given.words


@pytest_twisted.ensureDeferred
async def test_a_resume_that_hangs_may_still_happen(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """The result says so."""
    monkeypatch.setattr(fleet.service._fleet_stop, "resume", hangs)
    given = await fleet.give(LOCAL, order("resume", timeout=1))
    await fleet.after(lambda: bool(given.results), 1.0)
    assert given.words == "no answer within 19 s; it may still happen"


@pytest_twisted.ensureDeferred
async def test_a_right_that_is_revoked_ends_an_order(fleet: Fleet) -> None:
    """With the reason; the relay's shutdown does so too."""
    fleet.world.robot_comes()
    ann = await fleet.ann()
    given = await fleet.give(ann, order("call", service="/reset"))
    await until(lambda: bool(fleet.sessions()))
    with fleet.front.store.database.begin() as s:
        queries.revoke_right(s, fleet.front.rover.id, user_id=ann.user_id)
    await fleet.front.access.refresh()
    await until(lambda: bool(given.results))
    assert "revoked" in given.words
    given = await fleet.give(LOCAL, order("call", service="/reset"))
    await until(lambda: bool(fleet.sessions()))
    fleet.front.service.shutdown("the relay is going down")
    await until(lambda: bool(given.results))
    assert given.words == "the relay is going down; it was sent before, and may have been done"
    given = await fleet.give(LOCAL, order("call", service="/reset"))
    await until(lambda: bool(given.results))
    assert given.words == "the relay is going down"


@pytest_twisted.ensureDeferred
async def test_a_long_answer_is_not_passed_on(fleet: Fleet) -> None:
    """A thousand long answers would fill the memory; the result says whether the call succeeded."""
    fleet.world.robot_comes()
    given = await fleet.give(LOCAL, order("call", service="/reset"))
    await fleet.works(given)
    fleet.answers(await fleet.calls(), success=True, message="x" * VALUES_BYTES)
    await until(lambda: bool(given.results))
    assert given.results[0].outcome.ok
    assert given.results[0].outcome.values is None
    assert "64 KiB" in given.words


@pytest_twisted.ensureDeferred
async def test_a_stop_stands_before_everything(fleet: Fleet) -> None:
    """It is sent at once to all online robots, for any number of active orders of the user."""
    fleet.world.robot_comes()
    ann = await fleet.ann()
    orders = [await fleet.give(ann, order("call", service="/reset")) for _ in range(module.MAX_ORDERS)]
    plan = await fleet.service.plan(ann, order("stop", why="fire"), HERE)
    begun: list[None] = []
    given = Deferred.fromCoroutine(
        fleet.service.carry_out(plan, lambda: begun.append(None), lambda result: nothing())
    )
    (stop,) = fleet.world.control.all(link.Stop)
    assert (stop.by, stop.why, begun) == ("ann", "fire", [None])
    await until(lambda: given.called)
    assert not fleet.service._fleet_stop.online(queries.RobotRecord(99, "nowhere", "default", ""))
    for each in orders:
        each.running.cancel()


@pytest.mark.parametrize("who", ["ann", "local"])
@pytest_twisted.ensureDeferred
async def test_no_robot_that_is_here_waits_for_the_database_to_be_stopped(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, who: str
) -> None:
    """This needs a known user. When the database has not answered for some seconds, only these robots are
    selected.
    """
    fleet.world.robot_comes()
    asker = await fleet.ann() if who == "ann" else LOCAL
    if who == "ann":
        await fleet.service.groups(asker)
        fleet.front.access._robots.clear()
        permit = await fleet.front.access.permit(asker, RobotRecord(1, "rover", "default", ""))
        assert permit is not None
        fleet.front.access.release(permit)
    monkeypatch.setattr(fleet.front.store, "read", hangs)
    asked = outcome(fleet.service.plan(asker, order("stop", "*", "group:all", why="fire"), HERE))
    assert [each.why for each in fleet.world.control.all(link.Stop)] == ["fire"]
    assert asked == []
    fleet.world.clock.advance(LOOKUP_SECONDS)
    (plan,) = asked
    assert plan.start == FleetOrderStart("stop", ["rover"], ["group:all"], NOT_LOOKED_UP)
    results: list[TaskResult] = []

    async def report(each: TaskResult) -> None:
        results.append(each)

    given = outcome(fleet.service.carry_out(plan, lambda: None, report))
    await until(lambda: bool(given))
    assert [each.outcome.ok for each in results] == [True]
    assert len(fleet.world.control.all(link.Stop)) == 1


@pytest_twisted.ensureDeferred
async def test_repeated_stops_of_all_do_not_fill_the_audit_log(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each stopped robot is audited by itself; each robot gets every stop."""
    monkeypatch.setattr(module, "STOPS_BURST", 2)
    fleet.service = fleet.new_service()
    fleet.world.robot_comes()
    for _ in range(5):
        given = await fleet.give(LOCAL, order("stop", "rover"))
        await until(lambda given=given: given.running.called)
    await fleet.audit.flush()
    audit = await fleet.front.store.read(queries.list_audit)
    assert [each.action for each in audit].count("fleet.stop") == 2
    assert len(fleet.world.control.all(link.Stop)) == 5


@pytest_twisted.ensureDeferred
async def test_unknown_user_stops_no_robot_without_the_database(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The user gets the error soon. Other orders stop no robot."""
    fleet.world.robot_comes()
    ann = await fleet.ann()
    monkeypatch.setattr(fleet.front.store, "read", hangs)
    asked = [
        outcome(fleet.service.plan(ann, order("stop", "*"), HERE)),
        outcome(fleet.service.plan(LOCAL, order("resume", "*"), HERE, LATER)),
    ]
    fleet.world.clock.advance(LOOKUP_SECONDS)
    assert [str(error) for (error,) in asked] == [NOT_LOOKED_UP] * 2
    assert not fleet.world.control.all(link.Stop)


async def nothing() -> None:
    """Ignores progress."""


@pytest_twisted.ensureDeferred
async def test_controller_may_resume_the_robot(fleet: Fleet) -> None:
    """This includes resuming by an order, which has its own connection; others may not."""
    ann = await fleet.ann()
    fleet.world.robot_comes()
    session = await fleet.front.connected(ann)
    given = await fleet.give(ann, order("stop"))
    await until(lambda: bool(given.results))
    given = await fleet.give(ann, order("resume"))
    await until(lambda: bool(given.results))
    assert given.words == "only the holder of control and the robot's owners may resume it"
    taken = Deferred.fromCoroutine(session.controller.take(session, ""))
    await until(lambda: taken.called)
    given = await fleet.give(ann, order("resume"))
    await until(lambda: bool(given.results))
    assert given.results[0].outcome.ok, given.words
    session.port.end()


@pytest_twisted.ensureDeferred
async def test_a_viewing_token_does_not_resume_by_its_users_control(fleet: Fleet) -> None:
    """Stopping is allowed with any token. With the full scope the user may use their control from anywhere."""
    ann = await fleet.ann()
    fleet.world.robot_comes()
    session = await fleet.front.connected(ann)
    taken = Deferred.fromCoroutine(session.controller.take(session, ""))
    await until(lambda: taken.called)
    looks = await fleet.front.by_token(fleet.front.ann, "viewer")
    assert (await carried_out(fleet, await fleet.service.plan(looks, order("stop"), HERE))).outcome.ok
    result = await carried_out(fleet, await fleet.service.plan(looks, order("resume"), HERE, LATER))
    assert (result.outcome.ok, result.outcome.message) == (
        False,
        "only the holder of control and the robot's owners may resume it",
    )
    assert not fleet.world.control.all(link.Resume)
    drives = await fleet.front.by_token(fleet.front.ann, "operator")
    result = await carried_out(fleet, await fleet.service.plan(drives, order("resume"), HERE, LATER))
    assert result.outcome.ok, result.outcome.message
    session.port.end()


@pytest_twisted.ensureDeferred
async def test_rights_count_as_they_are_when_a_robot_has_its_turn(fleet: Fleet) -> None:
    """A former owner cannot resume it, and a user who has logged out cannot stop an offline robot."""
    ann = await fleet.ann()
    with fleet.front.store.database.begin() as s:
        queries.grant_right(s, fleet.front.rover.id, "owner", user_id=ann.user_id)
    await fleet.front.access.refresh()
    assert (await carried_out(fleet, await fleet.service.plan(ann, order("stop"), HERE))).outcome.pending
    plan = await fleet.service.plan(ann, order("resume"), HERE, LATER)
    with fleet.front.store.database.begin() as s:
        queries.revoke_right(s, fleet.front.rover.id, user_id=ann.user_id)
        queries.grant_right(s, fleet.front.rover.id, "operator", user_id=ann.user_id)
    assert "owners may resume" in (await carried_out(fleet, plan)).outcome.message
    resume, stop = [await fleet.service.plan(ann, order(do), HERE, LATER) for do in ("resume", "stop")]
    fleet.world.record.stops.clear()
    await fleet.front.logins.logout(ann)
    for plan in (resume, stop):
        result = await carried_out(fleet, plan)
        assert (result.outcome.ok, result.outcome.message) == (False, "your session was ended; log in again")
    assert not fleet.world.record.stops
    assert not fleet.front.access._permits


async def carried_out(fleet: Fleet, plan: FleetPlan) -> TaskResult:
    """The result of an order to one robot."""
    results: list[TaskResult] = []

    async def report(result: TaskResult) -> None:
        results.append(result)

    await fleet.service.carry_out(plan, lambda: None, report)
    (result,) = results
    return result


@pytest_twisted.ensureDeferred
async def test_a_stop_counts_where_rights_can_not_be_looked_up_again(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rights of the plan count for stops; resuming needs a new look-up."""
    ann = await fleet.ann()
    stop, resume = [await fleet.service.plan(ann, order(do), HERE, LATER) for do in ("stop", "resume")]

    async def locked(*_: object) -> None:
        raise Unavailable("the database is locked")

    monkeypatch.setattr(fleet.front.access, "permit_by_name", locked)
    assert (await carried_out(fleet, stop)).outcome.pending
    assert (await carried_out(fleet, resume)).outcome.message == "the database is locked"


@pytest_twisted.ensureDeferred
async def test_moving_requests_state_when_they_were_sent(fleet: Fleet) -> None:
    """The order is refused as a whole if that is too long ago for one of them; other orders may be of any
    age.
    """
    ann = await fleet.ann()
    fleet.world.robot_comes()
    moving = link.MotionPolicy(services=["/reset", "/driver/set_parameters"], actions=["/dock"])
    fleet.world.robot.description = link.Describe(motion=moving)
    now, late = fleet.world.now_ns(), (moving.deadline_ms + 1) * 1_000_000
    for do, fields in (
        ("call", {"service": "reset"}),
        ("call", {"service": "/dock/_action/send_goal"}),
        ("set", {"name": "driver:speed", "value": 1}),
    ):
        asked = order(do, **fields)
        with pytest.raises(FreshnessTokenRequired, match="this moves rover: prove that this is fresh"):
            await fleet.service.plan(ann, asked, HERE)
        with pytest.raises(
            FreshnessTokenExpired, match=f"{moving.deadline_ms + 1} ms ago; rover takes nothing older"
        ):
            await fleet.service.plan(ann, asked, HERE, now - late)
        assert (await fleet.service.plan(ann, asked, HERE, now)).robots
    for asked in (order("resume"), order("call", service="relay/resume")):
        with pytest.raises(FreshnessTokenRequired, match="lets robots move again"):
            await fleet.service.plan(ann, asked, HERE)
        assert (await fleet.service.plan(ann, asked, HERE, now - late)).robots
    for asked in (
        order("call", service="/lamp"),
        order("call", service="no name"),
        order("set", name="x:y", value=1),
    ):
        assert (await fleet.service.plan(ann, asked, HERE)).robots


@pytest_twisted.ensureDeferred
async def test_command_too_old_at_its_turn_moves_nothing(fleet: Fleet) -> None:
    """The robots before it took too long; this robot's result says so."""
    fleet.world.robot_comes()
    fleet.world.robot.description = link.Describe(motion=link.MotionPolicy(services=["/reset"]))
    plan = await fleet.service.plan(
        await fleet.ann(), order("call", service="/reset"), HERE, fleet.world.now_ns()
    )
    fleet.world.clock.advance(1.5)
    results: list[TaskResult] = []

    async def report(result: TaskResult) -> None:
        results.append(result)

    await fleet.service.carry_out(plan, lambda: None, report)
    (reported,) = results
    assert not reported.outcome.ok
    assert reported.outcome.message == (
        "the turn of rover came 1500 ms after this was sent, and it takes nothing older than 500 ms; send it "
        "again for this robot"
    )
    assert not fleet.world.control.all(link.ControlGrant)
    assert not fleet.world.link.all(link.CallService)


@pytest_twisted.ensureDeferred
async def test_an_old_order_to_resume_does_not_lift_a_newer_stop(fleet: Fleet) -> None:
    """Nor does one without a time; this includes the service of that name."""
    fleet.world.robot_comes()
    asked = fleet.world.now_ns()
    fleet.world.clock.advance(1)
    vic = Actor("vic", "user:vic", 8)
    await fleet.world.controllers.of(fleet.world.robot).stopping.stop(vic, "a child")
    for given in (order("resume"), order("call", service="/relay/resume")):
        old = await fleet.give(LOCAL, given, ago=(fleet.world.now_ns() - asked) / 1e9)
        await until(lambda old=old: bool(old.results))
        assert "was stopped, or may have been, after you sent this" in old.words
        assert not old.results[0].outcome.ok
    assert not fleet.world.control.all(link.Resume)
    fresh = await fleet.give(LOCAL, order("resume"))
    await until(lambda: bool(fresh.results))
    assert fresh.results[0].outcome.ok
