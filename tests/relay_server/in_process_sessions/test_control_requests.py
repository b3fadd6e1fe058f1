"""Control of a robot over a pooled connection of HTTP requests, with a real database."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import pytest_twisted
from twisted.internet.defer import CancelledError, Deferred

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from relay_server.access import Principal
from relay_server.common.errors import NotDone
from relay_server.control.controller import RobotController as ControlDesk
from relay_server.control.gateway import ControlGateway
from relay_server.control.types import ControlRules
from relay_server.in_process_sessions.control_requests import OVER, RELEASED
from relay_server.in_process_sessions.pool import LINGER_SECONDS, InProcessSessionPool, RobotCaller
from relay_server.sessions.context import ClientContext
from tests.worlds.control import outcome
from tests.worlds.session_manager import HERE, SessionsWorld

ROBOT = "rover"


class ControlWorld:
    """A robot with a control service: ann and bob operate it, olga owns it, vic may view it, eve has no
    right.
    """

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
        self.users = {"ann": front.ann}
        self._principals: dict[str, Principal] = {}
        with front.store.database.begin() as s:
            for name, level in (("bob", "operator"), ("olga", "owner"), ("vic", "viewer"), ("eve", "")):
                self.users[name] = queries.add_user(s, name, None)
                if level:
                    queries.grant_right(s, front.rover.id, level, user_id=self.users[name].id)
        self.world.robot = self.world.registry.robot(front.rover.id, ROBOT, "default")
        self.world.robot_comes()

    @property
    def service(self) -> ControlDesk:
        """Control of the robot."""
        return self.world.controllers.of(self.world.robot)

    @property
    def holder(self) -> str | None:
        """The controller's name."""
        tenure = self.service.lease.holder
        return None if tenure is None else tenure.client.name

    async def principal(self, name: str) -> Principal:
        """A user with a token; later calls return the same."""
        if name not in self._principals:
            self._principals[name] = await self.front.by_token(self.users[name])
        return self._principals[name]

    async def connected(self, name: str) -> ClientContext:
        """A user's websocket session."""
        return await self.front.connected(await self.principal(name))

    async def holding(self, name: str) -> ClientContext:
        """A user with control by a websocket."""
        session = await self.connected(name)
        assert (await self.service.take(session, "")).success
        return session

    def passes(self, seconds: float) -> None:
        """Lets time pass in steps, with answered pings."""
        self.world.clock.pump([0.5] * round(seconds / 0.5))

    async def waits(self, who: Principal, seconds: float = 60.0) -> list[Any]:
        """A user asks for control and waits; the result, once it exists."""
        async with self.pool.at(RobotCaller(who, ROBOT, HERE)):
            # From here on no step waits for the database.
            pass
        return outcome(self.console.take(who, ROBOT, "let me", HERE, seconds))


@pytest.fixture
def scene(front: SessionsWorld) -> ControlWorld:
    """A new scene."""
    return ControlWorld(front)


@pytest_twisted.ensureDeferred
async def test_a_free_robot_is_taken_and_kept_by_asking_again(scene: ControlWorld) -> None:
    """The connection is listed, and ends when it was idle for long enough."""
    ann = await scene.principal("ann")
    taken = await scene.console.take(ann, ROBOT, "delivery", HERE)
    assert taken.answer == (True, "you have control")
    (session,) = scene.front.service
    assert taken.control["holder"]["client"] == taken.control["you"]["client"] == session.number
    assert scene.world.record.notes[-1] == ("control.taken", "ann", "delivery", {"how": "taken"})
    for _ in range(3):
        scene.passes(LINGER_SECONDS - 1)
        assert (await scene.console.take(ann, ROBOT, "", HERE)).answer.success
    assert scene.world.record.kinds.count("control.taken") == 1
    scene.passes(LINGER_SECONDS)
    assert scene.holder is None
    assert scene.world.control.all(link.ControlGrant)[-1].holder == 0
    assert not list(scene.front.service)


@pytest_twisted.ensureDeferred
async def test_acquiring_control_needs_the_right(scene: ControlWorld) -> None:
    """A user without any right gets the error for an unknown robot; an offline robot has no controller."""
    with pytest.raises(Refused, match="control"):
        await scene.console.take(await scene.principal("vic"), ROBOT, "", HERE)
    eve, ann = await scene.principal("eve"), await scene.principal("ann")
    with pytest.raises(NotFound):
        await scene.console.take(eve, ROBOT, "", HERE)
    with pytest.raises(NotFound):
        await scene.console.release_own(eve, ROBOT, HERE)
    scene.world.robot_goes()
    with pytest.raises(Unavailable, match="offline"):
        await scene.console.take(ann, ROBOT, "", HERE)
    assert scene.holder is None


