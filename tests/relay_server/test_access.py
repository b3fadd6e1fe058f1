"""Decisions about rights, with a real database: open sessions follow the rights."""

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
from relay_server.robots.registry import RobotState

HASH = "ab" * 32


@dataclass
class World:
    """An access with one user, one token and one robot in its database."""

    store: AsyncDatabase
    now: float = 1000.0
    reported: list[str] = field(default_factory=list)

    async def open(self) -> World:
        """Fills the database."""
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
        """Gives ann a right on the robot."""
        await self.store.write(queries.grant_right, self.robot.id, level, user_id=self.user.id, **patterns)

    def slow_down(self) -> SlowStore:
        """Reads of the access wait from now on until the test releases them."""
        slow = SlowStore(self.store)
        self.access._store = cast(AsyncDatabase, slow)
        return slow

    async def permit(self) -> Permit:
        """A permit whose holder records its notifications."""
        permit = await self.access.permit(self.principal, self.robot)
        assert permit is not None
        permit.on_change = lambda: self.reported.append("changed")
        permit.on_revoke = lambda error: self.reported.append(f"{type(error).__name__}: {error}")
        return permit


class SlowStore:
    """A database whose first read returns its result only when the test releases it."""

    def __init__(self, store: AsyncDatabase) -> None:
        self._store = store
        self.read_done: Deferred[None] = Deferred()
        self.go: Deferred[None] = Deferred()

    async def read(self, query: Callable[..., Any], *args: Any) -> Any:
        found = await self._store.read(query, *args)
        if not self.read_done.called:
            self.read_done.callback(None)
            await self.go
        return found


@pytest_twisted.ensureDeferred
async def test_a_permit_judges_by_the_rights_in_the_database(store: AsyncDatabase) -> None:
    """Without any right there is no permit."""
    world = await World(store).open()
    permit = await world.permit()
    assert permit.decide(Operation.SUBSCRIBE, "/scan").allowed
    assert not permit.decide(Operation.PUBLISH, "/cmd_vel").allowed
    await store.write(queries.revoke_right, world.robot.id, user_id=world.user.id)
    assert await world.access.permit(world.principal, world.robot) is None


@pytest_twisted.ensureDeferred
async def test_changed_rights_reach_what_is_open(store: AsyncDatabase) -> None:
    """The permit changes in place, and its holder is notified once; without a change it is not."""
    world = await World(store).open()
    permit = await world.permit()
    await world.access.refresh()
    assert world.reported == []
    await world.grant("operator", deny=["publish:/arm"])
    await world.access.refresh()
    await world.access.refresh()
    assert world.reported == ["changed"]
    assert permit.rules.level is Level.OPERATOR
    assert not permit.decide(Operation.PUBLISH, "/arm").allowed


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("right", "Refused: your right on this robot was revoked"),
        ("token", "BadCredentials: your session was ended; log in again"),
        ("user", "BadCredentials: your session was ended; log in again"),
    ],
)
@pytest_twisted.ensureDeferred
async def test_revocation_is_reported_once_and_final(store: AsyncDatabase, what: str, words: str) -> None:
    """A revoked right, token or account ends everything opened with it."""
    world = await World(store).open()
    permit = await world.permit()
    if what == "right":
        await store.write(queries.revoke_right, world.robot.id, user_id=world.user.id)
    elif what == "token":
        await store.write(queries.revoke_token, world.principal.token_id)
    else:
        await store.write(queries.set_disabled, world.user.id, True)
    await world.access.refresh()
    await world.access.refresh()
    assert world.reported == [words]
    assert not permit.decide(Operation.SUBSCRIBE, "/scan").allowed


@pytest_twisted.ensureDeferred
async def test_a_token_that_runs_out_ends_what_is_open(store: AsyncDatabase) -> None:
    """To the second, without reading the database."""
    world = await World(store).open()
    await world.permit()
    world.now = 4999.9
    world.access.expire()
    assert world.reported == []
    world.now = 5000.0
    world.access.expire()
    world.access.expire()
    assert world.reported == ["BadCredentials: your session has expired; log in again"]


@pytest_twisted.ensureDeferred
async def test_a_released_permit_is_not_notified(store: AsyncDatabase) -> None:
    world = await World(store).open()
    permit = await world.permit()
    world.access.release(permit)
    world.access.release(permit)
    await store.write(queries.revoke_token, world.principal.token_id)
    await world.access.refresh()
    assert world.reported == []
    assert not world.access._permits


