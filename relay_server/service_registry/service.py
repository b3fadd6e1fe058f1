"""The service registry: which entries users may register, see, change and follow; and how its parts are built."""

from __future__ import annotations

import heapq
import secrets
import time
from collections.abc import Callable, Collection, Iterator, Sequence
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
from relay_server.common.etags import PreconditionFailed, check_match, tag_of
from relay_server.common.token_bucket import Buckets
from relay_server.core import Core
from relay_server.events.bus import EventFollower
from relay_server.service_registry.changes import EntryChange, RecentEntryChanges, change, remove
from relay_server.service_registry.entries import (
    CHANGES_A_SECOND,
    CHANGES_AT_ONCE,
    PER_REALM,
    PER_USER,
    USERS,
    EntryInfo,
    EntryQuery,
    Registration,
    check_address,
    check_texts,
    data_text,
    stored_event,
)
from relay_server.service_registry.leases import EntryCache, LeaseExpiry
from relay_server.service_registry.robot_entries import RobotEntries, VisibleRobot

NO_ENTRY = "there is no such entry, or none for you"


class TooManyEntryChanges(Refused):
    """A user changes the registry too often; they may again after ``retry_after`` seconds."""

    code = "too_often"
    retry_after = 1 / CHANGES_A_SECOND


class MatchNeeded(Refused):
    """A request that changes an entry lacks ``If-Match``."""

    code = "match_needed"


class EntryReply(NamedTuple):
    """An entry as it is sent.

    :param etag: its entity tag
    :param created: whether it was not there before
    """

    body: bytes
    etag: str
    id: str
    created: bool = False


