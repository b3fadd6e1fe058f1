"""Whom people and programs ask about events: who may write and read what, and what follows."""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from itertools import islice
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta
from twisted.internet.defer import Deferred, DeferredSemaphore
from twisted.python.failure import Failure

from relay_db import queries
from relay_db.base import canonical_json
from relay_db.models import NAME, SOURCE
from relay_db.queries import (
    EventCursor,
    EventSearch,
    MemoryPage,
    NewStoredEvent,
    StoredEventCounts,
    StoredEventRecord,
)
from relay_db.queries.event_search import LOGIN, OURS
from relay_protocol import jsontext
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_protocol.limits import ROBOT_NAME
from relay_protocol.rights import Rules
from relay_protocol.text import legible
from relay_server.access import NO_ROBOT, Access, Principal
from relay_server.common.database import AsyncDatabase
from relay_server.events import visibility
from relay_server.events.limits import ASKED, ASKED_EACH, COUNTED_USED, DATA, LOOKS, RECENT, SEVERAL
from relay_server.events.query import EventFormatter, EventQuery, chosen
from relay_server.events.quota import EventQuota
from relay_server.events.writer import EventWriter

PROGRAMS = 1024
"""Tokens of which it is known whose name they write under; the longest unused are forgotten first."""

FOLLOWED = 500
"""Events that are handed to a follower at a time."""


class NewEvent(msgspec.Struct, forbid_unknown_fields=True):
    """An event as somebody writes it; without a ``source`` it is from the program or user who writes."""

    kind: Annotated[str, Meta(min_length=1, max_length=NAME)]
    source: Annotated[str, Meta(min_length=1, max_length=SOURCE)] | None = None
    robot: Annotated[str, Meta(max_length=ROBOT_NAME)] | None = None
    data: msgspec.Raw = msgspec.field(default_factory=lambda: msgspec.Raw(b"{}"))


class EventVisibility(NamedTuple):
    """What somebody may see of what he asks for.

    :param ask: for the database
    :param names: of robots on which he has a right, by their numbers
    :param rules: what he may there
    """

    ask: EventSearch
    names: Mapping[int, str]
    rules: Mapping[int, Rules] = {}

    @property
    def forms(self) -> EventFormatter:
        """How what he sees is told."""
        return EventFormatter(self.names, self.rules)

    @property
    def empty(self) -> bool:
        """Whether there is nothing that he might see, so that nobody needs to look."""
        return not self.ask.robots and not self.ask.general

    def shows(self, event: StoredEventRecord) -> bool:
        """Whether an event is one of those; as the database judges it."""
        ask = self.ask
        if event.realm != ask.realm or not self._may_see(event):
            return False
        return (
            (ask.source is None or ask.source.fits(event.source))
            and (ask.kind is None or ask.kind.fits(event.kind))
            and (ask.user is None or ask.user == event.user)
            and (ask.since is None or event.at >= ask.since)
            and (ask.until is None or event.at < ask.until)
            and (not ask.data or queries.data_fits(ask.data, msgspec.json.decode(event.data)))
        )

    def _may_see(self, event: StoredEventRecord) -> bool:
        if event.robot_id is not None:
            return event.robot_id in self.ask.robots
        told = not event.source.startswith(OURS) and not event.kind.startswith(LOGIN)
        return self.ask.general and (told or self.ask.insider)


class RecentEvents:
    """What was written last, for those who follow; they hear of it without asking the database."""

    def __init__(self, size: int = RECENT) -> None:
        self._events: dict[str, deque[StoredEventRecord]] = {}
        self._size = size
        self._followers: set[EventFollower] = set()

    def written(self, events: list[StoredEventRecord]) -> None:
        """These are safe."""
        for each in events:
            self._events.setdefault(each.realm, deque(maxlen=self._size)).append(each)
        for follower in list(self._followers):
            follower.wake()

    def forget(self, realm: str) -> None:
        """A realm is gone; one of its name is another."""
        self._events.pop(realm, None)

    def since(self, realm: str, number: int) -> list[StoredEventRecord] | None:
        """Some of those with greater numbers, in their order; ``None`` when not all of them are known here."""
        events = self._events.get(realm)
        if not events or events[0].number > number + 1:
            return None
        if events[-1].number - events[0].number != len(events) - 1:
            # Not all numbers are this relay's.
            return None
        begin = max(0, number + 1 - events[0].number)
        return list(islice(events, begin, begin + FOLLOWED))

    def add(self, follower: EventFollower) -> None:
        """Somebody follows."""
        self._followers.add(follower)

    def remove(self, follower: EventFollower) -> None:
        """He does no more."""
        self._followers.discard(follower)


