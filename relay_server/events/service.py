"""The event log: which events users may write and read; and how its parts are built."""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Mapping
from contextlib import asynccontextmanager
from typing import Annotated, Any, Protocol

import msgspec
from msgspec import Meta
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from twisted.internet.defer import Deferred, DeferredSemaphore
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_db import queries
from relay_db.base import canonical_json
from relay_db.models import NAME, SOURCE
from relay_db.queries import (
    AlertRecord,
    EventCursor,
    EventSearch,
    FoundEvents,
    NewStoredEvent,
    StoredEventCounts,
    StoredEventRecord,
)
from relay_db.queries.event_search import RELAY_SOURCE
from relay_protocol import jsontext
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.limits import ROBOT_NAME
from relay_protocol.rights import Rules
from relay_protocol.text import is_printable
from relay_server.access import NO_ROBOT, Access, Principal
from relay_server.common.concurrency import with_timeout
from relay_server.common.database import AsyncDatabase
from relay_server.core import Core
from relay_server.events.bus import MAX_FOLLOWED, EventFollower, RecentEvents
from relay_server.events.collector import EventCollector
from relay_server.events.limits import (
    DATA,
    MAX_COUNTED_AS_USED,
    MAX_PER_REQUEST,
    MAX_READS,
    MAX_READS_PER_USER,
    MAX_SCANS,
)
from relay_server.events.query import (
    EventFormatter,
    EventInfo,
    EventQuery,
    EventVisibility,
    matching_robots,
    may_search,
)
from relay_server.events.writer import EventQuota, EventWriter

TOKEN_LABELS = 1024
"""Tokens of which the default source is cached; the least recently used leave first."""

STOP_SECONDS = 2.0
"""Time for the last write when the relay stops."""


class NewEvent(msgspec.Struct, forbid_unknown_fields=True):
    """An event of a request. Without ``source`` it gets the label of the writer's OAuth client, or the user's name."""

    kind: Annotated[str, Meta(min_length=1, max_length=NAME)]
    source: Annotated[str, Meta(min_length=1, max_length=SOURCE)] | None = None
    robot: Annotated[str, Meta(max_length=ROBOT_NAME)] | None = None
    data: msgspec.Raw = msgspec.field(default_factory=lambda: msgspec.Raw(b"{}"))


