"""OAuth clients of users and groups of robots, which administrators manage in their own realm, with a real
database.
"""

from __future__ import annotations

import pytest
import pytest_twisted

from relay_db import queries
from relay_db.queries import QuotaExceeded
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_server.auth import passwords
from relay_server.realms import robots, schemas, users
from relay_server.resources.page import PageQuery
from tests.worlds.realm_admin import ALL, HERE, RealmAdminWorld


@pytest_twisted.ensureDeferred
async def test_an_oauth_client_is_added_listed_and_revoked(world: RealmAdminWorld) -> None:
    """Its secret is returned once, authenticates it, and is not stored; each change is audited as by the
    command line.
    """
    made = await world.do(users.add_oauth_client, "Toad", "nightly report", "viewer@mobile")
    key, secret = made["key"], made.pop("secret")
    reported = {"key": key, "label": "nightly report", "created": 1000.0, "scope": "viewer@mobile"}
    assert made == reported
    assert await world.see(users.oauth_clients, "toad", ALL) == {"oauth_clients": [reported], "next": ""}
    assert (await world.see(users.realm_info))["oauth_clients"] == 1
    with world.store.database.reading() as s:
        kept = queries.find_oauth_client(s, key)
    assert kept is not None and kept.digest_ha1 == passwords.digest_ha1(key, secret)
    await world.do(users.revoke_oauth_client, key)
    assert world.taken_up == 2
    assert await world.see(users.oauth_clients, "toad", ALL) == {"oauth_clients": [], "next": ""}
    data = {"id": kept.id, "key": key, "scope": "viewer@mobile", "label": "nightly report"}
    assert world.record() == [
        ("user:root@lab1", HERE, "oauth_client.add", "toad@lab1", data),
        ("user:root@lab1", HERE, "oauth_client.revoke", str(kept.id), {"user": "toad@lab1"}),
    ]
    assert secret not in str(world.record())


@pytest_twisted.ensureDeferred
async def test_oauth_clients_are_listed_by_pages(world: RealmAdminWorld) -> None:
    """Ordered by their keys."""
    keys = sorted([(await world.do(users.add_oauth_client, "toad", "", None))["key"] for _ in range(3)])
    first = await world.see(users.oauth_clients, "toad", PageQuery(limit=2))
    assert ([each["key"] for each in first["oauth_clients"]], first["next"]) == (keys[:2], keys[1])
    rest = await world.see(users.oauth_clients, "toad", PageQuery(after=keys[1]))
    assert ([each["key"] for each in rest["oauth_clients"]], rest["next"]) == (keys[2:], "")


@pytest_twisted.ensureDeferred
async def test_an_oauth_client_of_another_realm_is_not_found(world: RealmAdminWorld) -> None:
    """Its key counts as unknown, and it stays; that of a disabled user of the own realm is found."""
    other = (await world.do(users.add_oauth_client, "toad", "", None, who="root@lab2"))["key"]
    own = (await world.do(users.add_oauth_client, "toad", "", None))["key"]
    for key in (other, own[:-1], "swc_%", "\0", ""):
        with pytest.raises(NotFound, match="no user of your realm has such an OAuth client"):
            await world.do(users.revoke_oauth_client, key)
    await world.do(users.change_user, "toad", None, True, None)
    await world.do(users.revoke_oauth_client, own)
    assert len((await world.see(users.oauth_clients, "toad", ALL, who="root@lab2"))["oauth_clients"]) == 1


