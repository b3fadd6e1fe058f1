"""What may not be here any more: robots are cut when their key was revoked, and like realms forgotten when removed."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection

from twisted.logger import Logger

from relay_db import queries
from relay_protocol.errors import NotFound, Unavailable
from relay_server.access import Access
from relay_server.alerts.alerts import AlertHub
from relay_server.common.clock import SingleFlight
from relay_server.common.database import AsyncDatabase
from relay_server.control.controllers import Controllers
from relay_server.registry.leases import LeaseExpiry
from relay_server.robots.registry import RobotRegistry
from relay_server.video.streams import CameraStreams


class ChangeWatcher:
    """Looks at the database for all parts of the relay.

    :param sweep: deletes what was recorded of robots that are gone; not waited for
    :param seconds: a monotonic clock
    """

    def __init__(
        self,
        store: AsyncDatabase,
        access: Access,
        realms: RealmCaches,
        registry: RobotRegistry,
        desks: Controllers,
        videos: CameraStreams,
        alerts: AlertHub,
        leases: LeaseExpiry,
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
        self._turns = SingleFlight(self._look)

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
        await remove_deleted(self._store, self._registry, self._desks, self._videos)
        self._desks.expect(await self._store.read(queries.pending_stops))
        await self._alerts.refresh()
        self._leases.soon()
        # Rights must be taken up however long a disk takes.
        self._sweep()
        # Only now: had anything above failed, the next look would have to do it again.
        self._revision = revision
        self._registry.changed()


log = Logger()

Told = Callable[[Collection[str], Collection[str]], None]
"""Hears the names of realms that are gone, and of all that there are; one made anew is both."""


class RealmCaches:
    """Tells which realms that were there are gone. By their ids: one of the same name may have come in between."""

    def __init__(self, store: AsyncDatabase, *told: Told) -> None:
        self._store = store
        self._told = told
        self._seen: dict[str, int] = {}

    async def look(self) -> None:
        """Look, and tell.

        :raises Unavailable: the database can't be asked
        """
        there = {each.name: each.id for each in await self._store.read(queries.list_realms)}
        gone = [name for name, number in self._seen.items() if there.get(name) != number]
        self._seen = there
        for told in self._told:
            told(gone, there.keys())


async def remove_deleted(
    store: AsyncDatabase, registry: RobotRegistry, desks: Controllers, videos: CameraStreams
) -> None:
    """Cut robots whose key was revoked, forget those that were removed.

    :raises Unavailable: the database can't be asked
    """
    links = [(robot, robot.control) for robot in registry]
    keys = {(robot.robot_id, robot.key) for robot, control in links if control is not None}
    live = await store.read(queries.live_keys, keys)
    there = {record.id for record in await store.read(queries.list_robots)}
    for robot, control in links:
        if robot.robot_id not in there:
            registry.forget(robot.robot_id)
            desks.forget(robot.robot_id)
            videos.end(robot, NotFound("this robot was removed from the relay"))
        elif control is not None and robot.control is control and (robot.robot_id, robot.key) not in live:
            log.info("robot {robot} is cut: its key is not accepted any more", robot=robot.full)
            control.close("the robot's key is not accepted any more")
            videos.end(robot, Unavailable("the robot's key is not accepted any more"))
