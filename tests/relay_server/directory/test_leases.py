"""What goes when its time is over, also past the end of a relay, and who is told."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest_twisted
from twisted.internet import reactor
from twisted.internet.task import deferLater

from relay_db import queries
from relay_server.access import Principal
from relay_server.registry.entries import EntryQuery
from relay_server.registry.limits import LOOK_SECONDS, SURE_SECONDS
from tests.harness.switchboard_waiting import PATIENCE
from tests.relay_server.directory.room import Room


async def until(room: Room, condition: Callable[[], Any]) -> None:
    """Let the loop look, and threads work, until something is so."""
    for _ in range(round(PATIENCE / 0.01)):
        if condition():
            return
        room.world.clock.advance(LOOK_SECONDS)
        await deferLater(reactor, 0.01)  # type: ignore[arg-type]  # to mypy it is a module
    raise AssertionError("it does not become so")


async def heard(room: Room, who: Principal, follower: Any) -> list[tuple[str, str]]:
    """What a follower is told, and of which name."""
    told, _, _ = await room.desk.news(who, EntryQuery(), follower)
    return [(what, entry["name"]) for _, what, entry in told]


@pytest_twisted.ensureDeferred
async def test_what_nobody_renews_is_gone_at_its_time(room: Room) -> None:
    """Before anybody has looked; then it is told, once, and its row goes."""
    await room.house.leases.start()
    await room.register(ttl=10, robot="rover")
    kept = (await room.register(name="kept", ttl=10))["id"]
    room.memory()
    with room.desk.following(room.people["bob"], None) as (follower, missed):
        assert not missed
        room.time.now += 9
        await room.put("ann", kept)
        room.time.now += 1
        assert await room.names() == ["kept"]
        assert await heard(room, room.people["bob"], follower) == []
        await until(room, lambda: room.noted)
        assert room.memory() == [("expired", "relay:rover", "default", "ann", "map")]
        assert await heard(room, room.people["bob"], follower) == [("expired", "map")]
        with room.store.database.reading() as s:
            assert queries.leases(s, room.time.now).there == {kept}
        await room.house.leases.look()
        assert room.noted == [] and await heard(room, room.people["bob"], follower) == []
    room.house.leases.looking.stop()


@pytest_twisted.ensureDeferred
async def test_leases_outlast_the_relay(room: Room) -> None:
    """What was over while it was away is told when it is back; the rest lasts as long as it was given."""
    await room.register(name="short", ttl=10)
    long = (await room.register(name="long", ttl=100))["id"]
    room.memory()
    room.time.now += 50
    room.house = room.again()
    room.desk = room.house.desk
    await room.house.leases.start()
    assert [each[0] for each in room.memory()] == ["expired"]
    assert [(each["name"], each["expires"]) for each in await room.all(kind="service", name="[sl]*")] == [
        ("long", 1100.0)
    ]
    assert (await room.put("ann", long))["expires"] == 1150.0
    room.time.now += 100
    await until(room, lambda: room.noted)
    assert room.memory() == [("expired", "relay", "default", "ann", "long")]
    room.house.leases.looking.stop()


@pytest_twisted.ensureDeferred
async def test_a_clock_that_is_set_prolongs_no_lease(room: Room) -> None:
    """Back: each lasts as long as it was given from now on, at most, and that is seen by itself. On: they end early."""
    await room.house.leases.start()
    await room.register(ttl=40)
    room.time.now -= 500
    (told,) = await room.all(name="map")
    assert told["expires"] == 540.0

    def bounded() -> bool:
        with room.store.database.reading() as s:
            return not queries.leases(s, room.time.now).overlong

    looked = room.world.clock.seconds()
    await until(room, bounded)
    # Nothing else has made it look: it does from time to time.
    assert room.world.clock.seconds() - looked >= SURE_SECONDS - LOOK_SECONDS
    room.time.now += 40
    assert await room.names() == []
    room.house.leases.looking.stop()


@pytest_twisted.ensureDeferred
async def test_what_goes_without_this_relay_is_told_to_who_follows(room: Room) -> None:
    """By the command line, or with its user; who removes something tells the memory himself."""
    await room.house.leases.start()
    gone = (await room.register(name="gone"))["id"]
    await room.register("bob", name="bobs")
    room.memory()
    with room.desk.following(room.people["ann"], None) as (follower, _):
        with room.store.database.begin() as s:
            assert queries.remove_entry(s, gone, room.time.now) is not None
            queries.remove_user(s, room.people["bob"].user_id)
        room.house.leases.soon()
        await until(room, lambda: follower.fresh)
        assert sorted(await heard(room, room.people["ann"], follower)) == [
            ("removed", "bobs"),
            ("removed", "gone"),
        ]
    assert room.noted == []
    room.house.leases.looking.stop()


@pytest_twisted.ensureDeferred
async def test_who_follows_hears_of_what_he_may_see(room: Room) -> None:
    """Once each, by his filters, and of no renewal."""
    ann, bob, cleo = (room.people[each] for each in ("ann", "bob", "cleo"))
    with (
        room.desk.following(ann, None) as (of_ann, _),
        room.desk.following(bob, None) as (of_bob, _),
        room.desk.following(cleo, None) as (of_cleo, _),
    ):
        id = (await room.register())["id"]
        await room.register("bob", name="secret", robot="hidden")
        await room.put("ann", id)
        await room.register()
        await room.put("ann", id, "*", description="b")
        await room.register(description="c")
        await room.remove("ann", id)
        mine = [("registered", "map"), ("changed", "map"), ("changed", "map"), ("removed", "map")]
        assert await heard(room, ann, of_ann) == mine
        told, missed, more = await room.desk.news(bob, EntryQuery(robot="h*"), of_bob)
        assert [(what, entry["name"]) for _, what, entry in told] == [("registered", "secret")]
        assert not missed and not more
        assert await heard(room, cleo, of_cleo) == []
        mark = room.desk.mark(of_ann)
    await room.register(name="later")
    with room.desk.following(ann, mark) as (again, missed):
        assert not missed and await heard(room, ann, again) == [("registered", "later")]
    room.desk = room.again().desk
    with room.desk.following(ann, mark) as (again, missed):
        assert missed and await heard(room, ann, again) == []
