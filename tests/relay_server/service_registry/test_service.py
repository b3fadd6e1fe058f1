"""Rights to register, see, renew, change and remove entries, with a real database."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted

from relay_db import queries
from relay_db.queries import AlreadyExists, QuotaExceeded
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError
from relay_server.common.etags import PreconditionFailed
from relay_server.service_registry import service as module
from relay_server.service_registry.entries import CHANGES_AT_ONCE, TooLarge
from relay_server.service_registry.service import MatchNeeded, TooManyEntryChanges
from tests.worlds.service_registry import HERE, Room


@pytest_twisted.ensureDeferred
async def test_registered_entry_is_returned_as_sent(room: Room) -> None:
    """With an id, its user and the end of its lease."""
    fields = {"kind": "application", "robot": "rover", "description": "x", "data": {"a": [1]}, "ttl": 30}
    reported = await room.register(**fields)
    etag, id = reported.pop("etag"), reported["id"]
    assert reported == {
        **fields,
        "name": "map",
        "address": "http://a/",
        "id": id,
        "user": "ann",
        "registered": 1000.0,
        "expires": 1030.0,
        "fresh": True,
    }
    one = await room.service.one(room.people["ann"], id)
    assert one.etag == etag
    del reported["fresh"]
    assert await room.all(kind="application") == [reported]
    assert room.memory() == [("registered", "relay:rover", "default", "ann", "map")]


@pytest_twisted.ensureDeferred
async def test_visibility_by_right(room: Room) -> None:
    """Entries about a robot need a right on it, scopes included; others are visible in their realm only."""
    about_rover = (await room.register(name="about-rover", robot="rover"))["id"]
    await room.register(name="for-all")
    await room.register("bob", name="about-hidden", robot="hidden")
    await room.register("cleo", name="elsewhere", robot="rover")
    assert await room.names("ann") == ["for-all", "about-rover"]
    assert await room.names("bob") == ["for-all", "about-hidden", "about-rover"]
    assert await room.names("root") == ["for-all", "about-hidden", "about-rover"]
    assert await room.names("cleo") == ["elsewhere"]
    assert await room.names("ann", realm="default") == ["for-all", "about-rover"]
    assert await room.names("ann", realm="lab") == await room.all("root", realm="lab") == []
    assert await room.names("bob", robot="*d*") == ["about-hidden"]
    assert await room.names("bob", robot="r*", name="a*") == ["about-rover"]
    assert await room.names(room.by_token("bob", "viewer@hidden")) == ["for-all", "about-hidden"]
    for who in ("cleo", room.by_token("ann", "operator@hidden")):
        with pytest.raises(NotFound):
            await room.service.one(room.who(who), about_rover)


@pytest_twisted.ensureDeferred
async def test_a_right_that_goes_hides_what_it_showed(room: Room) -> None:
    """At once, and entries registered by it cannot be renewed."""
    id = (await room.register(robot="rover"))["id"]
    rover, ann = room.robots["rover", "default"], room.people["ann"].user_id
    with room.store.database.begin() as s:
        queries.grant_right(s, rover, "viewer", user_id=ann)
    await room.access.refresh()
    assert await room.names("ann") == ["map"]
    with pytest.raises(Refused, match="provide on map needs the level operator"):
        await room.put("ann", id)
    with room.store.database.begin() as s:
        queries.revoke_right(s, rover, user_id=ann)
    await room.access.refresh()
    assert await room.names("ann") == []
    with pytest.raises(NotFound):
        await room.put("ann", id)


WRONG: list[tuple[str, dict[str, Any], type[SwitchboardError]]] = [
    ("bob", {"robot": "rover"}, Refused),
    ("ann", {"robot": "hidden"}, NotFound),
    ("ann", {"robot": "nowhere"}, NotFound),
    ("ann", {"kind": "robot"}, Invalid),
    ("ann", {"address": "http://ann:secret@host/"}, Invalid),
    ("ann", {"data": [1]}, Invalid),
    ("ann", {"data": {"a": "x" * 2048}}, TooLarge),
    ("ann viewer@rover", {"robot": "rover"}, Refused),
    ("ann operator@rover", {}, Refused),
    ("root admin", {}, Refused),
    ("root admin", {"robot": "rover"}, NotFound),
]


@pytest_twisted.ensureDeferred
async def test_forbidden_registration_is_refused(room: Room) -> None:
    """By rights and scopes; another user's robot is not disclosed."""
    for who, fields, error in WRONG:
        name, _, scope = who.partition(" ")
        with pytest.raises(error) as caught:
            await room.register(room.by_token(name, scope) if scope else name, **fields)
        assert type(caught.value) is error, (who, fields)
        if error is NotFound:
            assert str(caught.value) == "there is no such robot, or you have no right on it"
    assert await room.names("root") == [] and room.noted == []


@pytest_twisted.ensureDeferred
async def test_a_token_for_a_robot_registers_what_is_about_it(room: Room) -> None:
    """So does a right to provide that name; denying it counts as well."""
    await room.register(room.by_token("ann", "operator@rover"), robot="rover")
    with room.store.database.begin() as s:
        rover, bob = room.robots["rover", "default"], room.people["bob"].user_id
        queries.grant_right(s, rover, "operator", user_id=bob, deny=["provide:/door"])
    await room.access.refresh()
    await room.register("bob", name="/bell", robot="rover")
    with pytest.raises(Refused, match="denied to you"):
        await room.register("bob", name="/door", robot="rover")


