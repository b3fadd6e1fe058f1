"""The relay's HTTP site: everything served on its port, with one connection limit."""

from __future__ import annotations

import time
from functools import partial
from typing import NamedTuple

from prometheus_client.registry import Collector
from twisted.web.resource import IResource

import relay_server
from relay_protocol.clocks import now_ns
from relay_server.alerts.http import AlertEndpoints
from relay_server.cluster.admin import ClusterAdmin
from relay_server.cluster.forwarding import RequestForwarding
from relay_server.cluster.http import ClusterEndpoints
from relay_server.common.clock import PeriodicTimers
from relay_server.control.http import ControlEndpoints
from relay_server.core import Core
from relay_server.events.http import EventEndpoints
from relay_server.files.http import FileEndpoints
from relay_server.fleet.http import FleetEndpoints
from relay_server.fleet.websocket_stops import WebsocketStops
from relay_server.foxglove_urls.http import FoxgloveUrlEndpoints
from relay_server.http.authentication import RequestAuthenticator
from relay_server.http.cross_origin import CrossOrigin
from relay_server.http.idempotency import Idempotency
from relay_server.http.limits import ConnectionLimits, RequestLimits, UncountedConnections
from relay_server.http.live_updates import Source, Sources
from relay_server.http.logins import LoginEndpoints
from relay_server.http.openapi.http import DocumentEndpoints
from relay_server.http.rdf.vocabulary import TypeDocs, VocabularyEndpoints
from relay_server.http.relay_status import RelayCollector, StatusEndpoints, registry_of
from relay_server.http.router import Router
from relay_server.http.site import ClusterRoot, ClusterSite, RelaySite, RobotAddress, Root
from relay_server.http.static_files import Portal
from relay_server.icpi.http import ProgramEndpoints
from relay_server.icpi.session import IcpiServices
from relay_server.icpi.websocket import IcpiConnections, IcpiFactory
from relay_server.modules.http import ModuleEndpoints
from relay_server.oauth.http import OAuthEndpoints
from relay_server.offload.http import FunctionEndpoints
from relay_server.pipes.http import PipeEndpoints
from relay_server.realms.http import RealmEndpoints
from relay_server.recordings.http import RecordingEndpoints
from relay_server.resources.device_http import DeviceEndpoints
from relay_server.resources.goals_http import GoalEndpoints
from relay_server.resources.robots_http import (
    CameraEndpoints,
    CameraService,
    NodeEndpoints,
    NodeService,
    RobotEndpoints,
    RobotService,
)
from relay_server.resources.services_http import ActionEndpoints, ParameterEndpoints, ServiceEndpoints
from relay_server.resources.topics_http import TopicEndpoints
from relay_server.roles.elements_http import RoleElementEndpoints
from relay_server.roles.http import RoleEndpoints
from relay_server.roles.runs_http import RoleRunEndpoints
from relay_server.service_registry.http import ServiceRegistryEndpoints
from relay_server.services import Services
from relay_server.video.http import VideoResource
from relay_server.video.websocket import VideoFactory
from relay_server.wot.http import ThingEndpoints
from relay_server.wot.service import ThingService
from relay_server.ws.connection import ClientFactory
from relay_server.ws.handshake import WebSocketUpgrade
from relay_server.ws.updates import UpdatesAuth, UpdatesFactory


class HttpSite(NamedTuple):
    """The HTTP site, the websockets that follow all robots, and those of programs.

    :ivar cluster: the site for other relays; ``None``: this is the only one
    """

    site: RelaySite
    cluster: ClusterSite | None
    updates: UpdatesAuth
    programs: IcpiConnections


def build_http(services: Services, local: IResource) -> HttpSite:
    """Build the site of these services.

    :param local: the resource of the local socket; the other relays pass on some of what theirs get
    """
    core, settings = services.core, services.core.settings
    limits = RequestLimits(
        settings.requests,
        time.monotonic,
        settings.streams,
        settings.answer_seconds,
        settings.largest_message,
    )
    shown: dict[str, Source] = {
        "robots": services.sessions.overview.shared,
        "alerts": services.alerts.service.shown,
    }
    sources = Sources(core.reactor, shown, core.robots.on_change)
    authenticator = RequestAuthenticator(services.auth, core.origins, limits, cookie=core.cookie)
    forwarding = None
    if core.cluster is not None:
        forwarding = RequestForwarding(
            core.reactor,
            core.access,
            core.robots,
            core.homes,
            core.cluster.forwarder,
            core.cluster.others,
        )
    router = Router(authenticator, core.freshness, forwarding)
    router.add(*_endpoints(services, sources), *_robot_endpoints(services))
    timing = services.sessions.timing
    stops = WebsocketStops(core.reactor, services.fleet)
    updates = UpdatesAuth(core.reactor, services.auth, timing, core.origins, core.cookie, sources, stops)
    programs = _programs(services)
    connections = ConnectionLimits(settings.connections)
    root = _root(services, router, updates, programs, connections, limits, forwarding)
    site = RelaySite(
        root,
        core.reactor,
        connections,
        settings.tls,
        limits,
        authenticator.remembers,
        CrossOrigin(core.origins),
    )
    cluster_site = None
    if core.cluster is not None:
        secret = core.cluster.settings.secret
        core.cluster.drain.close_clients = (
            services.sessions.close_all,
            updates.close_all,
            programs.close_all,
            core.cluster.forwarder.leave,
        )
        cluster_site = ClusterSite(
            ClusterRoot(root, local), core.reactor, UncountedConnections(), limits, secret
        )
    return HttpSite(site, cluster_site, updates, programs)


