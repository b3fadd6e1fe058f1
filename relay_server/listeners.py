"""The listeners for robots and clients, and their TLS (1.2 and newer), reloaded without closing connections."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cryptography import x509
from OpenSSL import SSL
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from twisted.internet.defer import DeferredList, maybeDeferred
from twisted.internet.endpoints import (
    SSL4ServerEndpoint,
    TCP4ServerEndpoint,
    TCP6ServerEndpoint,
    UNIXServerEndpoint,
)
from twisted.internet.interfaces import IOpenSSLServerConnectionCreator
from twisted.internet.task import deferLater
from twisted.logger import Logger
from twisted.protocols.tls import TLSMemoryBIOFactory
from twisted.web.server import Site
from zope.interface import implementer

from relay_protocol.errors import Invalid
from relay_server.common.data_dir import DataDir
from relay_server.config import ListenAddress, RelaySettings

FLUSH_SECONDS = 0.2
"""Seconds after the last port is closed in which bytes that were just written can leave the process."""


BACKLOG = 1024
"""Connections that wait to be accepted: when a relay has died, the robots and clients of all of it come at once."""


class Listeners:
    """Opens and closes the ports of a relay.

    :param reactor: Twisted's
    :ivar http_port: TCP port of HTTP and websockets; 0 until it listens
    :ivar robots_port: TCP port that robots dial; 0 until it listens
    :ivar tls: of all ports; ``None``: without TLS
    :raises Invalid: the TLS certificate can't be used
    """

    log = Logger()

    def __init__(self, reactor: Any, settings: RelaySettings, data_dir: DataDir) -> None:
        self.http_port = 0
        self.robots_port = 0
        self._reactor = reactor
        self._settings = settings
        self._data_dir = data_dir
        self._ports: list[Any] = []
        self.tls = (
            ServerTls(settings.tls_cert, settings.tls_key) if settings.tls_cert and settings.tls_key else None
        )

    async def open(self, http: Any, robots: Any, admin: Any) -> None:
        """Listen on everything.

        :param http: factory of HTTP and websocket connections
        :param robots: factory of robots' connections
        :param admin: web resource of the local socket
        :raises CannotListenError: an address is taken
        :raises Invalid: the local socket can't be replaced
        """
        settings, worker = self._settings, self._settings.worker
        http_fd, robots_fd = (None, None) if worker is None else (worker.http, worker.robots)
        self.http_port = (await self._listen(settings.http, http, http_fd)).getHost().port
        self.robots_port = (await self._listen(settings.robots, robots, robots_fd)).getHost().port
        await self._listen_locally(admin)
        if self.tls is None and not (settings.http.loopback and settings.robots.loopback):
            self.log.warn(
                "without --tls-cert and --tls-key, passwords and commands cross the network unencrypted"
            )

    async def close(self) -> None:
        """Accept no more connections."""
        ports = [maybeDeferred(port.stopListening) for port in self._ports]
        await DeferredList(ports, consumeErrors=True)
        await deferLater(self._reactor, FLUSH_SECONDS)

    def reload_tls(self) -> None:
        """Read the certificate again. If that fails, the error is logged and the old one stays in use."""
        if self.tls is None:
            return
        try:
            self.tls.reload()
        except Invalid as error:
            self.log.error("{reason}; the old certificate stays in use", reason=str(error))
        else:
            self.log.info("the TLS certificate was read again")

    async def _listen(self, where: ListenAddress, factory: Any, opened: int | None) -> Any:
        if opened is None:
            port = await listen(self._reactor, where, factory, self.tls)
        else:
            port = adopt(self._reactor, opened, factory, self.tls)
        self._ports.append(port)
        return port

    async def _listen_locally(self, resource: Any) -> None:
        site = Site(resource, reactor=self._reactor)
        site.log = lambda request: None
        path = self._settings.socket_path
        self._data_dir.clear_socket(path)
        endpoint = UNIXServerEndpoint(self._reactor, str(path), mode=0o600)
        self._ports.append(await endpoint.listen(site))


@implementer(IOpenSSLServerConnectionCreator)
class ServerTls(Collector):
    """Makes TLS connections for Twisted; its certificate can be read again while it serves.

    :param cert: PEM file with the chain, the relay's own certificate first
    :param key: PEM file with its private key
    :raises Invalid: a file can't be read, or the key is not the certificate's
    """

    def __init__(self, cert: Path, key: Path) -> None:
        self._cert = cert
        self._key = key
        self._context = self._read()

    def serverConnectionForTLS(self, protocol: Any) -> SSL.Connection:
        """A connection with the certificate as it was last read."""
        return SSL.Connection(self._context, None)

    def collect(self) -> Iterator[Metric]:
        """See ``Collector``."""
        what = "When the TLS certificate in use ends, Unix seconds"
        yield GaugeMetricFamily("switchboard_certificate_expires_seconds", what, self._expires)

    def reload(self) -> None:
        """Read the files again; open connections keep the old certificate.

        :raises Invalid: as at the start; the old certificate then stays in use
        """
        self._context = self._read()

    def _read(self) -> SSL.Context:
        context = SSL.Context(SSL.TLS_SERVER_METHOD)
        context.set_min_proto_version(SSL.TLS1_2_VERSION)
        context.set_options(SSL.OP_NO_COMPRESSION | SSL.OP_NO_RENEGOTIATION)
        try:
            context.use_certificate_chain_file(str(self._cert))
            context.use_privatekey_file(str(self._key))
            context.check_privatekey()
            # The first certificate of the file is the relay's own.
            own = x509.load_pem_x509_certificate(self._cert.read_bytes())
        except (SSL.Error, OSError, ValueError):
            raise Invalid(
                f"the TLS certificate {self._cert.name} with the key {self._key.name} can't be used: "
                "both must be readable PEM files that belong together"
            ) from None
        self._expires = own.not_valid_after_utc.timestamp()
        return context


def adopt(reactor: Any, opened: int, factory: Any, tls: ServerTls | None) -> Any:
    """Listen by a socket that another process has opened; returns Twisted's port.

    :param opened: descriptor of the listening socket, which is closed
    """
    with socket.socket(fileno=opened) as listener:
        listener.setblocking(False)
        context: Any = tls
        served = factory if tls is None else TLSMemoryBIOFactory(context, False, factory)
        return reactor.adoptStreamPort(listener.fileno(), listener.family, served)


async def listen(reactor: Any, where: ListenAddress, factory: Any, tls: ServerTls | None) -> Any:
    """Listen on an address; returns Twisted's port.

    :raises CannotListenError: the address is taken
    """
    kind: Any = TCP6ServerEndpoint if ":" in where.host else TCP4ServerEndpoint
    endpoint: Any = kind(reactor, where.port, BACKLOG, where.host)
    if tls is not None:
        endpoint = SSL4ServerEndpoint(reactor, where.port, tls, BACKLOG, where.host)
    return await endpoint.listen(factory)
