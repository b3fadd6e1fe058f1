"""The core that most features of a relay use: database, rights, robots, channels, cameras, control, event bus."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from relay_db.engine import Database
from relay_protocol.clocks import now_ns
from relay_protocol.errors import Invalid
from relay_server.access import Access
from relay_server.audit_log import AuditLog
from relay_server.auth import passwords
from relay_server.auth.authenticator import Authenticator
from relay_server.auth.origins import Origins
from relay_server.channels.channel import Channels
from relay_server.cluster.homes import RobotHomes, SingleHome
from relay_server.common.data_dir import DataDir
from relay_server.common.database import AsyncDatabase
from relay_server.common.freshness_tokens import FreshnessTokens
from relay_server.config import RelaySettings
from relay_server.control.controllers import Controllers
from relay_server.control.records import ControlAuditSink
from relay_server.control.stored_stops import DatabasePendingStops
from relay_server.control.types import ControlRules
from relay_server.events.bus import EventBus
from relay_server.files.build import FileCore, build_files
from relay_server.modules.robot_modules import ModuleRegistry
from relay_server.robots.registry import RobotRegistry
from relay_server.video.streams import CameraStreams

if TYPE_CHECKING:
    from relay_server.cluster.service import Cluster


@dataclass(frozen=True, kw_only=True)
class Core:
    """Objects that the features of one relay share. Builders take it whole; the classes they build take parts of it.

    :ivar name: the relay's name, which robots sign
    :ivar cookie: name of the session cookie
    :ivar cluster: ``None``: this is the only relay
    """

    reactor: Any
    settings: RelaySettings
    data_dir: DataDir
    name: str
    cookie: str
    origins: Origins
    freshness: FreshnessTokens
    database: AsyncDatabase
    authenticator: Authenticator
    access: Access
    robots: RobotRegistry
    channels: Channels
    cameras: CameraStreams
    bus: EventBus
    audit: AuditLog
    controllers: Controllers
    modules: ModuleRegistry
    files: FileCore
    cluster: Cluster | None
    homes: RobotHomes

    @property
    def relay_id(self) -> str:
        """The id of this run of the relay in its cluster; empty if it is the only relay."""
        return "" if self.cluster is None else self.cluster.id

    def leads(self, task: str) -> bool:
        """Whether this relay does a task for all; see :mod:`relay_server.cluster.leadership`."""
        return self.cluster is None or self.cluster.leadership.leads(task)

    @property
    def draining(self) -> bool:
        """Whether robots and clients are asked to use another relay."""
        return self.cluster is not None and self.cluster.drain.begun

    def open_database(self) -> None:
        """Upgrade the database and start its threads.

        :raises SwitchboardError: it can't be used
        """
        self.database.database.upgrade()
        self.database.start()

    def release_robots(self, reason: str) -> None:
        """Close the robots' links.

        :param reason: in words
        """
        for robot in self.robots:
            if robot.control_link is not None:
                robot.control_link.close(reason)
        for channel in self.channels:
            channel.close()
        self.cameras.close()


def build_core(reactor: Any, settings: RelaySettings) -> Core:
    """Build it; nothing is opened but the data folder, which is locked.

    :param reactor: Twisted's
    :raises Unavailable: another relay runs on the data folder, or it can't be written
    :raises Invalid: the database's address or the relay's name can't be used
    """
    data_dir = DataDir(settings.data)
    name = settings.name or data_dir.relay_name()
    database = AsyncDatabase(reactor, Database(settings.database))
    robots = RobotRegistry(time.time)
    bus = EventBus()
    cluster = _cluster(reactor, settings, database, robots)
    audit = AuditLog(reactor, database, settings.data, bus.publish)
    return Core(
        reactor=reactor,
        settings=settings,
        data_dir=data_dir,
        name=name,
        # Browsers send cookies to every port of a host, so relays side by side need names of their own.
        cookie=f"switchboard_{hashlib.sha256(name.encode()).hexdigest()[:8]}",
        origins=Origins(settings.scheme, settings.origins),
        freshness=FreshnessTokens(now_ns),
        database=database,
        authenticator=Authenticator(reactor, database, time.monotonic, time.time),
        access=Access(database, time.time),
        robots=robots,
        channels=Channels(
            reactor, linger=settings.linger, new_ticket=passwords.new_token, wall_ns=time.time_ns
        ),
        cameras=CameraStreams(reactor, new_ticket=passwords.new_token),
        bus=bus,
        audit=audit,
        controllers=Controllers(
            reactor,
            ControlAuditSink(bus, audit, time.time),
            DatabasePendingStops(
                database,
                lambda robot_id: cluster is not None and not robots.connected(robot_id),
                "" if cluster is None else cluster.id,
            ),
            ControlRules.of(settings),
            robots.changed,
            time.time,
        ),
        modules=ModuleRegistry(reactor, time.time),
        files=build_files(reactor, settings, database, bus),
        cluster=cluster,
        homes=SingleHome() if cluster is None else cluster.homes,
    )


def _cluster(
    reactor: Any, settings: RelaySettings, database: AsyncDatabase, robots: RobotRegistry
) -> Cluster | None:
    """:raises Invalid: the client of the bus is not installed"""
    if settings.cluster is None:
        return None
    try:
        from relay_server.cluster.service import Cluster
    except ImportError:
        raise Invalid("several relays need NATS: pip install 'robot-switchboard[cluster]'") from None
    return Cluster(reactor, settings.cluster, database, robots)
