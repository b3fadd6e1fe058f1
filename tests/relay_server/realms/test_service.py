"""Changes of administrators in their own realm, with a real database."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet.defer import CancelledError, Deferred

from relay_db import queries
from relay_db.queries import PrincipalRecord
from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.auth import passwords
from relay_server.realms import robots, users
from relay_server.realms.realm_change import LastAdministrator
from tests.worlds.realm_admin import ALL, HERE, RealmAdminWorld


@pytest_twisted.ensureDeferred
async def test_every_change_is_on_record_as_by_the_command_line(world: RealmAdminWorld) -> None:
    """With full names, user and address; the relay applies it before the answer."""
    tokens = await world.see(users.tokens, "toad", ALL)
    done: list[tuple[Callable[..., Any], tuple[Any, ...], str, str]] = [
        (users.add_user, ("luigi", None, False), "user.add", "luigi@lab1"),
        (users.change_user, ("luigi", "hash", None, None), "user.password", "luigi@lab1"),
        (users.change_user, ("luigi", None, True, None), "user.disable", "luigi@lab1"),
        (users.change_user, ("luigi", None, False, None), "user.enable", "luigi@lab1"),
        (users.change_user, ("luigi", None, None, True), "user.admin", "luigi@lab1"),
        (users.remove_user, ("luigi",), "user.remove", "luigi@lab1"),
        (users.add_group, ("band",), "group.add", "band@lab1"),
        (users.join, ("band", "toad"), "group.join", "band@lab1"),
        (users.leave, ("band", "toad"), "group.leave", "band@lab1"),
        (users.remove_group, ("band",), "group.remove", "band@lab1"),
        (robots.add_robot, ("arm", "an arm"), "robot.add", "arm@lab1"),
        (robots.new_code, ("arm",), "robot.code", "arm@lab1"),
        (robots.remove_robot, ("arm", 3), "robot.remove", "arm@lab1"),
        (robots.grant, ("mobile", "toad", "viewer", [], []), "right.grant", "toad@lab1 on mobile@lab1"),
        (robots.grant, ("mobile", "@crew", "owner", [], []), "right.grant", "@crew@lab1 on mobile@lab1"),
        (robots.revoke, ("mobile", "@crew"), "right.revoke", "@crew@lab1 on mobile@lab1"),
        (users.revoke_token, (tokens["tokens"][0]["id"],), "token.revoke", "1"),
    ]
    for number, (work, args, *_) in enumerate(done, 1):
        await world.do(work, *args)
        assert world.taken_up == number
    log = world.record()
    assert [each[2:4] for each in log] == [(action, target) for *_, action, target in done]
    assert {each[:2] for each in log} == {("user:root@lab1", HERE)}
    assert log[12][4] == {"recordings": 3}
    right = {"holder": "toad@lab1", "robot": "mobile@lab1"}
    assert log[13][4] == {**right, "level": "viewer", "allow": [], "deny": []}
    assert log[15][4] == {"holder": "@crew@lab1", "robot": "mobile@lab1"}
    assert log[16][4] == {"user": "toad@lab1"}


@pytest_twisted.ensureDeferred
async def test_removal_of_a_robot_counts_its_recordings(world: RealmAdminWorld) -> None:
    """The audit entry equals that of the command line; the relay deletes them."""
    world.recorded = 2
    await world.service.remove_robot(world.people["root@lab1"], HERE, "mobile")
    assert world.record()[-1][2:] == ("robot.remove", "mobile@lab1", {"recordings": 2})
    with pytest.raises(NotFound):
        await world.service.remove_robot(world.people["root@lab1"], HERE, "mobile")


@pytest.mark.parametrize(
    ("work", "args"),
    [
        (users.remove_user, ("root",)),
        (users.remove_user, ("ROOT",)),
        (users.change_user, ("root", None, True, None)),
        (users.change_user, ("root", "hash", None, False)),
    ],
)
@pytest_twisted.ensureDeferred
async def test_administrators_cannot_remove_themselves(world: RealmAdminWorld, work: Any, args: Any) -> None:
    """Removing, disabling and demoting themselves are refused, so a realm never loses its last administrator."""
    before = await world.see(users.user, "root")
    with pytest.raises(LastAdministrator, match="ask another one"):
        await world.do(work, *args)
    assert await world.see(users.user, "root") == before
    assert world.record() == []


@pytest.mark.parametrize(
    ("work", "args"),
    [
        (users.remove_user, ()),
        (users.change_user, (None, True, None)),
        (users.change_user, (None, None, False)),
    ],
)
@pytest_twisted.ensureDeferred
async def test_of_two_administrators_who_remove_each_other_one_stays(
    world: RealmAdminWorld, work: Any, args: Any
) -> None:
    """Both were administrators when their requests were authenticated; this is checked again in the
    transaction.
    """
    await world.do(work, "boss", *args)
    with pytest.raises(Refused):
        await world.do(work, "root", *args, who="boss@lab1")
    reported = (await world.see(users.users, ALL))["users"]
    assert "root" in [each["user"] for each in reported if each["admin"] and not each["disabled"]]


@pytest_twisted.ensureDeferred
async def test_a_token_that_has_ended_changes_nothing(world: RealmAdminWorld) -> None:
    """It was valid when its request arrived."""
    with world.store.database.begin() as s:
        queries.revoke_token(s, world.people["root@lab1"].token_id)
    with pytest.raises(BadCredentials):
        await world.do(users.add_group, "band")


@pytest.mark.parametrize(
    ("scope", "may"), [(None, True), ("admin", True), ("viewer admin", True), ("owner", False)]
)
@pytest_twisted.ensureDeferred
async def test_a_token_must_be_for_administration(
    world: RealmAdminWorld, scope: str | None, may: bool
) -> None:
    """For every user, who must also be an administrator."""
    world.people["by token"] = world.by_token("root", "lab1", scope)
    world.people["toad's"] = world.by_token("toad", "lab1", scope)
    if may:
        assert (await world.see(users.realm_info, who="by token"))["realm"] == "lab1"
    else:
        with pytest.raises(Refused, match="for administrators of the realm"):
            await world.do(users.add_group, "band", who="by token")
    with pytest.raises(Refused, match="for administrators of the realm"):
        await world.see(users.realm_info, who="toad's")


@pytest_twisted.ensureDeferred
async def test_a_new_password_ends_sessions_but_the_one_that_asks(world: RealmAdminWorld) -> None:
    """For another user it ends all of them."""
    with world.store.database.begin() as s:
        for name in ("root", "toad"):
            user = queries.find_user(s, name, "lab1")
            assert user is not None
            for number in range(2):
                hash = passwords.token_hash(f"{name}{number}")
                queries.create_token(s, user.id, hash, kind="session", expires=None, now=1.0)
        root = queries.find_user(s, "root", "lab1")
        assert root is not None
        own = queries.create_token(s, root.id, "c" * 64, kind="session", expires=None, now=1.0)
        record = PrincipalRecord(root.id, "root", "lab1", True, own, None)
        world.people["session"] = Principal.of(record)
    for name, left in (("toad", 0), ("root", 1)):
        await world.do(users.change_user, name, "hash", None, None, who="session")
        reported = (await world.see(users.tokens, name, ALL))["tokens"]
        assert len([each for each in reported if each["kind"] == "session"]) == left


@pytest_twisted.ensureDeferred
async def test_a_change_that_is_taken_up_later_is_done(world: RealmAdminWorld) -> None:
    """The answer does not wait for a database that hangs afterwards; the relay retries by itself."""
    world.down = True
    assert (await world.do(robots.add_robot, "arm", ""))["enrolment_code"]
    assert (await world.see(robots.robot, "arm"))["keys"] == 0


@pytest_twisted.ensureDeferred
async def test_gone_client_does_not_prevent_resubscription(world: RealmAdminWorld) -> None:
    """Sessions with revoked rights are still cut."""
    begun: Deferred[None] = Deferred()
    held: Deferred[None] = Deferred()
    done = []

    async def take_up() -> None:
        begun.callback(None)
        await held
        done.append(True)

    world.service._apply = take_up
    waiting = Deferred.fromCoroutine(world.do(users.remove_user, "toad"))
    await begun
    # Not while the lock is held.
    await world.see(users.realm_info)
    waiting.cancel()
    with pytest.raises(CancelledError):
        await waiting
    held.callback(None)
    assert done


@pytest_twisted.ensureDeferred
async def test_a_database_that_does_not_answer_is_reported(
    world: RealmAdminWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The change was not made."""

    def fails(*_: object) -> None:
        raise Unavailable("the disk with the database is full; free some space")

    monkeypatch.setattr(queries, "append_audit", lambda *_, **__: fails())
    with pytest.raises(SwitchboardError, match="disk"):
        await world.do(users.add_group, "band")
    with pytest.raises(NotFound):
        await world.see(users.group, "band")


def test_the_service_module_imports_neither_commands_nor_a_reactor() -> None:
    """The command line and the relay share the module."""
    for each in Path(users.__file__).parent.glob("*.py"):
        text = each.read_text()
        assert "import click" not in text and "internet import reactor" not in text, each.name
