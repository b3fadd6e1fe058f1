"""Expired entries, also across restarts of the relay, and their notifications."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest_twisted
from twisted.internet import reactor
from twisted.internet.task import deferLater

from relay_db import queries
from relay_server.access import Principal
from relay_server.service_registry.entries import CHECK_SECONDS, FULL_CHECK_SECONDS, EntryQuery
from tests.worlds.service_registry import Room
from tests.worlds.waiting import PATIENCE


async def until(room: Room, condition: Callable[[], Any]) -> None:
    """Runs the loop and its threads until the condition holds."""
    for _ in range(round(PATIENCE / 0.01)):
        if condition():
            return
        room.world.clock.advance(CHECK_SECONDS)
        await deferLater(reactor, 0.01)  # type: ignore[arg-type]  # to mypy it is a module
    raise AssertionError("it does not become so")


async def heard(room: Room, who: Principal, follower: Any) -> list[tuple[str, str]]:
    """Changes that a follower gets, with their names."""
    reported, _, _ = await room.service.news(who, EntryQuery(), follower)
    return [(what, entry.name) for _, what, entry in reported]


@pytest_twisted.ensureDeferred
async def test_entry_without_renewal_ends_with_its_lease(room: Room) -> None:
    """It is not found even before the loop runs; then its end is sent once, and its row is removed."""
    await room.registry.leases.start()
    await room.register(ttl=10, robot="rover")
    kept = (await room.register(name="kept", ttl=10))["id"]
    room.memory()
    with room.service.following(room.people["bob"], None) as (follower, missed):
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
            assert queries.lease_times(s, room.time.now).ids == {kept}
        await room.registry.leases.check()
        assert room.noted == [] and await heard(room, room.people["bob"], follower) == []
    room.registry.leases.loop.stop()


@pytest_twisted.ensureDeferred
async def test_leases_outlast_the_relay(room: Room) -> None:
    """Entries that expired meanwhile are reported at the start; others keep their lease."""
    await room.register(name="short", ttl=10)
    long = (await room.register(name="long", ttl=100))["id"]
    room.memory()
    room.time.now += 50
    room.registry = room.again()
    room.service = room.registry.service
    await room.registry.leases.start()
    assert [each[0] for each in room.memory()] == ["expired"]
    assert [(each["name"], each["expires"]) for each in await room.all(kind="service", name="[sl]*")] == [
        ("long", 1100.0)
    ]
    assert (await room.put("ann", long))["expires"] == 1150.0
    room.time.now += 100
    await until(room, lambda: room.noted)
    assert room.memory() == [("expired", "relay", "default", "ann", "long")]
    room.registry.leases.loop.stop()


@pytest_twisted.ensureDeferred
async def test_a_clock_that_is_set_prolongs_no_lease(room: Room) -> None:
    """Set back: each lasts at most its full lease from now on, found without a request. Set forward: they end
    early.
    """
    await room.registry.leases.start()
    await room.register(ttl=40)
    room.time.now -= 500
    (reported,) = await room.all(name="map")
    assert reported["expires"] == 540.0

    def bounded() -> bool:
        with room.store.database.reading() as s:
            return not queries.lease_times(s, room.time.now).too_long

    looked = room.world.clock.seconds()
    await until(room, bounded)
    # Nothing else starts the loop: it runs from time to time.
    assert room.world.clock.seconds() - looked >= FULL_CHECK_SECONDS - CHECK_SECONDS
    room.time.now += 40
    assert await room.names() == []
    room.registry.leases.loop.stop()


@pytest_twisted.ensureDeferred
async def test_external_removal_is_sent_to_followers(room: Room) -> None:
    """By the command line, or with the user; other removers notify the event log themselves."""
    await room.registry.leases.start()
    gone = (await room.register(name="gone"))["id"]
    await room.register("bob", name="bobs")
    room.memory()
    with room.service.following(room.people["ann"], None) as (follower, _):
        with room.store.database.begin() as s:
            assert queries.remove_entry(s, gone, room.time.now) is not None
            queries.remove_user(s, room.people["bob"].user_id)
        room.registry.leases.check_soon()
        await until(room, lambda: follower.fresh)
        assert sorted(await heard(room, room.people["ann"], follower)) == [
            ("removed", "bobs"),
            ("removed", "gone"),
        ]
    assert room.noted == []
    room.registry.leases.loop.stop()


@pytest_twisted.ensureDeferred
async def test_follower_receives_visible_changes(room: Room) -> None:
    """Each once, by its filters, without renewals."""
    ann, bob, cleo = (room.people[each] for each in ("ann", "bob", "cleo"))
    with (
        room.service.following(ann, None) as (of_ann, _),
        room.service.following(bob, None) as (of_bob, _),
        room.service.following(cleo, None) as (of_cleo, _),
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
        reported, missed, more = await room.service.news(bob, EntryQuery(robot="h*"), of_bob)
        assert [(what, entry.name) for _, what, entry in reported] == [("registered", "secret")]
        assert not missed and not more
        assert await heard(room, cleo, of_cleo) == []
        mark = room.service.event_id(of_ann)
    await room.register(name="later")
    with room.service.following(ann, mark) as (again, missed):
        assert not missed and await heard(room, ann, again) == [("registered", "later")]
    room.service = room.again().service
    with room.service.following(ann, mark) as (again, missed):
        assert missed and await heard(room, ann, again) == []
