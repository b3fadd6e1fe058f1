"""Limits of administrators' changes, and the tokens for them, with a real database."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted
from twisted.internet.defer import CancelledError, Deferred

from relay_db import queries
from relay_db.queries import AlreadyExists, QuotaExceeded
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_server.auth import passwords
from relay_server.realms import realm_change, robots, schemas, users
from relay_server.realms.service import TooManyChanges
from tests.worlds.realm_admin import ALL, RealmAdminWorld


@pytest.mark.parametrize(
    ("work", "name", "more"),
    [
        (users.add_user, "toad", (None, False)),
        (users.add_group, "crew", ()),
        (robots.add_robot, "mobile", ("",)),
        (robots.add_group, "cleaners", ()),
    ],
)
@pytest_twisted.ensureDeferred
async def test_valid_names(
    world: RealmAdminWorld, monkeypatch: pytest.MonkeyPatch, work: Any, name: str, more: Any
) -> None:
    """Names in use, invalid names, and names that do not fit in a URL are refused, and their number is
    bounded.
    """
    with pytest.raises(AlreadyExists, match=f"'{name}' exists already"):
        await world.do(work, name, *more)
    for impossible in ("", "a b", "a@lab1", "a/b", "..", "\0", "x" * 64):
        with pytest.raises(Invalid):
            await world.do(work, impossible, *more)
    for what in schemas.MAX_COUNTS:
        monkeypatch.setitem(schemas.MAX_COUNTS, what, 1)
    with pytest.raises(QuotaExceeded, match=r"1 .* at most"):
        await world.do(work, "other", *more)
    assert world.record() == []


@pytest_twisted.ensureDeferred
async def test_a_right_that_can_not_be_is_refused(world: RealmAdminWorld) -> None:
    """As on the command line; the result says whether a right was replaced or new."""
    with pytest.raises(Invalid):
        await world.do(robots.grant, "mobile", "toad", "viewer", ["fly:/x"], [])
    _, fresh = await world.do(robots.grant, "mobile", "toad", "viewer", [], [])
    right, again = await world.do(robots.grant, "mobile", "Toad", "operator", ["call:/reset"], [])
    assert (fresh, again) == (True, False)
    assert (right["holder"], right["level"], right["allow"]) == ("toad", "operator", ["call:/reset"])
    await world.do(robots.revoke, "mobile", "toad")
    with pytest.raises(NotFound, match="no such right"):
        await world.do(robots.revoke, "mobile", "toad")
    with pytest.raises(NotFound, match="not in this group"):
        await world.do(users.leave, "crew", "toad")


def test_changes_are_counted(world: RealmAdminWorld) -> None:
    """The limit is per realm over all administrators. Reads do not count, and the limit refills."""
    root, boss = world.people["root@lab1"], world.people["boss@lab1"]
    for each in (root, boss):
        for _ in range(schemas.CHANGES_BURST // 2):
            world.service.admit(each, changes=True)
    for each in (root, boss, world.by_token("boss", "lab1", None)):
        with pytest.raises(TooManyChanges):
            world.service.admit(each, changes=True)
    world.service.admit(root)
    world.service.admit(world.people["root@lab2"], changes=True)
    world.seconds = 1.0
    world.service.admit(root, changes=True)


def test_changes_are_limited_per_token(world: RealmAdminWorld) -> None:
    """Otherwise the owner of a stolen token could prevent its revocation."""
    root = world.people["root@lab1"]
    for _ in range(schemas.CHANGES_BURST // 2):
        world.service.admit(root, changes=True)
    with pytest.raises(TooManyChanges):
        world.service.admit(root, changes=True)
    world.service.admit(world.people["boss@lab1"], changes=True)


def test_many_patterns_count_as_many_changes(world: RealmAdminWorld) -> None:
    """They are compiled in the process that serves all robots; refused changes are not counted."""
    root, patterns = world.people["root@lab1"], 9 * schemas.PATTERNS_PER_CHANGE
    for _ in range(schemas.CHANGES_BURST // 2 // 10):
        world.service.count(root, patterns)
    for _ in range(2):
        with pytest.raises(TooManyChanges) as error:
            world.service.count(root, patterns)
        assert error.value.retry_after == 10 / (schemas.CHANGES_PER_SECOND / 2)
    world.seconds = error.value.retry_after
    world.service.count(root, patterns)


@pytest_twisted.ensureDeferred
async def test_rights_have_not_too_many_patterns(
    world: RealmAdminWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Per robot and per realm; replacing as many is allowed."""
    monkeypatch.setattr(realm_change, "MAX_PATTERNS", 5)
    monkeypatch.setattr(realm_change, "MAX_PATTERNS_OF_A_ROBOT", 3)
    await world.do(robots.add_robot, "arm", "")
    await world.do(robots.grant, "mobile", "toad", "viewer", ["call:/a"], ["call:/b"])
    with pytest.raises(QuotaExceeded, match="use wildcards"):
        await world.do(robots.grant, "mobile", "@crew", "viewer", ["call:/a", "call:/b"], [])
    await world.do(robots.grant, "mobile", "toad", "viewer", ["call:/c"], ["call:/b", "call:/d"])
    await world.do(robots.grant, "arm", "toad", "viewer", ["call:/a", "call:/b"], [])
    with pytest.raises(QuotaExceeded):
        await world.do(robots.grant, "arm", "@crew", "viewer", ["call:/a"], [])
    await world.do(robots.grant, "arm", "@crew", "viewer", [], [])
    await world.do(robots.grant, "mobile", "toad", "viewer", ["call:/e"], ["call:/b", "call:/d"])


