"""A relay's HTTP site on transports in memory, with a backend of the test."""

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
from relay_server.common.freshness_tokens import FreshnessTokens
from relay_server.http.authentication import RequestAuthenticator
from relay_server.http.cross_origin import CrossOrigin
from relay_server.http.limits import ConnectionLimits, RequestLimits
from relay_server.http.live_updates import Sources
from relay_server.http.logins import LoginEndpoints
from relay_server.http.openapi.http import DocumentEndpoints
from relay_server.http.relay_status import StatusEndpoints
from relay_server.http.router import Router
from relay_server.http.site import Missing, RelaySite, RobotAddress, Root
from relay_server.http.static_files import Portal
from relay_server.resources.robots_http import RobotEndpoints, RobotService
from relay_server.sessions.ports import Timing
from relay_server.ws.connection import ClientFactory
from relay_server.ws.handshake import WebSocketUpgrade
from relay_server.ws.updates import UpdatesAuth, UpdatesFactory

ANN = Principal(1, "ann", "main", False, 1, None)
ROOT = Principal(2, "root", "default", True, 2, None)
HOST = "127.0.0.1:9090"
ORIGIN = f"http://{HOST}"


class MemoryAuth:
    """Has the tokens ``ann`` and ``root`` and one robot."""

    timing = Timing(2.0, 0.1, 6.0)

    def __init__(self) -> None:
        self.tokens = {"ann": ANN, "root": ROOT}
        self.up = True
        self.listeners: list[Callable[[], None]] = []
        self.tickets: list[TicketPurpose] = []

    async def password(self, user: str, password: str, address: str) -> tuple[Principal, str]:
        """One password is right, one is tried too often."""
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
        """The principal of a token."""
        if not self.up:
            raise Unavailable("the database does not answer")
        if token not in self.tokens:
            raise BadCredentials("the access token is unknown")
        return self.tokens[token]

    async def token_from_memory(self, token: str) -> Principal:
        """The cached principal of a token."""
        if token not in self.tokens:
            raise BadCredentials("the access token is unknown")
        return self.tokens[token]

    def remembers(self, token: str) -> bool:
        """All tokens are cached."""
        return token in self.tokens

    async def logout(self, principal: Principal) -> None:
        """Ends a session."""
        del self.tokens[principal.name]

    async def robots(self, principal: Principal) -> list[dict[str, Any]]:
        """One robot."""
        return [{"name": "rover", "seen by": principal.name}]

    async def people(self, principal: Principal, robot: str) -> dict[str, Any]:
        """The requesting user is the only one at the robot."""
        if robot != "rover":
            raise NotFound("there is no such robot, or you have no right on it")
        return {"robot": robot, "people": [{"user": principal.name}]}

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
        """Registers a listener."""
        self.listeners.append(listener)
        return lambda: self.listeners.remove(listener)

    def changed(self) -> None:
        """Notifies the listeners."""
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
        """The decoded body."""
        return json.loads(self.body)


class Transport(StringTransportWithDisconnection):
    """TCP in memory, from one address."""

    def __init__(self) -> None:
        super().__init__(peerAddress=IPv4Address("TCP", "192.0.2.9", 50000))

    def loseConnection(self) -> None:
        """Closes once."""
        self.disconnecting = True
        if self.connected:
            super().loseConnection()

    def abortConnection(self) -> None:
        """Closes at once."""
        if self.connected:
            super().abortConnection()

    def setTcpNoDelay(self, on: bool) -> None:
        """As TCP."""


class AtOnce:
    """Threads that run work at once."""

    async def run(self, work: Callable[..., Any], *args: Any) -> Any:
        """Runs it."""
        return work(*args)


def router_of(
    clock: Any,
    backend: Any,
    origins: Origins,
    tokens: FreshnessTokens,
    *,
    limits: RequestLimits | None = None,
    auth: Any = None,
) -> Router:
    """The API of a backend, which also authenticates by default."""
    auth = auth or backend
    limits = limits or RequestLimits(0.0, clock.seconds)
    router = Router(RequestAuthenticator(auth, origins, limits, cookie="sb"), tokens)
    # Tests replace the method.
    router.add(LoginEndpoints(auth), StatusEndpoints(lambda: backend.healthy(), CollectorRegistry()))
    return router


class World:
    """The site of a relay, and connections to it.

    :param clock: a reactor, to listen on a real port
    :param rate: requests per second of one user or network; 0 for unlimited
    :param streams: streams that one user may have open; 0 for unlimited
    :param documented: whether it has the OpenAPI document
    :param tokens: freshness tokens of endpoints
    :param listed: origins beside its own
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
        tokens: FreshnessTokens | None = None,
        listed: tuple[str, ...] = (),
    ) -> None:
        self.clock: Any = clock or Clock()
        self.service = MemoryAuth()
        self.cap = ConnectionLimits(4)
        origins = Origins("https" if tls else "http", listed)
        self.events: dict[str, Any] = {}
        limits = RequestLimits(rate, self.clock.seconds, streams)
        reported = ChainMap(self.events, {"robots": self.service.robots})
        sources = Sources(self.clock, reported, self.service.on_change)
        self.tokens = tokens or FreshnessTokens(lambda: 1)
        self.router = router_of(self.clock, self.service, origins, self.tokens, limits=limits)
        backend = cast(Any, self.service)
        self.router.add(
            RobotEndpoints(self.clock, RobotService(backend), backend, cast(Any, AtOnce()), sources)
        )
        websocket = WebSocketUpgrade(
            ClientFactory(self.clock, lambda: 0, self.service, self.service, self.cap, limits)
        )  # type: ignore[arg-type]
        self.pages = UpdatesAuth(
            self.clock, self.service, self.service.timing, origins, "sb", sources, cast(Any, None)
        )
        pages = WebSocketUpgrade(
            UpdatesFactory(self.clock, lambda: 0, self.pages, self.pages, self.cap, limits)
        )
        robots = RobotAddress(websocket, Missing(), "1.2.3")
        if documented:
            self.router.add(DocumentEndpoints("1.2.3", "sb"))
        root = Root(robots, self.router, Portal(folder), pages)
        remembers = self.router.authenticator.remembers
        self.site = RelaySite(root, self.clock, self.cap, tls, limits, remembers, CrossOrigin(origins))

    def connect(self) -> Transport:
        """A new connection."""
        transport = Transport()
        transport.protocol = self.site.buildProtocol(None)
        transport.protocol.makeConnection(transport)
        return transport

    def send(self, transport: Transport, data: bytes) -> None:
        """Sends bytes, if the connection is open."""
        if transport.connected:
            transport.protocol.dataReceived(data)

    def ask(
        self, method: str, path: str, body: Any = None, raw: bytes | None = None, **headers: str
    ) -> Answer:
        """A request on a new connection, and its answer."""
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
    """An answer parsed from its bytes."""
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
