"""The composition root: builds a relay from its settings, starts and stops it. Only this module knows all its parts."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from relay_server import VERSION
from relay_server.auth import service
from relay_server.cluster.admin import ClusterAdmin
from relay_server.common.lifecycle import Lifecycle, LifecycleStep
from relay_server.config import RelaySettings
from relay_server.fleet import http as fleet_http
from relay_server.http.admin_socket import AdminSocket
from relay_server.http.build import build_http
from relay_server.http.site import ClusterSite
from relay_server.robots.build import build_robot_factory
from relay_server.roles.local import LocalRoles
from relay_server.services import build_services


class Relay:
    """One relay.

    :param reactor: Twisted's
    :raises SwitchboardError: settings, the data folder or the certificate can't be used
    """

    def __init__(self, reactor: Any, settings: RelaySettings) -> None:
        self.settings = settings
        self.services = build_services(reactor, settings)
        self._lifecycle = Lifecycle(reactor, self._steps())
        self._started = time.monotonic()

    async def start(self) -> None:
        """Upgrade the database, listen on everything.

        :raises SwitchboardError: the database, the folder or the certificate can't be used
        :raises CannotListenError: an address is taken
        """
        await self._lifecycle.start()

    async def stop(self) -> None:
        """Refuse new connections, notify clients and robots, and finish all writes."""
        try:
            await self._lifecycle.stop("the relay is going down")
        finally:
            self.services.core.data_dir.release()

    def _steps(self) -> list[LifecycleStep]:
        """Steps in the order of starting. Alerts stop first, so that robots which leave with the relay cause none."""
        services, core = self.services, self.services.core
        admin = self._admin_socket()
        site, cluster_site, updates, programs = build_http(services, admin)
        robots = build_robot_factory(core, services.function_links.handler)
        step = LifecycleStep
        return [
            step(name="database", start=core.open_database, join=core.database.stop),
            step(name="files", start=core.files.start, join=core.files.stop),
            step(
                name="conversions",
                start=services.conversions.start,
                stop=services.conversions.close,
                join=services.conversions.stop,
            ),
            step(name="process of Roles", stop=services.roles.close),
            step(name="authentication", start=core.authenticator.start, join=core.authenticator.stop),
            step(name="audit log", start=core.audit.restore, stop=core.audit.close),
            step(name="changes", start=services.changes.begin),
            step(name="modules", start=services.modules.reports.start, stop=services.modules.reports.stop),
            step(name="robots", leave=core.release_robots),
            step(
                name="recordings",
                start=self._open_recordings,
                leave=services.recorder.begin_shutdown,
                stop=services.recorder.shut_down,
                join=services.recorder.close,
            ),
            step(name="events", start=services.events.start, stop=services.events.stop),
            step(
                name="service registry",
                start=services.service_registry.leases.start,
                stop=services.service_registry.leases.stop,
            ),
            step(name="websockets of all robots", leave=updates.shutdown),
            step(name="programs", leave=programs.shutdown),
            step(name="sessions", leave=services.sessions.shutdown),
            step(
                name="alerts",
                start=partial(services.alerts.start, core.name),
                leave=services.alerts.mute,
                stop=services.alerts.save,
                join=services.alerts.join,
            ),
            step(name="functions", start=services.functions.start, stop=services.functions.stop),
            *self._cluster_steps(cluster_site),
            step(name="pipes", start=services.pipes.start, leave=services.pipes.leave),
            step(name="started Roles", start=services.role_runs.begin, leave=services.role_runs.leave),
            step(
                name="ports",
                start=partial(services.listeners.open, site, robots, admin),
                stop=services.listeners.close,
            ),
            step(name="polling", start=services.polling.start, stop=services.polling.stop),
            step(name="purge", start=services.purge.start, stop=services.purge.stop),
            step(name="purge of files", start=services.files.start, stop=services.files.stop),
        ]

    def _admin_socket(self) -> Any:
        services, core = self.services, self.services.core
        return AdminSocket(
            self.status,
            self.refresh,
            partial(fleet_http.local, core.reactor, services.fleet),
            services.control_gateway,
            services.modules,
            services.pipes,
            LocalRoles(services.role_commands, services.role_runs, core.database),
            cluster=ClusterAdmin(core.cluster),
        ).app.resource()

    def _cluster_steps(self, site: ClusterSite | None) -> list[LifecycleStep]:
        """The cluster starts before clients and robots can connect."""
        cluster = self.services.core.cluster
        if cluster is None:
            return []
        start = partial(cluster.start, site, self.services.listeners.tls)
        return [LifecycleStep(name="cluster", start=start, leave=cluster.forwarder.leave, stop=cluster.stop)]

    async def drain(self) -> None:
        """Have robots and clients connect to other relays, if there are some."""
        cluster = self.services.core.cluster
        if cluster is not None:
            await cluster.drain.run()

    async def _open_recordings(self) -> None:
        self.services.recorder.open()
        await self.services.purge.recordings()
        self.services.recorder.recover()

    async def first_login(self) -> str | None:
        """A one-time login link for the administrator of a relay that has no login yet; of workers, by the first."""
        if self.settings.worker is not None and self.settings.worker.number > 1:
            return None
        return await service.first_login(self.services.core.database, self.url)

    async def login_link(self, user: str) -> str:
        """A one-time login link for a user.

        :raises Invalid: no such user
        """
        return await service.login_link(self.services.core.database, self.url, user)

    async def refresh(self) -> None:
        """Apply changes of the database.

        :raises Unavailable: the database does not answer
        """
        await self.services.changes.apply()

    def reload_tls(self) -> None:
        """Read the certificate again (SIGHUP)."""
        self.services.listeners.reload_tls()

    @property
    def url(self) -> str:
        """The portal's address: the first listed origin, else where the relay listens."""
        return self.settings.url(self.http_port)

    @property
    def http_port(self) -> int:
        """TCP port of HTTP and websockets."""
        return self.services.listeners.http_port

    @property
    def robots_port(self) -> int:
        """TCP port that robots dial."""
        return self.services.listeners.robots_port

    def status(self) -> dict[str, Any]:
        """The figures of ``switchboard status``."""
        return {
            "relay": VERSION,
            "uptime_s": round(time.monotonic() - self._started, 1),
            "url": self.url,
            "http_port": self.http_port,
            "robots_port": self.robots_port,
            "robots_host": self.settings.robots_host,
            "robots_tls": self.settings.robots_tls,
            "robots": self.services.sessions.status(),
        }