@pytest_twisted.ensureDeferred
async def test_no_permit_comes_of_rights_revoked_while_they_were_read(store: AsyncDatabase) -> None:
    """A refresh between the read and its result is not missed."""
    world = await World(store).open()
    slow = world.slow_down()
    asking = Deferred.fromCoroutine(world.access.permit(world.principal, world.robot))
    await slow.read_done
    await store.write(queries.revoke_right, world.robot.id, user_id=world.user.id)
    await world.access.refresh()
    slow.go.callback(None)
    assert await asking is None
    assert not world.access._permits


@pytest_twisted.ensureDeferred
async def test_no_list_is_kept_of_rights_revoked_while_they_were_read(store: AsyncDatabase) -> None:
    """The next look-up has the present rights."""
    world = await World(store).open()
    slow = world.slow_down()
    asking = Deferred.fromCoroutine(world.access.robots(world.principal))
    await slow.read_done
    await store.write(queries.revoke_right, world.robot.id, user_id=world.user.id)
    await world.access.refresh()
    slow.go.callback(None)
    await asking
    assert await world.access.robots(world.principal) == []


@pytest_twisted.ensureDeferred
async def test_no_permit_for_a_token_that_ended_since_it_was_proved(store: AsyncDatabase) -> None:
    """The token may end between its authentication and the permit."""
    world = await World(store).open()
    await store.write(queries.revoke_token, world.principal.token_id)
    with pytest.raises(BadCredentials, match="session was ended"):
        await world.access.permit(world.principal, world.robot)


@pytest_twisted.ensureDeferred
async def test_robots_are_listed_with_the_right_on_each(store: AsyncDatabase) -> None:
    """The list is cached until a change."""
    world = await World(store).open()
    await store.write(queries.add_robot, "hidden")
    ((robot, rules),) = await world.access.robots(world.principal)
    assert (robot.name, rules.level) == ("rover", Level.VIEWER)
    await world.grant("owner")
    ((_, rules),) = await world.access.robots(world.principal)
    assert rules.level is Level.VIEWER
    await world.access.refresh()
    ((_, rules),) = await world.access.robots(world.principal)
    assert rules.level is Level.OWNER


@pytest.mark.parametrize("ended", ["token", "user", "time", "nothing"])
@pytest_twisted.ensureDeferred
async def test_a_token_is_remembered_while_it_counts(store: AsyncDatabase, ended: str) -> None:
    """Changes in the database are applied as for open sessions."""
    world = await World(store).open()
    world.access.remember(HASH, world.principal, world.access.refreshed)
    assert world.access.remembered_principal(HASH) == world.principal
    if ended == "token":
        await store.write(queries.revoke_token, world.principal.token_id)
    elif ended == "user":
        await store.write(queries.set_disabled, world.user.id, True)
    elif ended == "time":
        world.now = 5000.0
    await world.access.refresh()
    assert world.access.remembered_principal(HASH) == (world.principal if ended == "nothing" else None)


@pytest_twisted.ensureDeferred
async def test_cached_results_follow_the_users_rights(store: AsyncDatabase) -> None:
    """A new administrator is one at the next request, and a former one is not."""
    world = await World(store).open()
    world.access.remember(HASH, world.principal, world.access.refreshed)
    for admin in (True, False):
        await store.write(queries.set_admin, world.user.id, admin)
        await world.access.refresh()
        assert world.access.remembered_principal(HASH) == replace(world.principal, admin=admin)


@pytest_twisted.ensureDeferred
async def test_cached_token_needs_the_database_revision(store: AsyncDatabase) -> None:
    """An old check does not count; overlapping checks do not undo each other."""
    seconds = 50.0
    world = await World(store).open()
    access = Access(store, lambda: world.now, lambda: seconds)
    access.remember(HASH, world.principal, access.refreshed)
    assert access.recent_principal(HASH) is None
    access.set_known_until(50.0)
    access.set_known_until(49.0)
    seconds += module.RECENT_READ_SECONDS
    assert access.recent_principal(HASH) == world.principal
    seconds += 0.1
    assert access.recent_principal(HASH) is None
    access.set_known_until(seconds)
    world.now = 5000.0
    assert access.recent_principal(HASH) is None


@pytest_twisted.ensureDeferred
async def test_a_token_that_was_looked_up_before_a_change_is_not_remembered(store: AsyncDatabase) -> None:
    """The change may concern that token."""
    world = await World(store).open()
    before = world.access.refreshed
    await world.access.refresh()
    world.access.remember(HASH, world.principal, before)
    assert world.access.remembered_principal(HASH) is None


