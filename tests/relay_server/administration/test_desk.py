"""What administrators change of their own realm, on a real database."""

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
from relay_server.realms.realm_change import Needed
from tests.relay_server.administration.office import ALL, HERE, Office


@pytest_twisted.ensureDeferred
async def test_every_change_is_on_record_as_by_the_command_line(office: Office) -> None:
    """With full names, by whom and from where; and taken up by the relay before it is answered."""
    tokens = await office.see(users.tokens, "toad", ALL)
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
        await office.do(work, *args)
        assert office.taken_up == number
    log = office.record()
    assert [each[2:4] for each in log] == [(action, target) for *_, action, target in done]
    assert {each[:2] for each in log} == {("user:root@lab1", HERE)}
    assert log[12][4] == {"recordings": 3}
    right = {"holder": "toad@lab1", "robot": "mobile@lab1"}
    assert log[13][4] == {**right, "level": "viewer", "allow": [], "deny": []}
    assert log[15][4] == {"holder": "@crew@lab1", "robot": "mobile@lab1"}
    assert log[16][4] == {"user": "toad@lab1"}


@pytest_twisted.ensureDeferred
async def test_what_is_removed_of_a_robot_counts_its_recordings(office: Office) -> None:
    """As the command line puts it on record; the relay deletes them."""
    office.recorded = 2
    await office.desk.remove_robot(office.people["root@lab1"], HERE, "mobile")
    assert office.record()[-1][2:] == ("robot.remove", "mobile@lab1", {"recordings": 2})
    with pytest.raises(NotFound):
        await office.desk.remove_robot(office.people["root@lab1"], HERE, "mobile")


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
async def test_nobody_takes_himself_away(office: Office, work: Any, args: Any) -> None:
    """Neither removed, nor disabled, nor no administrator any more: so a realm never loses its last one."""
    before = await office.see(users.user, "root")
    with pytest.raises(Needed, match="have another one do it"):
        await office.do(work, *args)
    assert await office.see(users.user, "root") == before
    assert office.record() == []


@pytest.mark.parametrize(
    ("work", "args"),
    [
        (users.remove_user, ()),
        (users.change_user, (None, True, None)),
        (users.change_user, (None, None, False)),
    ],
)
@pytest_twisted.ensureDeferred
async def test_of_two_who_take_each_other_away_one_stays(office: Office, work: Any, args: Any) -> None:
    """Though both were administrators when they were let in: it is seen again when nobody else can change it."""
    await office.do(work, "boss", *args)
    with pytest.raises(Refused):
        await office.do(work, "root", *args, who="boss@lab1")
    told = (await office.see(users.users, ALL))["users"]
    assert "root" in [each["user"] for each in told if each["admin"] and not each["disabled"]]


@pytest_twisted.ensureDeferred
async def test_a_token_that_has_ended_changes_nothing(office: Office) -> None:
    """Though it was good when its request came."""
    with office.store.database.begin() as s:
        queries.revoke_token(s, office.people["root@lab1"].token_id)
    with pytest.raises(BadCredentials):
        await office.do(users.add_group, "band")


@pytest.mark.parametrize(
    ("scope", "may"), [(None, True), ("admin", True), ("viewer admin", True), ("owner", False)]
)
@pytest_twisted.ensureDeferred
async def test_a_token_must_be_for_administration(office: Office, scope: str | None, may: bool) -> None:
    """Whatever its user is; and its user has to be one."""
    office.people["by token"] = office.by_token("root", "lab1", scope)
    office.people["toad's"] = office.by_token("toad", "lab1", scope)
    if may:
        assert (await office.see(users.about, who="by token"))["realm"] == "lab1"
    else:
        with pytest.raises(Refused, match="for administrators of the realm"):
            await office.do(users.add_group, "band", who="by token")
    with pytest.raises(Refused, match="for administrators of the realm"):
        await office.see(users.about, who="toad's")


@pytest_twisted.ensureDeferred
async def test_a_new_password_ends_sessions_but_the_one_that_asks(office: Office) -> None:
    """Of somebody else it ends all of them."""
    with office.store.database.begin() as s:
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
        office.people["session"] = Principal.of(record)
    for name, left in (("toad", 0), ("root", 1)):
        await office.do(users.change_user, name, "hash", None, None, who="session")
        told = (await office.see(users.tokens, name, ALL))["tokens"]
        assert len([each for each in told if each["kind"] == "session"]) == left


@pytest_twisted.ensureDeferred
async def test_a_change_that_is_taken_up_later_is_done(office: Office) -> None:
    """Its answer is not lost with a database that hangs after it: the relay looks again by itself."""
    office.down = True
    assert (await office.do(robots.add_robot, "arm", ""))["enrolment_code"]
    assert (await office.see(robots.robot, "arm"))["keys"] == 0


@pytest_twisted.ensureDeferred
async def test_who_leaves_does_not_keep_it_from_being_taken_up(office: Office) -> None:
    """What he has revoked is cut all the same."""
    begun: Deferred[None] = Deferred()
    held: Deferred[None] = Deferred()
    done = []

    async def take_up() -> None:
        begun.callback(None)
        await held
        done.append(True)

    office.desk._take_up = take_up
    waiting = Deferred.fromCoroutine(office.do(users.remove_user, "toad"))
    await begun
    # Not from within what is held.
    await office.see(users.about)
    waiting.cancel()
    with pytest.raises(CancelledError):
        await waiting
    held.callback(None)
    assert done


@pytest_twisted.ensureDeferred
async def test_a_database_that_does_not_answer_is_told(
    office: Office, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing was done then."""

    def fails(*_: object) -> None:
        raise Unavailable("the disk with the database is full; free some space")

    monkeypatch.setattr(queries, "append_audit", lambda *_, **__: fails())
    with pytest.raises(SwitchboardError, match="disk"):
        await office.do(users.add_group, "band")
    with pytest.raises(NotFound):
        await office.see(users.group, "band")


def test_the_room_knows_neither_commands_nor_a_reactor() -> None:
    """It is the command line's as well as the relay's."""
    for each in Path(users.__file__).parent.glob("*.py"):
        text = each.read_text()
        assert "import click" not in text and "internet import reactor" not in text, each.name
