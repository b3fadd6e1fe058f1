"""Control of a robot by a connection that is kept for who comes by HTTP, on a real database."""

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
from relay_server.control.commands import NotDone
from relay_server.control.controller import RobotController as ControlDesk
from relay_server.control.service import ControlService
from relay_server.control.types import ControlRules
from relay_server.http_sessions.control_requests import GIVEN_BACK, OVER
from relay_server.http_sessions.pool import LINGER_SECONDS, SessionPool
from relay_server.sessions.session import Session
from tests.relay_server.front_desk import HERE, Desk
from tests.relay_server.steering import outcome

ROBOT = "rover"


class Place:
    """A robot with a console in front of it: ann and bob operate it, olga owns it, vic may look, eve knows of none."""

    def __init__(self, front: Desk) -> None:
        self.front = front
        self.world = front.world
        self.guests = SessionPool(self.world.clock, front.desk, self.world.now_ns)
        offices = front.desk, front.access, self.world.desks, self.world.registry, front.store
        self.console = ControlService(self.world.clock, *offices, self.guests)
        self.users = {"ann": front.ann}
        self._principals: dict[str, Principal] = {}
        with front.store.database.begin() as s:
            for name, level in (("bob", "operator"), ("olga", "owner"), ("vic", "viewer"), ("eve", "")):
                self.users[name] = queries.add_user(s, name, None)
                if level:
                    queries.grant_right(s, front.rover.id, level, user_id=self.users[name].id)
        self.world.robot = self.world.registry.presence(front.rover.id, ROBOT, "default")
        self.world.robot_comes()

    @property
    def desk(self) -> ControlDesk:
        """Control of the robot."""
        return self.world.desks.of(self.world.robot)

    @property
    def holder(self) -> str | None:
        """Who has control."""
        tenure = self.desk.lease.holder
        return None if tenure is None else tenure.client.name

    async def principal(self, name: str) -> Principal:
        """Somebody with a token, the same each time."""
        if name not in self._principals:
            self._principals[name] = await self.front.by_token(self.users[name])
        return self._principals[name]

    async def connected(self, name: str) -> Session:
        """Somebody by a websocket."""
        session, _ = await self.front.opens(await self.principal(name))
        return session

    async def holding(self, name: str) -> Session:
        """Somebody who has control by a websocket."""
        session = await self.connected(name)
        assert (await self.desk.take(session, "")).success
        return session

    def passes(self, seconds: float) -> None:
        """Time, in steps between which pings are answered."""
        self.world.clock.pump([0.5] * round(seconds / 0.5))

    async def waits(self, who: Principal, seconds: float = 60.0) -> list[Any]:
        """Somebody asks for control and waits for the answer; what comes of it, when it has come."""
        async with self.guests.at(who, ROBOT, HERE):
            # From here on the database is not waited for.
            pass
        return outcome(self.console.take(who, ROBOT, "let me", HERE, seconds))


@pytest.fixture
def place(front: Desk) -> Place:
    """A place."""
    return Place(front)


@pytest_twisted.ensureDeferred
async def test_a_free_robot_is_taken_and_kept_by_asking_again(place: Place) -> None:
    """By one connection, which is told of; it is over when nothing is asked of it for so long."""
    ann = await place.principal("ann")
    taken = await place.console.take(ann, ROBOT, "delivery", HERE)
    assert taken.answer == (True, "you have control")
    (session,) = place.front.desk
    assert taken.control["holder"]["client"] == taken.control["you"]["client"] == session.number
    assert place.world.record.notes[-1] == ("control.taken", "ann", "delivery", {"how": "taken"})
    for _ in range(3):
        place.passes(LINGER_SECONDS - 1)
        assert (await place.console.take(ann, ROBOT, "", HERE)).answer.success
    assert place.world.record.kinds.count("control.taken") == 1
    place.passes(LINGER_SECONDS)
    assert place.holder is None
    assert place.world.control.all(link.Control)[-1].holder == 0
    assert not list(place.front.desk)


@pytest_twisted.ensureDeferred
async def test_only_who_may_control_takes(place: Place) -> None:
    """Others are refused, and who has no right at all hears of no robot; one that is away has no holder."""
    with pytest.raises(Refused, match="control"):
        await place.console.take(await place.principal("vic"), ROBOT, "", HERE)
    eve, ann = await place.principal("eve"), await place.principal("ann")
    with pytest.raises(NotFound):
        await place.console.take(eve, ROBOT, "", HERE)
    with pytest.raises(NotFound):
        await place.console.let_go(eve, ROBOT, HERE)
    place.world.robot_goes()
    with pytest.raises(Unavailable, match="offline"):
        await place.console.take(ann, ROBOT, "", HERE)
    assert place.holder is None


