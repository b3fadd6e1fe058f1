"""Deletes entries whose leases have ended, and finds those that the command line has removed."""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_db import queries
from relay_db.queries import EntryRecord
from relay_protocol.errors import SwitchboardError
from relay_server.common.clock import Clock, looping
from relay_server.common.database import AsyncDatabase
from relay_server.service_registry.entries import CHECK_SECONDS, FULL_CHECK_SECONDS

Ended = Callable[[str, EntryRecord], None]
"""Called with ``expired`` or ``removed``, and the entry."""


class EntryCache:
    """The known entries, so that a change can report an entry that is gone as it was."""

    def __init__(self) -> None:
        self._known: dict[str, EntryRecord] = {}

    def put(self, record: EntryRecord) -> None:
        """Add an entry, or its new state."""
        self._known[record.id] = record

    def pop(self, entry_id: str) -> EntryRecord | None:
        """Remove an entry; ``None`` when it is not known."""
        return self._known.pop(entry_id, None)

    def ids(self) -> set[str]:
        """The ids of all known entries."""
        return set(self._known)


class LeaseExpiry:
    """Ends leases.

    :param wall: Unix time in seconds
    :param cache: of the entries, so that ended ones can be reported
    :param on_ended: called once for each entry that is gone
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        store: AsyncDatabase,
        wall: Callable[[], float],
        cache: EntryCache,
        on_ended: Ended,
    ) -> None:
        self._clock = clock
        self._store = store
        self._wall = wall
        self._cache = cache
        self._on_ended = on_ended
        self._check_at = clock.seconds()
        self.loop = looping(clock, self._check)

    async def start(self) -> None:
        """Delete expired entries now, and periodically from now on.

        :raises Unavailable: the database does not answer
        """
        await self.check()
        for each in await self._store.read(queries.all_entries, self._wall()):
            self._cache.put(each)
        self.loop.start(CHECK_SECONDS, now=False)

    def stop(self) -> None:
        """Stop the periodic checks."""
        if self.loop.running:
            self.loop.stop()

    def check_soon(self) -> None:
        """Check in the next run, because the database was changed."""
        self._check_at = self._clock.seconds()

    def on_renewed(self, record: EntryRecord) -> None:
        """A lease has begun, or was renewed."""
        self._cache.put(record)
        self._check_at = min(self._check_at, self._clock.seconds() + record.ttl)

    def on_removed(self, record: EntryRecord) -> None:
        """A user has removed an entry."""
        self._end("removed", record.id)

    def _check(self) -> Deferred[None] | None:
        if self._clock.seconds() < self._check_at:
            return None
        # The loop waits for this Deferred, so checks never overlap.
        return Deferred.fromCoroutine(self.check()).addErrback(self._failed)

    def _failed(self, failure: Failure) -> None:
        self.check_soon()
        if failure.check(SwitchboardError):
            self.log.debug("leases are checked later: {reason}", reason=failure.value)
        else:
            self.log.failure("checking leases failed", failure)

    async def check(self) -> None:
        """Delete entries whose leases are over, and report all that are gone.

        :raises Unavailable: the database does not answer; the next check does the rest
        """
        known, now, begun = self._cache.ids(), self._wall(), self._clock.seconds()
        # A lease that begins meanwhile may make the next check earlier.
        self._check_at = begun + FULL_CHECK_SECONDS
        times = await self._store.read(queries.lease_times, now)
        for each in known - times.ids:
            self._end("removed", each)
        over = times.next_end is not None and times.next_end <= now
        if times.too_long:
            await self._store.write(queries.clamp_leases, now)
        if over:
            await self._expire(now)
        if over or times.too_long:
            times = await self._store.read(queries.lease_times, now)
        if times.next_end is not None:
            self._check_at = min(self._check_at, begun + times.next_end - now)

    async def _expire(self, now: float) -> None:
        while gone := await self._store.write(queries.expire_entries, now):
            for each in gone:
                self._cache.put(each)
                self._end("expired", each.id)

    def _end(self, what: str, entry_id: str) -> None:
        record = self._cache.pop(entry_id)
        if record is not None:
            self._on_ended(what, record)