@pytest_twisted.ensureDeferred
async def test_oauth_clients_that_can_not_be(world: RealmAdminWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    """These have a disabled user, an invalid scope, or exceed the limits of realm and user. They are not
    audited.
    """
    for scope in ("", "fly", "viewer  owner"):
        with pytest.raises(Invalid):
            await world.do(users.add_oauth_client, "toad", "", scope)
    with pytest.raises(Invalid, match="label of an OAuth client"):
        await world.do(users.add_oauth_client, "toad", "two\nlines", None)
    with world.store.database.begin() as s:
        toad = queries.find_user(s, "toad", "lab1")
        assert toad is not None
        queries.set_disabled(s, toad.id, True)
    with pytest.raises(Invalid, match="disabled; enable it first"):
        await world.do(users.add_oauth_client, "toad", "", None)
    monkeypatch.setattr(users, "MAX_OAUTH_CLIENTS", 0)
    with pytest.raises(QuotaExceeded, match="a user may have 0 OAuth clients"):
        await world.do(users.add_oauth_client, "boss", "", None)
    monkeypatch.setitem(schemas.MAX_COUNTS, "oauth_clients", 0)
    with pytest.raises(QuotaExceeded, match="a realm may have 0 OAuth clients"):
        await world.do(users.add_oauth_client, "boss", "", None)
    assert world.record() == []


@pytest_twisted.ensureDeferred
async def test_oauth_client_cannot_act_as_a_linked_account(world: RealmAdminWorld) -> None:
    """It would get tokens of the account's home realm and act as the user there."""
    with world.store.database.begin() as s:
        boss = queries.find_user(s, "boss", "lab1")
        assert boss is not None
        queries.add_linked_account(s, boss.id, "lab2")
    with pytest.raises(Refused, match="only in their own realm"):
        await world.do(users.add_oauth_client, "boss", "", None, who="root@lab2")
    assert await world.see(users.oauth_clients, "boss", ALL, who="root@lab2") == {
        "oauth_clients": [],
        "next": "",
    }
    assert world.record() == []


@pytest_twisted.ensureDeferred
async def test_a_group_of_robots_from_its_beginning_to_its_end(world: RealmAdminWorld) -> None:
    """It is audited under the names of the command line; a robot that is a member already is not added again."""
    await world.do(robots.add_robot, "arm", "")
    assert await world.do(robots.add_group, "Upstairs") == {"group": "upstairs", "robots": []}
    for robot in ("mobile", "arm", "arm"):
        await world.do(robots.join, "upstairs", robot)
    assert await world.see(robots.group, "UPSTAIRS") == {"group": "upstairs", "robots": ["arm", "mobile"]}
    assert await world.see(robots.groups, ALL) == {
        "robot_groups": [
            {"group": "cleaners", "robots": []},
            {"group": "upstairs", "robots": ["arm", "mobile"]},
        ],
        "next": "",
    }
    first = await world.see(robots.groups, PageQuery(limit=1))
    assert ([each["group"] for each in first["robot_groups"]], first["next"]) == (["cleaners"], "cleaners")
    await world.do(robots.leave, "upstairs", "arm")
    with pytest.raises(NotFound, match="not in this group"):
        await world.do(robots.leave, "upstairs", "arm")
    await world.do(robots.remove_group, "upstairs")
    assert [each["group"] for each in (await world.see(robots.groups, ALL))["robot_groups"]] == ["cleaners"]
    assert [each[2:] for each in world.record()[1:]] == [
        ("robot.group.add", "upstairs@lab1", {"robots": []}),
        ("robot.group.add", "upstairs@lab1", {"robots": ["mobile@lab1"]}),
        ("robot.group.add", "upstairs@lab1", {"robots": ["arm@lab1"]}),
        ("robot.group.remove", "upstairs@lab1", {"robots": ["arm@lab1"]}),
        ("robot.group.remove", "upstairs@lab1", {"robots": []}),
    ]


@pytest_twisted.ensureDeferred
async def test_groups_have_not_too_many_robots(
    world: RealmAdminWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For all groups of the realm together; members take no further place."""
    monkeypatch.setitem(schemas.MAX_COUNTS, "robot_memberships", 1)
    await world.do(robots.add_robot, "arm", "")
    for _ in range(2):
        await world.do(robots.join, "cleaners", "mobile")
    await world.do(robots.join, "cleaners", "mobile", who="root@lab2")
    with pytest.raises(QuotaExceeded, match="1 robot memberships at most"):
        await world.do(robots.join, "cleaners", "arm")


@pytest_twisted.ensureDeferred
async def test_a_robots_description_is_changed(world: RealmAdminWorld) -> None:
    """It is one line; an unchanged description is not audited."""
    for description in ("on the bench", "on the bench", None):
        reported = await world.do(robots.change_robot, "mobile", description)
        assert reported == {"robot": "mobile", "description": "on the bench", "keys": 0, "guest": False}
    with pytest.raises(Invalid, match="description of a robot"):
        await world.do(robots.change_robot, "mobile", "two\nlines")
    assert await world.see(robots.robot, "mobile") == reported
    assert (await world.see(robots.robot, "mobile", who="root@lab2"))["description"] == ""
    data = {"description": "on the bench"}
    assert [each[2:] for each in world.record()] == [("robot.describe", "mobile@lab1", data)]


@pytest_twisted.ensureDeferred
async def test_a_shared_robot_is_its_own_realms(world: RealmAdminWorld) -> None:
    """The other realm may give rights on it and add it to groups, but neither remove nor enrol it."""
    await world.do(robots.add_robot, "arm", "")
    with world.store.database.begin() as s:
        arm = queries.find_robot(s, "arm", "lab1")
        assert arm is not None
        queries.share_robot(s, arm.id, "lab2")
    for work, args in (
        (robots.change_robot, ("arm", "mine")),
        (robots.new_code, ("arm",)),
        (robots.revoke_key, ("arm", "0" * 16)),
        (robots.remove_robot, ("arm", 0)),
    ):
        with pytest.raises(Refused, match="only administrators of its own realm"):
            await world.do(work, *args, who="root@lab2")
    await world.do(robots.grant, "arm", "toad", "viewer", [], [], who="root@lab2")
    await world.do(robots.join, "cleaners", "arm", who="root@lab2")
    assert (await world.see(robots.group, "cleaners", who="root@lab2"))["robots"] == ["arm"]
    assert (await world.see(robots.group, "cleaners"))["robots"] == []
    with pytest.raises(Refused, match="only administrators of its own realm"):
        await world.see(robots.keys, "arm", PageQuery(), who="root@lab2")


@pytest_twisted.ensureDeferred
async def test_excluded_linked_account_stays_excluded(world: RealmAdminWorld) -> None:
    """Even if the home realm disabled and enabled the user meanwhile. Only the home realm may set the
    password.
    """
    with world.store.database.begin() as s:
        queries.add_user(s, "peach", "hash", realm="lab1")
        peach = queries.find_user(s, "peach", "lab1")
        assert peach is not None
        guest = queries.add_linked_account(s, peach.id, "lab2")
        queries.set_disabled(s, peach.id, True)
    change = users.change_user
    reported = await world.do(change, "peach", None, True, None, who="root@lab2")
    assert (reported["disabled"], reported["guest"]) == (True, True)
    with world.store.database.begin() as s:
        queries.set_disabled(s, peach.id, False)
        assert not queries.user_is_live(s, guest.id)
    with pytest.raises(Refused, match="an account elsewhere"):
        await world.do(change, "peach", "hash", None, None, who="root@lab2")


@pytest_twisted.ensureDeferred
async def test_the_retention_time_of_events_is_set_for_the_own_realm(world: RealmAdminWorld) -> None:
    """It is audited as by the command line; it needs a token with the full scope, and has a maximum."""
    assert (await world.do(users.keep_events, 7.0))["events_days"] == 7.0
    assert (await world.see(users.realm_info, who="root@lab2"))["events_days"] is None
    assert (await world.do(users.keep_events, None))["events_days"] is None
    assert world.record() == [
        ("user:root@lab1", HERE, "realm.set", "lab1", {"events_days": days}) for days in (7.0, None)
    ]
    for days in (0.0, 1e6):
        with pytest.raises(Invalid, match="more than 0"):
            await world.do(users.keep_events, days)
    world.people["narrow"] = world.by_token("root", "lab1", "admin")
    with pytest.raises(Refused):
        await world.do(users.keep_events, 7.0, who="narrow")
