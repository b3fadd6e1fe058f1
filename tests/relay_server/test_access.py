"""The only judge, with a real database: what is open follows the rights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, cast

import pytest
import pytest_twisted
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_protocol.rights import Level, Operation
from relay_server import access as module
from relay_server.access import Access, BadCredentials, Permit, Principal
from relay_server.common.database import AsyncDatabase

HASH = "ab" * 32


@dataclass
class Hall:
    """An access with one user, one token and one robot in its database."""

    store: AsyncDatabase
    now: float = 1000.0
    told: list[str] = field(default_factory=list)

    async def open(self) -> Hall:
        """Fill the database."""
        self.access = Access(self.store, lambda: self.now)
        self.user = await self.store.write(queries.add_user, "ann", None)
        self.robot = await self.store.write(queries.add_robot, "rover")
        await self.grant("viewer")
        await self.store.write(
            queries.create_token, self.user.id, HASH, kind="access", expires=5000.0, now=self.now
        )
        record = await self.store.read(queries.principal_by_token, HASH, self.now)
        assert record is not None
        self.principal = Principal.of(record)
        return self

    async def grant(self, level: str, **patterns: Any) -> None:
        """Give ann a right on the robot."""
        await self.store.write(queries.grant_right, self.robot.id, level, user_id=self.user.id, **patterns)

    def slow_down(self) -> SlowStore:
        """What the access reads from now on comes when the test lets it."""
        slow = SlowStore(self.store)
        self.access._store = cast(AsyncDatabase, slow)
        return slow

    async def permit(self) -> Permit:
        """A permit whose holder notes what it is told."""
        permit = await self.access.permit(self.principal, self.robot)
        assert permit is not None
        permit.on_change = lambda: self.told.append("changed")
        permit.on_revoke = lambda error: self.told.append(f"{type(error).__name__}: {error}")
        return permit


class SlowStore:
    """A store in front of another: the first read waits after it has been done, until the test lets it go."""

    def __init__(self, store: AsyncDatabase) -> None:
        self._store = store
        self.read_done: Deferred[None] = Deferred()
        self.go: Deferred[None] = Deferred()

    async def read(self, query: Callable[..., Any], *args: Any) -> Any:
        """As the store's."""
        found = await self._store.read(query, *args)
        if not self.read_done.called:
            self.read_done.callback(None)
            await self.go
        return found


@pytest_twisted.ensureDeferred
async def test_a_permit_judges_by_the_rights_in_the_database(store: AsyncDatabase) -> None:
    """And there is none without any right."""
    hall = await Hall(store).open()
    permit = await hall.permit()
    assert permit.judge(Operation.SUBSCRIBE, "/scan").allowed
    assert not permit.judge(Operation.PUBLISH, "/cmd_vel").allowed
    await store.write(queries.revoke_right, hall.robot.id, user_id=hall.user.id)
    assert await hall.access.permit(hall.principal, hall.robot) is None


@pytest_twisted.ensureDeferred
async def test_changed_rights_reach_what_is_open(store: AsyncDatabase) -> None:
    """The permit judges anew in place, and its holder is told once; nothing changed, nothing told."""
    hall = await Hall(store).open()
    permit = await hall.permit()
    await hall.access.refresh()
    assert hall.told == []
    await hall.grant("operator", deny=["publish:/arm"])
    await hall.access.refresh()
    await hall.access.refresh()
    assert hall.told == ["changed"]
    assert permit.rules.level is Level.OPERATOR
    assert not permit.judge(Operation.PUBLISH, "/arm").allowed


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("right", "Refused: your right on this robot was revoked"),
        ("token", "BadCredentials: your session was ended; log in again"),
        ("user", "BadCredentials: your session was ended; log in again"),
    ],
)
@pytest_twisted.ensureDeferred
async def test_what_is_revoked_is_told_once_and_nothing_is_allowed_after(
    store: AsyncDatabase, what: str, words: str
) -> None:
    """A right, a token, an account: each ends what was opened with it."""
    hall = await Hall(store).open()
    permit = await hall.permit()
    if what == "right":
        await store.write(queries.revoke_right, hall.robot.id, user_id=hall.user.id)
    elif what == "token":
        await store.write(queries.revoke_token, hall.principal.token_id)
    else:
        await store.write(queries.set_disabled, hall.user.id, True)
    await hall.access.refresh()
    await hall.access.refresh()
    assert hall.told == [words]
    assert not permit.judge(Operation.SUBSCRIBE, "/scan").allowed


@pytest_twisted.ensureDeferred
async def test_a_token_that_runs_out_ends_what_is_open(store: AsyncDatabase) -> None:
    """To the second, without asking the database."""
    hall = await Hall(store).open()
    await hall.permit()
    hall.now = 4999.9
    hall.access.expire()
    assert hall.told == []
    hall.now = 5000.0
    hall.access.expire()
    hall.access.expire()
    assert hall.told == ["BadCredentials: your session has expired; log in again"]


