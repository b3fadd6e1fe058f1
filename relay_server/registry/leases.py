"""Lets go what nobody has renewed, and sees what was taken out without this relay."""

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
from relay_server.registry.limits import LOOK_SECONDS, SURE_SECONDS

Gone = Callable[[str, EntryRecord], None]
"""Is told ``expired`` or ``removed``, and what."""


class EntryCache:
    """The entries that this relay knows of, so that what goes can be told as it was."""

    def __init__(self) -> None:
        self._known: dict[str, EntryRecord] = {}

    def keep(self, record: EntryRecord) -> None:
        """It is like this now."""
        self._known[record.id] = record

    def strike(self, entry_id: str) -> EntryRecord | None:
        """It is there no more; as it was, ``None`` when that was known already."""
        return self._known.pop(entry_id, None)

    def ids(self) -> set[str]:
        """Of all that are known."""
        return set(self._known)


class LeaseExpiry:
    """See the module's text.

    :param wall: Unix time in seconds
    :param gone: told once of each
    """

    log = Logger()

    def __init__(
        self, clock: Clock, store: AsyncDatabase, wall: Callable[[], float], book: EntryCache, gone: Gone
    ) -> None:
        self._clock = clock
        self._store = store
        self._wall = wall
        self._book = book
        self._gone = gone
        self._due = clock.seconds()
        self.looking = looping(clock, self._look)

    async def start(self) -> None:
        """Let go what is over, and look after the rest from now on.

        :raises Unavailable: the database can't be asked
        """
        await self.look()
        for each in await self._store.read(queries.all_entries, self._wall()):
            self._book.keep(each)
        self.looking.start(LOOK_SECONDS, now=False)

    def soon(self) -> None:
        """Somebody has changed something in the database."""
        self._due = self._clock.seconds()

    def lasts(self, record: EntryRecord) -> None:
        """A lease has begun, or begins anew."""
        self._book.keep(record)
        self._due = min(self._due, self._clock.seconds() + record.ttl)

    def ended(self, record: EntryRecord) -> None:
        """It was taken out."""
        self._strike("removed", record.id)

    def _look(self) -> Deferred[None] | None:
        if self._clock.seconds() < self._due:
            return None
        # The loop waits for it: no look begins before the last has ended.
        return Deferred.fromCoroutine(self.look()).addErrback(self._failed)

    def _failed(self, failure: Failure) -> None:
        self.soon()
        if failure.check(SwitchboardError):
            self.log.debug("leases are looked after later: {reason}", reason=failure.value)
        else:
            self.log.failure("looking after leases failed", failure)

    async def look(self) -> None:
        """See how the leases stand, let go those that are over, and tell of all that went.

        :raises Unavailable: the database can't be asked; the next look does what was not done
        """
        known, now, begun = self._book.ids(), self._wall(), self._clock.seconds()
        # What begins meanwhile may have the next look be sooner.
        self._due = begun + SURE_SECONDS
        stand = await self._store.read(queries.leases, now)
        for each in known - stand.there:
            self._strike("removed", each)
        over = stand.soonest is not None and stand.soonest <= now
        if stand.overlong:
            await self._store.write(queries.bound_leases, now)
        if over:
            await self._expire(now)
        if over or stand.overlong:
            stand = await self._store.read(queries.leases, now)
        if stand.soonest is not None:
            self._due = min(self._due, begun + stand.soonest - now)

    async def _expire(self, now: float) -> None:
        while gone := await self._store.write(queries.expire_entries, now):
            for each in gone:
                self._book.keep(each)
                self._strike("expired", each.id)

    def _strike(self, what: str, entry_id: str) -> None:
        record = self._book.strike(entry_id)
        if record is not None:
            self._gone(what, record)
