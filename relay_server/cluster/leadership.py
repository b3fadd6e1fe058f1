"""Tasks that one relay of the cluster does for all: it holds a lease in the database for each."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import LoopingCall
from twisted.logger import Logger

from relay_db import queries
from relay_protocol.errors import SwitchboardError
from relay_server.common.database import AsyncDatabase

ALERTS = "alerts"
"""Raising alerts about robots that are connected to no relay."""
PURGES = "purges"
"""Deleting expired rows of the database."""

LEASE_SECONDS = 15.0
RENEW_SECONDS = 5.0
MARGIN_SECONDS = 2.0
"""A leader stops so long before its lease ends: the database counts whole seconds."""


class Leadership:
    """The leases of this relay.

    :param own: id of this relay
    """

    log = Logger()

    def __init__(self, reactor: Any, database: AsyncDatabase, own: str) -> None:
        self._reactor = reactor
        self._database = database
        self._own = own
        self._until: dict[str, float] = {}
        """Monotonic seconds until which each lease surely is this relay's."""
        self._loop = LoopingCall(self._renew_all)
        self._loop.clock = reactor

    async def start(self) -> None:
        """Acquire what is free, and try again for ever."""
        await self._renew_all()
        self._loop.start(RENEW_SECONDS, now=False)

    async def stop(self) -> None:
        """Release all, so that another relay can take over."""
        if self._loop.running:
            self._loop.stop()
        self._until.clear()
        with suppress(SwitchboardError):
            await self._database.write(queries.release_relay_leases, self._own)

    def leads(self, task: str) -> bool:
        """Whether this relay has a task now."""
        return bool(self._until.get(task, 0.0) > self._reactor.seconds())

    def _renew_all(self) -> Deferred[None]:
        renewing = Deferred.fromCoroutine(self._renew())
        return renewing.addErrback(
            lambda failure: self.log.info("leases can't be renewed: {reason}", reason=failure.value)
        )

    async def _renew(self) -> None:
        for task in (ALERTS, PURGES):
            asked, had = self._reactor.seconds(), self.leads(task)
            if await self._database.write(queries.acquire_relay_lease, task, self._own, LEASE_SECONDS):
                self._until[task] = asked + LEASE_SECONDS - MARGIN_SECONDS
                if not had:
                    self.log.info("this relay has the task '{task}' of the cluster", task=task)
            else:
                self._until.pop(task, None)
