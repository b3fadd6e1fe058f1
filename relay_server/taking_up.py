"""What somebody changed in the database, by the command line or over HTTP, is what the relay goes by from then on."""

from __future__ import annotations

import time
from collections.abc import Callable

from relay_db import queries
from relay_server.access import Access
from relay_server.alerts.hub import Alerts
from relay_server.clock import Coalesced
from relay_server.control import Desks
from relay_server.directory.leases import Leases
from relay_server.registry import Registry
from relay_server.retiring import Realms, retire
from relay_server.store import Store
from relay_server.video import Videos


class TakingUp:
    """Looks at the database for all parts of the relay.

    :param sweep: deletes what was recorded of robots that are gone; not waited for
    :param seconds: a monotonic clock
    """

    def __init__(
        self,
        store: Store,
        access: Access,
        realms: Realms,
        registry: Registry,
        desks: Desks,
        videos: Videos,
        alerts: Alerts,
        leases: Leases,
        sweep: Callable[[], object],
        seconds: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._access = access
        self._realms = realms
        self._registry = registry
        self._desks = desks
        self._videos = videos
        self._alerts = alerts
        self._leases = leases
        self._sweep = sweep
        self._seconds = seconds
        self._revision = -1
        self._turns = Coalesced(self._look)

    async def begin(self) -> None:
        """Before anything is served: what there is counts as taken up.

        :raises Unavailable: the database can't be asked
        """
        self._revision = await self._store.read(queries.revision)
        self._registry.share(await self._store.read(queries.robot_shares))
        self._desks.expect(await self._store.read(queries.pending_stops))
        await self._realms.look()

    async def look(self) -> None:
        """Look once more, from now on, and take up what was changed. Those who ask meanwhile share the next look.

        :raises Unavailable: the database can't be asked
        """
        await self._turns.ask()

    async def _look(self) -> None:
        looked, revision = self._seconds(), await self._store.read(queries.revision)
        if revision != self._revision:
            await self._take_up(revision)
        self._access.in_step(looked)

    async def _take_up(self, revision: int) -> None:
        # Before rights on them are: nobody comes in from another realm unnoticed.
        self._registry.share(await self._store.read(queries.robot_shares))
        await self._access.refresh()
        await self._realms.look()
        await retire(self._store, self._registry, self._desks, self._videos)
        self._desks.expect(await self._store.read(queries.pending_stops))
        await self._alerts.refresh()
        self._leases.soon()
        # Rights must be taken up however long a disk takes.
        self._sweep()
        # Only now: had anything above failed, the next look would have to do it again.
        self._revision = revision
        self._registry.changed()