@pytest_twisted.ensureDeferred
async def test_a_released_permit_is_told_nothing(store: AsyncDatabase) -> None:
    """Nobody holds it, nothing keeps it."""
    hall = await Hall(store).open()
    permit = await hall.permit()
    hall.access.release(permit)
    hall.access.release(permit)
    await store.write(queries.revoke_token, hall.principal.token_id)
    await hall.access.refresh()
    assert hall.told == []
    assert not hall.access._permits


@pytest_twisted.ensureDeferred
async def test_no_permit_comes_of_rights_revoked_while_they_were_read(store: AsyncDatabase) -> None:
    """A refresh that goes by between the reading and its result is not missed."""
    hall = await Hall(store).open()
    slow = hall.slow_down()
    asking = Deferred.fromCoroutine(hall.access.permit(hall.principal, hall.robot))
    await slow.read_done
    await store.write(queries.revoke_right, hall.robot.id, user_id=hall.user.id)
    await hall.access.refresh()
    slow.go.callback(None)
    assert await asking is None
    assert not hall.access._permits


@pytest_twisted.ensureDeferred
async def test_no_list_is_kept_of_rights_revoked_while_they_were_read(store: AsyncDatabase) -> None:
    """The next look shows the truth."""
    hall = await Hall(store).open()
    slow = hall.slow_down()
    asking = Deferred.fromCoroutine(hall.access.robots(hall.principal))
    await slow.read_done
    await store.write(queries.revoke_right, hall.robot.id, user_id=hall.user.id)
    await hall.access.refresh()
    slow.go.callback(None)
    await asking
    assert await hall.access.robots(hall.principal) == []


@pytest_twisted.ensureDeferred
async def test_no_permit_for_a_token_that_ended_since_it_was_proved(store: AsyncDatabase) -> None:
    """Between the token's proof and the permit anything may happen."""
    hall = await Hall(store).open()
    await store.write(queries.revoke_token, hall.principal.token_id)
    with pytest.raises(BadCredentials, match="session was ended"):
        await hall.access.permit(hall.principal, hall.robot)


@pytest_twisted.ensureDeferred
async def test_robots_are_listed_with_the_right_on_each(store: AsyncDatabase) -> None:
    """Kept until something changes, then read again."""
    hall = await Hall(store).open()
    await store.write(queries.add_robot, "hidden")
    ((robot, rules),) = await hall.access.robots(hall.principal)
    assert (robot.name, rules.level) == ("rover", Level.VIEWER)
    await hall.grant("owner")
    ((_, rules),) = await hall.access.robots(hall.principal)
    assert rules.level is Level.VIEWER
    await hall.access.refresh()
    ((_, rules),) = await hall.access.robots(hall.principal)
    assert rules.level is Level.OWNER


@pytest.mark.parametrize("ended", ["token", "user", "time", "nothing"])
@pytest_twisted.ensureDeferred
async def test_a_token_is_remembered_while_it_counts(store: AsyncDatabase, ended: str) -> None:
    """Changes in the database are taken up as for what is open."""
    hall = await Hall(store).open()
    hall.access.remember(HASH, hall.principal, hall.access.refreshed)
    assert hall.access.remembered(HASH) == hall.principal
    if ended == "token":
        await store.write(queries.revoke_token, hall.principal.token_id)
    elif ended == "user":
        await store.write(queries.set_disabled, hall.user.id, True)
    elif ended == "time":
        hall.now = 5000.0
    await hall.access.refresh()
    assert hall.access.remembered(HASH) == (hall.principal if ended == "nothing" else None)


@pytest_twisted.ensureDeferred
async def test_what_is_remembered_follows_what_its_user_may(store: AsyncDatabase) -> None:
    """Who was made an administrator is one at the next request, and who is none any more is not."""
    hall = await Hall(store).open()
    hall.access.remember(HASH, hall.principal, hall.access.refreshed)
    for admin in (True, False):
        await store.write(queries.set_admin, hall.user.id, admin)
        await hall.access.refresh()
        assert hall.access.remembered(HASH) == replace(hall.principal, admin=admin)


@pytest_twisted.ensureDeferred
async def test_what_is_remembered_proves_nothing_without_a_look_at_the_database(store: AsyncDatabase) -> None:
    """Nor one that is too long ago; one that began before another and ended after it takes nothing away."""
    seconds = 50.0
    hall = await Hall(store).open()
    access = Access(store, lambda: hall.now, lambda: seconds)
    access.remember(HASH, hall.principal, access.refreshed)
    assert access.proves(HASH) is None
    access.in_step(50.0)
    access.in_step(49.0)
    seconds += module.IN_STEP_SECONDS
    assert access.proves(HASH) == hall.principal
    seconds += 0.1
    assert access.proves(HASH) is None
    access.in_step(seconds)
    hall.now = 5000.0
    assert access.proves(HASH) is None


