"""Whom people and programs ask about the directory: who may register, see and remove what, and what follows."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from relay_db import queries
from relay_db.queries import EntryCursor, EntryRecord, EntrySearch, NewEntry, NewStoredEvent
from relay_protocol import jsontext
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.rights import Operation
from relay_server.access import NO_ROBOT, Access, Principal
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import Buckets
from relay_server.events.service import EventFollower
from relay_server.registry.audit import change, remove
from relay_server.registry.changes import Changes, EntryChange
from relay_server.registry.entries import (
    EntryQuery,
    Registration,
    RegistryEntry,
    check_address,
    check_words,
    data_text,
    event,
)
from relay_server.registry.leases import LeaseExpiry
from relay_server.registry.limits import CHANGES_A_SECOND, CHANGES_AT_ONCE, OF_REALM, OF_USER, USERS
from relay_server.registry.robot_entries import RobotEntries, VisibleRobot
from relay_server.resources.etags import PreconditionFailed, see_match, tag_of

NO_ENTRY = "there is no such entry, or none for you"


class TooManyRegistryChanges(Refused):
    """Somebody changes the directory too often; he may again after ``retry_after`` seconds."""

    code = "too_often"
    retry_after = 1 / CHANGES_A_SECOND


class MatchNeeded(Refused):
    """What changes an entry has to say what it believes the entry to be."""

    code = "match_needed"


class Kept(NamedTuple):
    """An entry as it is told.

    :param etag: its entity tag
    :param fresh: whether it was not there before
    """

    body: bytes
    etag: str
    id: str
    fresh: bool = False


class RegistryService:
    """See the module's text.

    :param note: tells the memory
    :param wall: Unix time in seconds
    :param new_id: makes an unguessable one, of up to 32 hex digits
    """

    def __init__(
        self,
        store: AsyncDatabase,
        access: Access,
        robots: RobotEntries,
        leases: LeaseExpiry,
        changes: Changes,
        note: Callable[[NewStoredEvent], None],
        wall: Callable[[], float],
        seconds: Callable[[], float],
        new_id: Callable[[], str],
    ) -> None:
        self._store = store
        self._access = access
        self._robots = robots
        self._leases = leases
        self._changes = changes
        self._note = note
        self._wall = wall
        self._new_id = new_id
        self._buckets = Buckets(CHANGES_A_SECOND, CHANGES_AT_ONCE, USERS, seconds)

    # --- reading ------------------------------------------------------------------------------------------

    async def page(
        self, principal: Principal, ask: EntryQuery
    ) -> tuple[list[dict[str, Any]], EntryCursor | None]:
        """Entries in the order of their places, and the place behind which there are more.

        They may be fewer than wanted though there are more: a page looks through a bounded part of what robots have.

        :raises Unavailable: the database does not answer
        """
        if ask.realm not in (None, principal.realm):
            return [], None
        wanted = [each for each in await self._seen(principal) if _means(ask, each.record.name)]
        numbers = frozenset(each.record.id for each in wanted)
        meant = EntrySearch(principal.realm, numbers, ask.robot is None, ask.kind, ask.name, ask.after)
        now = self._wall()
        # One more than is told: that there is more shall be told only where there is.
        rows = await self._store.read(queries.list_entries, meant, now, ask.limit + 1)
        look = self._robots.look(wanted, ask)
        found: list[RegistryEntry] = []
        for each in heapq.merge(
            [RegistryEntry.of(row, now) for row in rows], look, key=lambda each: each.place
        ):
            if len(found) > ask.limit or (look.stopped is not None and each.place > look.stopped):
                break
            found.append(each)
        told, behind = found[: ask.limit], look.stopped
        if len(found) > ask.limit:
            behind = told[-1].place
        return [each.told() for each in told], behind

    async def one(self, principal: Principal, entry_id: str) -> Kept:
        """One entry.

        :raises NotFound: there is none for him
        """
        robots = await self._seen(principal)
        own = self._robots.one(robots, entry_id)
        if own is not None:
            return _kept(own)
        return _kept(RegistryEntry.of(await self._find(principal, robots, entry_id), self._wall()))

    # --- changing -----------------------------------------------------------------------------------------

    async def register(self, principal: Principal, new: Registration) -> Kept:
        """Enter something, or renew what the same user has registered by this kind, name and robot.

        :raises Invalid: it can't be
        :raises NotFound: it is about a robot that there is not, or on which he has no right
        :raises Refused: he may not, too often, or there is no room
        :raises Unavailable: the database can't be written
        """
        self._count(principal)
        values = _values(new)
        robots = await self._seen(principal)
        robot = next((each for each in robots if each.record.name == new.robot), None)
        if new.robot is not None and robot is None:
            raise NotFound(NO_ROBOT)
        _see_right(principal, robot, new.name)
        number = None if robot is None else robot.record.id
        entered = NewEntry(
            principal.realm,
            new.kind,
            new.name,
            values["address"],
            values["description"],
            number,
            principal.user_id,
            values["data"],
            values["ttl"],
        )
        room = {"of_user": OF_USER, "of_realm": OF_REALM}
        now = self._wall()
        record, before = await self._store.write(queries.register_entry, entered, self._new_id(), now, **room)
        self._leases.lasts(record)
        if before is None:
            self._changes.tell("registered", record)
            self._note(event("registered", record, now, principal.name))
        elif not _same(record, before):
            self._changes.tell("changed", record)
        return _kept(RegistryEntry.of(record, now), fresh=before is None)

    async def put(
        self, principal: Principal, entry_id: str, new: Registration | None, match: str | None, address: str
    ) -> Kept:
        """Renew an entry, and have it say something else if it should.

        :param new: what it is to say; ``None`` for what it says
        :param match: only if it is still like this: entity tags, as in ``If-Match``
        :param address: where the asker is, for the audit log
        :raises NotFound: there is none for him
        :raises MatchNeeded: it would be changed, and ``match`` is missing
        :raises NotAsBefore: it is not as he believes
        :raises SwitchboardError: as :meth:`register`
        """
        self._count(principal)
        record = await self._mine(principal, entry_id)
        now = self._wall()
        if match is not None:
            see_match(_kept(RegistryEntry.of(record, now)).etag, match)
        if new is not None and (new.kind, new.name, new.robot) != (record.kind, record.name, record.robot):
            raise Invalid("'kind', 'name' and 'robot' of an entry stay as they are; register another one")
        values = None if new is None else _values(new)
        kept: EntryRecord | None
        if values is None or all(getattr(record, name) == value for name, value in values.items()):
            kept = await self._store.write(queries.renew_entry, record.id, now)
            if kept is None:
                raise NotFound(NO_ENTRY)
        else:
            if match is None:
                raise MatchNeeded("to change an entry say by If-Match which ETag it had when you read it")
            kept = await self._store.write(change, principal, record, values, now, address)
            if kept is None:
                raise PreconditionFailed("it has changed since you read it; read it again")
            self._changes.tell("changed", kept)
        self._leases.lasts(kept)
        return _kept(RegistryEntry.of(kept, now))

    async def remove(self, principal: Principal, entry_id: str, match: str | None, address: str) -> None:
        """Take an entry out.

        :param match: as of :meth:`put`
        :raises SwitchboardError: as :meth:`put`
        """
        self._count(principal)
        record = await self._mine(principal, entry_id)
        now = self._wall()
        if match is not None:
            see_match(_kept(RegistryEntry.of(record, now)).etag, match)
        gone = await self._store.write(remove, principal, record, now, address)
        if gone is None:
            raise NotFound(NO_ENTRY)
        self._note(event("removed", gone, now, principal.name))
        self._leases.ended(gone)

    # --- following ----------------------------------------------------------------------------------------

    @contextmanager
    def following(self, principal: Principal, last: str | None) -> Iterator[tuple[EventFollower, bool]]:
        """Follow what is registered, until this ends; see :meth:`Changes.follow`."""
        follower, missed = self._changes.follow(principal.realm, last)
        try:
            yield follower, missed
        finally:
            self._changes.leave(follower)

    def mark(self, follower: EventFollower) -> str:
        """How far somebody has heard; see :meth:`Changes.mark`."""
        return self._changes.mark(follower.number)

    async def news(
        self, principal: Principal, ask: EntryQuery, follower: EventFollower
    ) -> tuple[list[tuple[str, str, dict[str, Any]]], bool, bool]:
        """Changes that are wanted, each as its mark, what became of the entry, and it; whether some before were missed,
        and whether there may be more.

        :raises Unavailable: the database has to be asked about rights, and does not answer
        """
        # First: what is looked up after that is told, whatever becomes of the database.
        seen = {each.record.id for each in await self._seen(principal)}
        news, now = self._changes.news(principal.realm, follower), self._wall()
        told = [
            (self._changes.mark(each.number), each.what, RegistryEntry.of(each.entry, now).told())
            for each in news.changes
            if _wants(ask, each, principal.realm, seen)
        ]
        return told, news.missed, news.more

    # --- rights -------------------------------------------------------------------------------------------

    async def _seen(self, principal: Principal) -> list[VisibleRobot]:
        return [VisibleRobot(record, rules) for record, rules in await self._access.robots(principal)]

    async def _find(self, principal: Principal, robots: Sequence[VisibleRobot], entry_id: str) -> EntryRecord:
        record = await self._store.read(queries.get_entry, principal.realm, entry_id, self._wall())
        if record is None or (
            record.robot_id is not None and all(each.record.id != record.robot_id for each in robots)
        ):
            raise NotFound(NO_ENTRY)
        return record

    async def _mine(self, principal: Principal, entry_id: str) -> EntryRecord:
        """An entry that he may change.

        :raises NotFound: there is none for him
        :raises Refused: he may not
        """
        robots = await self._seen(principal)
        if self._robots.one(robots, entry_id) is not None:
            raise Refused("this is what a robot has: it is in the directory by itself")
        record = await self._find(principal, robots, entry_id)
        if record.user_id != principal.user_id and not principal.admin:
            raise Refused(f"only {record.user}, who registered it, or an administrator may do that")
        robot = next((each for each in robots if each.record.id == record.robot_id), None)
        _see_right(principal, robot, record.name)
        return record

    def _count(self, principal: Principal) -> None:
        if not self._buckets.take(principal.user_id):
            raise TooManyRegistryChanges("you change the directory too often; try again in a moment")


def _see_right(principal: Principal, robot: VisibleRobot | None, name: str) -> None:
    """See that somebody may register, change or remove what is about this robot, or about none.

    :raises Refused: he may not
    """
    if robot is None:
        principal.needs_whole()
        return
    verdict = robot.rules.judge(Operation.PROVIDE, name)
    if not verdict.allowed:
        raise Refused(verdict.reason)


def _values(new: Registration) -> dict[str, Any]:
    """What an entry may come to say, checked."""
    check_words(new)
    return {
        "address": check_address(new.address),
        "description": new.description,
        "data": data_text(new.data),
        "ttl": new.ttl,
    }


def _same(one: EntryRecord, other: EntryRecord) -> bool:
    """Whether two say the same, whenever their leases are over."""
    return one._replace(expires=0.0) == other._replace(expires=0.0)


def _kept(entry: RegistryEntry, *, fresh: bool = False) -> Kept:
    body = jsontext.encode(entry.told())
    return Kept(body, tag_of(body), entry.id, fresh)


def _means(ask: EntryQuery, robot: str) -> bool:
    return ask.robot is None or fnmatchcase(robot, ask.robot)


def _wants(ask: EntryQuery, change: EntryChange, realm: str, seen: set[int]) -> bool:
    """Whether somebody who sees these robots wants to hear of a change."""
    entry = change.entry
    if ask.realm not in (None, realm) or ask.kind not in (None, entry.kind):
        return False
    if entry.robot_id is not None and entry.robot_id not in seen:
        return False
    return fnmatchcase(entry.name, ask.name) and (
        ask.robot is None if entry.robot is None else _means(ask, entry.robot)
    )
