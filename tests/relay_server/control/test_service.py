"""Control for users without a connection, and on the relay's own machine, with a real database."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted

from relay_db import queries
from relay_db.queries import RobotRecord
from relay_protocol import link
from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_server.access import LOOKUP_SECONDS, Principal
from relay_server.common.errors import NotDone
from relay_server.control.actor import Actor
from relay_server.control.gateway import NOT_ALL_KNOWN, ControlGateway
from relay_server.control.service import CONFIRM_SECONDS, NOT_CONFIRMED, NoControl
from relay_server.control.types import ControlReply
from relay_server.fleet.task import FleetStop
from relay_server.in_process_sessions.pool import InProcessSessionPool
from tests.worlds.control import outcome, result, stopped_by
from tests.worlds.relay import Person, hangs
from tests.worlds.session_manager import HERE, SessionsWorld

ROBOT = "rover"
LATER = 1 << 62
"""Sent after all there was."""


class ControlWorld:
    """A session manager with three users, and the control service."""

    def __init__(self, front: SessionsWorld) -> None:
        self.front = front
        self.world = front.world
        self.pool = InProcessSessionPool(self.world.clock, front.service)
        self.console = ControlGateway(
            self.world.clock,
            self.world.control_service,
            sessions=front.service,
            access=front.access,
            registry=self.world.registry,
            database=front.store,
            in_process_sessions=self.pool,
        )
        with front.store.database.begin() as s:
            self.users = {}
            for name, level in (("olga", "owner"), ("vic", "viewer"), ("eve", "")):
                self.users[name] = queries.add_user(s, name, None)
                if level:
                    queries.grant_right(s, self.front.rover.id, level, user_id=self.users[name].id)
        self.users["ann"] = self.front.ann

    async def principal(self, name: str, scope: str | None = None) -> Principal:
        """A user with a token."""
        return await self.front.by_token(self.users[name], scope)

    def robot_comes(self) -> None:
        """The robot in the database registers."""
        robot = self.world.registry.robot(self.front.rover.id, ROBOT, "default")
        self.world.robot = robot
        self.world.robot_comes()


@pytest.fixture
def scene(front: SessionsWorld) -> ControlWorld:
    """A new world."""
    return ControlWorld(front)


@pytest_twisted.ensureDeferred
async def test_every_user_with_a_right_may_stop_and_owners_may_resume(scene: ControlWorld) -> None:
    """A user without a right gets the error that there is no such robot."""
    scene.robot_comes()
    console = scene.console
    vic, olga, eve = [await scene.principal(name) for name in ("vic", "olga", "eve")]
    assert (await console.stop(vic, ROBOT, "smoke", HERE)).done is True
    with pytest.raises(NotFound):
        await console.stop(eve, ROBOT, "", HERE)
    with pytest.raises(Refused, match="only the holder of control"):
        await console.resume(vic, ROBOT, "", HERE, LATER)
    await console.resume(olga, ROBOT, "all clear", HERE, LATER)
    assert [type(each) for each in scene.world.control.said] == [link.Stop, link.Resume]
    assert [note[:2] for note in scene.world.record.notes] == [
        ("robot.stopped", "vic"),
        ("robot.resumed", "olga"),
    ]


@pytest_twisted.ensureDeferred
async def test_a_stop_by_all_paths_with_one_id_is_one_stop(scene: ControlWorld) -> None:
    """By websocket, HTTP and fleet order: one event, one alert, and one audit entry."""
    scene.robot_comes()
    vic, record = await scene.principal("vic"), scene.world.record
    person = Person(*(await scene.front.opens(vic)))
    fleet = FleetStop(scene.world.control_service, scene.world.registry)
    for stop_id, events in (("press-1", 1), ("press-2", 2)):
        args = {"why": "smoke", "stop_id": stop_id}
        person.says("call_service", id=stop_id, service="/relay/stop", args=args)
        assert person.received("service_response")[-1]["values"]["done"] is True
        assert (await scene.console.stop(vic, ROBOT, "smoke", HERE, stop_id)).done
        row = RobotRecord(scene.front.rover.id, ROBOT, "default", "")
        actor = Actor("vic", "user:vic", vic.user_id, HERE)
        assert (await fleet.stop(row, actor, "smoke", stop_id)).ok
        assert (record.stop_events, record.kinds) == (events, ["robot.stopped"] * events)
    assert len(scene.world.control.all(link.Stop)) == 6


@pytest_twisted.ensureDeferred
async def test_a_stop_that_comes_twice_by_the_admin_socket_is_one_stop(scene: ControlWorld) -> None:
    """The same id by a network user is another stop."""
    scene.robot_comes()
    for events, by in enumerate(["root", "root", "ann"], 1):
        await scene.console.stop_locally(ROBOT, "smoke", by, "press-1")
        assert scene.world.record.stop_events == min(events, 1 + (by == "ann"))
    await scene.console.stop(await scene.principal("vic"), ROBOT, "smoke", HERE, "press-1")
    assert scene.world.record.stop_events == 3


@pytest_twisted.ensureDeferred
async def test_a_robot_that_is_away_will_be_stopped(scene: ControlWorld) -> None:
    """All users with a right on it see this."""
    vic = await scene.principal("vic")
    outcome = await scene.console.stop(vic, ROBOT, "smoke", HERE)
    assert outcome.done is False
    assert outcome.stopped is not None
    assert outcome.stopped["confirmed"] is False
    (robot,) = await scene.front.service.overview.robots(vic)
    assert (robot["holder"], robot["stopped"]["why"]) == (None, "smoke")


@pytest_twisted.ensureDeferred
async def test_users_act_for_all_of_their_connections(scene: ControlWorld) -> None:
    """Control of one connection can be released, handed over and kept by another of the same user."""
    scene.robot_comes()
    console, ann, olga = scene.console, (await scene.principal("ann")), (await scene.principal("olga"))
    session = await scene.front.connected(ann)
    controller = scene.world.controllers.of(scene.world.robot)
    assert (await controller.take(session, "")).success
    reported = await console.control(ann, ROBOT, HERE)
    assert reported["holder"]["you"] is True
    assert reported["you"] == {"client": session.number, "may_control": True, "may_resume": True}
    assert (await console.control(olga, ROBOT, HERE))["you"]["client"] is None
    with pytest.raises(NoControl, match="you have no control of this robot"):
        await console.grant(olga, ROBOT, "", HERE)
    with pytest.raises(NotDone, match="there is no request for control"):
        await console.refuse(ann, ROBOT, "", HERE)
    assert (await console.release(ann, ROBOT, "done", HERE)).success
    assert controller.lease.holder is None


@pytest_twisted.ensureDeferred
async def test_a_viewing_token_does_nothing_with_its_users_control(scene: ControlWorld) -> None:
    """It neither releases control nor resumes the robot. Stopping needs no scope."""
    scene.robot_comes()
    console, viewing = scene.console, (await scene.principal("ann", "viewer"))
    session = await scene.front.connected(await scene.principal("ann"))
    controller = scene.world.controllers.of(scene.world.robot)
    assert (await controller.take(session, "")).success
    for do in (console.release, console.grant, console.refuse):
        with pytest.raises(NoControl, match="you have no control of this robot"):
            await do(viewing, ROBOT, "", HERE)
    assert (await console.stop(viewing, ROBOT, "smoke", HERE)).done is True
    with pytest.raises(Refused, match="may resume it"):
        await console.resume(viewing, ROBOT, "", HERE, LATER)
    assert controller.lease.holder is not None


@pytest_twisted.ensureDeferred
async def test_an_owner_takes_control_from_any_client(scene: ControlWorld) -> None:
    """Others cannot. The audit entry names the owner."""
    scene.robot_comes()
    console = scene.console
    ann, olga, vic = [await scene.principal(name) for name in ("ann", "olga", "vic")]
    session = await scene.front.connected(ann)
    controller = scene.world.controllers.of(scene.world.robot)
    await controller.take(session, "")
    with pytest.raises(NoControl):
        await console.release(vic, ROBOT, "", HERE)
    assert (await console.release(olga, ROBOT, "enough", HERE)).success
    assert controller.lease.holder is None
    assert scene.world.record.notes[-1] == ("control.released", "olga", "enough", {"of": "ann"})
    assert scene.world.record.actors[-1] == ("olga", "user:olga", olga.user_id, HERE, 0)


@pytest_twisted.ensureDeferred
async def test_a_control_request_of_an_owner_takes_control_from_the_holder(
    scene: ControlWorld,
) -> None:
    """The owner's request ends too. A release by others only withdraws their own request."""
    scene.robot_comes()
    console, (ann, olga) = scene.console, [await scene.principal(name) for name in ("ann", "olga")]
    holds, asks = await scene.front.connected(ann), await scene.front.connected(olga)
    controller = scene.world.controllers.of(scene.world.robot)
    await controller.take(holds, "")
    assert not (await controller.take(asks, "")).success
    assert (await console.release(olga, ROBOT, "enough", HERE)) == ControlReply(True, "control is released")
    assert controller.lease.holder is None
    assert controller.lease.request is None
    await controller.take(asks, "")
    await controller.take(holds, "")
    assert (await console.release(ann, ROBOT, "", HERE)) == ControlReply(
        True, "your request for control is withdrawn"
    )
    assert controller.lease.held_by(asks)


