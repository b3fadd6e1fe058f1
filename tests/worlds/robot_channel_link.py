"""The robot's side of a channel link as bytes: messages of a test pass the relay's decoder and its role."""

from __future__ import annotations

from typing import Any

from relay_protocol import link
from relay_protocol.frames import encode_sample
from relay_server.cluster.homes import SingleHome
from relay_server.http.limits import ConnectionLimits
from relay_server.robots.connection import LinkTiming, RobotConnection, RobotFactory
from relay_server.robots.link_handlers import HandshakeHandler, RobotLinkContext
from tests.worlds.relay import STRING, TEXTS, World
from tests.worlds.robot_links import RELAY, Robot, no_files


class _Relay:
    """Accepts connections for the world's channels; a robot that joins needs no database."""

    def __init__(self, world: World) -> None:
        unused: Any = None
        hall = RobotLinkContext(
            RELAY,
            unused,
            world.registry,
            world.channels,
            world.videos,
            world.controllers,
            unused,
            no_files(world.clock),
            unused,
            SingleHome(),
            unused,
            world.clock.seconds,
            world.clock.seconds,
        )
        cap = ConnectionLimits(3)
        self.factory = RobotFactory(
            lambda: RobotConnection(
                world.clock, world.now_ns, LinkTiming(2.0), lambda each: HandshakeHandler(hall, each), cap
            )
        )


class RobotLink:
    """A robot that has joined its channel; it registers first if it is not online."""

    def __init__(self, world: World) -> None:
        self.world = world
        if world.robot.control_link is None:
            world.robot_comes()
        self._heard: list[dict[str, Any]] = []
        self._robot: Robot

    def joins(self) -> RobotLink:
        """Connects with the newest ticket."""
        self.world.clock.advance(0)
        ticket = self.world.control.take(link.OpenChannel)[-1].ticket
        self._robot = Robot(_Relay(self.world), "192.168.1.1")  # type: ignore[arg-type]  # all that it uses of a hall
        self._heard = []
        self.says(link.Join(version=1, ticket=ticket))
        return self

    def says(self, message: link.Message) -> None:
        """Sends a message."""
        self._robot.says(message)

    def sample(self, number: int, body: bytes, stamp: int = 1) -> None:
        """Sends a sample; the stamp is wall clock time in nanoseconds."""
        self._robot.sends(encode_sample(number, stamp, body))

    def asked(self, op: str, **fields: Any) -> list[dict[str, Any]]:
        """Messages of one op so far that have these fields."""
        self._heard += self._robot.received()
        return [
            each
            for each in self._heard
            if each["op"] == op and all(each.get(name) == value for name, value in fields.items())
        ]

    def subscribed(self, topic: str, type_name: str = STRING, **more: Any) -> int:
        """Confirms the newest subscription to a topic, and sends its type; returns the number."""
        number = int(self.asked("subscribe", topic=topic)[-1]["number"])
        self.says(link.Subscribed(number=number, topic=topic, type=type_name, encoding="cdr", **more))
        for asked in self.asked("get_type", type=type_name):
            self._heard.remove(asked)
            self.says(link.TypeDefinition(type=type_name, text=TEXTS[type_name]))
        return number

    def advertised(self, topic: str, type_name: str = STRING, *, motion: bool = False) -> None:
        """Confirms the publisher of a topic, and sends its type."""
        number = int(self.asked("advertise", topic=topic)[-1]["number"])
        for asked in self.asked("get_type", type=type_name):
            self._heard.remove(asked)
            self.says(link.TypeDefinition(type=type_name, text=TEXTS[type_name]))
        self.says(link.Advertised(number=number, topic=topic, type=type_name, encoding="cdr", motion=motion))

    def stalls(self) -> None:
        """The robot reads nothing, so that messages to it wait in the relay."""
        assert self._robot.transport.producer is not None
        self._robot.transport.producer.pauseProducing()

    def leaves(self) -> None:
        """The network loses the channel link."""
        self._robot.breaks()
