"""Control for users without a connection, and on the relay's own machine, on a real database."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_server.access import Principal
from relay_server.control.commands import NotDone
from relay_server.control.service import (
    CONFIRM_SECONDS,
    NOT_ALL_KNOWN,
    NOT_CONFIRMED,
    ControlService,
    NoControl,
)
from relay_server.control.types import ControlReply
from relay_server.http_sessions.pool import SessionPool
from relay_server.sessions.manager import LOOKUP_SECONDS
from tests.relay_server.front_desk import HERE, Desk
from tests.relay_server.memory import hangs
from tests.relay_server.steering import outcome, result

ROBOT = "rover"
LATER = 1 << 62
"""Sent after all there was."""


class Place:
    """A front desk with three users, and the console in front of it."""

    def __init__(self, front: Desk) -> None:
        self.front = front
        self.world = front.world
        self.guests = SessionPool(self.world.clock, front.desk, self.world.now_ns)
        offices = front.desk, front.access, self.world.desks, self.world.registry, front.store
        self.console = ControlService(self.world.clock, *offices, self.guests)
        with front.store.database.begin() as s:
            self.users = {}
            for name, level in (("olga", "owner"), ("vic", "viewer"), ("eve", "")):
                self.users[name] = queries.add_user(s, name, None)
                if level:
                    queries.grant_right(s, self.front.rover.id, level, user_id=self.users[name].id)
        self.users["ann"] = self.front.ann

    async def principal(self, name: str, scope: str | None = None) -> Principal:
        """Somebody with a token."""
        return await self.front.by_token(self.users[name], scope)

    def robot_comes(self) -> None:
        """The robot that the database knows registers."""
        robot = self.world.registry.presence(self.front.rover.id, ROBOT, "default")
        self.world.robot = robot
        self.world.robot_comes()


@pytest.fixture
def place(front: Desk) -> Place:
    """A place."""
    return Place(front)


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
        await console.resume(vic, ROBOT, "", HERE, LATER)
    await console.resume(olga, ROBOT, "all clear", HERE, LATER)
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
    (robot,) = await place.front.desk.overview.robots(vic)
    assert (robot["holder"], robot["stopped"]["why"]) == (None, "smoke")


@pytest_twisted.ensureDeferred
async def test_users_act_for_all_of_their_connections(place: Place) -> None:
    """Who has control by one of them gives it back, hands it over and keeps it from anywhere."""
    place.robot_comes()
    console, ann, olga = place.console, (await place.principal("ann")), (await place.principal("olga"))
    session, _ = await place.front.opens(ann)
    desk = place.world.desks.of(place.world.robot)
    assert (await desk.take(session, "")).success
    told = await console.control(ann, ROBOT, HERE)
    assert told["holder"]["you"] is True
    assert told["you"] == {"client": session.number, "may_control": True, "may_resume": True}
    assert (await console.control(olga, ROBOT, HERE))["you"]["client"] is None
    with pytest.raises(NoControl, match="you have no control of this robot"):
        await console.grant(olga, ROBOT, "", HERE)
    with pytest.raises(NotDone, match="nobody asks for control"):
        await console.refuse(ann, ROBOT, "", HERE)
    assert (await console.release(ann, ROBOT, "done", HERE)).success
    assert desk.lease.holder is None


@pytest_twisted.ensureDeferred
async def test_a_token_to_look_does_nothing_with_its_users_control(place: Place) -> None:
    """Neither gives it back nor resumes the robot by it; stopping is for all."""
    place.robot_comes()
    console, looks = place.console, (await place.principal("ann", "viewer"))
    session, _ = await place.front.opens(await place.principal("ann"))
    desk = place.world.desks.of(place.world.robot)
    assert (await desk.take(session, "")).success
    for do in (console.release, console.grant, console.refuse):
        with pytest.raises(NoControl, match="you have no control of this robot"):
            await do(looks, ROBOT, "", HERE)
    assert (await console.stop(looks, ROBOT, "smoke", HERE)).done is True
    with pytest.raises(Refused, match="may resume it"):
        await console.resume(looks, ROBOT, "", HERE, LATER)
    assert desk.lease.holder is not None


@pytest_twisted.ensureDeferred
async def test_an_owner_takes_control_from_anybody(place: Place) -> None:
    """Nobody else does; the record says who did."""
    place.robot_comes()
    console = place.console
    ann, olga, vic = [await place.principal(name) for name in ("ann", "olga", "vic")]
    session, _ = await place.front.opens(ann)
    desk = place.world.desks.of(place.world.robot)
    await desk.take(session, "")
    with pytest.raises(NoControl):
        await console.release(vic, ROBOT, "", HERE)
    assert (await console.release(olga, ROBOT, "enough", HERE)).success
    assert desk.lease.holder is None
    assert place.world.record.notes[-1] == ("control.released", "olga", "enough", {"of": "ann"})
    assert place.world.record.actors[-1] == ("olga", "user:olga", olga.user_id, HERE, 0)


@pytest_twisted.ensureDeferred
async def test_an_owner_who_asks_for_control_takes_it_from_the_holder_all_the_same(place: Place) -> None:
    """His request is over, too; that of others who release is all that is taken back."""
    place.robot_comes()
    console, (ann, olga) = place.console, [await place.principal(name) for name in ("ann", "olga")]
    (holds, _), (asks, _) = await place.front.opens(ann), await place.front.opens(olga)
    desk = place.world.desks.of(place.world.robot)
    await desk.take(holds, "")
    assert not (await desk.take(asks, "")).success
    assert (await console.release(olga, ROBOT, "enough", HERE)) == ControlReply(True, "control is given back")
    assert desk.lease.holder is None
    assert desk.lease.request is None
    await desk.take(asks, "")
    await desk.take(holds, "")
    assert (await console.release(ann, ROBOT, "", HERE)) == ControlReply(True, "you ask for control no more")
    assert desk.lease.held_by(asks)


@pytest_twisted.ensureDeferred
async def test_what_is_suppressed_obeys_all_connections_of_the_caller(place: Place) -> None:
    """Or nobody, where he has none; it takes the right to."""
    place.robot_comes()
    console, ann, olga = place.console, (await place.principal("ann")), (await place.principal("olga"))
    await console.suppress(olga, ROBOT, "/cmd_vel", 100, HERE)
    first, second = (await place.front.opens(olga))[0], (await place.front.opens(olga))[0]
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
    olga, access = await place.principal("olga"), place.front.access
    await place.console.inhibit(olga, ROBOT, "/scan", 1000, False, HERE)
    place.world.clock.advance(2)
    assert not access._permits
    await place.console.inhibit(olga, ROBOT, "/scan", 60_000, False, HERE)
    with place.front.store.database.begin() as s:
        queries.revoke_right(s, place.front.rover.id, user_id=olga.user_id)
    await access.refresh()
    assert [each.ms for each in place.world.control.all(link.Inhibit)] == [1000, 60_000, 0]
    assert not access._permits


@pytest_twisted.ensureDeferred
async def test_on_the_relays_own_machine_all_robots_are_stopped(place: Place) -> None:
    """Those that are there at once, the others when they come; what was not told is taken back."""
    place.robot_comes()
    told = await place.console.stop_here(None, "fire", "root")
    assert told == ([{"robot": "hidden", "done": False}, {"robot": ROBOT, "done": True}], "")
    assert place.world.record.notes[0][1] == "root"
    await place.console.resume_here("hidden", "", "root", LATER)
    assert place.world.record.stops == {}
    with pytest.raises(NotFound, match="there is no robot 'mule'"):
        await place.console.stop_here("mule", "", "root")
    place.world.record.fails = Unavailable("the database is locked")
    ((failed,), _) = await place.console.stop_here("hidden", "", "root")
    assert failed["done"] is False
    assert "can't be kept" in failed["reason"]


class Hung:
    """A database that answers nothing more."""

    def __init__(self, place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(place.front.store, "read", hangs)
        monkeypatch.setattr(place.front.store, "write", hangs)


@pytest_twisted.ensureDeferred
async def test_who_is_known_stops_a_robot_without_the_database(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Known is who was let in to it since something last changed, or has it open."""
    place.robot_comes()
    vic = await place.principal("vic")
    await place.console.control(vic, ROBOT, HERE)
    ann = await place.principal("ann")
    session, _ = await place.front.opens(ann)
    await place.front.access.refresh()
    await place.console.control(vic, ROBOT, HERE)
    Hung(place, monkeypatch)
    for who in (vic, ann):
        assert result(place.console.stop(who, ROBOT, "smoke", HERE)).done
    assert [order.by for order in place.world.control.all(link.Stop)] == ["vic", "ann"]
    session.end()