@pytest_twisted.ensureDeferred
async def test_suppressed_topic_obeys_all_connections_of_the_caller(scene: ControlWorld) -> None:
    """Without a connection of the caller no client may command it. It needs the right."""
    scene.robot_comes()
    console, ann, olga = scene.console, (await scene.principal("ann")), (await scene.principal("olga"))
    await console.suppress(olga, ROBOT, "/cmd_vel", 100, HERE)
    first, second = await scene.front.connected(olga), await scene.front.connected(olga)
    await console.suppress(olga, ROBOT, "/cmd_vel", 100, HERE)
    await console.inhibit(olga, ROBOT, "/scan", 1000, True, HERE)
    with pytest.raises(Refused, match="needs the level owner"):
        await console.suppress(ann, ROBOT, "/cmd_vel", 100, HERE)
    suppressed = scene.world.control.all(link.Suppress)
    assert [each.sources for each in suppressed] == [[], [first.number, second.number]]


@pytest_twisted.ensureDeferred
async def test_inhibition_ends_with_the_callers_right(scene: ControlWorld) -> None:
    """The robot is notified when the right is revoked; no state is left when the time is over."""
    scene.robot_comes()
    olga, access = await scene.principal("olga"), scene.front.access
    await scene.console.inhibit(olga, ROBOT, "/scan", 1000, False, HERE)
    scene.world.clock.advance(2)
    assert not access._permits
    await scene.console.inhibit(olga, ROBOT, "/scan", 60_000, False, HERE)
    with scene.front.store.database.begin() as s:
        queries.revoke_right(s, scene.front.rover.id, user_id=olga.user_id)
    await access.refresh()
    assert [each.ms for each in scene.world.control.all(link.Inhibit)] == [1000, 60_000, 0]
    assert not access._permits