@pytest_twisted.ensureDeferred
async def test_control_of_held_robot_is_requested_and_awaited(scene: ControlWorld) -> None:
    """A grant ends the wait; the timeout ends it too, and the request stays."""
    held, ann = await scene.holding("bob"), await scene.principal("ann")
    asked = await scene.console.take(ann, ROBOT, "delivery", HERE)
    assert not asked.answer.success
    assert asked.control["request"]["why"] == "delivery" and asked.control["request"]["you"]
    late = await scene.waits(ann, 5.0)
    scene.passes(4.5)
    assert late == []
    scene.passes(0.5)
    assert [each.answer.success for each in late] == [False]
    waits = await scene.waits(ann)
    scene.passes(1)
    scene.service.grant(held, "")
    scene.passes(0.5)
    assert [each.answer.success for each in waits] == [True]
    assert scene.holder == "ann"


@pytest_twisted.ensureDeferred
async def test_waiting_user_gets_released_control(scene: ControlWorld) -> None:
    """The same as for a repeated request."""
    held, ann = await scene.holding("bob"), await scene.principal("ann")
    waits = await scene.waits(ann)
    scene.passes(1)
    scene.service.release(held, "done")
    scene.passes(0.5)
    assert [each.answer.success for each in waits] == [True]
    assert scene.holder == "ann"


@pytest_twisted.ensureDeferred
async def test_a_request_that_is_over_is_unknown(scene: ControlWorld) -> None:
    """It may be refused, expired, replaced by an owner, or not accepted because of another request."""
    # This connection answers all pings.
    pooled, _ = await scene.pool.keep(RobotCaller(await scene.principal("bob"), ROBOT, HERE))
    held, ann = pooled.client, await scene.principal("ann")
    await scene.service.take(held, "")
    refused = await scene.waits(ann)
    scene.service.refuse(held, "")
    scene.passes(0.5)
    with pytest.raises(Refused, match="has just kept control"):
        await scene.console.take(ann, ROBOT, "", HERE)
    scene.passes(LINGER_SECONDS)
    ignored = await scene.waits(ann, 90.0)
    scene.passes(ControlRules().request + 0.5)
    passed_over = await scene.waits(ann)
    olga = await scene.connected("olga")
    await scene.service.take(olga, "")
    scene.passes(0.5)
    for (error,) in (refused, ignored, passed_over):
        assert isinstance(error, NotDone) and str(error) == OVER
    with pytest.raises(NotDone, match="olga asks for it already"):
        await scene.console.take(ann, ROBOT, "", HERE)
    assert scene.holder == "bob"


@pytest_twisted.ensureDeferred
async def test_control_is_released_by_the_same_connection(scene: ControlWorld) -> None:
    """Control or the request; a websocket of the same user keeps its control, and releasing nothing has no
    effect.
    """
    ann, held = await scene.principal("ann"), await scene.holding("ann")
    await scene.console.release_own(ann, ROBOT, HERE)
    assert scene.service.lease.held_by(held)
    assert list(scene.front.service) == [held]
    held.port.end()
    await scene.console.take(ann, ROBOT, "", HERE)
    await scene.console.release_own(ann, ROBOT, HERE)
    assert scene.holder is None
    await scene.holding("bob")
    waits = await scene.waits(ann)
    await scene.console.release_own(ann, ROBOT, HERE)
    scene.passes(0.5)
    assert [str(error) for error in waits] == [RELEASED]
    assert scene.service.lease.request is None and scene.holder == "bob"


@pytest_twisted.ensureDeferred
async def test_released_control_is_not_granted_by_an_earlier_request(scene: ControlWorld) -> None:
    """Control may just have been granted, or the robot may have become free."""
    held, ann = await scene.holding("bob"), await scene.principal("ann")
    waits = await scene.waits(ann)
    scene.service.grant(held, "")
    await scene.console.release_own(ann, ROBOT, HERE)
    scene.passes(0.5)
    assert [str(error) for error in waits] == [RELEASED]
    assert scene.holder is None
    held = await scene.holding("bob")
    waits = await scene.waits(ann)
    await scene.console.release_own(ann, ROBOT, HERE)
    scene.service.release(held, "")
    scene.passes(0.5)
    assert [str(error) for error in waits] == [RELEASED]
    assert scene.holder is None


