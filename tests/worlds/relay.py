"""A relay's endpoints in memory: a robot's links, a client's websocket, and a world that joins them on a
Clock.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import msgspec
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol import limits, link
from relay_protocol.errors import Unavailable
from relay_protocol.link.motion import ControlOrder
from relay_protocol.rights import Grant, Level, Rules
from relay_server.access import Permit, Principal
from relay_server.channels.channel import Channel, Channels
from relay_server.cluster.homes import SingleHome
from relay_server.common.clock import PeriodicTimers
from relay_server.common.cpu_quota import UserQuotas
from relay_server.common.unfinished import UnfinishedBytes
from relay_server.control.controllers import Controllers
from relay_server.control.service import ControlService
from relay_server.control.types import ControlRules
from relay_server.events.bus import EventBus
from relay_server.modules.robot_modules import ModuleRegistry
from relay_server.modules.service import ModuleService
from relay_server.relay_node.node import RelayNode
from relay_server.robots.link_quality import UNKNOWN, LinkQuality
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.sessions.context import ClientContext
from relay_server.sessions.message_age import MessageAge
from relay_server.sessions.ports import ClientPort, Timing
from relay_server.sessions.presence import PresenceService
from relay_server.sessions.rosbridge_port import RosbridgePort
from relay_server.sessions.session import Session
from relay_server.sessions.websocket_port import WebsocketContext
from relay_server.video.streams import CameraStreams
from tests.worlds.control_audit import MemoryRecord

M = TypeVar("M", bound=link.Message)

STRING = "std_msgs/msg/String"
TWIST = "geometry_msgs/msg/Twist"
TRIGGER = "std_srvs/srv/Trigger"
ADD = "example_interfaces/srv/AddTwoInts"
FIBONACCI = "example_interfaces/action/Fibonacci"
TEXTS = {
    ADD: "int64 a\nint64 b\n---\nint64 sum\n",
    FIBONACCI: "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n",
    STRING: "string data\n",
    TWIST: "Vector3 linear\nVector3 angular\n"
    + "=" * 80
    + "\nMSG: geometry_msgs/msg/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n",
    TRIGGER: "---\nbool success\nstring message\n",
}
GRAPH = link.Graph(
    full=True,
    topics={
        "/chatter": link.Topic(types=[STRING], publishers=["/talker"], subscribers=["/logger"]),
        "/secret": link.Topic(types=[STRING], publishers=["/vault"]),
        "/cmd_vel": link.Topic(types=[TWIST], subscribers=["/base"]),
    },
    services={
        "/reset": link.Service(types=[TRIGGER], providers=["/base"]),
        "/vault/open": link.Service(types=[TRIGGER], providers=["/vault"]),
    },
    nodes={"/talker": {}, "/base": {}, "/logger": {}, "/vault": {}},
)
MOTION = link.Describe(host="shed", distro="jazzy", motion=link.MotionPolicy(types=[TWIST]))
TIMING = Timing(client_ping=2.0, driving_ping=0.1, stall_limit=5.0)


def text(words: str) -> bytes:
    """A std_msgs/String in CDR."""
    data = words.encode() + b"\x00"
    return b"\x00\x01\x00\x00" + len(data).to_bytes(4, "little") + data


def words(cdr: bytes) -> str:
    """The text of a std_msgs/String in CDR."""
    return cdr[8 : 8 + int.from_bytes(cdr[4:8], "little") - 1].decode()


def messages_in(frames: bytes) -> list[tuple[int, bytes]]:
    """First byte and payload of each websocket frame of a server."""
    found, at = [], 0
    while at < len(frames):
        first, length = frames[at], frames[at + 1]
        wide = {126: 2, 127: 8}.get(length, 0)
        at += 2 + wide
        length = int.from_bytes(frames[at - wide : at], "big") if wide else length
        payload = frames[at : at + length]
        assert len(payload) == length, "a frame is cut short"
        found.append((first, payload))
        at += length
    return found


class Time:
    """A clock of the test, in seconds."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