@pytest_twisted.ensureDeferred
async def test_on_the_relays_own_machine_all_robots_are_stopped(scene: ControlWorld) -> None:
    """Online robots stop at once, others when they connect. A resume withdraws stops that were not sent."""
    scene.robot_comes()
    reported = await scene.console.stop_locally(None, "fire", "root")
    assert reported == (
        [
            {"robot": "hidden", "done": False, "stopped": stopped_by("root", "fire", confirmed=False)},
            {"robot": ROBOT, "done": True, "stopped": stopped_by("root", "fire")},
        ],
        "",
    )
    assert scene.world.record.notes[0][1] == "root"
    await scene.console.resume_locally("hidden", "", "root", LATER)
    assert scene.world.record.stops == {}
    with pytest.raises(NotFound, match="there is no robot 'mule'"):
        await scene.console.stop_locally("mule", "", "root")
    scene.world.record.fails = Unavailable("the database is locked")
    ((failed,), _) = await scene.console.stop_locally("hidden", "", "root")
    assert failed["done"] is False
    assert "cannot be stored" in failed["reason"]


class Hung:
    """A database that never answers."""

    def __init__(self, scene: ControlWorld, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(scene.front.store, "read", hangs)
        monkeypatch.setattr(scene.front.store, "write", hangs)


@pytest_twisted.ensureDeferred
async def test_known_user_stops_a_robot_without_the_database(
    scene: ControlWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A known user was admitted since the last change of rights, or has an open session."""
    scene.robot_comes()
    vic = await scene.principal("vic")
    await scene.console.control(vic, ROBOT, HERE)
    ann = await scene.principal("ann")
    session = await scene.front.connected(ann)
    await scene.front.access.refresh()
    await scene.console.control(vic, ROBOT, HERE)
    Hung(scene, monkeypatch)
    for who in (vic, ann):
        assert result(scene.console.stop(who, ROBOT, "smoke", HERE)).done
    assert [order.by for order in scene.world.control.all(link.Stop)] == ["vic", "ann"]
    session.port.end()


@pytest_twisted.ensureDeferred
async def test_unknown_user_is_answered_soon_without_the_database(
    scene: ControlWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error has a reason, and no robot is stopped; a right that may have been revoked does not count."""
    scene.robot_comes()
    vic, eve = await scene.principal("vic"), await scene.principal("eve")
    await scene.console.control(vic, ROBOT, HERE)
    await scene.front.access.refresh()
    Hung(scene, monkeypatch)
    asked = [outcome(scene.console.stop(who, ROBOT, "", HERE)) for who in (vic, eve)]
    scene.world.clock.advance(LOOKUP_SECONDS - 0.1)
    assert asked == [[], []]
    scene.world.clock.advance(0.1)
    for (error,) in asked:
        assert isinstance(error, Unavailable)
        assert "by 'switchboard stop' on the relay's machine" in str(error)
    assert not scene.world.control.all(link.Stop)
    assert not scene.front.access._permits


@pytest_twisted.ensureDeferred
async def test_on_the_relays_own_machine_no_robot_that_is_here_waits_for_the_database(
    scene: ControlWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This holds for a named robot and for all; the result says that others could not be looked up."""
    scene.robot_comes()
    Hung(scene, monkeypatch)
    done = {"robot": ROBOT, "done": True, "stopped": stopped_by("root", "fire")}
    assert result(scene.console.stop_locally(ROBOT, "fire", "root")) == ([done], "")
    asked = outcome(scene.console.stop_locally(None, "fire", "root"))
    assert len(scene.world.control.all(link.Stop)) == 2
    scene.world.clock.advance(LOOKUP_SECONDS)
    ((robots, missed),) = asked
    assert [(each["robot"], each["done"]) for each in robots] == [(ROBOT, True)]
    assert missed == NOT_ALL_KNOWN
    unknown = outcome(scene.console.stop_locally("mule", "", "root"))
    scene.world.clock.advance(LOOKUP_SECONDS)
    assert isinstance(unknown[0], Unavailable)


@pytest_twisted.ensureDeferred
async def test_a_stop_that_is_neither_confirmed_nor_stored_fails(scene: ControlWorld) -> None:
    """It must not wait as long as a database hangs."""
    vic = await scene.principal("vic")
    await scene.console.control(vic, ROBOT, HERE)
    scene.world.record.hold = True
    asked = outcome(scene.console.stop(vic, ROBOT, "", HERE))
    scene.world.clock.advance(CONFIRM_SECONDS)
    assert [str(error) for error in asked] == [NOT_CONFIRMED]


@pytest_twisted.ensureDeferred
async def test_a_robot_that_does_not_come_to_an_end_holds_up_no_answer_about_the_others(
    scene: ControlWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For example an offline robot whose order waits for a hanging database."""

    async def no_others(*_: Any) -> list[Any]:
        return []

    monkeypatch.setattr(scene.front.store, "read", no_others)
    hidden = scene.world.registry.robot(2, "hidden", "default")
    assert hidden.control_link is None
    scene.robot_comes()
    scene.world.record.hold = True
    asked = outcome(scene.console.stop_locally(None, "fire", "root"))
    scene.world.clock.advance(CONFIRM_SECONDS - 0.1)
    assert asked == []
    scene.world.clock.advance(0.1)
    late = {"robot": "hidden", "done": False, "reason": NOT_CONFIRMED}
    assert asked == [([late, {"robot": ROBOT, "done": True, "stopped": stopped_by("root", "fire")}], "")]


@pytest_twisted.ensureDeferred
async def test_a_partial_stop_is_reported_as_stopped_by_every_path(scene: ControlWorld) -> None:
    scene.robot_comes()
    vic = await scene.principal("vic")
    controller = scene.world.controllers.of(scene.world.robot)
    scene.world.control.obeys = lambda order: controller.message_received(
        link.OrderResult(id=order.id, ok=False, reason="no contactor")
    )
    stopped = await scene.console.stop(vic, ROBOT, "smoke", HERE)
    words = "robot rover is stopped, but a part of the stop failed: no contactor"
    assert (stopped.done, stopped.sentence(ROBOT)) == (False, words)
    assert stopped.stopped == stopped_by("vic", "smoke", confirmed=False)
    person = Person(*(await scene.front.opens(vic)))
    person.says("call_service", id="stop", service="/relay/stop", args={"why": "smoke", "stop_id": "1"})
    values = person.received("service_response")[-1]["values"]
    assert (values["success"], values["done"], values["message"]) == (False, False, words)
    assert values["stopped"]["by"] == "vic"
    ((local,), _) = await scene.console.stop_locally(ROBOT, "", "root")
    assert (local["done"], local["reason"], local["stopped"]["by"]) == (False, words, "root")
    fleet = FleetStop(scene.world.control_service, scene.world.registry)
    row = RobotRecord(scene.front.rover.id, ROBOT, "default", "")
    outcome_of_order = await fleet.stop(row, Actor("vic", "user:vic", vic.user_id, HERE), "", "")
    assert (outcome_of_order.ok, outcome_of_order.pending, outcome_of_order.message) == (False, False, words)


@pytest_twisted.ensureDeferred
async def test_an_admission_is_released(scene: ControlWorld) -> None:
    """No permit is left open for any result."""
    vic = await scene.principal("vic")
    for work in (
        scene.console.control(vic, ROBOT, HERE),
        scene.console.resume(vic, ROBOT, "", HERE, LATER),
        scene.console.suppress(vic, ROBOT, "/x", 100, HERE),
    ):
        try:
            await work
        except Refused:
            continue
    assert not scene.front.access._permits