@pytest_twisted.ensureDeferred
async def test_restarted_program_gets_its_entry_back(room: Room) -> None:
    """The entry has the latest content. Another user's entry is not returned."""
    first = await room.register()
    room.time.now += 10
    again = await room.register(description="again")
    assert (again["id"], again["fresh"], again["expires"]) == (first["id"], False, 1070.0)
    with pytest.raises(AlreadyExists, match="ann has registered"):
        await room.register("root")
    await room.register("bob", robot="hidden")
    assert [each[0] for each in room.memory()] == ["registered", "registered"]


@pytest_twisted.ensureDeferred
async def test_a_lease_is_renewed_by_its_user_or_an_administrator(room: Room) -> None:
    """Without a body, or with the same one; an expired entry is not found."""
    id = (await room.register(ttl=30))["id"]
    room.time.now += 20
    assert (await room.put("ann", id))["expires"] == 1050.0
    assert (await room.put("ann", id, name="map", ttl=30))["expires"] == 1050.0
    room.time.now += 20
    assert (await room.put("root", id))["expires"] == 1070.0
    with pytest.raises(Refused, match="only ann, who registered this entry, or an administrator"):
        await room.put("bob", id)
    with pytest.raises(NotFound):
        await room.put("cleo", id)
    with pytest.raises(Refused, match="token without a scope"):
        await room.put(room.by_token("ann", "operator"), id)
    room.time.now += 30
    for who in ("ann", "root"):
        with pytest.raises(NotFound):
            await room.put(who, id)
    assert await room.names() == []
    assert [each[0] for each in room.memory()] == ["registered"]


@pytest_twisted.ensureDeferred
async def test_an_entry_is_changed_only_as_it_was_read(room: Room) -> None:
    """The condition is required; names cannot change."""
    read = await room.register()
    with pytest.raises(MatchNeeded):
        await room.put("ann", read["id"], description="b")
    with pytest.raises(PreconditionFailed):
        await room.put("ann", read["id"], '"other"', description="b")
    changed = await room.put("ann", read["id"], read["etag"], description="b", ttl=5)
    assert (changed["description"], changed["expires"]) == ("b", 1005.0)
    for match in (read["etag"], f"W/{read['etag']}"):
        with pytest.raises(PreconditionFailed):
            await room.put("ann", read["id"], match)
    # As a proxy that compresses changes it.
    changed = await room.put("ann", read["id"], f"W/{changed['etag']}", description="d")
    assert changed["description"] == "d"
    assert (await room.put("ann", read["id"], "*", description="c"))["description"] == "c"
    for fields in ({"name": "other"}, {"kind": "application"}, {"robot": "rover"}):
        with pytest.raises(Invalid, match="cannot be changed"):
            await room.put("ann", read["id"], "*", **fields)


@pytest_twisted.ensureDeferred
async def test_an_entry_is_removed_by_its_user_or_an_administrator(room: Room) -> None:
    """Removing another user's entry is audited."""
    mine, his, own = [(await room.register(name=each, robot="rover"))["id"] for each in ("a", "b", "c")]
    with pytest.raises(Refused, match="only ann"):
        await room.remove("bob", mine)
    with pytest.raises(NotFound):
        await room.remove("cleo", mine)
    with pytest.raises(PreconditionFailed):
        await room.remove("ann", mine, '"x"')
    await room.remove("ann", mine)
    with pytest.raises(NotFound):
        await room.remove("ann", mine)
    await room.put("root", own, "*", name="c", robot="rover", description="by root")
    await room.remove("root", his)
    assert await room.names() == ["c"]
    removed = [
        ("removed", "relay:rover", "default", who, name) for who, name in (("ann", "a"), ("root", "b"))
    ]
    assert room.memory()[3:] == removed
    with room.store.database.reading() as s:
        audited = queries.list_audit(s)
    assert {(each.actor, each.action, each.target, each.origin) for each in audited} == {
        ("user:root", "directory.remove", his, HERE),
        ("user:root", "directory.change", own, HERE),
    }
    assert all(each.data["registrant"] == "ann" and each.data["robot"] == "rover" for each in audited)


@pytest_twisted.ensureDeferred
async def test_entries_are_limited(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    """Per user and per realm."""
    monkeypatch.setattr(module, "PER_USER", 2)
    monkeypatch.setattr(module, "PER_REALM", 3)
    for name in ("a", "b"):
        await room.register(name=name)
    with pytest.raises(QuotaExceeded, match="at most 2 entries"):
        await room.register(name="c")
    await room.register("root", name="c")
    with pytest.raises(QuotaExceeded, match="is full"):
        await room.register("root", name="d")
    await room.register("cleo")


@pytest_twisted.ensureDeferred
async def test_too_many_changes_are_delayed(room: Room) -> None:
    """Failed changes count as well; other users are not affected."""
    for _ in range(CHANGES_AT_ONCE):
        with pytest.raises(NotFound):
            await room.register(robot="nowhere")
    for work in (room.register(), room.put("ann", "x"), room.remove("ann", "x")):
        with pytest.raises(TooManyEntryChanges):
            await work
    await room.register("root")
    room.world.clock.advance(1)
    await room.register(name="other")