@pytest_twisted.ensureDeferred
async def test_what_is_held_is_asked_for_and_waited_for(place: Place) -> None:
    """Who grants it ends the wait; so does the end of the time, with the request still there."""
    held, ann = await place.holding("bob"), await place.principal("ann")
    asked = await place.console.take(ann, ROBOT, "delivery", HERE)
    assert not asked.answer.success
    assert asked.control["request"]["why"] == "delivery" and asked.control["request"]["you"]
    late = await place.waits(ann, 5.0)
    place.passes(4.5)
    assert late == []
    place.passes(0.5)
    assert [each.answer.success for each in late] == [False]
    waits = await place.waits(ann)
    place.passes(1)
    place.desk.grant(held, "")
    place.passes(0.5)
    assert [each.answer.success for each in waits] == [True]
    assert place.holder == "ann"


@pytest_twisted.ensureDeferred
async def test_who_waits_gets_what_becomes_free(place: Place) -> None:
    """As whoever asks once more would."""
    held, ann = await place.holding("bob"), await place.principal("ann")
    waits = await place.waits(ann)
    place.passes(1)
    place.desk.release(held, "done")
    place.passes(0.5)
    assert [each.answer.success for each in waits] == [True]
    assert place.holder == "ann"


@pytest_twisted.ensureDeferred
async def test_a_request_that_is_over_is_told_to_be_none(place: Place) -> None:
    """Refused, not answered in time, passed over by an owner, or not even taken, since another's is there."""
    # Whose connection answers pings however long it is.
    guest, _ = await place.guests.keep(await place.principal("bob"), ROBOT, HERE)
    held, ann = guest.session, await place.principal("ann")
    await place.desk.take(held, "")
    refused = await place.waits(ann)
    place.desk.refuse(held, "")
    place.passes(0.5)
    with pytest.raises(Refused, match="has just kept control"):
        await place.console.take(ann, ROBOT, "", HERE)
    place.passes(LINGER_SECONDS)
    ignored = await place.waits(ann, 90.0)
    place.passes(ControlRules().request + 0.5)
    passed_over = await place.waits(ann)
    olga = await place.connected("olga")
    await place.desk.take(olga, "")
    place.passes(0.5)
    for (error,) in (refused, ignored, passed_over):
        assert isinstance(error, NotDone) and str(error) == OVER
    with pytest.raises(NotDone, match="olga asks for it already"):
        await place.console.take(ann, ROBOT, "", HERE)
    assert place.holder == "bob"


@pytest_twisted.ensureDeferred
async def test_it_is_let_go_by_the_same_connection(place: Place) -> None:
    """Control or the request; that of a websocket of the same user is left alone, and nothing is made of nothing."""
    ann, held = await place.principal("ann"), await place.holding("ann")
    await place.console.let_go(ann, ROBOT, HERE)
    assert place.desk.lease.held_by(held)
    assert list(place.front.desk) == [held]
    held.end()
    await place.console.take(ann, ROBOT, "", HERE)
    await place.console.let_go(ann, ROBOT, HERE)
    assert place.holder is None
    await place.holding("bob")
    waits = await place.waits(ann)
    await place.console.let_go(ann, ROBOT, HERE)
    place.passes(0.5)
    assert [str(error) for error in waits] == [GIVEN_BACK]
    assert place.desk.lease.request is None and place.holder == "bob"


@pytest_twisted.ensureDeferred
async def test_who_has_let_go_is_given_nothing_by_what_he_asked_before(place: Place) -> None:
    """Though control was just granted, or has become free meanwhile."""
    held, ann = await place.holding("bob"), await place.principal("ann")
    waits = await place.waits(ann)
    place.desk.grant(held, "")
    await place.console.let_go(ann, ROBOT, HERE)
    place.passes(0.5)
    assert [str(error) for error in waits] == [GIVEN_BACK]
    assert place.holder is None
    held = await place.holding("bob")
    waits = await place.waits(ann)
    await place.console.let_go(ann, ROBOT, HERE)
    place.desk.release(held, "")
    place.passes(0.5)
    assert [str(error) for error in waits] == [GIVEN_BACK]
    assert place.holder is None