class EventFollower:
    """Somebody who wants to hear of new events; ``number`` is that of the last one that he was given."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.fresh = False
        """Whether something was written since it was looked last."""
        self._wake: Deferred[None] | None = None

    def wake(self) -> None:
        """There is something new, or it is time to look."""
        self.fresh = True
        wake, self._wake = self._wake, None
        if wake is not None:
            wake.callback(None)

    async def news(self) -> None:
        """Wait for :meth:`wake`."""
        if self.fresh:
            return
        self._wake = Deferred()
        try:
            await self._wake
        finally:
            self._wake = None


class EventService:
    """See the module's text.

    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        store: AsyncDatabase,
        access: Access,
        writer: EventWriter,
        quota: EventQuota,
        recent: RecentEvents,
        wall: Callable[[], float],
    ) -> None:
        self._store = store
        self._access = access
        self._writer = writer
        self._quota = quota
        self._recent = recent
        self.wall = wall
        # The other of the threads that read is for logins and whatever else is asked.
        self._turn = DeferredSemaphore(1)
        self._asked: Counter[int] = Counter()
        """By user, reads that wait or are under way."""
        self._programs: OrderedDict[int, str] = OrderedDict()

    # --- writing ------------------------------------------------------------------------------------------

    async def write(self, principal: Principal, events: list[NewEvent]) -> list[dict[str, Any]]:
        """Keep events, all or none; they are safe when this returns.

        :raises Invalid: a name or the data can't be
        :raises NotFound: one is about a robot that there is not, or on which the writer has no right
        :raises Refused: a source that is the relay's
        :raises Unavailable: too many wait, or the database can't be written
        """
        if not 1 <= len(events) <= SEVERAL:
            raise Invalid(f"send one event, or a list of 1 to {SEVERAL}")
        names, _ = await self._robots(principal)
        numbers = {name: number for number, name in names.items()}
        own = "" if all(each.source for each in events) else await self._own_name(principal)
        now = self.wall()
        new = [self._new(principal, each, numbers, own, now) for each in events]
        kept, forms = await self._writer.write(new), EventFormatter(names)
        return [forms.json(each) for each in kept]

    async def may_write(self, principal: Principal, events: list[NewEvent]) -> None:
        """See that somebody could write these now, as far as it depends on robots.

        :raises NotFound: one is about a robot that there is not, or on which the writer has no right
        """
        names, _ = await self._robots(principal)
        if any(each.robot is not None and each.robot not in names.values() for each in events):
            raise NotFound(NO_ROBOT)

    def _new(
        self, principal: Principal, event: NewEvent, robots: Mapping[str, int], own: str, now: float
    ) -> NewStoredEvent:
        source = event.source or own
        if not legible(source) or not legible(event.kind):
            raise Invalid("'source' and 'kind' must be printable")
        if source.startswith(OURS):
            raise Refused(f"sources that begin with '{OURS}' are the relay's own; give another 'source'")
        if event.robot is not None and event.robot not in robots:
            raise NotFound(NO_ROBOT)
        robot = None if event.robot is None else robots[event.robot]
        return NewStoredEvent(
            principal.realm, now, source, event.kind, robot, principal.name, _text(event.data)
        )

    async def _own_name(self, principal: Principal) -> str:
        """The label of the program by whose token somebody writes, else the user's name."""
        known = self._programs.get(principal.token_id)
        if known is None:
            label = await self._store.read(queries.program_label, principal.token_id)
            known = self._programs[principal.token_id] = (label or principal.name)[:SOURCE]
        self._programs.move_to_end(principal.token_id)
        while len(self._programs) > PROGRAMS:
            self._programs.popitem(last=False)
        return known

    # --- reading ------------------------------------------------------------------------------------------

    async def sight(self, principal: Principal, ask: EventQuery) -> EventVisibility:
        """What somebody may see of what he asks for, now."""
        names, rules = await self._robots(principal)
        robots = chosen(ask, names)
        if ask.data:
            robots = frozenset(
                each for each in robots if visibility.may_ask(rules[each], ask.source, ask.data)
            )
        return EventVisibility(
            EventSearch(
                principal.realm,
                robots,
                ask.robot is None,
                principal.admin,
                ask.source,
                ask.kind,
                ask.user,
                ask.since,
                ask.until,
                ask.data,
            ),
            names,
            rules,
        )

    async def count(self, principal: Principal, ask: EventQuery) -> tuple[int, EventCursor | None]:
        """How many events there are, and the place behind which there may be more: one count takes :data:`LOOKS` reads.

        Who asks whether something has happened uses it by that as who reads it does.

        :raises Unavailable: the database does not answer, or too many ask
        """
        sight, place = await self.sight(principal, ask), ask.after
        count, numbers = 0, list[int]()
        for _ in range(0 if sight.empty else LOOKS):
            few = COUNTED_USED - len(numbers)
            part: StoredEventCounts = await self._read(
                principal, queries.count_memories, sight.ask, place, few
            )
            count, numbers, place = count + part.size, numbers + part.numbers, part.place
            if place is None:
                break
        # Of a part that had too many the numbers are not told.
        if place is None and count == len(numbers):
            self._quota.used(principal.realm, numbers)
        return count, None if sight.empty else place

    async def page(
        self, principal: Principal, ask: EventQuery, limit: int, *, uses: bool = True
    ) -> tuple[list[StoredEventRecord], EventFormatter, EventCursor | None]:
        """Events, the newest first, how to tell them, and the place behind which there may be more.

        They may be fewer than wanted, or none, though there are more: one page takes :data:`LOOKS` reads at most.

        :param limit: most events
        :param uses: whether they count as used by this
        :raises Unavailable: the database does not answer, or too many ask
        """
        sight, place = await self.sight(principal, ask), ask.after
        found: list[StoredEventRecord] = []
        for _ in range(0 if sight.empty else LOOKS):
            # One more than is told: that there are more shall be told only where there are, as far as one looks.
            room = limit + 1 - len(found)
            page: MemoryPage = await self._read(principal, queries.recall, sight.ask, place, room)
            found, place = found + page.events, page.place
            if place is None or len(found) > limit:
                break
        told = found[:limit]
        if uses:
            self._quota.used(principal.realm, [each.number for each in told])
        if len(found) > limit:
            place = EventCursor(told[-1].at, told[-1].number)
        return told, sight.forms, None if sight.empty else place

    async def follow_from(self, principal: Principal, number: int | None) -> EventFollower:
        """Begin to follow; :meth:`following` must go on with it.

        :param number: of the last event that is known already; ``None`` for whatever there is
        """
        latest = await self._store.read(queries.latest_memory, principal.realm)
        return EventFollower(latest if number is None else min(number, latest))

    @asynccontextmanager
    async def following(self, following: EventFollower) -> AsyncIterator[EventFollower]:
        """Have a follower woken at whatever is written, until this ends."""
        self._recent.add(following)
        try:
            yield following
        finally:
            self._recent.remove(following)

    async def news(
        self, principal: Principal, ask: EventQuery, following: EventFollower
    ) -> tuple[list[StoredEventRecord], EventFormatter, bool]:
        """New events that are wanted, in the order of their numbers, how to tell them, and whether there may be more.

        :raises Unavailable: the database has to be asked, and does not answer
        """
        realm, number, following.fresh = principal.realm, following.number, False
        events = self._recent.since(realm, number)
        if events is None:
            events = await self._read(principal, queries.memories_since, realm, number, FOLLOWED)
        sight = await self.sight(principal, ask)
        if events:
            following.number = events[-1].number
        return [each for each in events if sight.shows(each)], sight.forms, bool(events)

    async def _robots(self, principal: Principal) -> tuple[dict[int, str], dict[int, Rules]]:
        robots = await self._access.robots(principal)
        names = {record.id: record.name for record, _ in robots}
        return names, {record.id: rules for record, rules in robots}

    async def _read(self, principal: Principal, query: Callable[..., Any], *args: Any) -> Any:
        """Ask the database, one at a time: the next when the thread is done, also where the asker has left.

        :param principal: whose share of the queue it takes
        :raises Unavailable: it does not answer, or too many ask, or he too much
        """
        user = principal.user_id
        if self._asked[user] >= ASKED_EACH:
            raise Unavailable(
                f"you ask more than {ASKED_EACH} things about events at once; await some answers"
            )
        if self._asked.total() >= ASKED:
            raise Unavailable("too many ask about events now; try again in a moment")
        self._asked[user] += 1
        try:
            await self._turn.acquire()
        except BaseException:
            self._asked -= Counter((user,))
            raise
        # Not the read's own Deferred: who leaves would give the turn away while the thread goes on.
        answer: Deferred[Any] = Deferred()
        Deferred.fromCoroutine(self._store.read(query, *args)).addBoth(self._has_read, user, answer)
        return await answer

    def _has_read(self, result: Any, user: int, answer: Deferred[Any]) -> None:
        """The thread is done, whether or not anybody still waits for what it found."""
        self._asked -= Counter((user,))
        if isinstance(result, Failure):
            answer.errback(result)
        else:
            answer.callback(result)
        self._turn.release()


def _text(data: msgspec.Raw) -> str:
    """The data of an event as it is kept.

    :raises Invalid: it is no object, or too large
    :raises MalformedMessage: it is no JSON
    """
    value = jsontext.decode_any(bytes(data))
    if not isinstance(value, dict):
        raise Invalid("'data' is a JSON object")
    try:
        text = canonical_json(value)
    except (ValueError, RecursionError):
        text = ""
    if not 0 < len(text) <= DATA:
        raise Invalid(f"'data' may have {DATA} characters at most, as JSON in ASCII")
    return text