@pytest_twisted.ensureDeferred
async def test_who_is_not_known_is_told_soon_that_nobody_can_say(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In words, and nothing is stopped; a right that may have been revoked counts no more."""
    place.robot_comes()
    vic, eve = await place.principal("vic"), await place.principal("eve")
    await place.console.control(vic, ROBOT, HERE)
    await place.front.access.refresh()
    Hung(place, monkeypatch)
    asked = [outcome(place.console.stop(who, ROBOT, "", HERE)) for who in (vic, eve)]
    place.world.clock.advance(LOOKUP_SECONDS - 0.1)
    assert asked == [[], []]
    place.world.clock.advance(0.1)
    for (error,) in asked:
        assert isinstance(error, Unavailable)
        assert "by 'switchboard stop' on the relay's machine" in str(error)
    assert not place.world.control.all(link.Stop)
    assert not place.front.access._permits


@pytest_twisted.ensureDeferred
async def test_on_the_relays_own_machine_no_robot_that_is_here_waits_for_the_database(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither one that is named, nor all; that others could not be looked up is told."""
    place.robot_comes()
    Hung(place, monkeypatch)
    assert result(place.console.stop_here(ROBOT, "fire", "root")) == ([{"robot": ROBOT, "done": True}], "")
    asked = outcome(place.console.stop_here(None, "fire", "root"))
    assert len(place.world.control.all(link.Stop)) == 2
    place.world.clock.advance(LOOKUP_SECONDS)
    assert asked == [([{"robot": ROBOT, "done": True}], NOT_ALL_KNOWN)]
    unknown = outcome(place.console.stop_here("mule", "", "root"))
    place.world.clock.advance(LOOKUP_SECONDS)
    assert isinstance(unknown[0], Unavailable)


@pytest_twisted.ensureDeferred
async def test_a_stop_that_nobody_confirms_and_nobody_keeps_is_told_to_be_none(place: Place) -> None:
    """Rather than to be waited for as long as a database hangs."""
    vic = await place.principal("vic")
    await place.console.control(vic, ROBOT, HERE)
    place.world.record.hold = True
    asked = outcome(place.console.stop(vic, ROBOT, "", HERE))
    place.world.clock.advance(CONFIRM_SECONDS)
    assert [str(error) for error in asked] == [NOT_CONFIRMED]


@pytest_twisted.ensureDeferred
async def test_a_robot_that_does_not_come_to_an_end_holds_up_no_answer_about_the_others(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that is away, whose order a database that hangs does not keep."""

    async def no_others(*_: Any) -> list[Any]:
        return []

    monkeypatch.setattr(place.front.store, "read", no_others)
    hidden = place.world.registry.presence(2, "hidden", "default")
    assert hidden.control is None
    place.robot_comes()
    place.world.record.hold = True
    asked = outcome(place.console.stop_here(None, "fire", "root"))
    place.world.clock.advance(CONFIRM_SECONDS - 0.1)
    assert asked == []
    place.world.clock.advance(0.1)
    late = {"robot": "hidden", "done": False, "reason": NOT_CONFIRMED}
    assert asked == [([late, {"robot": ROBOT, "done": True}], "")]


@pytest_twisted.ensureDeferred
async def test_a_stop_that_is_not_all_done_says_how_the_robot_stands(place: Place) -> None:
    """With what it could not do."""
    place.robot_comes()
    vic = await place.principal("vic")
    desk = place.world.desks.of(place.world.robot)
    place.world.control.obeys = lambda order: desk.told(
        link.Done(id=order.id, ok=False, reason="no contactor")
    )
    stopped = await place.console.stop(vic, ROBOT, "smoke", HERE)
    assert (stopped.done, stopped.failed) == (False, "robot rover could not do it: no contactor")
    assert stopped.stopped is not None


@pytest_twisted.ensureDeferred
async def test_an_admission_is_given_back(place: Place) -> None:
    """Whatever comes of it: nothing stays open under it."""
    vic = await place.principal("vic")
    for work in (
        place.console.control(vic, ROBOT, HERE),
        place.console.resume(vic, ROBOT, "", HERE, LATER),
        place.console.suppress(vic, ROBOT, "/x", 100, HERE),
    ):
        try:
            await work
        except Refused:
            continue
    assert not place.front.access._permits