async def _refresh_metrics(core: Core) -> None:
    if core.cluster is not None:
        await core.cluster.status.refresh()


def _programs(services: Services) -> IcpiConnections:
    core = services.core
    reached = IcpiServices(
        core.reactor,
        services.programs,
        services.role_commands,
        services.role_runs,
        services.auth.token,
        now_ns,
    )
    return IcpiConnections(reached, services.auth, core.origins, core.cookie)


def _robot_endpoints(services: Services) -> list[object]:
    """Groups of endpoints for the resources of robots."""
    core, sessions = services.core, services.sessions
    # Recorded events have keys of their own, so that they cannot evict the keys of requests to robots.
    keys = Idempotency(core.reactor)
    service = services.resources
    return [
        ActionEndpoints(service),
        CameraEndpoints(CameraService(sessions.cameras), service),
        ControlEndpoints(services.control_gateway),
        GoalEndpoints(core.reactor, services.goals, service, keys),
        NodeEndpoints(NodeService(services.in_process_sessions), service),
        ParameterEndpoints(service),
        ServiceEndpoints(service, keys),
        TopicEndpoints(core.reactor, service, keys),
    ]


def _endpoints(services: Services, sources: Sources) -> list[object]:
    """All other groups of endpoints."""
    core, event_keys = services.core, Idempotency(services.core.reactor)
    collectors: list[Collector] = [
        RelayCollector(core.robots, core.channels, core.cameras, lambda: services.sessions),
        services.events,
        core.audit,
    ]
    if core.cluster is not None:
        collectors.append(core.cluster.status)
    if services.listeners.tls is not None:
        collectors.append(services.listeners.tls)
    robots, summaries = RobotService(services.sessions), services.sessions.overview
    things = ThingService(
        core.reactor,
        core.access,
        core.robots,
        core.channels,
        services.in_process_sessions,
        services.roles,
        core.modules,
    )
    return [
        AlertEndpoints(services.alerts.service),
        EventEndpoints(core.reactor, services.events.service, event_keys),
        DocumentEndpoints(relay_server.VERSION, core.cookie),
        LoginEndpoints(services.auth),
        ModuleEndpoints(core.reactor, services.sessions, services.modules),
        OAuthEndpoints(services.oauth),
        FoxgloveUrlEndpoints(services.foxglove_urls),
        PipeEndpoints(services.pipes),
        ProgramEndpoints(services.programs),
        FunctionEndpoints(services.functions),
        RealmEndpoints(services.realms),
        StatusEndpoints(
            services.sessions.healthy,
            registry_of(*collectors),
            lambda: core.draining,
            partial(_refresh_metrics, core),
        ),
        VocabularyEndpoints(TypeDocs(core.access, core.robots, services.conversions)),
        FleetEndpoints(core.reactor, services.fleet, core.freshness),
        RecordingEndpoints(core.reactor, services.recordings, event_keys),
        RoleElementEndpoints(services.roles, services.role_commands),
        DeviceEndpoints(services.sessions),
        ClusterEndpoints(ClusterAdmin(core.cluster)),
        FileEndpoints(core.reactor, services.files),
        RoleEndpoints(services.roles, services.conversions),
        RoleRunEndpoints(core.reactor, services.role_runs),
        RobotEndpoints(core.reactor, robots, summaries, services.conversions, sources),
        ServiceRegistryEndpoints(core.reactor, services.service_registry.service),
        ThingEndpoints(things, core.freshness),
    ]


def _root(
    services: Services,
    router: Router,
    updates: UpdatesAuth,
    programs: IcpiConnections,
    connections: ConnectionLimits,
    limits: RequestLimits,
    forwarding: RequestForwarding | None,
) -> Root:
    settings, reactor = services.core.settings, services.core.reactor
    auth, sessions, timers = services.auth, services.sessions, PeriodicTimers(reactor)
    clients = ClientFactory(
        reactor, now_ns, auth, sessions, connections, limits, largest_message=settings.largest_message
    )
    frames = VideoFactory(reactor, now_ns, auth, sessions, connections, timers, limits)
    clients.forwarding = frames.forwarding = forwarding
    clients.stop = services.control_gateway.stop
    video = VideoResource(
        reactor,
        timers,
        auth,
        sessions,
        router.authenticator.principal,
        WebSocketUpgrade(frames),
        forwarding,
    )
    return Root(
        RobotAddress(WebSocketUpgrade(clients), video, relay_server.VERSION),
        router,
        Portal(relay_server.PORTAL),
        WebSocketUpgrade(UpdatesFactory(reactor, now_ns, updates, updates, connections, limits)),
        WebSocketUpgrade(IcpiFactory(reactor, now_ns, programs, programs, connections, limits)),
    )
