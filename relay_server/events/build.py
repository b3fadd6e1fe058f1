"""The memory, put together: what notes, what writes, what looks after it, and whom people ask."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from typing import Any, Protocol

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from twisted.logger import Logger

from relay_db.queries import AlertRecord, StoredEventRecord
from relay_protocol.errors import SwitchboardError
from relay_server.access import Access
from relay_server.common.clock import with_timeout
from relay_server.common.database import AsyncDatabase
from relay_server.config import RelaySettings
from relay_server.events.bus import EventBus
from relay_server.events.collector import EventCollector
from relay_server.events.quota import EventQuota
from relay_server.events.service import EventService, RecentEvents
from relay_server.events.writer import EventWriter
from relay_server.robots.registry import RobotRegistry

KEEP_SECONDS = 2.0
"""What waits has so long to be written when the relay goes down."""


class AlertFeed(Protocol):
    """Where alerts are told; see :class:`relay_server.alerts.alerts.AlertHub`."""

    def listen(self, listener: Callable[[str, AlertRecord], None]) -> None:
        """Have somebody told."""


class EventParts(Collector):
    """All that a relay has for its memory; and its figures for Prometheus.

    :param reactor: Twisted's
    """

    log = Logger()

    def __init__(
        self,
        reactor: Any,
        store: AsyncDatabase,
        access: Access,
        registry: RobotRegistry,
        journal: EventBus,
        alerts: AlertFeed,
        settings: RelaySettings,
    ) -> None:
        self._clock = reactor
        self._recent = RecentEvents()
        self._quota = EventQuota(reactor, store, time.time, settings.events_of_source, settings.events_kept)
        self._writer = EventWriter(reactor, store, time.time, self._written)
        noticing = EventCollector(self._writer, registry, time.time, reactor.seconds)
        self.desk = EventService(store, access, self._writer, self._quota, self._recent, time.time)
        self.note = noticing.note
        """Keeps an event that the relay has put together, if there is room; nobody waits for it."""
        journal.witness(noticing.happened)
        registry.on_modules(noticing.modules)
        alerts.listen(noticing.alert)

    async def start(self) -> None:
        """Begin to look after it.

        :raises Unavailable: the database can't be asked
        """
        await self._quota.start()

    def realms(self, gone: Collection[str], there: Collection[str]) -> None:
        """Realms as :class:`relay_server.change_watcher.RealmCaches` tells of them."""
        for realm in gone:
            self._quota.forget(realm)
            self._writer.forget(realm)
            self._recent.forget(realm)
        self._writer.exist(there)

    async def keep(self) -> None:
        """Keep what waits, if the database takes it soon, and look after it no more."""
        self._quota.stop()
        late = f"the database has not taken them within {KEEP_SECONDS:g} s"
        try:
            await with_timeout(self._clock, KEEP_SECONDS, self._writer.flush(), late)
        except SwitchboardError as error:
            count = self._writer.waiting
            self.log.error("the latest {count} events are lost: {reason}", count=count, reason=str(error))

    def collect(self) -> Iterator[Metric]:
        """One reading."""
        writer = self._writer
        yield GaugeMetricFamily(
            "switchboard_events_waiting", "Events that wait to be written", writer.waiting
        )
        yield CounterMetricFamily("switchboard_events_written", "Events that were written", writer.written)
        yield CounterMetricFamily(
            "switchboard_events_dropped", "Events of the relay's own that were not kept", writer.dropped
        )

    def _written(self, events: list[StoredEventRecord]) -> None:
        self._quota.written(events)
        self._recent.written(events)