@pytest.mark.parametrize("end", ["the token", "its time", "the right", "the relay"])
@pytest_twisted.ensureDeferred
async def test_control_ends_with_what_it_is_had_by(place: Place, end: str) -> None:
    """At once: the robot is told that nobody has it."""
    front = place.front
    ann = replace(await place.principal("ann"), expires=front.wall() + 1)
    await place.console.take(ann, ROBOT, "", HERE)
    if end == "the relay":
        front.desk.say_goodbye("the relay is going down")
    elif end == "its time":
        place.passes(1)
        assert place.holder == "ann"
        front.access.expire()
    elif end == "the token":
        await front.store.write(queries.revoke_token, ann.token_id)
    else:
        with front.store.database.begin() as s:
            queries.grant_right(s, front.rover.id, "viewer", user_id=ann.user_id)
    await front.access.refresh()
    assert place.holder is None
    assert place.world.control.all(link.Control)[-1].holder == 0


@pytest_twisted.ensureDeferred
async def test_who_is_cut_while_he_takes_gets_nothing(place: Place) -> None:
    """Neither what he waits for, nor a robot that becomes free after he has gone."""
    ann = await place.principal("ann")
    held = await place.holding("bob")
    place.world.control.obeys = None
    place.desk.release(held, "")
    asked = await place.waits(ann)
    (session,) = [each for each in place.front.desk if each is not held]
    assert asked == []
    session.close(4403, "your right was revoked")
    (error,) = asked
    assert isinstance(error, SwitchboardError) and "revoked" in str(error)
    (last,) = place.world.control.all(link.Control)[-1:]
    place.desk.told(link.Done(id=last.id, ok=True))
    place.passes(1)
    assert place.desk.lease.holder is None and place.desk.lease.coming is None


def asks(place: Place, who: Principal, seconds: float = 60.0) -> Deferred[Any]:
    """Somebody asks for control and waits; cancelled when he hangs up."""
    asked = Deferred.fromCoroutine(place.console.take(who, ROBOT, "let me", HERE, seconds))
    asked.addErrback(lambda failure: failure.trap(CancelledError))
    return asked


@pytest_twisted.ensureDeferred
async def test_who_leaves_while_he_waits_asks_nobody_any_more(place: Place) -> None:
    """At once, not when his connection ends; what is granted then is given to nobody."""
    held, ann = await place.holding("bob"), await place.principal("ann")
    async with place.guests.at(ann, ROBOT, HERE):
        waits = asks(place, ann)
        assert place.desk.lease.request is not None
        waits.cancel()
        assert place.desk.lease.request is None
    place.desk.grant(held, "")
    assert place.holder == "bob"


@pytest_twisted.ensureDeferred
async def test_who_leaves_while_the_robot_is_told_has_no_control(place: Place) -> None:
    """Neither then nor when the robot has answered."""
    ann = await place.principal("ann")
    async with place.guests.at(ann, ROBOT, HERE):
        place.world.control.obeys = None
        waits = asks(place, ann)
        coming = place.desk.lease.coming
        assert coming is not None and coming.client.name == "ann"
        waits.cancel()
        for order in place.world.control.all(link.Control):
            place.desk.told(link.Done(id=order.id, ok=True))
        place.passes(1)
        assert place.holder is None and place.desk.lease.coming is None


@pytest_twisted.ensureDeferred
async def test_who_asks_again_is_not_undone_by_what_he_left(place: Place) -> None:
    """Nor by leaving is anything lost of which he was told before."""
    await place.holding("bob")
    ann = await place.principal("ann")
    async with place.guests.at(ann, ROBOT, HERE):
        first, again = asks(place, ann), asks(place, ann, 5.0)
        first.cancel()
        assert place.desk.lease.request is not None
        place.passes(5)
        assert not (await again).answer.success
        later = asks(place, ann)
        later.cancel()
        assert place.desk.lease.request is not None


@pytest_twisted.ensureDeferred
async def test_who_lets_go_before_he_is_let_in_gets_nothing(place: Place) -> None:
    """The database is slow; his request to give control back overtakes the one for it."""
    ann = await place.principal("ann")
    asked = Deferred.fromCoroutine(place.console.take(ann, ROBOT, "", HERE))
    assert place.guests.there(ann, ROBOT) is None
    await place.console.let_go(ann, ROBOT, HERE)
    with pytest.raises(NotDone, match="given back"):
        await asked
    assert place.holder is None and place.desk.lease.coming is None