@pytest.mark.parametrize("end", ["the token", "its time", "the right", "the relay"])
@pytest_twisted.ensureDeferred
async def test_control_ends_with_what_it_is_had_by(scene: ControlWorld, end: str) -> None:
    """At once: the robot is notified that it has no controller."""
    front = scene.front
    ann = replace(await scene.principal("ann"), expires=front.wall() + 1)
    await scene.console.take(ann, ROBOT, "", HERE)
    if end == "the relay":
        front.service.shutdown("the relay is going down")
    elif end == "its time":
        scene.passes(1)
        assert scene.holder == "ann"
        front.access.expire()
    elif end == "the token":
        await front.store.write(queries.revoke_token, ann.token_id)
    else:
        with front.store.database.begin() as s:
            queries.grant_right(s, front.rover.id, "viewer", user_id=ann.user_id)
    await front.access.refresh()
    assert scene.holder is None
    assert scene.world.control.all(link.ControlGrant)[-1].holder == 0


@pytest_twisted.ensureDeferred
async def test_connection_cut_during_a_take_gets_no_control(scene: ControlWorld) -> None:
    """Neither by the pending request, nor by a robot that becomes free later."""
    ann = await scene.principal("ann")
    held = await scene.holding("bob")
    scene.world.control.obeys = None
    scene.service.release(held, "")
    asked = await scene.waits(ann)
    (session,) = [each for each in scene.front.service if each is not held]
    assert asked == []
    session.close(4403, "your right was revoked")
    (error,) = asked
    assert isinstance(error, SwitchboardError) and "revoked" in str(error)
    (last,) = scene.world.control.all(link.ControlGrant)[-1:]
    scene.service.message_received(link.OrderResult(id=last.id, ok=True))
    scene.passes(1)
    assert scene.service.lease.holder is None and scene.service.lease.pending_holder is None


def asks(scene: ControlWorld, who: Principal, seconds: float = 60.0) -> Deferred[Any]:
    """A user asks for control and waits; the request is cancelled when the user disconnects."""
    asked = Deferred.fromCoroutine(scene.console.take(who, ROBOT, "let me", HERE, seconds))
    asked.addErrback(lambda failure: failure.trap(CancelledError))
    return asked


@pytest_twisted.ensureDeferred
async def test_gone_client_withdraws_its_control_request(scene: ControlWorld) -> None:
    """At once, before the connection ends; a later grant has no effect."""
    held, ann = await scene.holding("bob"), await scene.principal("ann")
    async with scene.pool.at(RobotCaller(ann, ROBOT, HERE)):
        waits = asks(scene, ann)
        assert scene.service.lease.request is not None
        waits.cancel()
        assert scene.service.lease.request is None
    scene.service.grant(held, "")
    assert scene.holder == "bob"


@pytest_twisted.ensureDeferred
async def test_client_that_leaves_during_a_take_has_no_control(scene: ControlWorld) -> None:
    """Neither then nor after the robot's answer."""
    ann = await scene.principal("ann")
    async with scene.pool.at(RobotCaller(ann, ROBOT, HERE)):
        scene.world.control.obeys = None
        waits = asks(scene, ann)
        coming = scene.service.lease.pending_holder
        assert coming is not None and coming.client.name == "ann"
        waits.cancel()
        for order in scene.world.control.all(link.ControlGrant):
            scene.service.message_received(link.OrderResult(id=order.id, ok=True))
        scene.passes(1)
        assert scene.holder is None and scene.service.lease.pending_holder is None


@pytest_twisted.ensureDeferred
async def test_new_request_is_not_undone_by_an_abandoned_one(scene: ControlWorld) -> None:
    """An earlier result that the user received stays valid."""
    await scene.holding("bob")
    ann = await scene.principal("ann")
    async with scene.pool.at(RobotCaller(ann, ROBOT, HERE)):
        first, again = asks(scene, ann), asks(scene, ann, 5.0)
        first.cancel()
        assert scene.service.lease.request is not None
        scene.passes(5)
        assert not (await again).answer.success
        later = asks(scene, ann)
        later.cancel()
        assert scene.service.lease.request is not None


@pytest_twisted.ensureDeferred
async def test_release_before_the_grant_cancels_it(scene: ControlWorld) -> None:
    """The database is slow, so the release overtakes the request."""
    ann = await scene.principal("ann")
    asked = Deferred.fromCoroutine(scene.console.take(ann, ROBOT, "", HERE))
    assert scene.pool.find(ann, ROBOT) is None
    await scene.console.release_own(ann, ROBOT, HERE)
    with pytest.raises(NotDone, match="released"):
        await asked
    assert scene.holder is None and scene.service.lease.pending_holder is None