@pytest_twisted.ensureDeferred
async def test_a_token_that_was_looked_up_before_a_change_is_not_remembered(store: AsyncDatabase) -> None:
    """The change may have been about just that."""
    hall = await Hall(store).open()
    before = hall.access.refreshed
    await hall.access.refresh()
    hall.access.remember(HASH, hall.principal, before)
    assert hall.access.remembered(HASH) is None


@pytest_twisted.ensureDeferred
async def test_what_is_remembered_is_bounded(store: AsyncDatabase, monkeypatch: pytest.MonkeyPatch) -> None:
    """The longest unused is forgotten."""
    monkeypatch.setattr(module, "PROVED", 2)
    hall = await Hall(store).open()
    for token_hash in ("a", "b", "c"):
        hall.access.remember(token_hash, hall.principal, hall.access.refreshed)
        # To be asked for is to be used.
        assert hall.access.remembered("a")
    assert [token_hash for token_hash in "abc" if hall.access.remembered(token_hash)] == ["a", "c"]


@pytest_twisted.ensureDeferred
async def test_what_an_earlier_look_has_read_does_not_come_after_a_later_one(store: AsyncDatabase) -> None:
    """A logout and somebody's change ask at once: the rights that hold are those of the last change."""
    hall = await Hall(store).open()
    permit = await hall.permit()
    slow = hall.slow_down()
    first = Deferred.fromCoroutine(hall.access.refresh())
    await slow.read_done
    await hall.grant("operator")
    second = Deferred.fromCoroutine(hall.access.refresh())
    # What it reads, if it does not wait for its turn, comes from a thread: all of them have been used once by then.
    for _ in range(4):
        await store.read(queries.revision)
    slow.go.callback(None)
    await first
    await second
    assert permit.rules.level is Level.OPERATOR


@pytest_twisted.ensureDeferred
async def test_who_has_a_right_is_known_without_the_database(store: AsyncDatabase) -> None:
    """From what is open, from what was looked up since the last change, and from nothing else."""
    hall = await Hall(store).open()
    access, robot = hall.access, hall.robot.id
    assert not access.knows(hall.principal, robot)
    permit = await hall.permit()
    await access.refresh()
    assert access.knows(hall.principal, robot)
    access.release(permit)
    assert not access.knows(hall.principal, robot)
    access.release(await hall.permit())
    assert access.knows(hall.principal, robot)
    await access.refresh()
    await access.robots(hall.principal)
    assert access.knows(hall.principal, robot)
    assert not access.knows(hall.principal, robot + 1)
    await store.write(queries.revoke_right, robot, user_id=hall.user.id)
    await access.refresh()
    assert not access.knows(hall.principal, robot)


async def _with_scope(hall: Hall, scope: str) -> Principal:
    """Ann by a token for less."""
    hash = "cd" * 32
    await hall.store.write(
        queries.create_token, hall.user.id, hash, kind="access", expires=None, now=hall.now, scope=scope
    )
    record = await hall.store.read(queries.principal_by_token, hash, hall.now)
    assert record is not None
    return Principal.of(record)


@pytest_twisted.ensureDeferred
async def test_a_scope_narrows_what_a_token_opens(store: AsyncDatabase) -> None:
    """The permit judges by both, and goes on to when the rights change."""
    hall = await Hall(store).open()
    await hall.grant("operator")
    narrow = await _with_scope(hall, "viewer call:/dock@rover")
    permit = await hall.access.permit(narrow, hall.robot)
    assert permit is not None
    assert permit.judge(Operation.CALL, "/dock").allowed
    assert not permit.judge(Operation.PUBLISH, "/cmd_vel").allowed
    assert hall.access.knows(narrow, hall.robot.id)
    await hall.grant("owner")
    await hall.access.refresh()
    assert permit.judge(Operation.CALL, "/dock").allowed
    assert not permit.judge(Operation.PUBLISH, "/cmd_vel").allowed
    await hall.grant("viewer")
    await hall.access.refresh()
    assert not permit.judge(Operation.CALL, "/dock").allowed


@pytest_twisted.ensureDeferred
async def test_a_robot_outside_the_scope_is_not_there(store: AsyncDatabase) -> None:
    """Neither in the list nor by name, however well the user's other tokens know it."""
    hall = await Hall(store).open()
    narrow = await _with_scope(hall, "owner@other")
    assert await hall.access.permit(hall.principal, hall.robot) is not None
    assert [record.name for record, _ in await hall.access.robots(hall.principal)] == ["rover"]
    assert await hall.access.robots(narrow) == []
    assert await hall.access.permit(narrow, hall.robot) is None
    assert not hall.access.knows(narrow, hall.robot.id)


@pytest_twisted.ensureDeferred
async def test_an_administrators_token_administers_if_its_scope_says_so(store: AsyncDatabase) -> None:
    """One to look at robots is no key to the house."""
    hall = await Hall(store).open()
    await store.write(queries.set_admin, hall.user.id, True)
    assert not (await _with_scope(hall, "owner")).admin
