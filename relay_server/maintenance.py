"""Keeps the running relay in step with the database, and deletes what is no longer needed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import LoopingCall
from twisted.logger import Logger

from relay_db import queries
from relay_protocol.errors import NotFound, SwitchboardError, Unavailable
from relay_server.access import Access
from relay_server.alerts.hub import AlertHub
from relay_server.cluster.leadership import PURGES
from relay_server.common.concurrency import SingleFlight
from relay_server.common.database import AsyncDatabase
from relay_server.control.controllers import Controllers
from relay_server.core import Core
from relay_server.events.bus import EventBus
from relay_server.recordings.recordings import Recordings
from relay_server.robots.registry import RobotRegistry
from relay_server.service_registry.leases import LeaseExpiry
from relay_server.video.streams import CameraStreams

STOPS_SECONDS = 1.0
"""Seconds between reads of stops that may have ended at another relay of the cluster."""


class ChangeWatcher:
    """Reads the revision number of the database, and applies changes to all parts of the relay.

    :param sweep: deletes the recordings of removed robots; not waited for
    :param seconds: a monotonic clock
    """

    def __init__(
        self,
        store: AsyncDatabase,
        access: Access,
        realms: RealmCaches,
        registry: RobotRegistry,
        controllers: Controllers,
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
        self._controllers = controllers
        self._videos = videos
        self._alerts = alerts
        self._leases = leases
        self._sweep = sweep
        self._seconds = seconds
        self._revision = -1
        self._checking = SingleFlight(self._check)
        self._stops_read_at = -math.inf
        self.several_relays = False
        """Whether other relays of a cluster change the database too."""
        self.on_applied: Callable[[int], object] = lambda revision: None
        """Called with each revision of the database after it was applied."""

    async def begin(self) -> None:
        """Load the present state, before anything is served.

        :raises Unavailable: the database does not answer
        """
        self._revision = await self._store.read(queries.revision)
        self._registry.share(await self._store.read(queries.robot_shares))
        await self._controllers.read_stored_stops()
        await self._realms.refresh()

    async def apply(self) -> None:
        """Apply all changes up to now. Calls during a check share the next one.

        :raises Unavailable: the database does not answer
        """
        await self._checking.run()

    async def _check(self) -> None:
        read_at, revision = self._seconds(), await self._store.read(queries.revision)
        if revision != self._revision:
            await self._apply(revision)
        elif (
            self.several_relays
            and read_at - self._stops_read_at >= STOPS_SECONDS
            and self._controllers.waits_in_database
        ):
            # The end of a stop counts up no revision.
            self._stops_read_at = read_at
            await self._controllers.read_stored_stops()
        self._access.set_known_until(read_at)

    async def _apply(self, revision: int) -> None:
        # Before the rights on shared robots, so that no user of another realm gets in unnoticed.
        self._registry.share(await self._store.read(queries.robot_shares))
        await self._access.refresh()
        await self._realms.refresh()
        await remove_deleted(self._store, self._registry, self._controllers, self._videos)
        await self._controllers.read_stored_stops()
        await self._alerts.refresh()
        self._leases.check_soon()
        # Not awaited: rights must be applied even if the disk is slow.
        self._sweep()
        # Last, so that the next check repeats everything if a step above has failed.
        self._revision = revision
        self._registry.changed()
        self.on_applied(revision)


log = Logger()

OnRealmsChanged = Callable[[Collection[str], Collection[str]], None]
"""Called with the names of removed realms and of all existing ones. A realm that was removed and added is in both."""


class RealmCaches:
    """Notifies listeners of removed realms. Realms are compared by id, since a name may be used again."""

    def __init__(self, store: AsyncDatabase, *listeners: OnRealmsChanged) -> None:
        self._store = store
        self._listeners = listeners
        self._seen: dict[str, int] = {}

    async def refresh(self) -> None:
        """Read the realms and notify the listeners.

        :raises Unavailable: the database does not answer
        """
        there = {each.name: each.id for each in await self._store.read(queries.list_realms)}
        gone = [name for name, number in self._seen.items() if there.get(name) != number]
        self._seen = there
        for listener in self._listeners:
            listener(gone, there.keys())


async def remove_deleted(
    store: AsyncDatabase, registry: RobotRegistry, controllers: Controllers, videos: CameraStreams
) -> None:
    """Close the links of robots whose key was revoked, and drop robots that were removed.

    :raises Unavailable: the database does not answer
    """
    links = [(robot, robot.control_link) for robot in registry]
    keys = {(robot.robot_id, robot.key) for robot, control in links if control is not None}
    live = await store.read(queries.live_keys, keys)
    there = {record.id for record in await store.read(queries.list_robots)}
    for robot, control in links:
        if robot.robot_id not in there:
            registry.forget(robot.robot_id)
            controllers.forget(robot.robot_id)
            videos.close_streams(robot, NotFound("this robot was removed from the relay"))
        elif (
            control is not None and robot.control_link is control and (robot.robot_id, robot.key) not in live
        ):
            log.info("the link of robot {robot} is closed: its key was revoked", robot=robot.full)
            control.close("the robot's key is not accepted any more")
            videos.close_streams(robot, Unavailable("the robot's key is not accepted any more"))


PURGE_SECONDS = 3600.0


class ChangePolling:
    """Polls the database for changes every ``--refresh`` seconds."""

    log = Logger()

    def __init__(self, core: Core, changes: ChangeWatcher) -> None:
        self._access = core.access
        self._changes = changes
        self._interval = core.settings.refresh
        self._loop = LoopingCall(self._poll)
        self._answers = True

    def start(self) -> None:
        """Begin to poll."""
        self._loop.start(self._interval, now=False)

    def stop(self) -> None:
        """End polling."""
        if self._loop.running:
            self._loop.stop()

    def _poll(self) -> Deferred[None]:
        return Deferred.fromCoroutine(self._apply_changes()).addErrback(
            lambda failure: self.log.failure("applying changes of the database failed", failure)
        )

    async def _apply_changes(self) -> None:
        self._access.expire()
        try:
            await self._changes.apply()
        except SwitchboardError as error:
            if self._answers:
                self.log.error("{reason}; open connections continue, new logins fail", reason=str(error))
            self._answers = False
        else:
            if not self._answers:
                self.log.info("the database answers again")
            self._answers = True


class Purge:
    """Deletes expired rows and the recordings of removed robots every hour."""

    log = Logger()

    def __init__(self, core: Core, alerts: AlertHub, recordings: Recordings) -> None:
        self._database = core.database
        self._bus = core.bus
        self._alerts = alerts
        self._recordings = recordings
        self._loop = LoopingCall(self._purge)
        self._leads = partial(core.leads, PURGES)

    def start(self) -> None:
        """Purge now and every hour."""
        self._loop.start(PURGE_SECONDS, now=True)

    def stop(self) -> None:
        """End purging."""
        if self._loop.running:
            self._loop.stop()

    async def recordings(self) -> None:
        """Delete the recordings of robots that were removed.

        :raises Unavailable: the database does not answer
        """
        await sweep(self._recordings, self._database, self._bus)

    def recordings_soon(self) -> Deferred[None]:
        """The same; a failure is only logged."""
        return Deferred.fromCoroutine(self.recordings()).addErrback(
            lambda failure: self.log.error(
                "recordings of removed robots stay for now: {reason}", reason=failure.value
            )
        )

    def _purge(self) -> Deferred[Any]:
        return Deferred.fromCoroutine(self._delete_expired()).addErrback(
            lambda failure: self.log.error("old rows stay for now: {reason}", reason=failure.value)
        )

    async def _delete_expired(self) -> None:
        if self._leads():
            await self._database.write(queries.purge_expired, time.time())
            await self._alerts.purge()
        await self.recordings_soon()
        self._recordings.recover()


SLACK_SECONDS = 60.0
"""A recording may seem to have begun this long after its robot was removed, because of two clocks and
requests in progress."""

_log = Logger()


async def sweep(recordings: Recordings, store: AsyncDatabase, bus: EventBus) -> None:
    """Delete the recordings of removed robots, and those in a realm that their robot was taken out of, where
    no user could reach them. Running ones are stopped first.

    Recordings of a robot that this database never removed stay, since the database may be another one than
    before.

    :raises Unavailable: the database cannot be asked
    """
    there = {record.id: record.realm for record in await store.read(queries.list_robots)}
    shares = await store.read(queries.robot_shares)
    left = [
        entry
        for entry in recordings.library
        if entry.realm != there.get(entry.robot_id) and entry.realm not in shares.get(entry.robot_id, ())
    ]
    names = {entry.robot_full for entry in left}
    removed = await store.read(queries.robot_removals, names)
    unshared = await store.read(queries.robot_unshares, names)
    for entry in left:
        robot = entry.robot_full
        gone = unshared.get((robot, entry.realm)) if entry.robot_id in there else removed.get(robot)
        if gone is None or entry.begun > gone + SLACK_SECONDS:
            continue
        try:
            await recordings.stop(entry, "the robot was removed from the relay")
            if not recordings.library.has(entry):
                continue
            await recordings.delete(entry)
        except Unavailable as error:
            _log.error(
                "recording {id} of a removed robot stays for now: {reason}", id=entry.id, reason=str(error)
            )
        else:
            bus.publish(
                "recording.removed",
                realm=entry.realm,
                robot=robot,
                recording=entry.id,
                bytes=entry.bytes,
            )
