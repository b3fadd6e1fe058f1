"""The one composition root: builds a relay from its settings, starts and stops it. Only this module knows all."""

from __future__ import annotations

import hashlib
import threading
import time
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred, DeferredList, maybeDeferred
from twisted.internet.endpoints import (
    SSL4ServerEndpoint,
    TCP4ServerEndpoint,
    TCP6ServerEndpoint,
    UNIXServerEndpoint,
)
from twisted.internet.task import LoopingCall, deferLater
from twisted.logger import Logger
from twisted.web.server import Site

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.clocks import now_ns
from relay_protocol.errors import Invalid, SwitchboardError
from relay_server import VERSION
from relay_server.access import Access
from relay_server.alerts import http as alerts
from relay_server.alerts.build import AlertParts
from relay_server.audit_log import AuditLog
from relay_server.auth import login_links, passwords
from relay_server.auth.authenticator import Authenticator
from relay_server.auth.origins import Origins
from relay_server.change_watcher import ChangeWatcher, RealmCaches
from relay_server.channels.channels import Channels
from relay_server.common.data_dir import DataDir
from relay_server.common.database import AsyncDatabase
from relay_server.common.freshness_tokens import FreshnessTokens
from relay_server.common.socket_writer import FlushScheduler
from relay_server.config import ListenAddress, RelaySettings
from relay_server.control import http as control_edge
from relay_server.control.audit import DatabaseAuditSink
from relay_server.control.controllers import Controllers
from relay_server.control.service import ControlService
from relay_server.control.types import ControlRules
from relay_server.events import http as events
from relay_server.events.build import EventParts
from relay_server.events.bus import EventBus
from relay_server.fleet import http as fleet
from relay_server.fleet.service import FleetService
from relay_server.http import negotiation
from relay_server.http.admin_socket import AdminSocket
from relay_server.http.api import Api
from relay_server.http.build import build_site
from relay_server.http.connection_limits import ConnectionLimits
from relay_server.http.idempotency import Idempotency
from relay_server.http.rate_limits import RequestLimits
from relay_server.http.rdf import http as vocabulary
from relay_server.http.site import RelaySite
from relay_server.http.update_sources import Sources
from relay_server.http_sessions.pool import SessionPool
from relay_server.metrics import RelayCollector, registry_of
from relay_server.oauth.service import OAuthService
from relay_server.realms import http as realm
from relay_server.realms.service import RealmService
from relay_server.recordings import http as recordings
from relay_server.recordings.library import FOLDER, Library
from relay_server.recordings.recordings import Recordings
from relay_server.recordings.retention import sweep
from relay_server.recordings.service import RecordingService
from relay_server.registry import http as directory_edge
from relay_server.registry.build import RegistryParts
from relay_server.resources import http as resources
from relay_server.resources import people_http
from relay_server.resources.robots_http import RobotResource
from relay_server.robots.connection import LinkTiming, RobotConnection, RobotFactory
from relay_server.robots.link_roles import HandshakeRole, RobotLinkContext
from relay_server.robots.registry import RobotRegistry
from relay_server.sessions.manager import SessionManager
from relay_server.sessions.ports import Timing
from relay_server.tls import ServerTls
from relay_server.video.streams import CameraStreams
from relay_server.ws.updates import UpdatesGate

PURGE_SECONDS = 3600.0
EVENT_SECONDS = 30 * 86400.0
"""Events are kept this long; the audit log is kept for ever."""


