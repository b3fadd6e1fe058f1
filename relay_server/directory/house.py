"""The directory, put together: what looks after leases, and whom people ask."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Collection
from typing import Any

from relay_db.queries import EntryRecord, NewMemory
from relay_server.access import Access
from relay_server.channel import Channels
from relay_server.directory.changes import Changes
from relay_server.directory.desk import DirectoryDesk
from relay_server.directory.entries import event
from relay_server.directory.leases import Book, Leases
from relay_server.directory.own import Robots
from relay_server.registry import Registry
from relay_server.store import Store


class DirectoryHouse:
    """All that a relay has for its directory.

    :param reactor: Twisted's
    :param note: tells the memory
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        reactor: Any,
        store: Store,
        access: Access,
        registry: Registry,
        channels: Channels,
        note: Callable[[NewMemory], None],
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._note = note
        self._wall = wall
        self._changes = Changes(secrets.token_hex(4))
        self.leases = Leases(reactor, store, wall, Book(), self._gone)
        self.desk = DirectoryDesk(
            store,
            access,
            Robots(registry, channels),
            self.leases,
            self._changes,
            note,
            wall,
            reactor.seconds,
            lambda: secrets.token_hex(12),
        )

    def realms(self, gone: Collection[str], there: Collection[str]) -> None:
        """Realms as :class:`relay_server.retiring.Realms` tells of them."""
        for realm in gone:
            self._changes.forget(realm)

    def _gone(self, what: str, record: EntryRecord) -> None:
        self._changes.tell(what, record)
        # Of what was removed the memory hears from who removed it.
        if what == "expired":
            self._note(event(what, record, self._wall(), record.user))