@pytest_twisted.ensureDeferred
async def test_cache_is_bounded(store: AsyncDatabase, monkeypatch: pytest.MonkeyPatch) -> None:
    """The least recently used is removed."""
    monkeypatch.setattr(module, "PROVED", 2)
    world = await World(store).open()
    for token_hash in ("a", "b", "c"):
        world.access.remember(token_hash, world.principal, world.access.refreshed)
        # A request counts as a use.
        assert world.access.remembered_principal("a")
    assert [token_hash for token_hash in "abc" if world.access.remembered_principal(token_hash)] == ["a", "c"]


@pytest_twisted.ensureDeferred
async def test_earlier_reading_does_not_follow_a_later_one(store: AsyncDatabase) -> None:
    """A logout and another change cause two readings: the rights of the last change hold."""
    world = await World(store).open()
    permit = await world.permit()
    slow = world.slow_down()
    first = Deferred.fromCoroutine(world.access.refresh())
    await slow.read_done
    await world.grant("operator")
    second = Deferred.fromCoroutine(world.access.refresh())
    # Without a queue it would read in a thread of the pool, each of which has been used once by then.
    for _ in range(4):
        await store.read(queries.revision)
    slow.go.callback(None)
    await first
    await second
    assert permit.rules.level is Level.OPERATOR


@pytest_twisted.ensureDeferred
async def test_rights_are_known_without_the_database(store: AsyncDatabase) -> None:
    """From open sessions and look-ups since the last change only."""
    world = await World(store).open()
    access, robot = world.access, world.robot.id
    assert not access.knows(world.principal, robot)
    permit = await world.permit()
    await access.refresh()
    assert access.knows(world.principal, robot)
    access.release(permit)
    assert not access.knows(world.principal, robot)
    access.release(await world.permit())
    assert access.knows(world.principal, robot)
    await access.refresh()
    await access.robots(world.principal)
    assert access.knows(world.principal, robot)
    assert not access.knows(world.principal, robot + 1)
    assert access.may_stop_at_once(world.principal, RobotState(robot, "rover", world.principal.realm))
    assert not access.may_stop_at_once(world.principal, RobotState(robot, "rover", "elsewhere"))
    await store.write(queries.revoke_right, robot, user_id=world.user.id)
    await access.refresh()
    assert not access.knows(world.principal, robot)


async def _with_scope(world: World, scope: str) -> Principal:
    """Ann, with a token limited to a scope."""
    hash = "cd" * 32
    await world.store.write(
        queries.create_token, world.user.id, hash, kind="access", expires=None, now=world.now, scope=scope
    )
    record = await world.store.read(queries.principal_by_token, hash, world.now)
    assert record is not None
    return Principal.of(record)


@pytest_twisted.ensureDeferred
async def test_a_scope_narrows_what_a_token_opens(store: AsyncDatabase) -> None:
    """The permit follows both, also after a change of rights."""
    world = await World(store).open()
    await world.grant("operator")
    narrow = await _with_scope(world, "viewer call:/dock@rover")
    permit = await world.access.permit(narrow, world.robot)
    assert permit is not None
    assert permit.decide(Operation.CALL, "/dock").allowed
    assert not permit.decide(Operation.PUBLISH, "/cmd_vel").allowed
    assert world.access.knows(narrow, world.robot.id)
    await world.grant("owner")
    await world.access.refresh()
    assert permit.decide(Operation.CALL, "/dock").allowed
    assert not permit.decide(Operation.PUBLISH, "/cmd_vel").allowed
    await world.grant("viewer")
    await world.access.refresh()
    assert not permit.decide(Operation.CALL, "/dock").allowed


@pytest_twisted.ensureDeferred
async def test_a_robot_outside_the_scope_is_not_there(store: AsyncDatabase) -> None:
    """Neither in the list nor by name, even if the user's other tokens know it."""
    world = await World(store).open()
    narrow = await _with_scope(world, "owner@other")
    assert await world.access.permit(world.principal, world.robot) is not None
    assert [record.name for record, _ in await world.access.robots(world.principal)] == ["rover"]
    assert await world.access.robots(narrow) == []
    assert await world.access.permit(narrow, world.robot) is None
    assert not world.access.knows(narrow, world.robot.id)


@pytest_twisted.ensureDeferred
async def test_an_administrators_token_administers_if_its_scope_says_so(store: AsyncDatabase) -> None:
    """A token for viewing robots does not administer."""
    world = await World(store).open()
    await store.write(queries.set_admin, world.user.id, True)
    assert not (await _with_scope(world, "owner")).admin
