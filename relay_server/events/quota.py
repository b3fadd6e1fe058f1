"""Keeps each source and each realm to what they may have, and lets go what is old: unseen, a little at a time.

Which events go is looked up by those who read, so that writers wait for the deletion of a few hundred rows at most.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable

from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_db import queries
from relay_db.queries import StoredEventRecord
from relay_protocol.errors import SwitchboardError
from relay_server.common.clock import Clock, looping
from relay_server.common.database import AsyncDatabase
from relay_server.events.limits import REALM_EVENTS, USES

LOOK_SECONDS = 1.0
"""How often sources that were written to are looked at."""

GONE = 500
"""Events that go in one transaction."""

DAY = 86400.0

PURGE_SECONDS = 600.0
"""How often what is old is looked for."""

USED = 1000
"""Events whose use is counted in one transaction."""


class EventQuota:
    """See the module's text.

    :param wall: Unix time in seconds
    :param of_source: events that a source may have in a realm
    :param kept: seconds after which an event goes, where its realm says nothing else
    :param of_realm: events that a realm may have
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        store: AsyncDatabase,
        wall: Callable[[], float],
        of_source: int,
        kept: float,
        of_realm: int = REALM_EVENTS,
    ) -> None:
        self._store = store
        self._wall = wall
        self._of_source = of_source
        self._of_realm = of_realm
        self._kept = kept
        self._grown: set[tuple[str, str]] = set()
        self._sizes: Counter[str] = Counter()
        self._uses: Counter[tuple[str, int]] = Counter()
        self._purge_at = 0.0
        self._looking = looping(clock, self._look)

    async def start(self) -> None:
        """See what there is, and look after it from now on.

        :raises Unavailable: the database can't be asked
        """
        self._sizes.update(await self._store.read(queries.memory_sizes))
        self._grown.update(await self._store.read(queries.crowded_sources, self._of_source))
        self._looking.start(LOOK_SECONDS, now=False)

    def stop(self) -> None:
        """Look no more."""
        if self._looking.running:
            self._looking.stop()

    def written(self, events: Iterable[StoredEventRecord]) -> None:
        """These were written."""
        for each in events:
            self._grown.add((each.realm, each.source))
            self._sizes[each.realm] += 1

    def forget(self, realm: str) -> None:
        """A realm is gone; one of its name is another."""
        self._grown = {each for each in self._grown if each[0] != realm}
        self._sizes.pop(realm, None)
        self._uses = Counter({each: times for each, times in self._uses.items() if each[0] != realm})

    def used(self, realm: str, numbers: Iterable[int]) -> None:
        """A query has given these of a realm, or counted them."""
        for number in numbers:
            key = (realm, number)
            if len(self._uses) < USES or key in self._uses:
                self._uses[key] += 1

    def _look(self) -> Deferred[None]:
        # The loop waits for it: no look begins before the last has ended.
        return Deferred.fromCoroutine(self.look()).addErrback(self._failed)

    def _failed(self, failure: Failure) -> None:
        if failure.check(SwitchboardError):
            self.log.debug("the memory is looked after later: {reason}", reason=failure.value)
        else:
            self.log.failure("looking after the memory failed", failure)

    async def look(self) -> None:
        """Write which events were used, and let go what is too much.

        :raises Unavailable: the database can't be asked; what was not done is done by a later look
        """
        await self.count_uses()
        if self._wall() >= self._purge_at:
            await self.purge()
            self._purge_at = self._wall() + PURGE_SECONDS
        for realm, source in list(self._grown):
            self._grown.discard((realm, source))
            try:
                await self._trim(realm, source)
            except SwitchboardError:
                self._grown.add((realm, source))
                raise
        for realm, size in list(self._sizes.items()):
            while size > self._of_realm:
                most = min(GONE, size - self._of_realm)
                if not await self._forget(realm, queries.old_memories, None, most):
                    break
                size = self._sizes[realm]

    async def count_uses(self) -> None:
        """Have the database know what was used, some of it.

        :raises Unavailable: it can't be written
        """
        uses = dict(list(self._uses.items())[:USED])
        if uses:
            await self._store.write(queries.use_memories, uses)
            self._uses -= Counter(uses)

    async def purge(self) -> None:
        """Let go what is too old.

        :raises Unavailable: the database can't be asked
        """
        for realm in await self._store.read(queries.list_realms):
            own = realm.events_days
            before = self._wall() - (self._kept if own is None else own * DAY)
            while await self._forget(realm.name, queries.old_memories, before, GONE):
                pass

    async def _trim(self, realm: str, source: str) -> None:
        while await self._forget(realm, queries.surplus_memories, source, self._of_source, GONE):
            pass

    async def _forget(self, realm: str, which: Callable[..., list[int]], *args: object) -> int:
        """Let go those that a query names; how many."""
        numbers = await self._store.read(which, realm, *args)
        if not numbers:
            return 0
        gone = await self._store.write(queries.forget_memories, realm, numbers)
        self._sizes[realm] -= gone
        return gone
