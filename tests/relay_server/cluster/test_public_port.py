"""The port for clients ignores the headers by which relays forward authenticated clients."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest
from twisted.internet.address import IPv4Address
from twisted.internet.testing import MemoryReactorClock, StringTransport
from twisted.web.resource import Resource

from relay_server.cluster.forwarding import CLIENT_HEADER, CLUSTER_HEADER, ForwardedClient
from relay_server.http.limits import ConnectionLimits, RequestLimits, UncountedConnections
from relay_server.http.site import ClusterRoot, ClusterSite, Missing, RelaySite, RobotAddress, Root
from relay_server.ws.connection import ClientFactory
from relay_server.ws.handshake import WebSocketUpgrade

ADMIN = str(ForwardedClient("192.0.2.1", False, 1, "admin", "lab1", True, 0, None, None, None)).encode()
HEAD = (
    b"\r\nHost: a\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)
SECRET = "s" * 32


class LocalSocket(Resource):
    """Stands for the local socket."""

    isLeaf = True

    def render_GET(self, request: Any) -> bytes:
        return b"the local socket"


class Sessions:
    """Records admitted clients, and never answers unless it has an admission for them."""

    accepting = True

    def __init__(self, admission: Any = None) -> None:
        self.admitted: list[Any] = []
        self.released: list[Any] = []
        self._admission = admission

    async def admit(self, principal: Any, robot: str, address: str) -> Any:
        self.admitted.append((principal.name, robot, address))
        if self._admission is None:
            raise AssertionError("admitted")
        return self._admission

    def release(self, admission: Any) -> None:
        self.released.append(admission)


def admitted_by(head: bytes, *, cluster: bool) -> tuple[list[Any], bytes]:
    """The user that a request's head admits, and the first bytes of the answer.

    :param cluster: at the port for other relays, otherwise at the port for clients
    """
    sessions = Sessions()
    return sessions.admitted, answer_to(head, sessions, cluster=cluster)


def answer_to(head: bytes, sessions: Sessions, *, cluster: bool) -> bytes:
    """The first bytes of the answer to a request's head."""
    clock = MemoryReactorClock()
    limits = RequestLimits(0, clock.seconds)
    counted = ConnectionLimits(10)
    auth: Any = None
    factory = ClientFactory(clock, time.monotonic_ns, auth, sessions, counted, limits)
    root = Root(RobotAddress(WebSocketUpgrade(factory), Missing(), "1"), *[Missing() for _ in range(4)])
    site: RelaySite = RelaySite(root, clock, counted, False, limits)
    if cluster:
        site = ClusterSite(ClusterRoot(root, LocalSocket()), clock, UncountedConnections(), limits, SECRET)
    transport: Any = StringTransport(peerAddress=IPv4Address("TCP", "192.0.2.66", 1))
    transport.abortConnection = transport.getHandle = lambda: None
    transport.protocol = channel = site.buildProtocol(None)
    channel.makeConnection(transport)
    channel.dataReceived(head)
    clock.advance(0.1)
    return bytes(transport.value())


def test_a_client_whose_robot_has_moved_on_is_refused() -> None:
    """The relay that forwards it may not know yet. Here it would wait for the robot for ever."""
    admission = SimpleNamespace(robot=SimpleNamespace(elsewhere=True))
    sessions = Sessions(admission)
    head = b"GET /robots/rover HTTP/1.1" + HEAD + CLIENT_HEADER.encode() + b": " + ADMIN + b"\r\n"
    head += CLUSTER_HEADER.encode() + b": " + SECRET.encode() + b"\r\n\r\n"
    answer = answer_to(head, sessions, cluster=True)
    assert answer.startswith(b"HTTP/1.1 503 robot rover has connected to another relay; connect again")
    assert sessions.released == [admission]


@pytest.mark.parametrize(
    "target",
    [
        b"/robots/rover?a\xa0HTTP/1.1\x85%s:%s\x85X:",
        b"/robots/rover\xa0HTTP/1.1\x85%s:%s\x85X:",
        b"/robots/rover?a\x1cHTTP/1.1\x1d%s:%s\x1eX:",
        b"/robots/rover?%%0d%%0a%s:%s",
    ],
)
def test_a_target_that_holds_lines_is_no_header(target: bytes) -> None:
    name = CLIENT_HEADER.encode()
    admitted, _ = admitted_by(b"GET " + target % (name, ADMIN) + b" HTTP/1.1" + HEAD + b"\r\n", cluster=False)
    assert admitted == []


@pytest.mark.parametrize("secret", [None, b"x" * 32, SECRET.encode()])
@pytest.mark.parametrize("cluster", [False, True])
def test_only_the_port_for_relays_takes_a_client_and_only_with_the_secret(
    secret: bytes | None, cluster: bool
) -> None:
    head = b"GET /robots/rover HTTP/1.1" + HEAD + CLIENT_HEADER.encode() + b": " + ADMIN + b"\r\n"
    if secret is not None:
        head += CLUSTER_HEADER.encode() + b": " + secret + b"\r\n"
    admitted, answer = admitted_by(head + b"\r\n", cluster=cluster)
    let_in = cluster and secret == SECRET.encode()
    assert admitted == ([("admin", "rover", "192.0.2.1")] if let_in else []), answer


@pytest.mark.parametrize("byte", [b"\x00", b"\x1f", b" ", b"\x7f", b"\x80", b"\x85", b"\xa0", b"\xff"])
def test_a_target_has_only_bytes_of_a_uri(byte: bytes) -> None:
    _, answer = admitted_by(b"GET /robots/a" + byte + b"b HTTP/1.1" + HEAD + b"\r\n", cluster=False)
    assert answer.startswith(b"HTTP/1.1 400 ")


@pytest.mark.parametrize("cluster", [True, False])
@pytest.mark.parametrize("secret", [SECRET, "x" * 32])
@pytest.mark.parametrize(
    "path",
    [
        "/local/modules",
        "/local/pipes",
        "/local/stop",
        "/local/drain",
        "/local/modules/x",
        "/modules",
        "/local",
    ],
)
def test_relays_pass_on_only_requests_about_modules_and_pipes(path: str, secret: str, cluster: bool) -> None:
    head = f"GET {path} HTTP/1.1\r\nHost: a\r\n{CLIENT_HEADER}: {ADMIN.decode()}\r\n{CLUSTER_HEADER}: {secret}\r\n"
    answer = answer_to(head.encode() + b"\r\n", Sessions(), cluster=cluster)
    passed_on = cluster and secret == SECRET and path in ("/local/modules", "/local/pipes")
    assert (b"the local socket" in answer) == passed_on, answer