class MemoryLink:
    """A robot's link as the relay writes to it."""

    def __init__(self) -> None:
        self.said: list[link.Message] = []
        self.samples: list[tuple[int, int, bytes]] = []
        self.commands: list[tuple[int, int, int, bytes]] = []
        self.closed: str | None = None
        self.pings: list[Deferred[float]] = []
        self.full = False
        """Whether there is no room for what clients ask for, or answer at length."""
        self.obeys: Callable[[ControlOrder], None] | None = None
        """Carries out orders about motion."""
        self.has_no_type: Callable[[link.Failed], None] | None = None
        """Takes the answer of a robot that can't tell definitions."""

    def send(self, message: link.Message) -> None:
        """Stores it, after checking that a robot can read its JSON."""
        msgspec.json.decode(msgspec.json.encode(message))
        answered = isinstance(message, link.ServiceResponse | link.ActionResult) and message.result
        if self.full and (answered or isinstance(message, link.CallService | link.SendActionGoal)):
            raise Unavailable("no room")
        self.said.append(message)
        if self.obeys is not None and isinstance(message, ControlOrder):
            self.obeys(message)
        if self.has_no_type is not None and isinstance(message, link.GetType):
            self.has_no_type(link.Failed(request="get_type", reference=message.type, reason="small"))

    def message_sender(
        self, number: int, convert: Callable[[bytes], bytes] = bytes, *, commands: bool
    ) -> Callable[[int, int, bytes], None]:
        """A function that stores messages of one publication."""
        if commands:
            return lambda stamp, source, body: self.command(number, stamp, source, convert(body))
        return lambda stamp, source, body: self.sample(number, stamp, convert(body))

    def sample(self, number: int, stamp: int, body: bytes) -> None:
        """Stores it."""
        self.samples.append((number, stamp, body))

    def command(self, number: int, stamp: int, source: int, body: bytes) -> None:
        """Stores it, as a sample and with its source."""
        self.commands.append((number, stamp, source, body))
        self.sample(number, stamp, body)

    def send_newest(self, key: str, message: link.Message) -> None:
        """Stores it; links in memory are never slow."""
        self.send(message)

    def close(self, reason: str) -> None:
        """The relay closes the link."""
        self.closed = self.closed or reason

    def close_replaced(self, reason: str, answers: Callable[[], None]) -> None:
        """The relay closes the link; the test may answer."""
        self.close(reason)
        self.answers = answers

    def link_quality(self) -> LinkQuality:
        """The unknown quality."""
        return UNKNOWN

    def round_trip(self) -> Deferred[float]:
        """A ping the test answers."""
        self.pings.append(Deferred())
        return self.pings[-1]

    def all(self, kind: type[M]) -> list[M]:
        """Messages of one kind so far."""
        return [message for message in self.said if isinstance(message, kind)]

    def take(self, kind: type[M]) -> list[M]:
        """Messages of one kind, which are then removed."""
        found = self.all(kind)
        self.said = [message for message in self.said if not isinstance(message, kind)]
        return found


class MemoryClient:
    """A client's websocket as a session writes to it."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.pings: list[bytes] = []
        self.closed: tuple[int, str] | None = None
        self.unfinished = UnfinishedBytes(limits.UNFINISHED_MESSAGES * limits.CLIENT_MESSAGE).count(1)

    def send(self, frames: bytes) -> None:
        """Stores the frames' content; a closed websocket stores nothing."""
        assert self.closed is None, "sent after the close"
        self.sent += [payload for _, payload in messages_in(frames)]

    def ping(self, payload: bytes) -> None:
        """Stores it; the test answers."""
        assert self.closed is None, "pinged after the close"
        self.pings.append(payload)

    def close(self, code: int, reason: str, farewell: bytes | None = None) -> None:
        """The session disconnects the client."""
        assert self.closed is None, "closed twice"
        if farewell:
            self.send(farewell)
        self.closed = (code, reason)

    def take(self) -> list[dict[str, Any]]:
        """Received messages, decoded; they are then removed."""
        sent, self.sent = self.sent, []
        return [json.loads(each) for each in sent]