class EntryService:
    """Which entries a user may register, see and change (SPEC 1.15).

    :param record: stores an event
    :param wall: Unix time in seconds
    :param new_id: makes an unguessable id of up to 32 hex digits
    """

    def __init__(
        self,
        store: AsyncDatabase,
        access: Access,
        robots: RobotEntries,
        leases: LeaseExpiry,
        changes: RecentEntryChanges,
        record: Callable[[NewStoredEvent], None],
        wall: Callable[[], float],
        seconds: Callable[[], float],
        new_id: Callable[[], str],
    ) -> None:
        self._store = store
        self._access = access
        self._robots = robots
        self._leases = leases
        self._changes = changes
        self._record_event = record
        self._wall = wall
        self._new_id = new_id
        self._buckets = Buckets(CHANGES_A_SECOND, CHANGES_AT_ONCE, USERS, seconds)

    # --- reading ------------------------------------------------------------------------------------------

    async def page(
        self, principal: Principal, query: EntryQuery
    ) -> tuple[list[EntryInfo], EntryCursor | None]:
        """Entries in the order of their cursors, and the cursor behind which there are more.

        A page may be short although there are more: it scans a bounded number of members of robots.

        :raises Unavailable: the database does not answer
        """
        if query.realm not in (None, principal.realm):
            return [], None
        wanted = [
            each for each in await self._visible_robots(principal) if _matches_robot(query, each.record.name)
        ]
        numbers = frozenset(each.record.id for each in wanted)
        entry_search = EntrySearch(
            principal.realm, numbers, query.robot is None, query.kind, query.name, query.after
        )
        now = self._wall()
        # One more than the limit shows whether there are more.
        rows = await self._store.read(queries.list_entries, entry_search, now, query.limit + 1)
        search = self._robots.search(wanted, query)
        found: list[EntryInfo] = []
        for each in heapq.merge(
            [EntryInfo.of(row, now) for row in rows], search, key=lambda each: each.cursor
        ):
            if len(found) > query.limit or (search.stopped is not None and each.cursor > search.stopped):
                break
            found.append(each)
        page, behind = found[: query.limit], search.stopped
        if len(found) > query.limit:
            behind = page[-1].cursor
        return page, behind

    async def one(self, principal: Principal, entry_id: str) -> EntryReply:
        """One entry.

        :raises NotFound: there is none that the user may see
        """
        robots = await self._visible_robots(principal)
        own = self._robots.find(robots, entry_id)
        if own is not None:
            return _reply(own)
        return _reply(EntryInfo.of(await self._find(principal, robots, entry_id), self._wall()))

    # --- changing -----------------------------------------------------------------------------------------

    async def register(self, principal: Principal, new: Registration) -> EntryReply:
        """Register an entry, or renew the one that the same user has registered by this kind, name and robot.

        :raises Invalid: a text or the data is not allowed
        :raises NotFound: it is about a robot that does not exist, or on which the user has no right
        :raises Refused: without the right, too often, or over the quota
        :raises Unavailable: the database can't be written
        """
        self._check_rate(principal)
        values = _checked_values(new)
        robots = await self._visible_robots(principal)
        robot = next((each for each in robots if each.record.name == new.robot), None)
        if new.robot is not None and robot is None:
            raise NotFound(NO_ROBOT)
        _check_right(principal, robot, new.name)
        entered = NewEntry(
            realm=principal.realm,
            kind=new.kind,
            name=new.name,
            robot_id=None if robot is None else robot.record.id,
            user_id=principal.user_id,
            **values,
        )
        room = {"of_user": PER_USER, "of_realm": PER_REALM}
        now = self._wall()
        record, before = await self._store.write(queries.register_entry, entered, self._new_id(), now, **room)
        self._leases.on_renewed(record)
        if before is None:
            self._changes.publish("registered", record)
            self._record_event(stored_event("registered", record, now, principal.name))
        elif not _same(record, before):
            self._changes.publish("changed", record)
        return _reply(EntryInfo.of(record, now), created=before is None)

    async def put(
        self, principal: Principal, entry_id: str, new: Registration | None, match: str | None, address: str
    ) -> EntryReply:
        """Renew an entry, and change it if the request has other values.

        :param new: the new values; ``None`` to keep the old ones
        :param match: entity tags as in ``If-Match``: only if the entry has one of them
        :param address: of the client, for the audit log
        :raises NotFound: there is none that the user may see
        :raises MatchNeeded: it would be changed, and ``match`` is missing
        :raises PreconditionFailed: the entry has another entity tag
        :raises SwitchboardError: as :meth:`register`
        """
        self._check_rate(principal)
        record = await self._changeable(principal, entry_id)
        now = self._wall()
        if match is not None:
            check_match(_reply(EntryInfo.of(record, now)).etag, match)
        if new is not None and (new.kind, new.name, new.robot) != (record.kind, record.name, record.robot):
            raise Invalid("'kind', 'name' and 'robot' of an entry cannot be changed; register another entry")
        values = None if new is None else _checked_values(new)
        kept: EntryRecord | None
        if values is None or all(getattr(record, name) == value for name, value in values.items()):
            kept = await self._store.write(queries.renew_entry, record.id, now)
            if kept is None:
                raise NotFound(NO_ENTRY)
        else:
            if match is None:
                raise MatchNeeded(
                    "to change an entry, send If-Match with the ETag that it had when you read it"
                )
            kept = await self._store.write(change, principal, record, values, now, address)
            if kept is None:
                raise PreconditionFailed("the entry has changed since you read it; read it again")
            self._changes.publish("changed", kept)
        self._leases.on_renewed(kept)
        return _reply(EntryInfo.of(kept, now))

    async def remove(self, principal: Principal, entry_id: str, match: str | None, address: str) -> None:
        """Remove an entry.

        :param match: as of :meth:`put`
        :raises SwitchboardError: as :meth:`put`
        """
        self._check_rate(principal)
        record = await self._changeable(principal, entry_id)
        now = self._wall()
        if match is not None:
            check_match(_reply(EntryInfo.of(record, now)).etag, match)
        gone = await self._store.write(remove, principal, record, now, address)
        if gone is None:
            raise NotFound(NO_ENTRY)
        self._record_event(stored_event("removed", gone, now, principal.name))
        self._leases.on_removed(gone)

    # --- following ----------------------------------------------------------------------------------------

    @contextmanager
    def following(self, principal: Principal, last: str | None) -> Iterator[tuple[EventFollower, bool]]:
        """Follow changes while the context is open; see :meth:`RecentEntryChanges.follow`."""
        follower, missed = self._changes.follow(principal.realm, last)
        try:
            yield follower, missed
        finally:
            self._changes.unfollow(follower)

    def event_id(self, follower: EventFollower) -> str:
        """See :meth:`RecentEntryChanges.event_id`."""
        return self._changes.event_id(follower.number)

    async def news(
        self, principal: Principal, query: EntryQuery, follower: EventFollower
    ) -> tuple[list[tuple[str, str, EntryInfo]], bool, bool]:
        """The next changes that match.

        :returns: event id, kind of change and entry of each; whether earlier ones are lost; whether there may be more
        :raises Unavailable: the database has to be read for the rights, and does not answer
        """
        # First: this may fail, and the changes that are taken after it must be sent.
        seen = {each.record.id for each in await self._visible_robots(principal)}
        news, now = self._changes.news(principal.realm, follower), self._wall()
        page = [
            (self._changes.event_id(each.number), each.what, EntryInfo.of(each.entry, now))
            for each in news.changes
            if _matches(query, each, principal.realm, seen)
        ]
        return page, news.missed, news.more

    # --- rights -------------------------------------------------------------------------------------------

    async def _visible_robots(self, principal: Principal) -> list[VisibleRobot]:
        return [VisibleRobot(record, rules) for record, rules in await self._access.robots(principal)]

    async def _find(self, principal: Principal, robots: Sequence[VisibleRobot], entry_id: str) -> EntryRecord:
        record = await self._store.read(queries.get_entry, principal.realm, entry_id, self._wall())
        if record is None or (
            record.robot_id is not None and all(each.record.id != record.robot_id for each in robots)
        ):
            raise NotFound(NO_ENTRY)
        return record

    async def _changeable(self, principal: Principal, entry_id: str) -> EntryRecord:
        """An entry that the user may change.

        :raises NotFound: there is none that the user may see
        :raises Refused: without the right
        """
        robots = await self._visible_robots(principal)
        if self._robots.find(robots, entry_id) is not None:
            raise Refused("entries of what a robot has cannot be changed or removed")
        record = await self._find(principal, robots, entry_id)
        if record.user_id != principal.user_id and not principal.admin:
            raise Refused(f"only {record.user}, who registered this entry, or an administrator may change it")
        robot = next((each for each in robots if each.record.id == record.robot_id), None)
        _check_right(principal, robot, record.name)
        return record

    def _check_rate(self, principal: Principal) -> None:
        if not self._buckets.take(principal.user_id):
            raise TooManyEntryChanges("too many changes of the directory; try again in a moment")


