"""Writes events in batches, and deletes those that are too old, or too many for their source or realm."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_db import queries
from relay_db.base import canonical_json
from relay_db.queries import NewStoredEvent, StoredEventRecord
from relay_db.queries.event_search import RELAY_SOURCE
from relay_protocol.errors import NotFound, SwitchboardError, Unavailable
from relay_protocol.realms import DEFAULT_REALM
from relay_server.common.clock import Clock, Timer, looping
from relay_server.common.database import AsyncDatabase
from relay_server.events.limits import (
    BATCH,
    DROP_REPORT_SECONDS,
    GATHER_SECONDS,
    MAX_PENDING_USES,
    QUEUE,
    REALM_EVENTS,
    RELAY_QUEUE,
    RETRY_AFTER_SECONDS,
    RETRY_SECONDS,
)

DROPPED = f"{RELAY_SOURCE}.dropped"
"""Source of the events that report dropped ones. No robot has it, and its events displace no others."""

Written = Callable[[list[StoredEventRecord]], None]
"""Called with events that are in the database, in the order of their numbers."""


class EventQueueFull(Unavailable):
    """Too many events wait to be written."""

    code = "full"
    retry_after = RETRY_AFTER_SECONDS


class _Batch(NamedTuple):
    """Events of which all are written, or none.

    :param waiting: fires when they are written; ``None`` for events of the relay, for which no request waits
    """

    events: Sequence[NewStoredEvent]
    waiting: Deferred[list[StoredEventRecord]] | None


class EventWriter:
    """The only writer of the event log.

    :param wall: Unix time in seconds
    :param written: called with all events that were written
    :ivar waiting: events in the queue; ``own_waiting`` of them are the relay's
    :ivar dropped: events of the relay that were not stored
    """

    log = Logger()

    def __init__(
        self, clock: Clock, store: AsyncDatabase, wall: Callable[[], float], written: Written
    ) -> None:
        self._clock = clock
        self._store = store
        self._wall = wall
        self._on_written = written
        self._batches: deque[_Batch] = deque()
        self._timer: Timer | None = None
        self._writing = False
        self._retry: Timer | None = None
        """Runs after a failed write while events of the relay wait."""
        self._idle: list[Deferred[None]] = []
        self._unreported: Counter[str] = Counter()
        """Dropped events of the relay that no event has reported yet, by realm."""
        self._report_at: dict[str, float] = {}
        """The monotonic time of the next such report, by realm."""
        self._realms = {DEFAULT_REALM}
        """Existing realms. Names that are none are not counted, so unauthenticated clients cannot fill the memory."""
        self.waiting = 0
        self.own_waiting = 0
        self.written = 0
        self.dropped = 0

    def append(self, event: NewStoredEvent) -> None:
        """Write an event of the relay, if there is room in the queue; returns at once."""
        if self.own_waiting >= RELAY_QUEUE or self.waiting >= QUEUE:
            self.count_drop(event.realm)
            return
        self.own_waiting += 1
        self._put(_Batch((event,), None))

    def count_drop(self, realm: str) -> None:
        """Count an event of the relay that is not stored; a later event reports the count."""
        self.dropped += 1
        if realm in self._realms:
            self._unreported[realm] += 1

    def knows_realm(self, realm: str) -> bool:
        """Whether a realm exists."""
        return realm in self._realms

    def set_realms(self, realms: Iterable[str]) -> None:
        """Set the names of all realms."""
        self._realms = {DEFAULT_REALM, *realms}

    def forget_realm(self, realm: str) -> None:
        """Drop the counts of a realm that was removed; a new one of its name is another."""
        self._realms.discard(realm)
        self._unreported.pop(realm, None)
        self._report_at.pop(realm, None)

    async def write(self, events: Sequence[NewStoredEvent]) -> list[StoredEventRecord]:
        """Write all of these events or none; they are in the database when this returns.

        :raises EventQueueFull: too many wait already
        :raises Unavailable: the database can't be written; none is stored
        """
        if self.waiting + len(events) > QUEUE:
            raise EventQueueFull("too many events wait to be written; try again in a moment")
        waiting: Deferred[list[StoredEventRecord]] = Deferred()
        self._put(_Batch(events, waiting))
        return await waiting

    async def flush(self) -> None:
        """Wait until the queue is empty."""
        if self._writing or self._batches:
            idle: Deferred[None] = Deferred()
            self._idle.append(idle)
            if self._retry is not None:
                self._retry.cancel()
                self._retry_write()
            await idle

    # --- writing ------------------------------------------------------------------------------------------

    def _put(self, batch: _Batch) -> None:
        self._batches.append(batch)
        self.waiting += len(batch.events)
        self._go_on()

    def _go_on(self) -> None:
        """Write a full batch at once, and others after :data:`GATHER_SECONDS`."""
        if self._writing or self._retry is not None:
            return
        if self.waiting >= BATCH:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            self._write()
        elif self._batches and self._timer is None:
            self._timer = self._clock.callLater(GATHER_SECONDS, self._gathered)

    def _gathered(self) -> None:
        self._timer = None
        self._write()

    def _write(self) -> None:
        batches = [self._batches.popleft()]
        size = len(batches[0].events)
        while self._batches and size + len(self._batches[0].events) <= BATCH:
            batches.append(self._batches.popleft())
            size += len(batches[-1].events)
        self._writing = True
        # An unexpected error must not end all writing.
        Deferred.fromCoroutine(self._save(batches)).addErrback(
            lambda failure: self.log.failure("events are lost", failure)
        ).addBoth(self._saved)

    async def _save(self, batches: list[_Batch]) -> None:
        unreported = self._reportable()
        self._unreported -= unreported
        events = [each for batch in batches for each in batch.events] + self._drop_events(unreported)
        try:
            stored = await self._store.write(queries.store_events, events)
        except Exception as error:
            self._unreported.update(unreported)
            self._failed(batches, error)
            if not isinstance(error, SwitchboardError):
                raise
            return
        self._release(batches)
        self._report_at |= dict.fromkeys(unreported, self._clock.seconds() + DROP_REPORT_SECONDS)
        at = 0
        for batch in batches:
            mine = [each for each in stored[at : at + len(batch.events)] if each is not None]
            at += len(batch.events)
            if batch.waiting is None or batch.waiting.called:
                continue
            if len(mine) == len(batch.events):
                batch.waiting.callback(mine)
            else:
                batch.waiting.errback(NotFound("the realm was removed"))
        written = [each for each in stored if each is not None]
        self.written += len(written)
        self._realms.update(each.realm for each in written)
        self._on_written(written)

    def _failed(self, batches: list[_Batch], error: Exception) -> None:
        """Keep the relay's events until the database is back; fail the writes of others."""
        known = isinstance(error, SwitchboardError)
        words = str(error) if known else "the relay failed; see its log"
        retried = [batch for batch in batches if batch.waiting is None and known]
        if retried:
            self._batches.extendleft(reversed(retried))
            self._retry = self._clock.callLater(RETRY_SECONDS, self._retry_write)
        gone = [batch for batch in batches if batch.waiting is not None or not known]
        self._release(gone)
        for batch in gone:
            if batch.waiting is None:
                self.count_drop(batch.events[0].realm)
            elif not batch.waiting.called:
                batch.waiting.errback(Unavailable(words))

    def _release(self, batches: list[_Batch]) -> None:
        self.own_waiting -= sum(batch.waiting is None for batch in batches)
        self.waiting -= sum(len(batch.events) for batch in batches)

    def _retry_write(self) -> None:
        self._retry = None
        self._write()

    def _saved(self, _: object) -> None:
        self._writing = False
        self._go_on()
        if not self._batches and not self._writing:
            idle, self._idle = self._idle, []
            for each in idle:
                if not each.called:
                    each.callback(None)

    def _reportable(self) -> Counter[str]:
        """Counts of dropped events, of realms without a report in the last :data:`DROP_REPORT_SECONDS`."""
        now = self._clock.seconds()
        return Counter(
            {realm: n for realm, n in self._unreported.items() if now >= self._report_at.get(realm, now)}
        )

    def _drop_events(self, unreported: Counter[str]) -> list[NewStoredEvent]:
        now = self._wall()
        return [
            NewStoredEvent(
                realm, now, DROPPED, "events.dropped", None, None, canonical_json({"count": count})
            )
            for realm, count in unreported.items()
        ]