class Relay:
    """One relay.

    :param reactor: Twisted's
    """

    log = Logger()

    def __init__(self, reactor: Any, settings: RelaySettings) -> None:
        self._reactor = reactor
        self.settings = settings
        self._folder = DataDir(settings.data)
        self._database = Database(settings.database)
        self._store = AsyncDatabase(reactor, self._database)
        self._tls = (
            ServerTls(settings.tls_cert, settings.tls_key) if settings.tls_cert and settings.tls_key else None
        )
        self._workshop = negotiation.ConversionPool(reactor)
        self._auth = Authenticator(reactor, self._store, time.monotonic, time.time)
        self._access = Access(self._store, time.time)
        self._registry = RobotRegistry(time.time)
        self._channels = Channels(
            reactor, linger=settings.linger, new_ticket=passwords.new_token, wall_ns=time.time_ns
        )
        self._videos = CameraStreams(reactor, new_ticket=passwords.new_token)
        library = Library(settings.data / FOLDER, settings.recordings, settings.recordings_reserve)
        self._recordings = Recordings(reactor, reactor, library, self._channels, self._videos, time.time)
        self._journal = EventBus(self._store, time.time)
        self._audit = AuditLog(reactor, self._store, settings.data, self._journal.tell)
        record = DatabaseAuditSink(self._store, self._journal, self._audit, time.time)
        self._desks = Controllers(
            reactor, record, ControlRules.of(settings), self._registry.changed, time.time
        )
        judged = self._store, self._access, self._registry
        self._alerts = AlertParts(reactor, *judged, self._channels, self._desks, self._journal, settings)
        told = self._journal, self._alerts.alerts
        self._memory = EventParts(reactor, *judged, *told, settings)
        self._directory = RegistryParts(reactor, *judged, self._channels, self._memory.note)
        realms = RealmCaches(self._store, self._memory.realms, self._directory.realms)
        concerned = self._registry, self._desks, self._videos, self._alerts.alerts, self._directory.leases
        self._taking_up = ChangeWatcher(self._store, self._access, realms, *concerned, self._sweep)
        self._ports: list[Any] = []
        self._polling = LoopingCall(self._poll)
        self._purging = LoopingCall(self._purge)
        self._database_fine = True
        self._desk: SessionManager | None = None
        self._pages: UpdatesGate | None = None
        self._fleet: FleetService | None = None
        self._console: ControlService | None = None
        self.http_port = 0
        self.robots_port = 0
        self._started = time.monotonic()

    # --- starting -----------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Upgrade the database, listen on everything.

        :raises SwitchboardError: in words, when the database or the certificate can't be used
        :raises CannotListenError: an address is taken
        """
        self._database.upgrade()
        for each in (self._store, self._workshop, self._auth):
            each.start()
        self._recordings.open()
        self._audit.restore()
        await self._auth.take_up()
        await self._taking_up.begin()
        await sweep(self._recordings, self._store, self._journal)
        self._recordings.recover()
        name = self.settings.name or self._folder.relay_name()
        await self._memory.start()
        await self._directory.leases.start()
        await self._alerts.start(name)
        self.http_port = (await self._listen(self.settings.http, self._site(name))).getHost().port
        rooms = self._store, self._registry, self._channels, self._videos, self._desks, self._journal
        hall = RobotLinkContext(name, *rooms, time.monotonic, time.time)
        robots = await self._listen(self.settings.robots, self._robot_factory(hall))
        self.robots_port = robots.getHost().port
        await self._listen_locally()
        if self._tls is None and not (self.settings.http.loopback and self.settings.robots.loopback):
            self.log.warn(
                "without --tls-cert and --tls-key passwords and commands cross the network in the clear"
            )
        self._polling.start(self.settings.refresh, now=False)
        self._purging.start(PURGE_SECONDS, now=True)

    def _site(self, name: str) -> RelaySite:
        settings = self.settings
        origins = Origins(settings.scheme, settings.origins)
        # Cookies know no ports: relays side by side on one host must not overwrite each other's.
        cookie = f"switchboard_{hashlib.sha256(name.encode()).hexdigest()[:8]}"
        self._desk = SessionManager(
            self._reactor,
            self._store,
            self._auth,
            self._access,
            self._registry,
            self._channels,
            self._videos,
            self._desks,
            self._journal,
            origins,
            Timing(
                settings.client_ping, settings.driving_ping, settings.stall_limit, settings.largest_message
            ),
            cookie=cookie,
            clock_ns=now_ns,
            wall=time.time,
        )
        desk, moments = self._desk, FreshnessTokens(now_ns)
        collector = RelayCollector(self._registry, self._channels, self._videos, lambda: desk)
        metrics = registry_of(collector, self._memory, self._audit)
        keeper = RecordingService(desk, self._recordings, self._store, self._journal, time.time)
        guests = SessionPool(self._reactor, desk, now_ns)
        offices = self._access, self._desks, self._registry, self._store
        self._console = ControlService(self._reactor, desk, *offices, guests)
        # What is written down often is not to crowd out what robots have been asked to do.
        keys, robots_keys = Idempotency(self._reactor), Idempotency(self._reactor)
        making = robots_keys, self._workshop, moments, now_ns, time.time
        below = {
            "recordings": partial(recordings.below, self._reactor, keeper, keys),
            "people": partial(people_http.below, desk.overview),
            **resources.parts(self._reactor, desk, guests, *making),
            **{
                part: partial(control_edge.below, self._console, moments, part) for part in control_edge.PARTS
            },
        }
        self._fleet = FleetService(
            self._reactor,
            desk,
            self._access,
            self._registry,
            self._desks,
            self._store,
            self._journal,
            self._audit,
        )
        meanings = vocabulary.TypeDocs(self._access, self._registry, self._workshop)
        realms = RealmService(
            self._store, self._auth, self._recordings, self.refresh, lambda: self.robots_port
        )
        beside = {
            "alerts": partial(alerts.beside, self._alerts.desk),
            "directory": partial(directory_edge.beside, self._reactor, self._directory.desk),
            "events": partial(events.beside, self._reactor, self._memory.desk, keys),
            "fleet": partial(fleet.beside, self._reactor, self._fleet, moments),
            "realm": partial(realm.beside, realms),
            "vocabulary": partial(vocabulary.beside, meanings),
        }
        told = {"robots": desk.overview.shared, "alerts": self._alerts.desk.shown}
        sources = Sources(self._reactor, told, self._registry.on_change)
        served = desk, origins, metrics, below, beside, RobotResource(desk, self._workshop), sources
        limits = RequestLimits(settings.requests, time.monotonic, settings.streams, settings.answer_seconds)
        api = Api(self._reactor, *served, cookie=cookie, secure=settings.tls, limits=limits)
        self._pages = UpdatesGate(self._reactor, desk, origins, cookie, sources)
        oauth = OAuthService(self._store, self._auth, self._access, self._journal, time.monotonic, time.time)
        return build_site(self._reactor, now_ns, desk, api, oauth, self._pages, settings, limits, cookie)

    def _robot_factory(self, hall: RobotLinkContext) -> RobotFactory:
        cap = ConnectionLimits(self.settings.connections_per_address)
        timing = LinkTiming(self.settings.heartbeat, self.settings.largest_sample)
        turns = FlushScheduler(self._reactor)

        def build() -> RobotConnection:
            return RobotConnection(
                self._reactor, now_ns, timing, lambda connection: HandshakeRole(hall, connection), cap, turns
            )

        return RobotFactory(build)

    async def _listen(self, where: ListenAddress, factory: Any) -> Any:
        kind: Any = TCP6ServerEndpoint if ":" in where.host else TCP4ServerEndpoint
        endpoint: Any = kind(self._reactor, where.port, interface=where.host)
        if self._tls is not None:
            endpoint = SSL4ServerEndpoint(self._reactor, where.port, self._tls, interface=where.host)
        port = await endpoint.listen(factory)
        self._ports.append(port)
        return port

    async def _listen_locally(self) -> None:
        assert self._fleet is not None and self._console is not None
        order = partial(fleet.local, self._reactor, self._fleet)
        admin = AdminSocket(self.status, self.refresh, order, self._console)
        site = Site(admin.app.resource(), reactor=self._reactor)
        site.log = lambda request: None
        self._folder.clear_socket(self.settings.socket_path)
        endpoint = UNIXServerEndpoint(self._reactor, str(self.settings.socket_path), mode=0o600)
        self._ports.append(await endpoint.listen(site))

    async def first_login(self) -> str | None:
        """A one-time login link for the administrator of a relay nobody can log in to yet."""
        return await login_links.first_login(self._store, self.url)

    async def login_link(self, user: str) -> str:
        """A one-time login link for a user.

        :raises Invalid: no such user
        """
        return await login_links.login_link(self._store, self.url, user)

    @property
    def url(self) -> str:
        """Where people go: the first origin that was listed, else where the relay listens."""
        return self.settings.url(self.http_port)

    # --- running ------------------------------------------------------------------------------------------

    async def refresh(self) -> None:
        """Take up changes somebody made in the database."""
        await self._taking_up.look()

    def _sweep(self) -> Deferred[None]:
        return Deferred.fromCoroutine(sweep(self._recordings, self._store, self._journal)).addErrback(
            lambda failure: self.log.error(
                "recordings of removed robots stay for now: {reason}", reason=failure.value
            )
        )

    async def _poll_once(self) -> None:
        self._access.expire()
        try:
            await self.refresh()
        except SwitchboardError as error:
            if self._database_fine:
                self.log.error("{reason}; what is open goes on, new asks are refused", reason=str(error))
            self._database_fine = False
        else:
            if not self._database_fine:
                self.log.info("the database answers again")
            self._database_fine = True

    def _poll(self) -> Deferred[None]:
        return Deferred.fromCoroutine(self._poll_once()).addErrback(
            lambda failure: self.log.failure("taking up changes failed", failure)
        )

    def _purge(self) -> Deferred[Any]:
        return Deferred.fromCoroutine(self._forget_old()).addErrback(
            lambda failure: self.log.error("old rows stay for now: {reason}", reason=failure.value)
        )

    async def _forget_old(self) -> None:
        now = time.time()
        await self._store.write(queries.purge_expired, now)
        # In small transactions: logins wait for the same writer.
        while await self._store.write(queries.purge_events, now - EVENT_SECONDS):
            pass
        await self._alerts.alerts.purge()
        await self._sweep()
        self._recordings.recover()

    def reload_tls(self) -> None:
        """Read the certificate again (SIGHUP)."""
        if self._tls is None:
            return
        try:
            self._tls.reload()
        except Invalid as error:
            self.log.error("{reason}; the old certificate stays in use", reason=str(error))
        else:
            self.log.info("the TLS certificate was read again")

    def status(self) -> dict[str, Any]:
        """What ``switchboard status`` shows."""
        return {
            "relay": VERSION,
            "uptime_s": round(time.monotonic() - self._started, 1),
            "http_port": self.http_port,
            "robots_port": self.robots_port,
            "robots_loopback": self.settings.robots.loopback,
            "tls": self.settings.tls,
            "robots": self._desk.status() if self._desk else [],
        }

    # --- stopping -----------------------------------------------------------------------------------------

    async def stop(self) -> None:
        """Refuse newcomers, tell clients and robots, finish what is being written."""
        try:
            await self._say_goodbye()
        finally:
            await self._finish_threads()
            self._folder.release()

    async def _finish_threads(self) -> None:
        """Let what is being written be written; waiting for a database that hangs must not block the reactor."""

        def finish() -> None:
            self._auth.stop()
            self._workshop.stop()
            self._recordings.close()
            self._alerts.finish()
            self._store.stop()
            self._reactor.callFromThread(done.callback, None)

        self._workshop.close()
        done: Deferred[None] = Deferred()
        threading.Thread(target=finish, name="finish", daemon=True).start()
        await done

    async def _say_goodbye(self) -> None:
        why = "the relay is going down"
        self._alerts.hush()
        if self._desk is not None:
            self._desk.say_goodbye(why)
        if self._pages is not None:
            self._pages.say_goodbye(why)
        # Nobody drives on until a disk or a database has answered: all are told first.
        recorded = Deferred.fromCoroutine(self._recordings.shut(why))
        for robot in self._registry:
            if robot.control is not None:
                robot.control.close(why)
        for loop in (self._polling, self._purging, self._directory.leases.looking):
            if loop.running:
                loop.stop()
        for channel in self._channels:
            channel.shut()
        self._videos.shut()
        ports = [maybeDeferred(port.stopListening) for port in self._ports]
        await DeferredList(ports, consumeErrors=True)
        await self._alerts.keep()
        await self._memory.keep()
        await recorded
        await self._audit.close()
        # The farewells are on their way; a moment lets slow networks take them.
        await deferLater(self._reactor, 0.2)
