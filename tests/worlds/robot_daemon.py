"""Connection and daemon together, in memory, with the relay's side of their links."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from twisted.internet.address import IPv4Address
from twisted.internet.defer import Deferred, fail, maybeDeferred, succeed
from twisted.internet.error import ConnectionLost, ConnectionRefusedError
from twisted.internet.protocol import Factory
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransportWithDisconnection
from twisted.python.failure import Failure

from relay_protocol import frames, identity, link
from robot_client.alerts import ignore_alert
from robot_client.camera.ipc import CameraSettings
from robot_client.camera.service import DaemonCameras
from robot_client.camera.supervisor import CameraSupervisor
from robot_client.config import RobotSettings
from robot_client.daemon import Daemon
from robot_client.device_state.manager import DeviceManager
from robot_client.files.confirmed import ConfirmedFiles
from robot_client.files.uploader import FileUploader
from robot_client.link.addresses import RelayAddresses
from robot_client.link.backoff import Backoff
from robot_client.link.control_connection import ControlConnection
from robot_client.link.links import ControlLink, Identity
from robot_client.modules.relay_requests import ModuleRequests
from robot_client.modules.supervisor import ModuleSupervisor
from robot_client.motion.guard_port import NoGuard
from robot_client.motion.hardware import Hardware, Switches
from robot_client.motion.stop_store import MemoryStopStore
from robot_client.platforms.base import GraphView
from tests.worlds.memory_platform import TWIST, MemoryPlatform, twist

DRIVER = 7
"""The source that holds control."""

ME = Identity("r1", "relay-1", identity.generate_key())


class RelayEnd:
    """The relay's side of one connection in memory."""

    def __init__(self, protocol: Any, address: str) -> None:
        self.address = address
        self.protocol = protocol
        self.transport = StringTransportWithDisconnection(peerAddress=IPv4Address("TCP", "127.0.0.1", 1))
        self.transport.protocol = protocol
        self.transport.abortConnection = self.transport.loseConnection
        self.closed = False
        protocol.makeConnection(self.transport)

    def send(self, *messages: link.Message) -> None:
        self.protocol.dataReceived(b"".join(map(link.frame, messages)))

    def received(self) -> list[Any]:
        data = self.transport.value()
        self.transport.clear()
        return [
            json.loads(each.body) if isinstance(each, frames.JsonFrame) else each
            for each in frames.FrameDecoder(2**25).feed(data)
        ]

    def ops(self) -> list[str]:
        return [each["op"] for each in self.received() if isinstance(each, dict)]

    def lose(self) -> None:
        self.transport.connected = False
        self.protocol.connectionLost(Failure(ConnectionLost()))


class Endpoint:
    def __init__(self, scene: Scene, address: str) -> None:
        self.scene = scene
        self.address = address

    def connect(self, factory: Factory[Any]) -> Deferred[Any]:
        self.scene.dialled.append((self.scene.clock.seconds(), self.address))
        if not self.scene.listening:
            return fail(ConnectionRefusedError())
        protocol = factory.buildProtocol(IPv4Address("TCP", "127.0.0.1", 1))
        self.scene.lines.append(RelayEnd(protocol, self.address))
        return succeed(protocol)


class Answered(ControlConnection):
    """The connection to a relay that answers every ping at once."""

    now: Callable[[], int]

    @property
    def answered(self) -> int | None:
        return self.now() if self.registered else None


class NoDevice(DeviceManager):
    """A device manager without measurements."""

    def __init__(self) -> None:
        self.cycle_seconds = 3600.0

    def registered(self) -> None:
        """Ignores it."""

    def link_lost(self) -> None:
        """Ignores it."""


class Scene:
    """A daemon and its relay.

    :param answers: whether the relay answers every ping, unseen
    """

    def __init__(
        self,
        stop_store: MemoryStopStore | None = None,
        switches: Switches | None = None,
        settings: RobotSettings | None = None,
        answers: bool = True,
        addresses: str = "relay:1",
    ) -> None:
        self.stop_store = stop_store or MemoryStopStore()
        self.addresses = RelayAddresses(addresses)
        self.clock = Clock()
        self.clock.advance(1000)
        self.listening = True
        self.dialled: list[tuple[float, str]] = []
        self.lines: list[RelayEnd] = []
        self.left: list[Any] = []
        """What came of the daemon's end."""
        self.platform = MemoryPlatform(GraphView(nodes=frozenset({"/talker"})))
        self.connection = (Answered if answers else ControlConnection)(
            dial=self.dial,
            build_link=lambda: ControlLink(ME, "test", self.now),
            clock=self.clock,
            backoff=Backoff(lambda: 0.5),
            robot="r1",
            addresses=self.addresses,
        )
        if isinstance(self.connection, Answered):
            self.connection.now = self.now
        self.cameras = CameraSupervisor(
            self.clock, CameraSettings(address="relay:1", node="camera", streams=8)
        )
        self.modules = ModuleSupervisor(
            [],
            Path(),
            reactor=self.clock,
            environment={},
            graph=self.platform.graph,
            alert=lambda *args, **more: None,
            boot="",
        )
        self.daemon = self._daemon(settings or RobotSettings(), switches or Switches())
        self.daemon.start()

    def _daemon(self, settings: RobotSettings, switches: Switches) -> Daemon:
        return Daemon(
            settings=settings,
            connection=self.connection,
            platform=self.platform,
            guard=NoGuard(),
            cameras=DaemonCameras(
                {}, self.cameras, self.connection.send, self.clock, address=lambda: "relay:1"
            ),
            modules=ModuleRequests(
                self.modules,
                Path(),
                send=self.connection.send,
                clock=self.clock,
                in_thread=maybeDeferred,
                other_roots=dict,
                wall=lambda: 1000.0,
            ),
            files=FileUploader(
                [],
                ConfirmedFiles(Path()),
                send=self.connection.send,
                dial=self.dial,
                clock=self.clock,
                in_thread=maybeDeferred,
                full=bool,
                now=self.now,
                alert=ignore_alert,
            ),
            device=NoDevice(),
            stop_store=self.stop_store,
            hardware=Hardware(switches, self.platform, self.clock),
            clock=self.clock,
            dial=self.dial,
            agent="test",
            now=self.now,
        )

    def now(self) -> int:
        return round(self.clock.seconds() * 1e9)

    def dial(self, address: str) -> Endpoint:
        return Endpoint(self, address)

    def register(self) -> RelayEnd:
        line = self.lines[-1]
        line.send(link.Challenge(nonce=link.to_base64(bytes(32)), relay="relay-1"))
        line.send(link.Welcome(session="s", heartbeat=2.0, frame_limit=2**24))
        return line

    def channel(self, control: RelayEnd, name: str = "c1", address: str = "") -> RelayEnd:
        control.send(link.OpenChannel(channel=name, ticket="t-" + name, address=address))
        line = self.lines[-1]
        line.send(link.Joined(channel=name, at=self.now()))
        return line

    def driving(self, control: RelayEnd) -> RelayEnd:
        control.send(link.ControlGrant(id=1, holder=DRIVER, user="ann", level="operator"))
        line = self.channel(control)
        line.send(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
        self.command(line, twist(1.0))
        assert self.platform.published[-1] == ("/cmd_vel", twist(1.0))
        return line

    def command(self, line: RelayEnd, body: bytes, source: int = DRIVER) -> None:
        line.protocol.dataReceived(frames.encode_command(5, self.now(), source, body))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 10)):
            self.clock.advance(0.1)
