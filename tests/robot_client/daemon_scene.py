"""Connection and daemon together, in memory, on a clock of ours, with the relay's ends of their links."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from twisted.internet.address import IPv4Address
from twisted.internet.defer import Deferred, fail, succeed
from twisted.internet.error import ConnectionLost, ConnectionRefusedError
from twisted.internet.protocol import Factory
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransportWithDisconnection
from twisted.python.failure import Failure

from relay_protocol import frames, identity, link
from robot_client.camera.ipc import CameraSettings
from robot_client.camera.service import DaemonCameras
from robot_client.camera.supervisor import CameraSupervisor
from robot_client.config import RobotSettings
from robot_client.daemon import Daemon
from robot_client.link.backoff import Backoff
from robot_client.link.connection import ControlConnection
from robot_client.link.protocol import ControlLink, Identity
from robot_client.motion.guard_port import NoGuard
from robot_client.motion.hardware import Hardware, Switches
from robot_client.motion.stop_store import MemoryStopStore
from robot_client.platforms.base import GraphView
from robot_client.platforms.memory import TWIST, MemoryPlatform, twist

DRIVER = 7
"""The source that holds control."""

ME = Identity("r1", "relay-1", identity.generate_key())


class Line:
    """The relay's end of one connection in memory."""

    def __init__(self, protocol: Any, address: str) -> None:
        self.address = address
        self.protocol = protocol
        self.transport = StringTransportWithDisconnection(peerAddress=IPv4Address("TCP", "127.0.0.1", 1))
        self.transport.protocol = protocol
        self.transport.abortConnection = self.transport.loseConnection
        self.closed = False
        protocol.makeConnection(self.transport)

    def say(self, *messages: link.Message) -> None:
        self.protocol.dataReceived(b"".join(map(link.frame, messages)))

    def heard(self) -> list[Any]:
        data = self.transport.value()
        self.transport.clear()
        return [
            json.loads(each.body) if isinstance(each, frames.JsonFrame) else each
            for each in frames.FrameDecoder(2**25).feed(data)
        ]

    def ops(self) -> list[str]:
        return [each["op"] for each in self.heard() if isinstance(each, dict)]

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
        self.scene.lines.append(Line(protocol, self.address))
        return succeed(protocol)


class Answered(ControlConnection):
    """Of a relay that answers every ping at once."""

    now: Callable[[], int]

    @property
    def answered(self) -> int | None:
        return self.now() if self.registered else None


class Scene:
    """
    :param answers: whether the relay answers every ping, unseen
    """

    def __init__(
        self,
        latch: MemoryStopStore | None = None,
        switches: Switches | None = None,
        settings: RobotSettings | None = None,
        answers: bool = True,
    ) -> None:
        self.latch = latch or MemoryStopStore()
        self.clock = Clock()
        self.clock.advance(1000)
        self.listening = True
        self.dialled: list[tuple[float, str]] = []
        self.lines: list[Line] = []
        self.left: list[Any] = []
        """What came of the daemon's end."""
        self.platform = MemoryPlatform(GraphView(nodes=frozenset({"/talker"})))
        self.connection = (Answered if answers else ControlConnection)(
            self.dial,
            lambda: ControlLink(ME, "test", self.now),
            self.clock,
            Backoff(lambda: 0.5),
            "r1",
            "relay:1",
        )
        if isinstance(self.connection, Answered):
            self.connection.now = self.now
        self.cameras = CameraSupervisor(
            self.clock, CameraSettings(address="relay:1", node="camera", streams=8)
        )
        self.daemon = Daemon(
            settings or RobotSettings(),
            self.connection,
            self.platform,
            NoGuard(),
            DaemonCameras({}, self.cameras, self.connection.say, self.clock),
            self.latch,
            Hardware(switches or Switches(), self.platform, self.clock),
            self.clock,
            self.dial,
            "test",
            self.now,
        )
        self.daemon.start()

    def now(self) -> int:
        return round(self.clock.seconds() * 1e9)

    def dial(self, address: str) -> Endpoint:
        return Endpoint(self, address)

    def register(self) -> Line:
        line = self.lines[-1]
        line.say(link.Challenge(nonce=link.to_base64(bytes(32)), relay="relay-1"))
        line.say(link.Welcome(session="s", heartbeat=2.0, frame_limit=2**24))
        return line

    def channel(self, control: Line, name: str = "c1", address: str = "") -> Line:
        control.say(link.OpenChannel(channel=name, ticket="t-" + name, address=address))
        line = self.lines[-1]
        line.say(link.Joined(channel=name, at=self.now()))
        return line

    def driving(self, control: Line) -> Line:
        control.say(link.Control(id=1, holder=DRIVER, user="ann", level="operator"))
        line = self.channel(control)
        line.say(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
        self.command(line, twist(1.0))
        assert self.platform.published[-1] == ("/cmd_vel", twist(1.0))
        return line

    def command(self, line: Line, body: bytes, source: int = DRIVER) -> None:
        line.protocol.dataReceived(frames.encode_command(5, self.now(), source, body))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 10)):
            self.clock.advance(0.1)