class EventService:
    """Which events a user may write, find and follow (SPEC 1.14).

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
        # One read at a time: of the two reading threads the other stays free for logins.
        self._turn = DeferredSemaphore(1)
        self._reads_by_user: Counter[int] = Counter()
        """Reads that wait or run, by user."""
        self._token_labels: OrderedDict[int, str] = OrderedDict()

    # --- writing ------------------------------------------------------------------------------------------

    async def write(self, principal: Principal, events: list[NewEvent]) -> list[EventInfo]:
        """Store all of these events or none; they are in the database when this returns.

        :raises Invalid: a name or the data is not allowed
        :raises NotFound: one is about a robot that does not exist, or on which the writer has no right
        :raises Refused: a source that is reserved for the relay
        :raises Unavailable: too many events wait, or the database can't be written
        """
        if not 1 <= len(events) <= MAX_PER_REQUEST:
            raise Invalid(f"send one event, or a list of 1 to {MAX_PER_REQUEST}")
        names, _ = await self._robots(principal)
        numbers = {name: number for number, name in names.items()}
        own = "" if all(each.source for each in events) else await self._default_source(principal)
        now = self.wall()
        new = [self._new(principal, each, numbers, own, now) for each in events]
        stored, formatter = await self._writer.write(new), EventFormatter(names)
        return [formatter.info(each) for each in stored]

    async def may_write(self, principal: Principal, events: list[NewEvent]) -> None:
        """Check the robots of events that are to be written.

        :raises NotFound: one is about a robot that does not exist, or on which the writer has no right
        """
        names, _ = await self._robots(principal)
        if any(each.robot is not None and each.robot not in names.values() for each in events):
            raise NotFound(NO_ROBOT)

    def _new(
        self, principal: Principal, event: NewEvent, robots: Mapping[str, int], own: str, now: float
    ) -> NewStoredEvent:
        source = event.source or own
        if not is_printable(source) or not is_printable(event.kind):
            raise Invalid("'source' and 'kind' must be printable")
        if source.startswith(RELAY_SOURCE):
            raise Refused(
                f"sources that begin with '{RELAY_SOURCE}' are the relay's own; give another 'source'"
            )
        if event.robot is not None and event.robot not in robots:
            raise NotFound(NO_ROBOT)
        robot = None if event.robot is None else robots[event.robot]
        return NewStoredEvent(
            principal.realm, now, source, event.kind, robot, principal.name, _text(event.data)
        )

    async def _default_source(self, principal: Principal) -> str:
        """The label of the OAuth client that the writer's token was issued to, else the user's name."""
        known = self._token_labels.get(principal.token_id)
        if known is None:
            label = await self._store.read(queries.oauth_client_label, principal.token_id)
            known = self._token_labels[principal.token_id] = (label or principal.name)[:SOURCE]
        self._token_labels.move_to_end(principal.token_id)
        while len(self._token_labels) > TOKEN_LABELS:
            self._token_labels.popitem(last=False)
        return known

    # --- reading ------------------------------------------------------------------------------------------

    async def visibility_of(self, principal: Principal, query: EventQuery) -> EventVisibility:
        """The part of a query that a user may see now."""
        names, rules = await self._robots(principal)
        robots = matching_robots(query, names)
        if query.data:
            robots = frozenset(each for each in robots if may_search(rules[each], query.source, query.data))
        search = EventSearch(
            principal.realm,
            robots,
            without_robot=query.robot is None,
            admin=principal.admin,
            source=query.source,
            kind=query.kind,
            user=query.user,
            since=query.since,
            until=query.until,
            data=query.data,
        )
        return EventVisibility(search, names, rules)

    async def count(self, principal: Principal, query: EventQuery) -> tuple[int, EventCursor | None]:
        """Count events with at most :data:`MAX_SCANS` reads. The counted events count as used where they are few.

        :returns: the number, and the cursor behind which there may be more
        :raises Unavailable: the database does not answer, or too many reads wait
        """
        visible, cursor = await self.visibility_of(principal, query), query.after
        count, numbers = 0, list[int]()
        for _ in range(0 if visible.empty else MAX_SCANS):
            few = MAX_COUNTED_AS_USED - len(numbers)
            part: StoredEventCounts = await self._read(
                principal, queries.count_events, visible.search, cursor, few
            )
            count, numbers, cursor = count + part.size, numbers + part.numbers, part.cursor
            if cursor is None:
                break
        # The numbers are missing where a read found too many events.
        if cursor is None and count == len(numbers):
            self._quota.mark_used(principal.realm, numbers)
        return count, None if visible.empty else cursor

    async def page(
        self, principal: Principal, query: EventQuery, limit: int, *, uses: bool = True
    ) -> tuple[list[StoredEventRecord], EventFormatter, EventCursor | None]:
        """Find events with at most :data:`MAX_SCANS` reads; so a page may be short although there are more.

        :param limit: most events
        :param uses: whether they count as used
        :returns: events, the newest first; their formatter; the cursor behind which there may be more
        :raises Unavailable: the database does not answer, or too many reads wait
        """
        visible, cursor = await self.visibility_of(principal, query), query.after
        found: list[StoredEventRecord] = []
        for _ in range(0 if visible.empty else MAX_SCANS):
            # One more than the limit shows whether there are more.
            room = limit + 1 - len(found)
            page: FoundEvents = await self._read(
                principal, queries.search_events, visible.search, cursor, room
            )
            found, cursor = found + page.events, page.cursor
            if cursor is None or len(found) > limit:
                break
        page_events = found[:limit]
        if uses:
            self._quota.mark_used(principal.realm, [each.number for each in page_events])
        if len(found) > limit:
            cursor = EventCursor(page_events[-1].at, page_events[-1].number)
        return page_events, visible.formatter, None if visible.empty else cursor

    async def follow_from(self, principal: Principal, number: int | None) -> EventFollower:
        """A follower of new events, for :meth:`following`.

        :param number: of the last event that the reader has; ``None`` for the latest
        """
        latest = await self._store.read(queries.latest_event_number, principal.realm)
        return EventFollower(latest if number is None else min(number, latest))

    @asynccontextmanager
    async def following(self, follower: EventFollower) -> AsyncIterator[EventFollower]:
        """Wake the follower whenever events are written, while the context is open."""
        self._recent.subscribe(follower)
        try:
            yield follower
        finally:
            self._recent.unsubscribe(follower)

    async def news(
        self, principal: Principal, query: EventQuery, follower: EventFollower
    ) -> tuple[list[StoredEventRecord], EventFormatter, bool]:
        """The next new events.

        :returns: those that match, in the order of their numbers; their formatter; whether there may be more
        :raises Unavailable: the database has to be read, and does not answer
        """
        realm, number, follower.fresh = principal.realm, follower.number, False
        events = self._recent.since(realm, number)
        if events is None:
            events = await self._read(principal, queries.events_since, realm, number, MAX_FOLLOWED)
        visible = await self.visibility_of(principal, query)
        if events:
            follower.number = events[-1].number
        return [each for each in events if visible.matches(each)], visible.formatter, bool(events)

    async def _robots(self, principal: Principal) -> tuple[dict[int, str], dict[int, Rules]]:
        robots = await self._access.robots(principal)
        names = {record.id: record.name for record, _ in robots}
        return names, {record.id: rules for record, rules in robots}

    async def _read(self, principal: Principal, statement: Callable[..., Any], *args: Any) -> Any:
        """Read the database, one read at a time. The next begins when the thread is done, even if the caller left.

        :param principal: each user has a part of the queue
        :raises Unavailable: it does not answer, or too many reads of this user or of all wait
        """
        user = principal.user_id
        if self._reads_by_user[user] >= MAX_READS_PER_USER:
            raise Unavailable(
                f"more than {MAX_READS_PER_USER} of your requests for events run already; wait for some answers"
            )
        if self._reads_by_user.total() >= MAX_READS:
            raise Unavailable("too many requests for events wait; try again in a moment")
        self._reads_by_user[user] += 1
        try:
            await self._turn.acquire()
        except BaseException:
            self._reads_by_user -= Counter((user,))
            raise
        # Not the read's own Deferred: cancelling that would release the semaphore while the thread works on.
        answer: Deferred[Any] = Deferred()
        Deferred.fromCoroutine(self._store.read(statement, *args)).addBoth(self._read_done, user, answer)
        return await answer

    def _read_done(self, result: Any, user: int, answer: Deferred[Any]) -> None:
        self._reads_by_user -= Counter((user,))
        if isinstance(result, Failure):
            answer.errback(result)
        else:
            answer.callback(result)
        self._turn.release()


def _text(data: msgspec.Raw) -> str:
    """The data of an event as it is stored.

    :raises Invalid: it is not an object, or too large
    :raises MalformedMessage: it is not JSON
    """
    value = jsontext.decode_any(bytes(data))
    if not isinstance(value, dict):
        raise Invalid("'data' must be a JSON object")
    try:
        text = canonical_json(value)
    except (ValueError, RecursionError):
        text = ""
    if not 0 < len(text) <= DATA:
        raise Invalid(f"'data' may have {DATA} characters at most, as JSON in ASCII")
    return text


class AlertFeed(Protocol):
    """Publishes alerts; see :class:`relay_server.alerts.hub.AlertHub`."""

    def subscribe(self, subscriber: Callable[[str, AlertRecord], None]) -> None:
        """Call this with what became of an alert, and the alert."""


class EventLog(Collector):
    """The event log of a relay: collects, writes, limits and serves events, and counts them for Prometheus.

    :ivar service: the rules for users
    :ivar record: stores an event that another part of the relay has made, if there is room; returns at once
    """

    log = Logger()

    def __init__(self, core: Core, alerts: AlertFeed) -> None:
        clock, settings = core.reactor, core.settings
        self._clock = clock
        self._recent = RecentEvents()
        self._quota = EventQuota(
            clock, core.database, time.time, settings.events_of_source, settings.events_kept
        )
        self._writer = EventWriter(clock, core.database, time.time, self._on_written)
        collector = EventCollector(self._writer, core.robots, time.time, clock.seconds)
        self.service = EventService(
            core.database, core.access, self._writer, self._quota, self._recent, time.time
        )
        self.record = collector.record
        core.bus.subscribe(collector.on_bus_event)
        core.robots.on_nodes(collector.on_nodes_changed)
        alerts.subscribe(collector.on_alert)

    async def start(self) -> None:
        """Enforce the quotas from now on.

        :raises Unavailable: the database cannot be read
        """
        await self._quota.start()

    def on_realms_changed(self, gone: Collection[str], there: Collection[str]) -> None:
        """See :class:`relay_server.maintenance.RealmCaches`."""
        for realm in gone:
            self._quota.forget_realm(realm)
            self._writer.forget_realm(realm)
            self._recent.forget_realm(realm)
        self._writer.set_realms(there)

    async def stop(self) -> None:
        """Write the events that wait, for :data:`STOP_SECONDS` at most, and enforce no quotas any more."""
        self._quota.stop()
        late = f"the database has not taken them within {STOP_SECONDS:g} s"
        try:
            await with_timeout(self._clock, STOP_SECONDS, self._writer.flush(), late)
        except SwitchboardError as error:
            count = self._writer.waiting
            self.log.error("the latest {count} events are lost: {reason}", count=count, reason=str(error))

    def collect(self) -> Iterator[Metric]:
        """See :class:`Collector`."""
        writer = self._writer
        yield GaugeMetricFamily(
            "switchboard_events_waiting", "Events that wait to be written", writer.waiting
        )
        yield CounterMetricFamily("switchboard_events_written", "Events that were written", writer.written)
        yield CounterMetricFamily(
            "switchboard_events_dropped", "Events of the relay that were not stored", writer.dropped
        )

    def _on_written(self, events: list[StoredEventRecord]) -> None:
        self._quota.on_written(events)
        self._recent.on_written(events)
