"""A relay's HTTP site on transports in memory, behind it a desk the test fills."""

from __future__ import annotations

import json
from collections import ChainMap
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from prometheus_client import CollectorRegistry
from twisted.internet.address import IPv4Address
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransportWithDisconnection

from relay_protocol.errors import NotFound, Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.auth.authenticator import TicketPurpose, TooManyTries
from relay_server.auth.origins import Origins
from relay_server.http.api import Api
from relay_server.http.connection_limits import ConnectionLimits
from relay_server.http.openapi.http import ApiDocuments
from relay_server.http.rate_limits import RequestLimits
from relay_server.http.site import Missing, RelaySite, RobotAddress, Root
from relay_server.http.static_files import Portal
from relay_server.http.update_sources import Sources
from relay_server.resources.robots_http import RobotResource
from relay_server.sessions.ports import Timing
from relay_server.ws.client import ClientFactory
from relay_server.ws.updates import UpdatesFactory, UpdatesGate
from relay_server.ws.upgrade import WebSocketUpgrade

ANN = Principal(1, "ann", "main", False, 1, None)
ROOT = Principal(2, "root", "default", True, 2, None)
HOST = "127.0.0.1:9090"
ORIGIN = f"http://{HOST}"


class MemoryDesk:
    """Knows the tokens ``ann`` and ``root`` and one robot."""

    timing = Timing(2.0, 0.1, 6.0)

    def __init__(self) -> None:
        self.tokens = {"ann": ANN, "root": ROOT}
        self.up = True
        self.listeners: list[Callable[[], None]] = []
        self.tickets: list[TicketPurpose] = []

    async def password(self, user: str, password: str, address: str) -> tuple[Principal, str]:
        """One password is right, one too many."""
        if password == "again":
            raise TooManyTries(59.5)
        if (user, password) != ("ann", "correct horse"):
            raise BadCredentials("user or password is wrong")
        return ANN, "ann"

    async def login_code(self, code: str, address: str) -> tuple[Principal, str]:
        """One code is right."""
        if code == "break":
            raise RuntimeError("the secret of our insides")
        if code != "once":
            raise BadCredentials("the login link is unknown")
        return ROOT, "root"

    async def token(self, token: str) -> Principal:
        """A token."""
        if not self.up:
            raise Unavailable("the database does not answer")
        if token not in self.tokens:
            raise BadCredentials("the access token is unknown")
        return self.tokens[token]

    async def urgent_token(self, token: str) -> Principal:
        """A token, as it was known before."""
        if token not in self.tokens:
            raise BadCredentials("the access token is unknown")
        return self.tokens[token]

    async def logout(self, principal: Principal) -> None:
        """End a session."""
        del self.tokens[principal.name]

    async def robots(self, principal: Principal) -> list[dict[str, Any]]:
        """One robot."""
        return [{"name": "rover", "seen by": principal.name}]

    async def issue_ticket(self, principal: Principal, opens: TicketPurpose) -> str:
        """A ticket for the one robot."""
        if opens.robot != "rover":
            raise NotFound("there is no such robot, or you have no right on it")
        self.tickets.append(opens)
        return f"ticket of {principal.name}"

    async def healthy(self) -> bool:
        """Whether the database answers."""
        return self.up

    def on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Follow changes."""
        self.listeners.append(listener)
        return lambda: self.listeners.remove(listener)

    def changed(self) -> None:
        """Something changed."""
        for listener in list(self.listeners):
            listener()


@dataclass
class Answer:
    """An HTTP answer."""

    status: int
    headers: dict[str, str]
    body: bytes
    cookies: list[str] = field(default_factory=list)

    @property
    def json(self) -> Any:
        """The body decoded."""
        return json.loads(self.body)


class Transport(StringTransportWithDisconnection):
    """TCP in memory, from one address."""

    def __init__(self) -> None:
        super().__init__(peerAddress=IPv4Address("TCP", "192.0.2.9", 50000))

    def loseConnection(self) -> None:
        """Close once."""
        self.disconnecting = True
        if self.connected:
            super().loseConnection()

    def abortConnection(self) -> None:
        """Close at once."""
        if self.connected:
            super().abortConnection()

    def setTcpNoDelay(self, on: bool) -> None:
        """As TCP."""


class AtOnce:
    """Threads that do things at once."""

    async def run(self, work: Callable[..., Any], *args: Any) -> Any:
        """Do it."""
        return work(*args)


def api_of(
    clock: Any,
    desk: Any,
    origins: Origins,
    below: dict[str, Any] | None = None,
    beside: dict[str, Any] | None = None,
    sources: Sources | None = None,
    *,
    tls: bool = False,
    limits: RequestLimits | None = None,
) -> Api:
    """The API in front of a desk."""
    return Api(
        clock,
        desk,
        origins,
        CollectorRegistry(),
        {} if below is None else below,
        {} if beside is None else beside,
        RobotResource(desk, cast(Any, AtOnce())),
        sources or Sources(clock, {}, lambda listener: lambda: None),
        cookie="sb",
        secure=tls,
        limits=limits,
    )


class World:
    """The site of a relay, and connections to it.

    :param clock: a reactor, for who listens on a real port
    :param rate: requests a second of one user or network; 0 for as many as come
    :param streams: streams that one user may have open; 0 for as many as come
    :param documented: whether it tells of the API
    """

    def __init__(
        self,
        folder: Path,
        tls: bool = False,
        clock: Any = None,
        *,
        rate: float = 0.0,
        streams: int = 0,
        documented: bool = False,
    ) -> None:
        self.clock: Any = clock or Clock()
        self.desk = MemoryDesk()
        self.cap = ConnectionLimits(4)
        origins = Origins("https" if tls else "http")
        self.below: dict[str, Any] = {}
        self.beside: dict[str, Any] = {}
        self.events: dict[str, Any] = {}
        limits = RequestLimits(rate, self.clock.seconds, streams)
        told = ChainMap(self.events, {"robots": self.desk.robots})
        sources = Sources(self.clock, told, self.desk.on_change)
        parts = self.below, self.beside, sources
        api = api_of(self.clock, self.desk, origins, *parts, tls=tls, limits=limits)
        websocket = WebSocketUpgrade(ClientFactory(self.clock, lambda: 0, self.desk, self.cap, limits))  # type: ignore[arg-type]
        self.pages = UpdatesGate(self.clock, self.desk, origins, "sb", sources)
        pages = WebSocketUpgrade(UpdatesFactory(self.clock, lambda: 0, self.pages, self.cap, limits))
        robots = RobotAddress(websocket, Missing(), "1.2.3")
        documents = ApiDocuments(limits, "1.2.3", "sb").app.resource() if documented else None
        root = Root(robots, api.app.resource(), Missing(), Portal(folder), pages, documents)
        self.site = RelaySite(root, self.clock, self.cap, tls, limits)

    def connect(self) -> Transport:
        """A connection."""
        transport = Transport()
        transport.protocol = self.site.buildProtocol(None)
        transport.protocol.makeConnection(transport)
        return transport

    def send(self, transport: Transport, data: bytes) -> None:
        """Bytes, if the connection is still there."""
        if transport.connected:
            transport.protocol.dataReceived(data)

    def ask(
        self, method: str, path: str, body: Any = None, raw: bytes | None = None, **headers: str
    ) -> Answer:
        """One request on a connection of its own, and its answer."""
        transport = self.connect()
        content = raw if raw is not None else b"" if body is None else json.dumps(body).encode()
        lines = {"Host": HOST, "Connection": "close"}
        if content:
            lines |= {"Content-Length": str(len(content)), "Content-Type": "application/json"}
        lines |= {name.replace("_", "-"): value for name, value in headers.items()}
        head = f"{method} {path} HTTP/1.1\r\n" + "".join(
            f"{name}: {value}\r\n" for name, value in lines.items()
        )
        self.send(transport, head.encode() + b"\r\n" + content)
        self.clock.advance(0)
        return parse(transport.value())


def parse(data: bytes) -> Answer:
    """An answer as it came over the wire."""
    head, _, body = data.partition(b"\r\n\r\n")
    first, *lines = head.decode().split("\r\n")
    pairs = [line.split(": ", 1) for line in lines]
    headers = {name.lower(): value for name, value in pairs}
    if headers.get("transfer-encoding") == "chunked":
        body = _unchunked(body)
    cookies = [value for name, value in pairs if name.lower() == "set-cookie"]
    return Answer(int(first.split()[1]), headers, body, cookies)


def _unchunked(data: bytes) -> bytes:
    body = b""
    while data:
        size, _, data = data.partition(b"\r\n")
        length = int(size, 16)
        body += data[:length]
        data = data[length + 2 :]
    return body
