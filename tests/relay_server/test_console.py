"""Control for users without a connection, and on the relay's own machine, on a real database."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_server.access import Principal
from relay_server.console import Console
from relay_server.control import Answer
from relay_server.store import Store
from tests.relay_server.test_frontdesk import HERE, Desk

ROBOT = "rover"


class Place:
    """A front desk with three users, and the console in front of it."""

    def __init__(self, store: Store) -> None:
        self.made = Desk(store)
        self.world = self.made.world
        self.console = Console(self.made.desk, self.world.desks, self.world.registry, store)
        with store.database.begin() as s:
            self.users = {}
            for name, level in (("olga", "owner"), ("vic", "viewer"), ("eve", "")):
                self.users[name] = queries.add_user(s, name, None)
                if level:
                    queries.grant_right(s, self.made.rover.id, level, user_id=self.users[name].id)
        self.users["ann"] = self.made.ann

    async def principal(self, name: str) -> Principal:
        """Somebody with a token."""
        user = self.users[name]
        token = f"token of {name}"
        await self.made.store.write(
            queries.create_token,
            user.id,
            hashlib.sha256(token.encode()).hexdigest(),
            kind="access",
            label="",
            expires=None,
            now=1000.0,
        )
        return await self.made.desk.token(token)

    def robot_comes(self) -> None:
        """The robot that the database knows registers."""
        robot = self.world.registry.presence(self.made.rover.id, ROBOT, "default")
        self.world.robot = robot
        self.world.robot_comes()


@pytest.fixture
def place(store: Store) -> Iterator[Place]:
    """A place."""
    made = Place(store)
    yield made
    made.made.auth.stop()


@pytest_twisted.ensureDeferred
async def test_everybody_with_a_right_stops_and_owners_resume(place: Place) -> None:
    """A stranger hears that there is no such robot."""
    place.robot_comes()
    console = place.console
    vic, olga, eve = [await place.principal(name) for name in ("vic", "olga", "eve")]
    assert (await console.stop(vic, ROBOT, "smoke", HERE)).done is True
    with pytest.raises(NotFound):
        await console.stop(eve, ROBOT, "", HERE)
    with pytest.raises(Refused, match="only who has control"):
        await console.resume(vic, ROBOT, "", HERE)
    await console.resume(olga, ROBOT, "all clear", HERE)
    assert [type(each) for each in place.world.control.said] == [link.Stop, link.Resume]
    assert [note[:2] for note in place.world.record.notes] == [
        ("robot.stopped", "vic"),
        ("robot.resumed", "olga"),
    ]


@pytest_twisted.ensureDeferred
async def test_a_robot_that_is_away_will_be_stopped(place: Place) -> None:
    """Which everybody sees who has a right on it."""
    vic = await place.principal("vic")
    outcome = await place.console.stop(vic, ROBOT, "smoke", HERE)
    assert outcome.done is False
    assert outcome.stopped is not None
    assert outcome.stopped["told"] is False
    (robot,) = await place.made.desk.overview.robots(vic)
    assert (robot["holder"], robot["stopped"]["why"]) == (None, "smoke")


@pytest_twisted.ensureDeferred
async def test_users_act_for_all_of_their_connections(place: Place) -> None:
    """Who has control by one of them gives it back, hands it over and keeps it from anywhere."""
    place.robot_comes()
    console, ann, olga = place.console, (await place.principal("ann")), (await place.principal("olga"))
    session, _ = await place.made.opens(ann)
    desk = place.world.desks.of(place.world.robot)
    assert (await desk.take(session, "")).success
    told = await console.control(ann, ROBOT, HERE)
    assert told["holder"]["you"] is True
    assert told["you"] == {"client": session.number, "may_control": True, "may_resume": True}
    assert (await console.control(olga, ROBOT, HERE))["you"]["client"] is None
    assert (await console.grant(olga, ROBOT, "", HERE)) == Answer(False, "you have no control of this robot")
    assert (await console.refuse(ann, ROBOT, "", HERE)) == Answer(False, "nobody asks for control")
    assert (await console.release(ann, ROBOT, "done", HERE)).success
    assert desk.lease.holder is None


@pytest_twisted.ensureDeferred
async def test_an_owner_takes_control_from_anybody(place: Place) -> None:
    """Nobody else does; the record says who did."""
    place.robot_comes()
    console = place.console
    ann, olga, vic = [await place.principal(name) for name in ("ann", "olga", "vic")]
    session, _ = await place.made.opens(ann)
    desk = place.world.desks.of(place.world.robot)
    await desk.take(session, "")
    assert not (await console.release(vic, ROBOT, "", HERE)).success
    assert (await console.release(olga, ROBOT, "enough", HERE)).success
    assert desk.lease.holder is None
    assert place.world.record.notes[-1] == ("control.released", "ann", "enough", {"by": "olga"})


@pytest_twisted.ensureDeferred
async def test_an_owner_who_asks_for_control_takes_it_from_the_holder_all_the_same(place: Place) -> None:
    """His request is over, too; that of others who release is all that is taken back."""
    place.robot_comes()
    console, (ann, olga) = place.console, [await place.principal(name) for name in ("ann", "olga")]
    (holds, _), (asks, _) = await place.made.opens(ann), await place.made.opens(olga)
    desk = place.world.desks.of(place.world.robot)
    await desk.take(holds, "")
    assert not (await desk.take(asks, "")).success
    assert (await console.release(olga, ROBOT, "enough", HERE)) == Answer(True, "control is given back")
    assert desk.lease.holder is None
    assert desk.lease.request is None
    await desk.take(asks, "")
    await desk.take(holds, "")
    assert (await console.release(ann, ROBOT, "", HERE)) == Answer(True, "you ask for control no more")
    assert desk.lease.held_by(asks)


@pytest_twisted.ensureDeferred
async def test_what_is_suppressed_obeys_all_connections_of_the_caller(place: Place) -> None:
    """Or nobody, where he has none; it takes the right to."""
    place.robot_comes()
    console, ann, olga = place.console, (await place.principal("ann")), (await place.principal("olga"))
    await console.suppress(olga, ROBOT, "/cmd_vel", 100, HERE)
    first, second = (await place.made.opens(olga))[0], (await place.made.opens(olga))[0]
    await console.suppress(olga, ROBOT, "/cmd_vel", 100, HERE)
    await console.inhibit(olga, ROBOT, "/scan", 1000, True, HERE)
    with pytest.raises(Refused, match="needs the level owner"):
        await console.suppress(ann, ROBOT, "/cmd_vel", 100, HERE)
    suppressed = place.world.control.all(link.Suppress)
    assert [each.sources for each in suppressed] == [[], [first.number, second.number]]


@pytest_twisted.ensureDeferred
async def test_what_is_inhibited_is_no_longer_than_the_caller_has_the_right(place: Place) -> None:
    """The robot is told when that is revoked; nothing stays open when the time is over."""
    place.robot_comes()
    olga, access = await place.principal("olga"), place.made.access
    await place.console.inhibit(olga, ROBOT, "/scan", 1000, False, HERE)
    place.world.clock.advance(2)
    assert not access._permits
    await place.console.inhibit(olga, ROBOT, "/scan", 60_000, False, HERE)
    with place.made.store.database.begin() as s:
        queries.revoke_right(s, place.made.rover.id, user_id=olga.user_id)
    await access.refresh()
    assert [each.ms for each in place.world.control.all(link.Inhibit)] == [1000, 60_000, 0]
    assert not access._permits


@pytest_twisted.ensureDeferred
async def test_on_the_relays_own_machine_all_robots_are_stopped(place: Place) -> None:
    """Those that are there at once, the others when they come; what was not told is taken back."""
    place.robot_comes()
    told = await place.console.stop_here(None, "fire", "root")
    assert told == [{"robot": "hidden", "done": False}, {"robot": ROBOT, "done": True}]
    assert place.world.record.notes[0][1] == "root"
    await place.console.resume_here("hidden", "", "root")
    assert place.world.record.stops == {}
    with pytest.raises(NotFound, match="there is no robot 'mule'"):
        await place.console.stop_here("mule", "", "root")
    place.world.record.fails = Unavailable("the database is locked")
    (failed,) = await place.console.stop_here("hidden", "", "root")
    assert failed["done"] is False
    assert "can't be kept" in failed["reason"]


@pytest_twisted.ensureDeferred
async def test_an_admission_is_given_back(place: Place) -> None:
    """Whatever comes of it: nothing stays open under it."""
    vic = await place.principal("vic")
    for work in (
        place.console.control(vic, ROBOT, HERE),
        place.console.resume(vic, ROBOT, "", HERE),
        place.console.suppress(vic, ROBOT, "/x", 100, HERE),
    ):
        try:
            await work
        except Refused:
            continue
    assert not place.made.access._permits
