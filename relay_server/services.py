"""The services of one relay, and how they are built."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from typing import Any

from relay_protocol.clocks import now_ns
from relay_server.alerts.hub import AlertHub
from relay_server.alerts.service import Alerts
from relay_server.auth.service import AuthService
from relay_server.auth.url_tokens import UrlTokens
from relay_server.cluster.element_commands import ClusterElements, NoElementForwarding
from relay_server.cluster.fleet_orders import ClusterOrders, NoOrderForwarding, OrderForwarding
from relay_server.config import RelaySettings
from relay_server.control.gateway import ControlGateway
from relay_server.control.lease import LeaseState
from relay_server.control.service import ControlService
from relay_server.core import Core, build_core
from relay_server.events.service import EventLog
from relay_server.files.service import FileService
from relay_server.fleet.service import FleetService
from relay_server.foxglove_urls.service import FoxgloveUrlService
from relay_server.icpi.programs import ProgramRegistry
from relay_server.in_process_sessions.in_process_port import InProcessPort
from relay_server.in_process_sessions.pool import InProcessSessionPool
from relay_server.listeners import Listeners
from relay_server.maintenance import ChangePolling, ChangeWatcher, Purge, RealmCaches
from relay_server.modules.report_store import ModuleReportStore
from relay_server.modules.service import ModuleService
from relay_server.oauth.service import OAuthService
from relay_server.offload.build import build_function_links, build_functions
from relay_server.offload.robot_link import FunctionLinks
from relay_server.offload.service import FunctionService
from relay_server.pipes.service import PipeService
from relay_server.realms.service import RealmService
from relay_server.recordings.library import FOLDER, Library, open_storage
from relay_server.recordings.recordings import Recordings
from relay_server.recordings.service import RecordingService
from relay_server.relay_node.functions import FunctionRosServices
from relay_server.relay_node.pipes import PipeRosServices
from relay_server.relay_node.roles import RoleRosServices
from relay_server.resources.goals import GoalService
from relay_server.resources.representations import ConversionPool
from relay_server.resources.service import RobotResourceService
from relay_server.robots.link_handlers import report_key_used_twice
from relay_server.robots.registry import RobotState
from relay_server.roles.commands import RoleCommands
from relay_server.roles.process import RoleProcess
from relay_server.roles.runs import RoleRuns
from relay_server.roles.service import RoleService
from relay_server.service_registry.service import ServiceRegistry
from relay_server.sessions.manager import SessionManager
from relay_server.sessions.ports import Timing


@dataclass(frozen=True, kw_only=True)
class Services:
    """The services of a relay. Its HTTP site is built from them.

    :ivar recorder: records; ``recordings`` are its rules for users
    :ivar in_process_sessions: sessions that the relay opens for HTTP clients
    :ivar conversions: threads that convert RDF
    """

    core: Core
    auth: AuthService
    sessions: SessionManager
    in_process_sessions: InProcessSessionPool
    resources: RobotResourceService
    goals: GoalService
    control_gateway: ControlGateway
    fleet: FleetService
    foxglove_urls: FoxgloveUrlService
    modules: ModuleService
    pipes: PipeService
    functions: FunctionService
    function_links: FunctionLinks
    alerts: Alerts
    events: EventLog
    service_registry: ServiceRegistry
    recorder: Recordings
    recordings: RecordingService
    realms: RealmService
    roles: RoleService
    role_commands: RoleCommands
    role_runs: RoleRuns
    files: FileService
    programs: ProgramRegistry
    oauth: OAuthService
    changes: ChangeWatcher
    polling: ChangePolling
    purge: Purge
    conversions: ConversionPool
    listeners: Listeners


def build_services(reactor: Any, settings: RelaySettings) -> Services:
    """Build the services of one relay. Nothing is opened yet but its data folder, which is locked.

    :param reactor: Twisted's
    :raises SwitchboardError: settings, the data folder or the certificate can't be used
    """
    core = build_core(reactor, settings)
    listeners = Listeners(reactor, settings, core.data_dir)
    recorder = _recorder(core)
    alerts = Alerts(core)
    events = EventLog(core, alerts.hub)
    service_registry = ServiceRegistry(core, events.record)
    purge = Purge(core, alerts.hub, recorder)
    changes = _changes(core, alerts, events, service_registry, purge)
    control = ControlService(reactor, core.controllers)
    modules = _modules(core)
    sessions = _sessions(core, control, modules)
    in_process_sessions = InProcessSessionPool(reactor, sessions)
    functions = _functions(core, sessions)
    _join_cluster(core, sessions, changes, functions, recorder, alerts.hub)
    conversions = ConversionPool(reactor)
    resources = RobotResourceService(reactor, in_process_sessions, conversions, now_ns, time.time)
    programs = ProgramRegistry()
    pipes = _pipes(core, sessions, programs)
    roles = RoleService(core.database, core.access, RoleProcess(reactor))
    goals = GoalService(reactor, in_process_sessions, resources, time.time)
    role_commands = _role_commands(core, roles, resources, goals, sessions, modules, pipes, programs)
    role_runs = _role_runs(core, sessions, roles, role_commands, pipes, programs)
    return Services(
        core=core,
        auth=_auth(core),
        sessions=sessions,
        in_process_sessions=in_process_sessions,
        resources=resources,
        goals=goals,
        control_gateway=_control_gateway(core, control, sessions, in_process_sessions),
        fleet=_fleet(core, sessions, control, modules),
        foxglove_urls=_foxglove_urls(core, changes, sessions),
        modules=modules,
        functions=functions,
        function_links=build_function_links(core, functions),
        pipes=pipes,
        alerts=alerts,
        events=events,
        service_registry=service_registry,
        recorder=recorder,
        recordings=RecordingService(sessions, recorder, core.database, core.bus, time.time),
        realms=_realms(core, recorder, changes, listeners),
        roles=roles,
        role_commands=role_commands,
        role_runs=role_runs,
        files=_files(core, sessions),
        programs=programs,
        oauth=_oauth(core),
        changes=changes,
        polling=ChangePolling(core, changes),
        purge=purge,
        conversions=conversions,
        listeners=listeners,
    )


def _join_cluster(
    core: Core,
    sessions: SessionManager,
    changes: ChangeWatcher,
    functions: FunctionService,
    recorder: Recordings,
    alerts: AlertHub,
) -> None:
    """Give the cluster what it needs of the services; nothing if this is the only relay."""
    cluster = core.cluster
    if cluster is None:
        return
    cluster.notices.apply = changes.apply
    changes.several_relays = True
    cluster.robot_facts.facts_of = sessions.overview.facts_of
    sessions.overview.facts_elsewhere = cluster.robot_facts.find
    cluster.alert_notices.take = alerts.mirror
    alerts.on_written = cluster.alert_notices.written
    changes.on_applied = cluster.notices.applied

    def moved(robot: RobotState) -> None:
        sessions.robot_moved(robot)
        core.controllers.of(robot).robot_moved()

    cluster.homes.on_moved = moved
    cluster.homes.on_key_used_twice = partial(report_key_used_twice, core.bus)
    cluster.clients = lambda: sum(1 for _ in sessions)
    cluster.lag = lambda: core.access.lag
    cluster.take_over = functions.take_over

    def stays(robot: RobotState) -> bool:
        # Pipes, Roles, goals and the like have sessions in this process.
        clients = sessions.clients_of(robot.robot_id)
        driven = core.controllers.of(robot).lease.state is not LeaseState.FREE
        in_use = any(isinstance(each.port, InProcessPort) for each in clients)
        return driven or in_use or recorder.records(robot.robot_id)

    cluster.overload.stays = stays


def _files(core: Core, sessions: SessionManager) -> FileService:
    quota = core.settings.files.robot
    files = FileService(sessions, core.files, core.database, core.bus, quota, time.time)
    if core.cluster is not None:
        files.on_removed = core.cluster.file_notices.removed
        core.cluster.file_notices.delete = files.delete_removed
    return files


def _auth(core: Core) -> AuthService:
    access = core.access
    url_tokens = UrlTokens(core.database, lambda: access.refreshed, time.monotonic, time.time)
    return AuthService(
        core.reactor,
        core.database,
        core.authenticator,
        access,
        core.bus,
        core.origins,
        core.cookie,
        url_tokens,
    )


def _oauth(core: Core) -> OAuthService:
    return OAuthService(core.database, core.authenticator, core.access, core.bus, time.monotonic, time.time)


def _recorder(core: Core) -> Recordings:
    settings = core.settings
    library = Library(
        settings.data / FOLDER,
        settings.recordings,
        settings.recordings_reserve,
        open_storage(settings.files.storage),
    )
    return Recordings(core.reactor, core.reactor, library, core.channels, core.cameras, time.time)


def _changes(
    core: Core, alerts: Alerts, events: EventLog, service_registry: ServiceRegistry, purge: Purge
) -> ChangeWatcher:
    return ChangeWatcher(
        core.database,
        core.access,
        RealmCaches(core.database, events.on_realms_changed, service_registry.on_realms_changed),
        core.robots,
        core.controllers,
        core.cameras,
        alerts.hub,
        service_registry.leases,
        purge.recordings_soon,
    )


def _realms(core: Core, recorder: Recordings, changes: ChangeWatcher, listeners: Listeners) -> RealmService:
    return RealmService(
        core.database, core.authenticator, recorder, changes.apply, lambda: listeners.robots_port
    )


def _control_gateway(
    core: Core,
    control: ControlService,
    sessions: SessionManager,
    in_process_sessions: InProcessSessionPool,
) -> ControlGateway:
    return ControlGateway(
        core.reactor,
        control,
        sessions=sessions,
        access=core.access,
        registry=core.robots,
        database=core.database,
        in_process_sessions=in_process_sessions,
    )


def _fleet(
    core: Core, sessions: SessionManager, control: ControlService, modules: ModuleService
) -> FleetService:
    return FleetService(
        core.reactor,
        sessions,
        core.access,
        core.robots,
        control,
        core.database,
        core.bus,
        core.audit,
        modules,
        forwarding=_order_forwarding(core),
    )


def _order_forwarding(core: Core) -> OrderForwarding:
    if core.cluster is None:
        return NoOrderForwarding()
    return ClusterOrders(core.reactor, core.homes, core.cluster.forwarder)


def _foxglove_urls(core: Core, changes: ChangeWatcher, sessions: SessionManager) -> FoxgloveUrlService:
    return FoxgloveUrlService(
        core.reactor, core.access, core.database, changes.apply, sessions.tokens_of, time.time
    )


def _functions(core: Core, sessions: SessionManager) -> FunctionService:
    functions = build_functions(core)
    function_services = FunctionRosServices(functions)
    sessions.relay_node.add_services(function_services.handlers())
    sessions.relay_node.add_actions(function_services.actions())
    return functions


def _modules(core: Core) -> ModuleService:
    reports = ModuleReportStore(core.reactor, core.database, core.modules)
    return ModuleService(core.modules, core.robots, core.database, core.bus, time.time, reports, core.homes)


def _role_commands(
    core: Core,
    roles: RoleService,
    resources: RobotResourceService,
    goals: GoalService,
    sessions: SessionManager,
    modules: ModuleService,
    pipes: PipeService,
    programs: ProgramRegistry,
) -> RoleCommands:
    return RoleCommands(
        roles,
        resources,
        goals,
        sessions,
        modules=modules,
        pipes=pipes,
        programs=programs,
        audit=core.audit,
        wall=time.time,
        forwarding=NoElementForwarding()
        if core.cluster is None
        else ClusterElements(core.homes, core.access, core.cluster.forwarder),
    )


def _role_runs(
    core: Core,
    sessions: SessionManager,
    roles: RoleService,
    commands: RoleCommands,
    pipes: PipeService,
    programs: ProgramRegistry,
) -> RoleRuns:
    runs = RoleRuns(
        core.reactor,
        roles,
        commands,
        pipes,
        core.modules,
        programs,
        sessions,
        core.database,
        core.bus,
        wall=time.time,
    )
    sessions.relay_node.add_services(RoleRosServices(commands, runs).handlers())
    return runs


def _pipes(core: Core, sessions: SessionManager, programs: ProgramRegistry) -> PipeService:
    pipes = PipeService(
        core.reactor,
        sessions,
        core.database,
        core.bus,
        programs,
        clock_ns=now_ns,
        wall=time.time,
        homes=core.homes,
    )
    sessions.relay_node.add_services(PipeRosServices(pipes).handlers())
    return pipes


def _sessions(core: Core, control: ControlService, modules: ModuleService) -> SessionManager:
    settings = core.settings
    return SessionManager(
        core.reactor,
        core.database,
        core.access,
        core.robots,
        core.channels,
        core.cameras,
        control,
        modules,
        core.bus,
        Timing(settings.client_ping, settings.driving_ping, settings.stall_limit, settings.largest_message),
        clock_ns=now_ns,
        wall=time.time,
    )
