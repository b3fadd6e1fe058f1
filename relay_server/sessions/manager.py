"""Opens sessions of clients that are authenticated: authorizes them, and keeps the list of all that are open."""

from __future__ import annotations

import secrets
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound, SwitchboardError, Unavailable
from relay_protocol.rights import Operation
from relay_server.access import NO_ROBOT, Access, Permit, Principal
from relay_server.channels.channel import Channels
from relay_server.common import close_codes
from relay_server.common.clock import Clock, PeriodicTimers
from relay_server.common.connection_ids import ConnectionIds
from relay_server.common.cpu_quota import UserQuotas
from relay_server.common.database import AsyncDatabase
from relay_server.control.service import ControlService
from relay_server.events.bus import EventBus
from relay_server.foxglove.assets import asset_budget
from relay_server.foxglove.options import StreamOptions
from relay_server.foxglove.port import FoxglovePort
from relay_server.modules.service import ModuleService
from relay_server.relay_node.node import RelayNode
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.sessions.context import ClientContext
from relay_server.sessions.message_age import MessageAge
from relay_server.sessions.ports import ClientPort, ClientTransport, Timing
from relay_server.sessions.presence import PresenceService, RobotInfo
from relay_server.sessions.rosbridge_port import RosbridgePort
from relay_server.sessions.session import Session
from relay_server.sessions.summaries import RobotSummaries
from relay_server.sessions.websocket_port import WebsocketContext
from relay_server.video.streams import CameraStreams
from relay_server.video.viewer import CameraViewer, FrameSink, camera_info, check_view


class ShuttingDown(Unavailable):
    """The relay is shutting down."""

    code = "going_down"


@dataclass(frozen=True)
class Admission:
    """A principal that may open a session on a robot.

    :param snapshot: for one image of a camera
    """

    permit: Permit
    robot: RobotState
    address: str
    snapshot: bool = False