CHECK_SECONDS = 1.0
"""Pause between two checks of the sources that have new events."""

DELETE_BATCH = 500
"""Events that are deleted in one transaction."""

DAY = 86400.0

PURGE_SECONDS = 600.0
"""Pause between two deletions of old events."""

USE_BATCH = 1000
"""Events whose use is counted in one transaction."""


class EventQuota:
    """Limits the number and age of stored events.

    :param wall: Unix time in seconds
    :param per_source: most events of a source in a realm
    :param retention: seconds after which events are deleted, in realms without a retention of their own
    :param per_realm: most events of a realm
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        store: AsyncDatabase,
        wall: Callable[[], float],
        per_source: int,
        retention: float,
        per_realm: int = REALM_EVENTS,
    ) -> None:
        self._store = store
        self._wall = wall
        self._per_source = per_source
        self._per_realm = per_realm
        self._retention = retention
        self._changed_sources: set[tuple[str, str]] = set()
        self._sizes: Counter[str] = Counter()
        self._uses: Counter[tuple[str, int]] = Counter()
        self._purge_at = 0.0
        self._loop = looping(clock, self._run)

    async def start(self) -> None:
        """Read the counts, and enforce the limits from now on.

        :raises Unavailable: the database cannot be read
        """
        self._sizes.update(await self._store.read(queries.event_counts))
        self._changed_sources.update(await self._store.read(queries.sources_over_quota, self._per_source))
        self._loop.start(CHECK_SECONDS, now=False)

    def stop(self) -> None:
        """Enforce nothing any more."""
        if self._loop.running:
            self._loop.stop()

    def on_written(self, events: Iterable[StoredEventRecord]) -> None:
        """Count events that were written."""
        for each in events:
            self._changed_sources.add((each.realm, each.source))
            self._sizes[each.realm] += 1

    def forget_realm(self, realm: str) -> None:
        """Drop the counts of a realm that was removed; a new one of its name is another."""
        self._changed_sources = {each for each in self._changed_sources if each[0] != realm}
        self._sizes.pop(realm, None)
        self._uses = Counter({each: times for each, times in self._uses.items() if each[0] != realm})

    def mark_used(self, realm: str, numbers: Iterable[int]) -> None:
        """Count one use of events of a realm."""
        for number in numbers:
            key = (realm, number)
            if len(self._uses) < MAX_PENDING_USES or key in self._uses:
                self._uses[key] += 1

    def _run(self) -> Deferred[None]:
        # The loop waits for the result, so runs never overlap.
        return Deferred.fromCoroutine(self.run_once()).addErrback(self._failed)

    def _failed(self, failure: Failure) -> None:
        if failure.check(SwitchboardError):
            self.log.debug("the limits of the event log are enforced later: {reason}", reason=failure.value)
        else:
            self.log.failure("enforcing the limits of the event log failed", failure)

    async def run_once(self) -> None:
        """Write the uses, and delete events over the limits.

        :raises Unavailable: the database does not answer; a later run does the rest
        """
        await self.count_uses()
        if self._wall() >= self._purge_at:
            await self.purge()
            self._purge_at = self._wall() + PURGE_SECONDS
        for realm, source in list(self._changed_sources):
            self._changed_sources.discard((realm, source))
            try:
                await self._trim(realm, source)
            except SwitchboardError:
                self._changed_sources.add((realm, source))
                raise
        for realm, size in list(self._sizes.items()):
            while size > self._per_realm:
                most = min(DELETE_BATCH, size - self._per_realm)
                if not await self._delete(realm, queries.oldest_events, None, most):
                    break
                size = self._sizes[realm]

    async def count_uses(self) -> None:
        """Write the uses of up to :data:`USE_BATCH` events.

        :raises Unavailable: the database can't be written
        """
        uses = dict(list(self._uses.items())[:USE_BATCH])
        if uses:
            await self._store.write(queries.add_event_uses, uses)
            self._uses -= Counter(uses)

    async def purge(self) -> None:
        """Delete old events.

        :raises Unavailable: the database does not answer
        """
        for realm in await self._store.read(queries.list_realms):
            own = realm.events_days
            before = self._wall() - (self._retention if own is None else own * DAY)
            while await self._delete(realm.name, queries.oldest_events, before, DELETE_BATCH):
                pass

    async def _trim(self, realm: str, source: str) -> None:
        while await self._delete(realm, queries.surplus_events, source, self._per_source, DELETE_BATCH):
            pass

    async def _delete(self, realm: str, which: Callable[..., list[int]], *args: object) -> int:
        """Delete the events that a query finds; returns how many."""
        numbers = await self._store.read(which, realm, *args)
        if not numbers:
            return 0
        gone = await self._store.write(queries.delete_events, realm, numbers)
        self._sizes[realm] -= gone
        return gone