class ServiceRegistry:
    """The service registry of a relay: its rules for users, the expiry of leases, and recent changes.

    :param record: stores an event
    :param wall: Unix time in seconds
    :ivar service: the rules for users
    """

    def __init__(
        self, core: Core, record: Callable[[NewStoredEvent], None], wall: Callable[[], float] = time.time
    ) -> None:
        self._record_event = record
        self._wall = wall
        self._changes = RecentEntryChanges(secrets.token_hex(4))
        self.leases = LeaseExpiry(core.reactor, core.database, wall, EntryCache(), self._on_ended)
        self.service = EntryService(
            core.database,
            core.access,
            RobotEntries(core.robots, core.channels),
            self.leases,
            self._changes,
            record,
            wall,
            core.reactor.seconds,
            lambda: secrets.token_hex(12),
        )

    def on_realms_changed(self, gone: Collection[str], there: Collection[str]) -> None:
        """See :class:`relay_server.maintenance.RealmCaches`."""
        for realm in gone:
            self._changes.forget_realm(realm)

    def _on_ended(self, what: str, record: EntryRecord) -> None:
        self._changes.publish(what, record)
        # The event of a removed entry names the user who removed it, so the service records it.
        if what == "expired":
            self._record_event(stored_event(what, record, self._wall(), record.user))


def _check_right(principal: Principal, robot: VisibleRobot | None, name: str) -> None:
    """Check the right to register, change or remove an entry about this robot, or about none.

    :raises Refused: without it
    """
    if robot is None:
        principal.require_full_scope()
        return
    decision = robot.rules.decide(Operation.PROVIDE, name)
    if not decision.allowed:
        raise Refused(decision.reason)


def _checked_values(new: Registration) -> dict[str, Any]:
    check_texts(new)
    return {
        "address": check_address(new.address),
        "description": new.description,
        "data": data_text(new.data),
        "ttl": new.ttl,
    }


def _same(one: EntryRecord, other: EntryRecord) -> bool:
    """Whether two entries differ in nothing but the end of their leases."""
    return one._replace(expires=0.0) == other._replace(expires=0.0)


def _reply(entry: EntryInfo, *, created: bool = False) -> EntryReply:
    body = jsontext.encode(entry)
    return EntryReply(body, tag_of(body), entry.id, created)


def _matches_robot(query: EntryQuery, robot: str) -> bool:
    return query.robot is None or fnmatchcase(robot, query.robot)


def _matches(query: EntryQuery, change: EntryChange, realm: str, seen: set[int]) -> bool:
    """Whether a change matches the query of a reader who may see these robots."""
    entry = change.entry
    if query.realm not in (None, realm) or query.kind not in (None, entry.kind):
        return False
    if entry.robot_id is not None and entry.robot_id not in seen:
        return False
    return fnmatchcase(entry.name, query.name) and (
        query.robot is None if entry.robot is None else _matches_robot(query, entry.robot)
    )
