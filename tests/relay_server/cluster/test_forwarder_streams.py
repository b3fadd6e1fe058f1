"""Streams of one relay at the listener of another, over real sockets."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor as twisted_reactor
from twisted.internet.defer import Deferred, gatherResults, maybeDeferred
from twisted.internet.endpoints import HostnameEndpoint, wrapClientTLS
from twisted.internet.protocol import Protocol
from twisted.internet.ssl import Certificate, optionsForClientTLS, trustRootFromCertificates
from twisted.web.resource import Resource

from relay_protocol.errors import Unavailable
from relay_server.access import Principal
from relay_server.cluster.forwarding import STOP_WATCH_SECONDS, ForwardedClient, Forwarder
from relay_server.cluster.relays import RelayInfo
from relay_server.config import ClusterSettings, ListenAddress
from relay_server.http.limits import RequestLimits, UncountedConnections
from relay_server.http.site import ClusterSite
from relay_server.listeners import ServerTls, listen
from tests.worlds.certificates import Authority

SECRET = "0123456789abcdef" * 2
CLIENT = ForwardedClient.of(Principal(1, "ann", "lab1", False, 2, None), "192.0.2.7")
BODY = b"x" * 300_000
reactor: Any = twisted_reactor


class Page(Resource):
    """A large answer with the address of the client."""

    isLeaf = True

    def render_GET(self, request: Any) -> bytes:
        return request.getClientAddress().host.encode() + BODY


class Reader(Protocol):
    """Sends one request, and reads the answer until the home closes the stream."""

    transport: Any

    def __init__(self, fields: dict[str, str]) -> None:
        self.answer = b""
        self.done: Deferred[bytes] = Deferred()
        self._fields = fields

    def connectionMade(self) -> None:
        head = "".join(f"{name}: {value}\r\n" for name, value in self._fields.items())
        self.transport.write(f"GET / HTTP/1.1\r\nHost: a\r\nConnection: close\r\n{head}\r\n".encode())

    def dataReceived(self, data: bytes) -> None:
        self.answer += data

    def connectionLost(self, reason: object = None) -> None:
        self.done.callback(self.answer)


class Counted(ClusterSite):
    """Counts TCP connections."""

    connections = 0

    def buildProtocol(self, addr: Any) -> Any:
        self.connections += 1
        return super().buildProtocol(addr)


class TrustingForwarder(Forwarder):
    """Trusts the authority of the tests."""

    authority: Path

    def endpoint(self, host: str, port: int) -> Any:
        endpoint = HostnameEndpoint(reactor, b"127.0.0.1", port)
        if not self._settings.tls:
            return endpoint
        root = trustRootFromCertificates([Certificate.loadPEM(self.authority.read_bytes())])
        return wrapClientTLS(optionsForClientTLS("localhost", root), endpoint)


class Home:
    """A relay's listener for other relays, and a forwarder of another relay."""

    def __init__(self, folder: Path, *, encrypted: bool = False) -> None:
        self._tls: ServerTls | None = None
        authority = Authority(folder, "authority")
        if encrypted:
            cert, key = folder / "cert.pem", folder / "key.pem"
            authority.certify(cert, key, name="localhost")
            self._tls = ServerTls(cert, key)
        limits = RequestLimits(0, reactor.seconds)
        self.site = Counted(Page(), reactor, UncountedConnections(), limits, SECRET)
        self._authority = authority.path

    async def start(self) -> RelayInfo:
        self._port = await listen(reactor, ListenAddress("127.0.0.1", 0), self.site, self._tls)
        return RelayInfo("home", "localhost", self._port.getHost().port, "1", 0.0)

    def forwarder(self, secret: str = SECRET) -> TrustingForwarder:
        address = ListenAddress("127.0.0.1", 0)
        settings = ClusterSettings((), address, "localhost", secret, self._tls is not None)
        forwarder = TrustingForwarder(reactor, settings)
        forwarder.authority = self._authority
        return forwarder

    async def stop(self) -> None:
        await maybeDeferred(self._port.stopListening)


@pytest.mark.parametrize("encrypted", [False, True])
@pytest_twisted.ensureDeferred
async def test_many_streams_share_one_connection(encrypted: bool, tmp_path: Path) -> None:
    """Each is a connection of the listener's site. Those that come while it is being opened share it too."""
    home = Home(tmp_path, encrypted=encrypted)
    relay = await home.start()
    forwarder = home.forwarder()
    readers = [Reader(forwarder.headers(CLIENT)) for _ in range(20)]
    await gatherResults([Deferred.fromCoroutine(forwarder.open_stream(relay, each)) for each in readers])
    answers = await gatherResults([each.done for each in readers])
    bodies = [answer.partition(b"\r\n\r\n")[2] for answer in answers]
    assert bodies == [b"192.0.2.7" + BODY] * 20
    assert home.site.connections == 1 + len(readers)
    (shared,) = forwarder._shared.values()
    gone: Deferred[None] = Deferred()
    forget = shared.on_lost
    shared.on_lost = lambda: (forget(), gone.callback(None))
    await forwarder.close()
    await gone
    assert forwarder._shared == {}
    await home.stop()


@pytest_twisted.ensureDeferred
async def test_a_relay_that_does_not_accept_is_explained(tmp_path: Path) -> None:
    """To all that wait, and the next stream tries again."""
    home = Home(tmp_path)
    relay = await home.start()
    stranger = home.forwarder("another secret of the same length")
    for _ in range(2):
        waiting = [Deferred.fromCoroutine(stranger.open_stream(relay, Reader({}))) for _ in range(2)]
        for each in waiting:
            with pytest.raises(Unavailable, match="answered 403 to a request for a shared connection"):
                await each
    await home.stop()
    with pytest.raises(Unavailable, match="does not answer"):
        await home.forwarder().open_stream(relay, Reader({}))


@pytest_twisted.ensureDeferred
async def test_a_host_that_answers_no_connection_is_given_up_as_soon_as_it_is_noticed() -> None:
    """Its queue of connections is full, so the kernel drops more. A stop is stored only after this very error."""
    with ExitStack() as stack:
        server = stack.enter_context(socket.socket())
        server.bind(("127.0.0.1", 0))
        server.listen(0)
        for _ in range(3):
            filling = stack.enter_context(socket.socket())
            filling.setblocking(False)
            filling.connect_ex(server.getsockname())
        settings = ClusterSettings((), ListenAddress.parse("127.0.0.1:0"), "localhost", SECRET)
        forwarder = Forwarder(reactor, settings)
        relay = RelayInfo("two", "127.0.0.1", server.getsockname()[1], "1", 0.0)
        asking = forwarder.ask_lines("/", b"", relay, CLIENT, "", lambda line: None, STOP_WATCH_SECONDS)
        with pytest.raises(Unavailable, match="was lost"):
            await asking
        await forwarder.close()
