"""The robot's end of a channel link as bytes: what a test sends passes the relay's decoder and its role."""

from __future__ import annotations

from typing import Any

from relay_protocol import link
from relay_protocol.frames import encode_sample
from relay_server.http.connection_limits import ConnectionLimits
from relay_server.robots.connection import LinkTiming, RobotConnection, RobotFactory
from relay_server.robots.link_roles import HandshakeRole, RobotLinkContext
from tests.relay_server.edges.robot_ends import RELAY, Robot
from tests.relay_server.memory import STRING, TEXTS, World


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
            world.desks,
            unused,
            world.clock.seconds,
            world.clock.seconds,
        )
        cap = ConnectionLimits(3)
        self.factory = RobotFactory(
            lambda: RobotConnection(
                world.clock, world.now_ns, LinkTiming(2.0), lambda each: HandshakeRole(hall, each), cap
            )
        )


class RobotLink:
    """A robot that has joined its channel; it registers first if it is not online."""

    def __init__(self, world: World) -> None:
        self.world = world
        if world.robot.control is None:
            world.robot_comes()
        self._heard: list[dict[str, Any]] = []
        self._robot: Robot

    def joins(self) -> RobotLink:
        """Dial with the newest ticket."""
        self.world.clock.advance(0)
        ticket = self.world.control.take(link.OpenChannel)[-1].ticket
        self._robot = Robot(_Relay(self.world), "192.168.1.1")  # type: ignore[arg-type]  # all that it uses of a hall
        self._heard = []
        self.says(link.Join(version=1, ticket=ticket))
        return self

    def says(self, message: link.Message) -> None:
        """Send one message."""
        self._robot.says(message)

    def sample(self, number: int, body: bytes, stamp: int = 1) -> None:
        """Send one sample; the stamp is wall clock time in nanoseconds."""
        self._robot.sends(encode_sample(number, stamp, body))

    def asked(self, op: str, **fields: Any) -> list[dict[str, Any]]:
        """Messages of one op so far, those that have these fields."""
        self._heard += self._robot.hears()
        return [
            each
            for each in self._heard
            if each["op"] == op and all(each.get(name) == value for name, value in fields.items())
        ]

    def subscribed(self, topic: str, type_name: str = STRING, **more: Any) -> int:
        """Confirm the newest subscription to a topic, tell its type; the number."""
        number = int(self.asked("subscribe", topic=topic)[-1]["number"])
        self.says(link.Subscribed(number=number, topic=topic, type=type_name, encoding="cdr", **more))
        for asked in self.asked("get_type", type=type_name):
            self._heard.remove(asked)
            self.says(link.TypeDefinition(type=type_name, text=TEXTS[type_name]))
        return number

    def leaves(self) -> None:
        """The network loses the channel link."""
        self._robot.breaks()
