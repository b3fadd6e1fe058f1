"""Administrators' lists of their own realm, without anything of other realms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol.errors import NotFound
from relay_server.realms import robots, users
from relay_server.resources.page import PageQuery
from tests.worlds.realm_admin import ALL, RealmAdminWorld

LOOKS: list[tuple[Callable[..., Any], tuple[Any, ...]]] = [
    (users.user, ("{}",)),
    (users.tokens, ("{}", ALL)),
    (users.oauth_clients, ("{}", ALL)),
    (users.group, ("{}",)),
    (robots.group, ("{}",)),
    (robots.robot, ("{}",)),
    (robots.keys, ("{}", ALL)),
    (robots.rights, (ALL, "{}", None)),
    (robots.rights, (ALL, None, "{}")),
]
CHANGES: list[tuple[Callable[..., Any], tuple[Any, ...]]] = [
    (users.change_user, ("{}", None, True, None)),
    (users.remove_user, ("{}",)),
    (users.remove_group, ("{}",)),
    (users.join, ("{}", "toad")),
    (users.join, ("crew", "{}")),
    (users.leave, ("crew", "{}")),
    (users.add_oauth_client, ("{}", "", None)),
    (users.revoke_oauth_client, ("{}",)),
    (robots.change_robot, ("{}", "x")),
    (robots.remove_group, ("{}",)),
    (robots.join, ("{}", "mobile")),
    (robots.join, ("cleaners", "{}")),
    (robots.leave, ("{}", "mobile")),
    (robots.leave, ("cleaners", "{}")),
    (robots.new_code, ("{}",)),
    (robots.remove_robot, ("{}", 0)),
    (robots.revoke_key, ("{}", "0" * 16)),
    (robots.grant, ("{}", "toad", "viewer", [], [])),
    (robots.grant, ("mobile", "{}", "viewer", [], [])),
    (robots.grant, ("mobile", "@{}", "viewer", [], [])),
    (robots.revoke, ("{}", "toad")),
]


@pytest.mark.parametrize(("work", "args"), [*LOOKS, *CHANGES])
@pytest_twisted.ensureDeferred
async def test_entry_of_another_realm_is_not_found(world: RealmAdminWorld, work: Any, args: Any) -> None:
    """By its bare name and its full one: the answer is that for an unknown name."""
    with world.store.database.begin() as s:
        queries.add_user(s, "mole", None, realm="lab2")
        queries.add_group(s, "mole", realm="lab2")
        queries.add_robot(s, "mole", realm="lab2")
        queries.add_robot_group(s, "mole", realm="lab2")
    said = set()
    for name in ("mole", "mole@lab2", "nobody", "toad@lab2", "\0", "", "mobile@lab2"):
        given = [each.format(name) if isinstance(each, str) else each for each in args]
        with pytest.raises(NotFound) as error:
            await (world.see if (work, args) in LOOKS else world.do)(work, *given)
        said.add(str(error.value))
    assert len(said) == 1
    assert world.record() == []


@pytest_twisted.ensureDeferred
async def test_lists_are_of_the_own_realm(world: RealmAdminWorld) -> None:
    """Complete and in pages, ordered by name."""
    with world.store.database.begin() as s:
        for lab, level in (("lab1", "viewer"), ("lab2", "owner")):
            robot, toad = queries.find_robot(s, "mobile", lab), queries.find_user(s, "toad", lab)
            group = queries.find_group(s, "crew", lab)
            assert robot is not None and toad is not None and group is not None
            queries.grant_right(s, robot.id, level, user_id=toad.id)
            queries.grant_right(s, robot.id, level, group_id=group.id)
            queries.add_member(s, group.id, toad.id)
        for key in (b"a", b"b"):
            queries.issue_enrolment_code(s, 1, key.hex() * 32, 10.0)
            queries.redeem_enrolment_code(
                s, "mobile", key.hex() * 32, key * 32, key.hex() * 8, "x", 1.0, realm="lab1"
            )
    assert await world.see(users.realm_info) == {
        "realm": "lab1",
        "users": 3,
        "groups": 1,
        "robots": 1,
        "oauth_clients": 0,
        "robot_groups": 1,
        "events_days": None,
    }
    reported = await world.see(users.users, ALL)
    assert [(each["user"], each["groups"]) for each in reported["users"]] == [
        ("boss", []),
        ("root", []),
        ("toad", ["crew"]),
    ]
    first = await world.see(users.users, PageQuery(limit=2))
    assert (first["users"], first["next"]) == (reported["users"][:2], "root")
    assert await world.see(users.users, PageQuery(after="root")) == {
        "users": reported["users"][2:],
        "next": "",
    }
    assert (await world.see(users.groups, ALL))["groups"] == [{"group": "crew", "members": ["toad"]}]
    assert (await world.see(robots.robots, ALL))["robots"] == [
        {"robot": "mobile", "description": "", "keys": 2, "guest": False}
    ]
    rights = (await world.see(robots.rights, ALL, None, None))["rights"]
    assert [(each["holder"], each["level"]) for each in rights] == [("@crew", "viewer"), ("toad", "viewer")]
    assert (await world.see(robots.rights, ALL, None, "boss"))["rights"] == []
    assert len((await world.see(robots.rights, ALL, "mobile", "toad"))["rights"]) == 2
    await world.do(robots.revoke_key, "mobile", "61" * 8)
    keys = (await world.see(robots.keys, "mobile", ALL))["keys"]
    assert [each["retired"] for each in keys] == [1000.0, None]


@pytest_twisted.ensureDeferred
async def test_a_token_of_another_realm_is_not_found(world: RealmAdminWorld) -> None:
    """Its name does not disclose the number of tokens, and revokes it only in its own realm."""
    (token,) = (await world.see(users.tokens, "toad", ALL, who="root@lab2"))["tokens"]
    assert len(token["id"]) == 16 and token["kind"] == "access"
    for id in (token["id"], token["id"][:15], "%" * 16, "_" * 16, "1"):
        with pytest.raises(NotFound, match="no user of your realm has such a token"):
            await world.do(users.revoke_token, id)
    await world.do(users.revoke_token, token["id"], who="root@lab2")
    assert (await world.see(users.tokens, "toad", ALL, who="root@lab2"))["tokens"] == []
