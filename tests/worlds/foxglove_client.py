"""Foxglove clients: real websocket bytes, from the handshake on, to the relay of
:class:`tests.worlds.relay.World`.
"""

from __future__ import annotations

import json
import struct
from typing import Any, NamedTuple

from websockets.frames import Opcode

from relay_protocol.errors import NotFound
from relay_protocol.rights import Level
from relay_server.access import BadCredentials, Permit, Principal
from relay_server.auth.authenticator import TicketPurpose
from relay_server.foxglove.assets import asset_budget
from relay_server.foxglove.port import FoxglovePort
from relay_server.sessions.rosbridge_port import RosbridgePort
from relay_server.sessions.websocket_port import WebsocketContext
from tests.worlds.relay import TIMING, World
from tests.worlds.websocket_client import Client

SDK, LEGACY = "foxglove.sdk.v1", "foxglove.websocket.v1"


class WorldGate:
    """Accepts tokens of the form ``token-NAME``, and opens sessions on the robot of a world."""

    def __init__(self, world: World) -> None:
        self.accepting = True
        self.world = world
        self.permits: dict[str, Permit] = {}
        self.asset_budget = asset_budget()

    def person(self, name: str, level: Level, **rights: Any) -> Permit:
        """A user with a right on the robot."""
        permit = self.permits[name] = self.world.permit(
            level, name=name, user=len(self.permits) + 1, **rights
        )
        return permit

    async def bearer(self, token: str) -> Principal:
        """An access token."""
        permit = self.permits.get(token.removeprefix("token-"))
        if permit is None:
            raise BadCredentials("the access token is unknown, expired or revoked")
        return permit.principal

    async def ticket(self, ticket: str, purpose: TicketPurpose) -> Principal:
        """A ticket in the form of a token."""
        return await self.bearer(ticket)

    async def cookie(self, header: str, origin: str | None, host: str) -> Principal | None:
        """A session cookie; there are none."""
        return None

    async def admit(self, principal: Principal, robot: str, address: str) -> Any:
        """The right of a principal."""
        if robot != "rover":
            raise NotFound("there is no such robot, or you have no right on it")
        return self.permits[principal.name]

    def open(self, admission: Any, transport: Any, opened_ns: int) -> RosbridgePort:
        """A session of rosbridge."""
        world, age = self.world, self.world.message_age()
        client = RosbridgePort(WebsocketContext(world.clock, transport, age, TIMING, world.rounds))
        client.attach(world.session(admission, client, age))
        return client

    def open_foxglove(self, admission: Any, transport: Any, opened_ns: int, options: Any) -> FoxglovePort:
        """A session of Foxglove."""
        world, age = self.world, self.world.message_age()
        client = FoxglovePort(
            WebsocketContext(world.clock, transport, age, TIMING, world.rounds),
            "run",
            options,
            self.asset_budget,
        )
        client.attach(world.session(admission, client, age))
        return client

    def release(self, admission: Any) -> None:
        """The client left before."""


class Sample(NamedTuple):
    """A binary message of a channel."""

    subscription: int
    time_ns: int
    body: bytes


class Foxglove(Client):
    """A Foxglove client of one user."""

    def __init__(self, gate: WorldGate, name: str = "ann", protocol: str = SDK, **headers: str) -> None:
        credentials = {"Authorization": f"Bearer token-{name}"} if name else {}
        super().__init__(gate, clock=gate.world.clock, subprotocol=protocol, **credentials, **headers)
        self._taken = 0

    @property
    def _messages(self) -> list[tuple[Opcode, bytes]]:
        """Complete messages so far; the relay sends long ones in several frames."""
        found: list[tuple[Opcode, bytes]] = []
        kind, parts = Opcode.TEXT, list[bytes]()
        for frame in self.frames:
            if frame.opcode not in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                continue
            if frame.opcode is not Opcode.CONT:
                kind = frame.opcode
            parts.append(bytes(frame.data))
            if frame.fin:
                found.append((kind, b"".join(parts)))
                parts = []
        return found

    def take(self) -> list[dict[str, Any] | bytes]:
        """Messages since the last call, JSON decoded."""
        self.run()
        messages = self._messages
        fresh, self._taken = messages[self._taken :], len(messages)
        return [json.loads(data) if kind is Opcode.TEXT else data for kind, data in fresh]

    def took(self, op: str) -> list[dict[str, Any]]:
        """Messages of one op since the last call; others are discarded."""
        return [each for each in self.take() if isinstance(each, dict) and each["op"] == op]

    def statuses(self) -> list[str]:
        """Texts of the statuses since the last call; others are discarded."""
        return [each["message"] for each in self.took("status")]

    def samples(self) -> list[Sample]:
        """Messages of channels since the last call; others are discarded."""
        found = [each for each in self.take() if isinstance(each, bytes) and each[0] == 1]
        return [Sample(*struct.unpack_from("<IQ", each, 1), each[13:]) for each in found]

    def sends(self, op: str, **fields: Any) -> None:
        """Sends a JSON message."""
        self.says(json.dumps({"op": op, **fields}))

    def sends_binary(self, payload: bytes) -> None:
        """Sends a binary message."""
        self.core.send_binary(payload)
        self.run()

    def publishes(self, channel: int, payload: bytes) -> None:
        """Sends a message on a channel of the client."""
        self.sends_binary(struct.pack("<BI", 1, channel) + payload)

    def channels(self) -> dict[str, dict[str, Any]]:
        """Channels advertised since the last call, by topic; others are discarded."""
        return {each["topic"]: each for message in self.took("advertise") for each in message["channels"]}


class FoxgloveWorld(World):
    """A robot that has joined and has sent its definitions, and clients that speak Foxglove."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = WorldGate(self)

    def client(self, level: Level = Level.OPERATOR, name: str = "ann", **rights: Any) -> Foxglove:
        """A client of a new user."""
        self.gate.person(name, level, **rights)
        return Foxglove(self.gate, name)

    def settle(self, *clients: Foxglove) -> None:
        """The robot answers requests for definitions."""
        self.robot_joins()
        self.answer(*clients)

    def answer(self, *clients: Foxglove) -> None:
        """Sends definitions until no more are requested."""
        for _ in range(10):
            self.define()
            self.clock.advance(0)
        for each in clients:
            each.run()


def twist(x: float) -> bytes:
    """A geometry_msgs/Twist in CDR."""
    return b"\x00\x01\x00\x00" + struct.pack("<6d", x, 0, 0, 0, 0, 0)