@pytest_twisted.ensureDeferred
async def test_the_same_right_again_changes_nothing(world: RealmAdminWorld) -> None:
    """It is not audited, and the relay applies nothing."""
    given = ("mobile", "@crew", "operator", ["call:/reset"], ["publish:/x"])
    reported, fresh = await world.do(robots.grant, *given)
    with world.store.database.reading() as s:
        revision = queries.revision(s)
    assert fresh and await world.do(robots.grant, *given) == (reported, False)
    with world.store.database.reading() as s:
        assert queries.revision(s) == revision
    assert len(world.record()) == 1


@pytest.mark.parametrize(
    ("work", "args"),
    [
        (users.add_user, ("luigi", None, False)),
        (users.change_user, ("toad", "hash", None, None)),
        (users.change_user, ("toad", None, True, True)),
        (users.change_user, ("toad", None, False, None)),
        (users.change_user, ("toad", None, None, True)),
        (users.change_user, ("toad", None, None, None)),
        (users.remove_user, ("toad",)),
        (users.add_group, ("band",)),
        (users.remove_group, ("crew",)),
        (users.join, ("crew", "toad")),
        (users.leave, ("crew", "toad")),
        (robots.grant, ("mobile", "toad", "viewer", [], [])),
        (robots.revoke, ("mobile", "toad")),
        (users.add_oauth_client, ("toad", "", None)),
    ],
)
@pytest_twisted.ensureDeferred
async def test_a_token_for_administration_gives_no_other_right(
    world: RealmAdminWorld, work: Any, args: Any
) -> None:
    """Otherwise it would give all rights of its user, who could set their own password by it."""
    world.people["narrow"] = world.by_token("root", "lab1", "admin")
    with pytest.raises(Refused, match="an access token without a scope"):
        await world.do(work, *args, who="narrow")
    assert world.record() == []


@pytest_twisted.ensureDeferred
async def test_a_token_for_administration_shuts_out_and_sees_to_robots(world: RealmAdminWorld) -> None:
    """It hashes no password. It may disable users, revoke tokens, and add, enrol and remove robots."""
    world.people["narrow"] = narrow = world.by_token("root", "lab1", "admin")
    with pytest.raises(Refused, match="an access token without a scope"):
        await world.service.new_hash(narrow, "correct horse")
    await world.do(users.change_user, "toad", None, True, None, who="narrow")
    await world.do(robots.add_robot, "arm", "", who="narrow")
    await world.do(robots.new_code, "arm", who="narrow")
    await world.do(robots.change_robot, "arm", "on the bench", who="narrow")
    await world.do(robots.join, "cleaners", "arm", who="narrow")
    await world.do(robots.remove_robot, "arm", 0, who="narrow")
    (token,) = (await world.see(users.tokens, "toad", ALL, who="narrow"))["tokens"]
    await world.do(users.revoke_token, token["id"], who="narrow")
    assert [each[2] for each in world.record()] == [
        "user.disable",
        "robot.add",
        "robot.code",
        "robot.describe",
        "robot.group.add",
        "robot.remove",
        "token.revoke",
    ]


@pytest_twisted.ensureDeferred
async def test_few_passwords_are_hashed_at_once(world: RealmAdminWorld) -> None:
    """Logins wait in the same queue; finished hashes make room, cancelled callers do not."""
    root, world.held = world.people["root@lab1"], Deferred()
    left, *waiting = (
        Deferred.fromCoroutine(world.service.new_hash(root, "correct horse"))
        for _ in range(schemas.PASSWORDS_AT_ONCE)
    )
    left.cancel()
    with pytest.raises(CancelledError):
        await left
    with pytest.raises(Unavailable, match="too many passwords"):
        await world.service.new_hash(root, "correct horse")
    world.held.callback(None)
    for each in waiting:
        assert passwords.verify_password("correct horse", await each)
    assert await world.service.new_hash(root, "correct horse")
