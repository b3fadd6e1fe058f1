"""Writes events, many in one transaction, and tells who brought them when they are safe.

No more than one transaction of the memory stands in the queue for the database at a time: a login that comes waits
for that one at most.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db import queries
from relay_db.base import canonical_json
from relay_db.queries import NewStoredEvent, StoredEventRecord
from relay_db.queries.event_search import OURS
from relay_protocol.errors import NotFound, SwitchboardError, Unavailable
from relay_protocol.realms import DEFAULT_REALM
from relay_server.common.clock import Clock, Timer
from relay_server.common.database import AsyncDatabase
from relay_server.events.limits import (
    AGAIN_SECONDS,
    BATCH,
    DROPS_SECONDS,
    GATHER_SECONDS,
    OWN_QUEUE,
    QUEUE,
    RETRY_SECONDS,
)

DROPPED = f"{OURS}.dropped"
"""Who says how many were dropped: no robot (those are ``relay:<name>``), and its events push no other ones out."""

Written = Callable[[list[StoredEventRecord]], None]
"""Is told of events once they are safe, in the order of their numbers."""


class EventQueueFull(Unavailable):
    """Too many events wait to be written."""

    code = "full"
    retry_after = AGAIN_SECONDS


class _Lot(NamedTuple):
    """What belongs together: all of it is written, or nothing.

    :param waiting: fires when it is safe; ``None`` for the relay's own, for which nobody waits
    """

    events: Sequence[NewStoredEvent]
    waiting: Deferred[list[StoredEventRecord]] | None


class EventWriter:
    """The one way into the memory.

    :param wall: Unix time in seconds
    :param written: told of all that was written
    """

    log = Logger()

    def __init__(
        self, clock: Clock, store: AsyncDatabase, wall: Callable[[], float], written: Written
    ) -> None:
        self._clock = clock
        self._store = store
        self._wall = wall
        self._told = written
        self._lots: deque[_Lot] = deque()
        self._timer: Timer | None = None
        self._writing = False
        self._retry: Timer | None = None
        """Runs while the database has refused the last events of the relay's own, which wait."""
        self._idle: list[Deferred[None]] = []
        self._untold: Counter[str] = Counter()
        """By realm, the relay's own events that were dropped and of which nobody has been told."""
        self._due: dict[str, float] = {}
        """By realm, when the next of that may be told."""
        self._realms = {DEFAULT_REALM}
        """Those that are known to exist: what strangers name is not counted by realm."""
        self.waiting = 0
        self.own_waiting = 0
        self.written = 0
        self.dropped = 0

    def note(self, event: NewStoredEvent) -> None:
        """Keep an event of the relay's own if there is room. Nobody waits for it."""
        if self.own_waiting >= OWN_QUEUE or self.waiting >= QUEUE:
            self.drop(event.realm)
            return
        self.own_waiting += 1
        self._put(_Lot((event,), None))

    def drop(self, realm: str) -> None:
        """An event of the relay's own is not kept; it is counted, and that is told with what is written later."""
        self.dropped += 1
        if realm in self._realms:
            self._untold[realm] += 1

    def knows(self, realm: str) -> bool:
        """Whether a realm is known to exist."""
        return realm in self._realms

    def exist(self, realms: Iterable[str]) -> None:
        """These realms are all that there are."""
        self._realms = {DEFAULT_REALM, *realms}

    def forget(self, realm: str) -> None:
        """A realm is gone; one of its name is another."""
        self._realms.discard(realm)
        self._untold.pop(realm, None)
        self._due.pop(realm, None)

    async def write(self, events: Sequence[NewStoredEvent]) -> list[StoredEventRecord]:
        """Keep these events, all or none; they are safe when this returns.

        :raises Full: too many wait already
        :raises Unavailable: the database can't be written; none is kept
        """
        if self.waiting + len(events) > QUEUE:
            raise EventQueueFull("too many events wait to be written; try again in a moment")
        waiting: Deferred[list[StoredEventRecord]] = Deferred()
        self._put(_Lot(events, waiting))
        return await waiting

    async def flush(self) -> None:
        """Wait until nothing waits any more."""
        if self._writing or self._lots:
            idle: Deferred[None] = Deferred()
            self._idle.append(idle)
            if self._retry is not None:
                self._retry.cancel()
                self._again()
            await idle

    # --- writing ------------------------------------------------------------------------------------------

    def _put(self, lot: _Lot) -> None:
        self._lots.append(lot)
        self.waiting += len(lot.events)
        self._go_on()

    def _go_on(self) -> None:
        """Write at once what fills a transaction, and soon what does not."""
        if self._writing or self._retry is not None:
            return
        if self.waiting >= BATCH:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            self._write()
        elif self._lots and self._timer is None:
            self._timer = self._clock.callLater(GATHER_SECONDS, self._gathered)

    def _gathered(self) -> None:
        self._timer = None
        self._write()

    def _write(self) -> None:
        lots = [self._lots.popleft()]
        size = len(lots[0].events)
        while self._lots and size + len(self._lots[0].events) <= BATCH:
            lots.append(self._lots.popleft())
            size += len(lots[-1].events)
        self._writing = True
        # An error that nobody has foreseen must not be the end of all writing.
        Deferred.fromCoroutine(self._save(lots)).addErrback(
            lambda failure: self.log.failure("events are lost", failure)
        ).addBoth(self._saved)

    async def _save(self, lots: list[_Lot]) -> None:
        untold = self._tellable()
        self._untold -= untold
        events = [each for lot in lots for each in lot.events] + self._drops(untold)
        try:
            kept = await self._store.write(queries.remember, events)
        except Exception as error:
            self._untold.update(untold)
            self._failed(lots, error)
            if not isinstance(error, SwitchboardError):
                raise
            return
        self._taken_out(lots)
        self._due |= dict.fromkeys(untold, self._clock.seconds() + DROPS_SECONDS)
        at = 0
        for lot in lots:
            mine = [each for each in kept[at : at + len(lot.events)] if each is not None]
            at += len(lot.events)
            if lot.waiting is None or lot.waiting.called:
                continue
            if len(mine) == len(lot.events):
                lot.waiting.callback(mine)
            else:
                lot.waiting.errback(NotFound("the realm was removed"))
        safe = [each for each in kept if each is not None]
        self.written += len(safe)
        self._realms.update(each.realm for each in safe)
        self._told(safe)

    def _failed(self, lots: list[_Lot], error: Exception) -> None:
        """The relay's own events wait until the database is back; others are refused, so their senders know."""
        known = isinstance(error, SwitchboardError)
        words = str(error) if known else "the relay failed; its log tells more"
        kept = [lot for lot in lots if lot.waiting is None and known]
        if kept:
            self._lots.extendleft(reversed(kept))
            self._retry = self._clock.callLater(RETRY_SECONDS, self._again)
        gone = [lot for lot in lots if lot.waiting is not None or not known]
        self._taken_out(gone)
        for lot in gone:
            if lot.waiting is None:
                self.drop(lot.events[0].realm)
            elif not lot.waiting.called:
                lot.waiting.errback(Unavailable(words))

    def _taken_out(self, lots: list[_Lot]) -> None:
        self.own_waiting -= sum(lot.waiting is None for lot in lots)
        self.waiting -= sum(len(lot.events) for lot in lots)

    def _again(self) -> None:
        self._retry = None
        self._write()

    def _saved(self, _: object) -> None:
        self._writing = False
        self._go_on()
        if not self._lots and not self._writing:
            idle, self._idle = self._idle, []
            for each in idle:
                if not each.called:
                    each.callback(None)

    def _tellable(self) -> Counter[str]:
        """How many were dropped, of realms where that was not told a moment ago."""
        now = self._clock.seconds()
        return Counter({realm: n for realm, n in self._untold.items() if now >= self._due.get(realm, now)})

    def _drops(self, untold: Counter[str]) -> list[NewStoredEvent]:
        """What says how many were dropped."""
        now = self._wall()
        return [
            NewStoredEvent(
                realm, now, DROPPED, "events.dropped", None, None, canonical_json({"count": count})
            )
            for realm, count in untold.items()
        ]