class SessionManager:
    """Opens the sessions of websockets and of HTTP clients, and closes them all at shutdown.

    :param clock_ns: monotonic nanoseconds
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        clock: Clock,
        store: AsyncDatabase,
        access: Access,
        registry: RobotRegistry,
        channels: Channels,
        videos: CameraStreams,
        control: ControlService,
        modules: ModuleService,
        bus: EventBus,
        timing: Timing,
        *,
        clock_ns: Callable[[], int],
        wall: Callable[[], float],
    ) -> None:
        self.accepting = True
        self._clock = clock
        self._store = store
        self._access = access
        self._registry = registry
        self._channels = channels
        self._videos = videos
        self._controllers = control.controllers
        self._bus = bus
        self.timing = timing
        self._timers = PeriodicTimers(clock)
        self._quotas = UserQuotas(clock.seconds, time.thread_time)
        self._asset_budget = asset_budget()
        self._clock_ns = clock_ns
        self._wall = wall
        # Robots know by these numbers which client must release the controls. They are new in each run of the relay.
        self._numbers = ConnectionIds()
        self._run_id = secrets.token_hex(8)
        self._clients: dict[int, dict[int, ClientContext]] = {}
        self._viewers: set[CameraViewer] = set()
        people = PresenceService(self.clients_of, control.controllers.holder, clock.seconds)
        self.overview = RobotSummaries(
            access, registry, people, self.clients_of, control.controllers, clock.seconds
        )
        self.relay_node = RelayNode(self.clients_of, videos, people, control, modules)

    def __iter__(self) -> Iterator[ClientContext]:
        return iter([client for each in self._clients.values() for client in each.values()])

    def clients_of(self, robot_id: int) -> list[ClientContext]:
        """The clients of a robot, oldest first."""
        return list(self._clients.get(robot_id, {}).values())

    def tokens_of(self, robot_id: int) -> list[int]:
        """The numbers of the tokens by which a robot's clients are connected, one of each client."""
        return [client.permit.principal.token_id for client in self._clients.get(robot_id, {}).values()]

    # --- robots -------------------------------------------------------------------------------------------

    async def admit(self, principal: Principal, robot: str, address: str) -> Admission:
        """Authorize a principal for a robot on which it has any right; :meth:`open` or :meth:`release` must follow.

        :raises NotFound: no such robot, or no right on it; the answers are the same
        """
        found = await self._access.permit_by_name(principal, robot)
        if found is None:
            self._bus.publish(
                "client.refused",
                source=f"user:{principal.name}",
                realm=principal.realm,
                robot=robot[:64],
                address=address,
            )
            raise NotFound(NO_ROBOT)
        record, permit = found
        return Admission(permit, self._registry.robot(record.id, record.name, record.realm), address)

    @asynccontextmanager
    async def admitted(self, principal: Principal, robot: str, address: str) -> AsyncIterator[Admission]:
        """The admission of a principal for one request; see :meth:`admit`."""
        admission = await self.admit(principal, robot, address)
        try:
            yield admission
        finally:
            self.release(admission)

    def release(self, admission: Admission) -> None:
        """The client left before its authorized session began."""
        self._access.release(admission.permit)

    def open(self, admission: Admission, transport: ClientTransport, opened_ns: int) -> RosbridgePort:
        """Begin an authorized session for a client that speaks rosbridge.

        :param opened_ns: when the websocket's handshake was answered, monotonic nanoseconds
        """
        age = MessageAge(self._clock_ns, opened_ns, _ping_token)
        port = RosbridgePort(self._websocket_context(transport, age))
        port.attach(self._open(admission, port, age))
        return port

    def open_foxglove(
        self, admission: Admission, transport: ClientTransport, opened_ns: int, options: StreamOptions
    ) -> FoxglovePort:
        """As :meth:`open`, for a client that speaks the Foxglove protocol.

        :param options: of the URL
        """
        age = MessageAge(self._clock_ns, opened_ns, _ping_token)
        port = FoxglovePort(
            self._websocket_context(transport, age), self._run_id, options, self._asset_budget
        )
        port.attach(self._open(admission, port, age))
        return port

    def _websocket_context(self, transport: ClientTransport, age: MessageAge) -> WebsocketContext:
        return WebsocketContext(self._clock, transport, age, self.timing, self._timers)

    def open_in_process(self, admission: Admission, port: ClientPort) -> Session:
        """Begin an authorized session for a client in this process; it is never pinged."""
        now = self._clock_ns()
        return self._open(admission, port, MessageAge(self._clock_ns, now, lambda: b""))

    def _open(self, admission: Admission, port: ClientPort, age: MessageAge) -> Session:
        robot, permit = admission.robot, admission.permit
        client = ClientContext(
            clock=self._clock,
            number=self._numbers.take(),
            address=admission.address,
            since=self._wall(),
            permit=permit,
            robot=robot,
            channel=self._channels.of(robot),
            controller=self._controllers.of(robot),
            port=port,
            age=age,
            user_quota=self._quotas.of(permit.principal.user_id),
        )
        session = Session(client, self._clock, self.relay_node, self._timers, self._ended)
        self._clients.setdefault(robot.robot_id, {})[client.number] = client
        robot.users = len(self._clients[robot.robot_id])
        source = f"user:{client.name}"
        client.activity = partial(self._bus.publish, robot_id=robot.robot_id, source=source)
        self._bus.publish("client.joined", robot.robot_id, source, address=admission.address)
        self._registry.changed()
        return session

    def _ended(self, client: ClientContext) -> None:
        self._access.release(client.permit)
        here = self._clients.get(client.robot.robot_id, {})
        here.pop(client.number, None)
        client.robot.users = len(here)
        self._bus.publish(
            "client.left",
            client.robot.robot_id,
            f"user:{client.name}",
            drops=client.drops,
            refusals=client.refusals,
        )
        self._registry.changed()

    # --- cameras ------------------------------------------------------------------------------------------

    async def cameras(self, principal: Principal, robot: str) -> list[dict[str, Any]]:
        """The cameras of a robot that the principal may view.

        :raises NotFound: no such robot, or no right on it
        """
        for record, rules in await self._access.robots(principal):
            if record.name == robot:
                there = self._registry.robot(record.id, record.name, record.realm)
                streams = self._videos.streams_of(there)
                return [
                    camera_info(camera, streams)
                    for camera in there.cameras
                    if rules.decide(Operation.VIEW, camera.name).allowed
                ]
        raise NotFound(NO_ROBOT)

    async def may_view(
        self, principal: Principal, robot: str, camera: str, transport: str, address: str
    ) -> None:
        """Check that the principal may view a camera now.

        :raises NotFound: no such robot, or no right on it or to view the camera
        """
        admission = await self.admit(principal, robot, address)
        try:
            check_view(admission.permit, camera, transport)
        finally:
            self.release(admission)

    async def view(
        self,
        principal: Principal,
        robot: str,
        camera: str,
        settings: link.VideoSettings,
        sink: FrameSink,
        address: str,
        snapshot: bool = False,
    ) -> CameraViewer:
        """View a camera until :meth:`CameraViewer.leave`, or until the sink is notified of the end.

        :param snapshot: for one image
        :raises NotFound: no such robot, or no right on it or to view the camera
        :raises Unavailable: there are too many viewers, or the relay is shutting down
        """
        admission = await self.admit(principal, robot, address)
        return self.watch(replace(admission, snapshot=snapshot), camera, settings, sink)

    def watch(
        self, admission: Admission, camera: str, settings: link.VideoSettings, sink: FrameSink
    ) -> CameraViewer:
        """As :meth:`view`, for an authorized client. The admission is used up, also by an error."""
        viewer = CameraViewer(
            admission.permit,
            admission.robot,
            camera,
            settings,
            sink,
            address=admission.address,
            on_end=self._viewer_left,
            snapshot=admission.snapshot,
        )
        try:
            if not self.accepting:
                raise ShuttingDown("the relay is going down; try again in a moment")
            viewer.start(self._videos)
        except SwitchboardError:
            self.release(admission)
            raise
        self._viewers.add(viewer)
        self._registry.viewer_joined(viewer.robot, viewer)
        self._publish_video_event("video.joined", viewer, address=viewer.address)
        return viewer

    def _viewer_left(self, viewer: CameraViewer) -> None:
        self._access.release(viewer.permit)
        self._viewers.discard(viewer)
        self._registry.viewer_left(viewer.robot, viewer)
        self._publish_video_event("video.left", viewer, pictures=viewer.frames)

    def _publish_video_event(self, kind: str, viewer: CameraViewer, **data: Any) -> None:
        source = f"user:{viewer.name}"
        self._bus.publish(kind, viewer.robot.robot_id, source, **viewer.event_data, **data)

    # --- robots of a principal ----------------------------------------------------------------------------

    async def robots(self, principal: Principal) -> list[RobotInfo]:
        """Summaries of the principal's robots, by its rights."""
        return await self.overview.robots(principal)

    async def healthy(self) -> bool:
        """Whether the database answers."""
        try:
            await self._store.read(queries.revision)
        except SwitchboardError:
            return False
        return True

    def on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call ``listener`` when robots may have changed; returns a function that ends that."""
        return self._registry.on_change(listener)

    def status(self) -> list[dict[str, Any]]:
        """Every robot the relay knows, with its clients, for the administrator's own machine."""
        return self.overview.status()

    def robot_moved(self, robot: RobotState) -> None:
        """A robot has connected to another relay of the cluster, which its clients reach when they connect again."""
        for client in self.clients_of(robot.robot_id):
            client.close(
                close_codes.UNAVAILABLE, f"robot {robot.name} has connected to another relay; connect again"
            )

    def shutdown(self, reason: str) -> None:
        """The relay shuts down: refuse new clients, and close what is open."""
        self.accepting = False
        self.close_all(reason)

    def close_all(self, reason: str) -> None:
        """Close the websockets of all clients, which may connect again."""
        for client in self:
            client.close(close_codes.GOING_AWAY, reason)
        for viewer in list(self._viewers):
            viewer.end(ShuttingDown(reason))


def _ping_token() -> bytes:
    return secrets.token_bytes(8)
