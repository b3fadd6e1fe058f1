"""How much administrators may change of their realm, and by which tokens, on a real database."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted
from twisted.internet.defer import CancelledError, Deferred

from relay_db import queries
from relay_db.queries import AlreadyExists, QuotaExceeded
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_server.auth import passwords
from relay_server.realms import limits, realm_change, robots, users
from relay_server.realms.service import TooManyChanges
from tests.relay_server.administration.office import ALL, Office


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
async def test_what_new_things_may_be_called(
    office: Office, monkeypatch: pytest.MonkeyPatch, work: Any, name: str, more: Any
) -> None:
    """Nothing that there is, that can't be a name, or that can't stand in an address; and there are not too many."""
    with pytest.raises(AlreadyExists, match=f"'{name}' already"):
        await office.do(work, name, *more)
    for impossible in ("", "a b", "a@lab1", "a/b", "..", "\0", "x" * 64):
        with pytest.raises(Invalid):
            await office.do(work, impossible, *more)
    for what in limits.MOST:
        monkeypatch.setitem(limits.MOST, what, 1)
    with pytest.raises(QuotaExceeded, match=r"1 .* at most"):
        await office.do(work, "other", *more)
    assert office.record() == []


@pytest_twisted.ensureDeferred
async def test_a_right_that_can_not_be_is_refused(office: Office) -> None:
    """As on the command line; one in the place of another is told from a new one."""
    with pytest.raises(Invalid):
        await office.do(robots.grant, "mobile", "toad", "viewer", ["fly:/x"], [])
    _, fresh = await office.do(robots.grant, "mobile", "toad", "viewer", [], [])
    right, again = await office.do(robots.grant, "mobile", "Toad", "operator", ["call:/reset"], [])
    assert (fresh, again) == (True, False)
    assert (right["holder"], right["level"], right["allow"]) == ("toad", "operator", ["call:/reset"])
    await office.do(robots.revoke, "mobile", "toad")
    with pytest.raises(NotFound, match="no such right"):
        await office.do(robots.revoke, "mobile", "toad")
    with pytest.raises(NotFound, match="not in this group"):
        await office.do(users.leave, "crew", "toad")


def test_changes_are_counted(office: Office) -> None:
    """Too many of a realm are refused, whoever makes them; looks are not, and after a time there may be more."""
    root, boss = office.people["root@lab1"], office.people["boss@lab1"]
    for each in (root, boss):
        for _ in range(limits.CHANGES_AT_ONCE // 2):
            office.desk.admit(each, changes=True)
    for each in (root, boss, office.by_token("boss", "lab1", None)):
        with pytest.raises(TooManyChanges):
            office.desk.admit(each, changes=True)
    office.desk.admit(root)
    office.desk.admit(office.people["root@lab2"], changes=True)
    office.seconds = 1.0
    office.desk.admit(root, changes=True)


def test_one_token_leaves_changes_to_others(office: Office) -> None:
    """Or who has stolen one could keep everybody from revoking it."""
    root = office.people["root@lab1"]
    for _ in range(limits.CHANGES_AT_ONCE // 2):
        office.desk.admit(root, changes=True)
    with pytest.raises(TooManyChanges):
        office.desk.admit(root, changes=True)
    office.desk.admit(office.people["boss@lab1"], changes=True)


def test_many_patterns_count_as_many_changes(office: Office) -> None:
    """As they are compiled where everybody's robots are served; what is refused is not counted."""
    root, patterns = office.people["root@lab1"], 9 * limits.PATTERNS_A_CHANGE
    for _ in range(limits.CHANGES_AT_ONCE // 2 // 10):
        office.desk.count(root, patterns)
    for _ in range(2):
        with pytest.raises(TooManyChanges) as error:
            office.desk.count(root, patterns)
        assert error.value.retry_after == 10 / (limits.CHANGES_A_SECOND / 2)
    office.seconds = error.value.retry_after
    office.desk.count(root, patterns)


@pytest_twisted.ensureDeferred
async def test_rights_have_not_too_many_patterns(office: Office, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither those on a robot nor those of the realm; what takes the place of as many is taken."""
    monkeypatch.setattr(realm_change, "MOST_PATTERNS", 5)
    monkeypatch.setattr(realm_change, "MOST_PATTERNS_OF_A_ROBOT", 3)
    await office.do(robots.add_robot, "arm", "")
    await office.do(robots.grant, "mobile", "toad", "viewer", ["call:/a"], ["call:/b"])
    with pytest.raises(QuotaExceeded, match="use wildcards"):
        await office.do(robots.grant, "mobile", "@crew", "viewer", ["call:/a", "call:/b"], [])
    await office.do(robots.grant, "mobile", "toad", "viewer", ["call:/c"], ["call:/b", "call:/d"])
    await office.do(robots.grant, "arm", "toad", "viewer", ["call:/a", "call:/b"], [])
    with pytest.raises(QuotaExceeded):
        await office.do(robots.grant, "arm", "@crew", "viewer", ["call:/a"], [])
    await office.do(robots.grant, "arm", "@crew", "viewer", [], [])
    await office.do(robots.grant, "mobile", "toad", "viewer", ["call:/e"], ["call:/b", "call:/d"])


@pytest_twisted.ensureDeferred
async def test_the_same_right_again_changes_nothing(office: Office) -> None:
    """Nor is it on record: the relay has nothing to take up."""
    given = ("mobile", "@crew", "operator", ["call:/reset"], ["publish:/x"])
    told, fresh = await office.do(robots.grant, *given)
    with office.store.database.reading() as s:
        revision = queries.revision(s)
    assert fresh and await office.do(robots.grant, *given) == (told, False)
    with office.store.database.reading() as s:
        assert queries.revision(s) == revision
    assert len(office.record()) == 1


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
        (users.add_program, ("toad", "", None)),
    ],
)
@pytest_twisted.ensureDeferred
async def test_a_token_for_administration_alone_gives_nobody_more(
    office: Office, work: Any, args: Any
) -> None:
    """Or it would be worth all that its user may: by it he could set his own password."""
    office.people["narrow"] = office.by_token("root", "lab1", "admin")
    with pytest.raises(Refused, match="a token without a scope"):
        await office.do(work, *args, who="narrow")
    assert office.record() == []


@pytest_twisted.ensureDeferred
async def test_a_token_for_administration_shuts_out_and_sees_to_robots(office: Office) -> None:
    """It hashes no password, but users are disabled, tokens revoked, and robots added, enrolled and removed."""
    office.people["narrow"] = narrow = office.by_token("root", "lab1", "admin")
    with pytest.raises(Refused, match="a token without a scope"):
        await office.desk.new_hash(narrow, "correct horse")
    await office.do(users.change_user, "toad", None, True, None, who="narrow")
    await office.do(robots.add_robot, "arm", "", who="narrow")
    await office.do(robots.new_code, "arm", who="narrow")
    await office.do(robots.change_robot, "arm", "on the bench", who="narrow")
    await office.do(robots.join, "cleaners", "arm", who="narrow")
    await office.do(robots.remove_robot, "arm", 0, who="narrow")
    (token,) = (await office.see(users.tokens, "toad", ALL, who="narrow"))["tokens"]
    await office.do(users.revoke_token, token["id"], who="narrow")
    assert [each[2] for each in office.record()] == [
        "user.disable",
        "robot.add",
        "robot.code",
        "robot.describe",
        "robot.group.add",
        "robot.remove",
        "token.revoke",
    ]


@pytest_twisted.ensureDeferred
async def test_few_passwords_are_hashed_at_once(office: Office) -> None:
    """People who log in wait in the same line; what is done makes room, and that somebody has left does not."""
    root, office.held = office.people["root@lab1"], Deferred()
    left, *waiting = (
        Deferred.fromCoroutine(office.desk.new_hash(root, "correct horse"))
        for _ in range(limits.PASSWORDS_AT_ONCE)
    )
    left.cancel()
    with pytest.raises(CancelledError):
        await left
    with pytest.raises(Unavailable, match="too many passwords"):
        await office.desk.new_hash(root, "correct horse")
    office.held.callback(None)
    for each in waiting:
        assert passwords.verify_password("correct horse", await each)
    assert await office.desk.new_hash(root, "correct horse")
