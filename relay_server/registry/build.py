"""The directory, put together: what looks after leases, and whom people ask."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Collection
from typing import Any

from relay_db.queries import EntryRecord, NewStoredEvent
from relay_server.access import Access
from relay_server.channels.channels import Channels
from relay_server.common.database import AsyncDatabase
from relay_server.registry.changes import Changes
from relay_server.registry.entries import event
from relay_server.registry.leases import EntryCache, LeaseExpiry
from relay_server.registry.robot_entries import RobotEntries
from relay_server.registry.service import RegistryService
from relay_server.robots.registry import RobotRegistry


class RegistryParts:
    """All that a relay has for its directory.

    :param reactor: Twisted's
    :param note: tells the memory
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        reactor: Any,
        store: AsyncDatabase,
        access: Access,
        registry: RobotRegistry,
        channels: Channels,
        note: Callable[[NewStoredEvent], None],
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._note = note
        self._wall = wall
        self._changes = Changes(secrets.token_hex(4))
        self.leases = LeaseExpiry(reactor, store, wall, EntryCache(), self._gone)
        self.desk = RegistryService(
            store,
            access,
            RobotEntries(registry, channels),
            self.leases,
            self._changes,
            note,
            wall,
            reactor.seconds,
            lambda: secrets.token_hex(12),
        )

    def realms(self, gone: Collection[str], there: Collection[str]) -> None:
        """Realms as :class:`relay_server.change_watcher.RealmCaches` tells of them."""
        for realm in gone:
            self._changes.forget(realm)

    def _gone(self, what: str, record: EntryRecord) -> None:
        self._changes.tell(what, record)
        # Of what was removed the memory hears from who removed it.
        if what == "expired":
            self._note(event(what, record, self._wall(), record.user))