class Person:
    """A session with its client."""

    def __init__(self, rosbridge: RosbridgePort, client: MemoryClient) -> None:
        self.rosbridge = rosbridge
        self.session = rosbridge.session
        self.context = rosbridge.session.client
        self.client = client

    def says(self, op: str, **fields: Any) -> None:
        """Sends a rosbridge message."""
        self.rosbridge.message(json.dumps({"op": op, **fields}).encode())

    def received(self, op: str) -> list[dict[str, Any]]:
        """Received messages of one op; others are discarded."""
        return [message for message in self.client.take() if message["op"] == op]

    def reported(self) -> list[str]:
        """Texts of the received statuses; others are discarded."""
        return [message["msg"] for message in self.received("status")]

    def answers_pings(self) -> None:
        """Sends a pong for every ping."""
        pings, self.client.pings = self.client.pings, []
        for payload in pings:
            self.rosbridge.pong(payload)


class World:
    """One robot and its channel, on a clock of the test."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.clock.advance(1000)
        self.rounds = PeriodicTimers(self.clock)
        self.worked = 0.0
        self.budgets = UserQuotas(self.clock.seconds, lambda: self.worked)
        self.registry = RobotRegistry(lambda: 1.7e9 + self.clock.seconds())
        tickets = itertools.count(1)
        self.channels = Channels(
            self.clock,
            linger=5.0,
            new_ticket=lambda: f"ticket-{next(tickets)}",
            wall_ns=lambda: self.now_ns() + 10**18,
        )
        self.videos = CameraStreams(self.clock, new_ticket=lambda: f"ticket-{next(tickets)}")
        self.robot = self.registry.robot(1, "rover", "default")
        self.record = MemoryRecord()
        self.controllers = Controllers(
            self.clock,
            self.record,
            self.record,
            ControlRules(),
            self.registry.changed,
            lambda: 1.7e9 + self.clock.seconds(),
            self.now_ns,
        )
        self.control_service = ControlService(self.clock, self.controllers)
        self.modules = ModuleRegistry(self.clock, lambda: 1.7e9 + self.clock.seconds())
        no_database: Any = None
        self.bus = EventBus()
        self.module_service = ModuleService(
            self.modules,
            self.registry,
            no_database,
            self.bus,
            lambda: 1.7e9 + self.clock.seconds(),
            no_database,
            SingleHome(),
        )
        self.control = self.control_link()
        self.link = MemoryLink()
        self.people: list[ClientContext] = []
        self.presence = PresenceService(lambda robot_id: self.people, lambda robot: 0, self.clock.seconds)
        self._tokens = itertools.count(1)
        self._numbers = itertools.count(1)

    def now_ns(self) -> int:
        """The clock in nanoseconds."""
        return round(self.clock.seconds() * 1e9)

    def control_link(self) -> MemoryLink:
        """A control link of a robot that confirms motion orders at once."""
        made = MemoryLink()
        made.obeys = lambda order: self.controllers.of(self.robot).message_received(
            link.OrderResult(id=order.id)
        )
        return made

    @property
    def channel(self) -> Channel:
        """The robot's channel in its present state."""
        return self.channels.of(self.robot)

    def robot_comes(self, encodings: Iterable[str] = ("cdr", "json"), graph: link.Graph = GRAPH) -> None:
        """The robot registers and sends its graph."""
        self.robot.encodings = tuple(encodings)
        self.control = self.control_link()
        self.registry.registered(self.robot, self.control)
        self.robot.description = MOTION
        self.registry.graph(self.robot, graph)

    def robot_goes(self) -> None:
        """The control link ends."""
        self.registry.lost(self.robot, self.control)

    def robot_joins(self, *, tells_types: bool = False) -> MemoryLink:
        """The robot connects with its ticket.

        :param tells_types: for a JSON robot: whether the test itself answers for definitions
        """
        self.clock.advance(0)
        ticket = self.control.take(link.OpenChannel)[-1].ticket
        self.link = MemoryLink()
        if "cdr" not in self.robot.encodings and not tells_types:
            self.link.has_no_type = self.channel.message
        self.channels.redeem(ticket).joined(self.link)
        return self.link

    def define(self, *types: str) -> None:
        """The robot answers requests for definitions."""
        for asked in self.link.take(link.GetType):
            assert not types or asked.type in types
            self.channel.message(link.TypeDefinition(type=asked.type, text=TEXTS[asked.type]))

    def cdr(self, part: str, **fields: Any) -> str:
        """A body of a type that the robot has defined, in base64."""
        return link.to_base64(self.robot.types.from_json(part, fields, 0))

    def fields(self, part: str, cdr: str | None) -> Any:
        """The decoded fields of such a body."""
        assert cdr is not None
        return json.loads(self.robot.types.to_json(part, link.from_base64(cdr, "cdr")))

    def subscribed(self, number: int, type_name: str = STRING, encoding: str = "cdr", **more: Any) -> None:
        """The robot confirms a subscription."""
        self.channel.message(
            link.Subscribed(number=number, topic="/x", type=type_name, encoding=encoding, **more)
        )

    def person(
        self,
        level: Level = Level.OPERATOR,
        allow: tuple[str, ...] = (),
        deny: tuple[str, ...] = (),
        user: int = 7,
        name: str = "ann",
    ) -> Person:
        """A client with a right on the robot, in a started session."""
        permit = self.permit(level, allow, deny, user, name)
        client = MemoryClient()
        age = self.message_age()
        rosbridge = RosbridgePort(WebsocketContext(self.clock, client, age, TIMING, self.rounds))
        rosbridge.attach(self.session(permit, rosbridge, age))
        rosbridge.start()
        return Person(rosbridge, client)

    def permit(
        self,
        level: Level = Level.OPERATOR,
        allow: tuple[str, ...] = (),
        deny: tuple[str, ...] = (),
        user: int = 7,
        name: str = "ann",
    ) -> Permit:
        """A right on the robot."""
        principal = Principal(user, name, "default", False, next(self._tokens), None)
        return Permit(principal, 1, Rules([Grant(level, allow, deny)]))

    def message_age(self) -> MessageAge:
        """The message age of a client that connects now."""
        return MessageAge(self.now_ns, self.now_ns(), lambda: next(self._tokens).to_bytes(8, "big"))

    def session(self, permit: Permit, port: ClientPort, age: MessageAge) -> Session:
        """A session that answers to a port; it is not started."""
        context = ClientContext(
            clock=self.clock,
            number=next(self._numbers),
            address="192.0.2.7",
            since=1.7e9,
            permit=permit,
            robot=self.robot,
            channel=self.channel,
            controller=self.controllers.of(self.robot),
            port=port,
            age=age,
            user_quota=self.budgets.of(permit.principal.user_id),
        )
        node = RelayNode(
            lambda robot_id: self.people,
            self.videos,
            self.presence,
            self.control_service,
            self.module_service,
        )
        session = Session(context, self.clock, node, self.rounds, self.people.remove)
        self.people.append(context)
        return session

    def wait(self, seconds: float, *people: Person) -> None:
        """Lets time pass, while these clients answer their pings."""
        until = self.clock.seconds() + seconds
        while (left := until - self.clock.seconds()) > 0:
            self.clock.advance(min(left, 1.0))
            for person in people:
                person.answers_pings()

    def at_work(self) -> Person:
        """An operator that receives errors, with a robot that is online and joined."""
        self.robot_comes()
        person = self.person()
        self.robot_joins()
        person.says("set_level", level="error")
        return person

    def working(self) -> None:
        """The robot is online, has joined, and has sent all requested definitions."""
        self.robot_comes()
        self.robot_joins()
        self.define()


def fails(work: Any) -> str:
    """Starts a coroutine that must fail now; returns the text."""
    errors: list[BaseException] = []
    Deferred.fromCoroutine(work).addErrback(lambda failure: errors.append(failure.value))
    assert errors, "it has not failed"
    return str(errors[0])


async def hangs(*_: object, **__: object) -> None:
    """Replaces any request that is never answered, as by a locked database."""
    await Deferred()


__all__ = [
    "ADD", "FIBONACCI", "GRAPH", "MOTION", "STRING", "TEXTS", "TIMING", "TRIGGER", "TWIST", "MemoryClient",
    "MemoryLink", "Person", "RobotState", "Time", "Unavailable", "World", "fails", "hangs", "text", "words",
]  # fmt: skip
