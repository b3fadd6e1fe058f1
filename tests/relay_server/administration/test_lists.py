"""What administrators are told of their own realm, and that nothing of another is there for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol.errors import NotFound
from relay_server.realms import robots, users
from relay_server.resources.page import PageQuery
from tests.relay_server.administration.office import ALL, Office

LOOKS: list[tuple[Callable[..., Any], tuple[Any, ...]]] = [
    (users.user, ("{}",)),
    (users.tokens, ("{}", ALL)),
    (users.programs, ("{}", ALL)),
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
    (users.add_program, ("{}", "", None)),
    (users.revoke_program, ("{}",)),
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
async def test_what_is_of_another_realm_is_not_there(office: Office, work: Any, args: Any) -> None:
    """By its bare name and by its full one: the answer is that of a name nobody has."""
    with office.store.database.begin() as s:
        queries.add_user(s, "mole", None, realm="lab2")
        queries.add_group(s, "mole", realm="lab2")
        queries.add_robot(s, "mole", realm="lab2")
        queries.add_robot_group(s, "mole", realm="lab2")
    said = set()
    for name in ("mole", "mole@lab2", "nobody", "toad@lab2", "\0", "", "mobile@lab2"):
        given = [each.format(name) if isinstance(each, str) else each for each in args]
        with pytest.raises(NotFound) as error:
            await (office.see if (work, args) in LOOKS else office.do)(work, *given)
        said.add(str(error.value))
    assert len(said) == 1
    assert office.record() == []


@pytest_twisted.ensureDeferred
async def test_lists_are_of_the_own_realm(office: Office) -> None:
    """Whole, and by pages, in the order of names."""
    with office.store.database.begin() as s:
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
    assert await office.see(users.about) == {
        "realm": "lab1",
        "users": 3,
        "groups": 1,
        "robots": 1,
        "programs": 0,
        "robot_groups": 1,
        "events_days": None,
    }
    told = await office.see(users.users, ALL)
    assert [(each["user"], each["groups"]) for each in told["users"]] == [
        ("boss", []),
        ("root", []),
        ("toad", ["crew"]),
    ]
    first = await office.see(users.users, PageQuery(limit=2))
    assert (first["users"], first["next"]) == (told["users"][:2], "root")
    assert await office.see(users.users, PageQuery(after="root")) == {"users": told["users"][2:], "next": ""}
    assert (await office.see(users.groups, ALL))["groups"] == [{"group": "crew", "members": ["toad"]}]
    assert (await office.see(robots.robots, ALL))["robots"] == [
        {"robot": "mobile", "description": "", "keys": 2, "guest": False}
    ]
    rights = (await office.see(robots.rights, ALL, None, None))["rights"]
    assert [(each["holder"], each["level"]) for each in rights] == [("@crew", "viewer"), ("toad", "viewer")]
    assert (await office.see(robots.rights, ALL, None, "boss"))["rights"] == []
    assert len((await office.see(robots.rights, ALL, "mobile", "toad"))["rights"]) == 2
    await office.do(robots.revoke_key, "mobile", "61" * 8)
    keys = (await office.see(robots.keys, "mobile", ALL))["keys"]
    assert [each["retired"] for each in keys] == [1000.0, None]


@pytest_twisted.ensureDeferred
async def test_a_token_of_another_realm_is_none(office: Office) -> None:
    """Its name says nothing of how many tokens there are, and revokes it in its own realm alone."""
    (token,) = (await office.see(users.tokens, "toad", ALL, who="root@lab2"))["tokens"]
    assert len(token["id"]) == 16 and token["kind"] == "access"
    for id in (token["id"], token["id"][:15], "%" * 16, "_" * 16, "1"):
        with pytest.raises(NotFound, match="nobody in your realm has such a token"):
            await office.do(users.revoke_token, id)
    await office.do(users.revoke_token, token["id"], who="root@lab2")
    assert (await office.see(users.tokens, "toad", ALL, who="root@lab2"))["tokens"] == []
