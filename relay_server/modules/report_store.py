"""Stores the latest report of each robot's modules, so that they are known after a restart of the relay."""

from __future__ import annotations

import msgspec
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import ModuleReportRecord
from relay_protocol import jsontext, link
from relay_protocol.errors import Unavailable
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.concurrency import SingleFlight
from relay_server.common.database import AsyncDatabase
from relay_server.modules.robot_modules import ModuleRegistry, RobotModules

STORE_SECONDS = 1.0
"""Reports of all robots within this time are stored together."""

RETRY_SECONDS = 5.0
"""Pause after the database did not answer."""

_decoder = msgspec.json.Decoder(list[link.ModuleInfo])


class ModuleReportStore:
    """Stores reports soon after they have come, and restores them when the relay starts."""

    log = Logger()

    def __init__(self, clock: Clock, database: AsyncDatabase, registry: ModuleRegistry) -> None:
        self._clock = clock
        self._database = database
        self._registry = registry
        self._changed: dict[int, RobotModules] = {}
        self._timer: Timer | None = None
        self._writing = SingleFlight(self._write)
        registry.store_report = self._store_soon

    async def start(self) -> None:
        """Restore the reports of all robots.

        :raises Unavailable: the database does not answer
        """
        for each in await self._database.read(queries.module_reports):
            self._restore(each)

    async def stop(self) -> None:
        """Store what is not stored yet."""
        await self._writing.run()
        cancel(self._timer)

    async def refresh(self, robot_id: int) -> None:
        """Read the report of a robot that may have been connected to another relay.

        :raises Unavailable: the database does not answer
        """
        found = await self._database.read(queries.module_report, robot_id)
        if found is not None:
            self._restore(found)

    def _restore(self, found: ModuleReportRecord) -> None:
        try:
            modules = _decoder.decode(found.modules)
        except msgspec.DecodeError as error:
            # Stored by another version.
            self.log.warn(
                "the stored modules of robot {robot} can't be read: {why}",
                robot=found.robot_id,
                why=str(error),
            )
            return
        self._registry.restore(found.robot_id, modules, found.at)

    def _store_soon(self, modules: RobotModules) -> None:
        self._changed[modules.robot.robot_id] = modules
        self._schedule(STORE_SECONDS)

    def _schedule(self, seconds: float) -> None:
        if self._timer is None:
            self._timer = self._clock.callLater(seconds, self._begin)

    def _begin(self) -> None:
        self._timer = None
        Deferred.fromCoroutine(self._writing.run()).addErrback(
            lambda failure: self.log.failure("modules could not be stored", failure)
        )

    async def _write(self) -> None:
        changed, self._changed = self._changed, {}
        reports = [_record(each) for each in changed.values()]
        if not reports:
            return
        try:
            await self._database.write(queries.store_module_reports, reports)
        except Unavailable:
            self._changed = {**changed, **self._changed}
            self._schedule(RETRY_SECONDS)


def _record(modules: RobotModules) -> ModuleReportRecord:
    text = jsontext.encode(list(modules.modules)).decode()
    return ModuleReportRecord(modules.robot.robot_id, modules.reported_at or 0.0, text)
