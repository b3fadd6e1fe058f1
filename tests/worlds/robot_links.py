"""The relay's side of robot connections on transports in memory, and a robot's side of one."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, cast

from twisted.internet import reactor
from twisted.internet.address import IPv4Address
from twisted.internet.defer import Deferred
from twisted.internet.error import ConnectionDone
from twisted.internet.testing import StringTransportWithDisconnection
from twisted.python.failure import Failure

from relay_protocol import PROTOCOL_VERSION, identity, jsontext, limits, link
from relay_protocol.frames import FrameDecoder, JsonFrame, encode_json
from relay_server.cluster.homes import SingleHome
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.files.links import FileLinks
from relay_server.http.limits import ConnectionLimits
from relay_server.modules.robot_modules import ModuleRegistry
from relay_server.robots.connection import LinkTiming, RobotConnection, RobotFactory
from relay_server.robots.link_handlers import HandshakeHandler, RobotLinkContext
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.robots.tickets import Tickets
from tests.worlds.relay import World

RELAY = "lab relay"
KEY = bytes(range(32))
FINGERPRINT = identity.fingerprint(identity.public_half(KEY))


class Transport(StringTransportWithDisconnection):
    """A TCP connection in memory; like TLS it does not close while a producer is registered."""

    aborted = False

    def setTcpNoDelay(self, on: bool) -> None:
        """As TCP."""

    def setTcpKeepAlive(self, on: bool) -> None:
        """As TCP."""

    def getHandle(self) -> None:
        """No socket."""

    def loseConnection(self) -> None:
        """Closes, unless a producer still holds it."""
        if self.connected and self.producer is None:
            super().loseConnection()

    def abortConnection(self) -> None:
        """Closes at once."""
        self.aborted = True
        if self.connected:
            super().abortConnection()


def no_files(clock: Any) -> FileLinks:
    """Links of files that no robot opens."""
    return FileLinks(_no_uploads(), Tickets(clock, lambda: "file-ticket"))


def _no_uploads() -> Any:
    """For robots that upload nothing."""
    return None


class RobotLinkWorld:
    """The relay's side of robot connections, with one enrolled robot."""

    def __init__(self, store: AsyncDatabase, files: FileLinks | None = None) -> None:
        self.world = World()
        self.store = store
        self.registry = RobotRegistry(lambda: 1000.0)
        self.cap = ConnectionLimits(3)
        clock = self.world.clock
        self.bus = EventBus()
        self.reported: list[tuple[str, dict[str, Any]]] = []
        """Kinds and data of events."""
        self.bus.subscribe(lambda event: self.reported.append((event.kind, event.data)))
        self.scene = RobotLinkContext(
            RELAY,
            store,
            self.registry,
            self.world.channels,
            self.world.videos,
            self.world.controllers,
            ModuleRegistry(clock, lambda: 1000.0),
            files or no_files(clock),
            cast(Any, None),
            SingleHome(),
            self.bus,
            clock.seconds,
            lambda: 1000.0,
        )
        timing = LinkTiming(2.0)
        self.factory = RobotFactory(
            lambda: RobotConnection(
                clock, self.world.now_ns, timing, lambda each: HandshakeHandler(self.scene, each), self.cap
            )
        )

    def dial(self, address: str = "192.168.1.1") -> Robot:
        """A robot's new connection."""
        return Robot(self, address)

    async def registered(self, address: str = "192.168.1.1") -> Robot:
        """A robot that has proved its key."""
        robot = self.dial(address)
        assert (await robot.registers())["op"] == "welcome"
        return robot

    @property
    def presence(self) -> RobotState | None:
        """The robot's state in the registry."""
        return next((robot for robot in self.registry if robot.name == "r2-d2"), None)

    @property
    def online(self) -> bool:
        """Whether the registry has a control link of the robot."""
        return self.presence is not None and self.presence.control_link is not None


class Robot:
    """A robot's side of one connection."""

    def __init__(self, scene: RobotLinkWorld, address: str) -> None:
        self.scene = scene
        self.transport = Transport(peerAddress=IPv4Address("TCP", address, 54321))
        self.connection = scene.factory.buildProtocol(None)
        self.transport.protocol = self.connection
        self._decoder = FrameDecoder(limits.RELAY_FRAME)
        self.connection.makeConnection(self.transport)

    def says(self, message: link.Message) -> None:
        """Sends a message."""
        self.sends(encode_json(jsontext.encode(message)))

    def sends(self, data: bytes) -> None:
        """Sends bytes."""
        self.connection.dataReceived(data)

    def frames(self) -> list[Any]:
        """Frames since the last call."""
        data = self.transport.value()
        self.transport.clear()
        return self._decoder.feed(data)

    def received(self) -> list[dict[str, Any]]:
        """Messages since the last call."""
        return [json.loads(frame.body) for frame in self.frames() if isinstance(frame, JsonFrame)]

    def pongs(self) -> list[dict[str, Any]]:
        """Answers all received pings; returns the other messages."""
        others = []
        for each in self.received():
            if each["op"] == "ping":
                self.says(link.Pong(t=each["t"], at=1))
            else:
                others.append(each)
        return others

    def refusal(self) -> dict[str, Any]:
        """The refusal that ended the connection."""
        last = self.received()[-1]
        assert last["op"] == "refused"
        assert not self.transport.connected
        return last

    def hello(self, robot: str = "r2-d2", key: str = FINGERPRINT) -> str:
        """Sends its name; returns the nonce."""
        self.says(link.Hello(version=PROTOCOL_VERSION, robot=robot, key=key, encodings=["cdr"]))
        (challenge,) = self.received()
        assert (challenge["op"], challenge["relay"]) == ("challenge", RELAY)
        return str(challenge["nonce"])

    def prove(self, nonce: str, robot: str = "r2-d2", key: bytes = KEY) -> None:
        """Signs a nonce."""
        signature = identity.sign(key, RELAY, robot, link.from_base64(nonce, "nonce"))
        self.says(link.Prove(signature=link.to_base64(signature)))

    async def registers(self) -> dict[str, Any]:
        """The whole registration; returns the answer."""
        self.prove(self.hello())
        await self.answered()
        return self.received()[0]

    async def answered(self) -> None:
        """Waits until the database has answered."""
        await until(lambda: not self.connection._suspended)

    def breaks(self) -> None:
        """The network loses the connection."""
        self.transport.connected = False
        self.connection.connectionLost(Failure(ConnectionDone()))


async def until(true: Callable[[], bool]) -> None:
    """Runs the reactor until the condition holds."""
    for _ in range(2000):
        if true():
            return
        tick: Deferred[None] = Deferred()
        reactor.callLater(0.005, tick.callback, None)  # type: ignore[attr-defined]
        await tick
    raise AssertionError("it never held")
