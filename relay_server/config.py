"""Settings of one relay. The composition root reads them once."""

from __future__ import annotations

import ipaddress
import os
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from relay_protocol import limits
from relay_protocol.errors import Invalid
from relay_server.common.data_dir import SOCKET_NAME


@dataclass(frozen=True)
class ListenAddress:
    """Where to listen: a host (name or address) and a TCP port; port 0 takes any free one."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> ListenAddress:
        """Parse ``HOST:PORT``, with an IPv6 address in brackets.

        :raises Invalid: it does not have that form
        """
        try:
            parts = urlsplit("//" + text)
            port = parts.port
        except ValueError:
            port = None
            parts = urlsplit("//")
        if not parts.hostname or port is None or parts.path or parts.username:
            raise Invalid(f"'{text}' is not an address to listen on; write HOST:PORT, as in 127.0.0.1:9090")
        return cls(parts.hostname, port)

    @property
    def loopback(self) -> bool:
        """Whether only this machine can connect to it."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


@dataclass(frozen=True)
class AlertSettings:
    """Settings of alerts.

    :param webhook_networks: private or local networks that messages may be sent to
    :param webhook_deny: further networks that messages must not be sent to
    :param apprise_schemes: schemes of Apprise URLs that users may have messages sent by
    :param battery_low: charge, 0 to 1, at which a warning begins; 0 switches it off
    :param battery_critical: charge, 0 to 1, at which it becomes an error
    """

    webhook_networks: tuple[str, ...] = ()
    webhook_deny: tuple[str, ...] = ()
    apprise_schemes: tuple[str, ...] = ()
    battery_low: float = 0.2
    battery_critical: float = 0.1


@dataclass(frozen=True)
class OffloadSettings:
    """Settings of functions.

    :param processes: calls that run at a time
    :param folder: of further functions: ``*.py``
    :param robots: patterns of the functions that robots may run
    :param scheduler: address of a Dask scheduler whose workers run the calls; empty: this machine does
    :param tls: files of the scheduler's CA, of the relay's certificate and of its key
    """

    processes: int = field(default_factory=lambda: max(1, min(4, os.cpu_count() or 1)))
    folder: Path | None = None
    robots: tuple[str, ...] = ("*",)
    scheduler: str = ""
    tls: tuple[str, str, str] = ("", "", "")


@dataclass(frozen=True)
class FileSettings:
    """Settings of the files of robots. Sizes are bytes.

    :param robot: files of one robot
    :param realm: files of all robots of a realm
    :param relay: files of all robots
    :param reserve: what stays free on the relay's disk
    :param storage: URL of an S3-compatible storage; empty: the data folder
    """

    robot: int = 10 * 10**9
    realm: int = 50 * 10**9
    relay: int = 100 * 10**9
    reserve: int = 10**9
    storage: str = ""


@dataclass(frozen=True)
class ClusterSettings:
    """Settings of a relay that is one of a cluster.

    :param bus: addresses of NATS servers
    :param listen: where the other relays connect
    :param host: the name or address at which they reach this relay
    :param secret: that all relays of the cluster have
    :param tls: whether the listener uses TLS, with the relay's certificate
    :param group: relays of one group have the same address, so robots can't choose between them; empty: none
    """

    bus: tuple[str, ...]
    listen: ListenAddress
    host: str
    secret: str = field(repr=False)
    tls: bool = False
    group: str = ""


@dataclass(frozen=True)
class WorkerSettings:
    """Settings of a worker, from the process that starts all workers; see :mod:`relay_server.cluster.workers`.

    :param number: from 1
    :param count: of workers
    :param http: descriptor of the listening socket for clients
    :param robots: the same for robots
    :param group: of :class:`ClusterSettings`
    :param name: of the relay
    :param parent: id of the process that starts them
    """

    number: int
    count: int
    http: int
    robots: int
    group: str
    name: str
    parent: int


@dataclass(frozen=True)
class RelaySettings:
    """Settings of the relay.

    :param data: folder of the embedded database, the local socket and the pid file
    :param database: SQLAlchemy URL
    :param tls_cert: PEM chain; given together with ``tls_key`` or not at all
    :param origins: further origins (``https://host[:port]``) whose pages may use cookies here
    :param heartbeat: seconds between pings on a robot link
    :param linger: seconds a channel stays open after its last client
    :param client_ping: seconds between pings to an idle client
    :param driving_ping: seconds between pings to a client that is driving
    :param stall_limit: seconds a client may take nothing before it is cut
    :param refresh: seconds between looks at the database's revision counter
    :param files: settings of the files of robots
    :param explicit_control: no command takes control of a robot; a client has to ask for it
    :param control_grace: seconds a holder of control has to answer a request, before an owner may take over
    :param control_request: seconds a holder of control has to answer a request, before it lapses
    :param control_idle: seconds without a command that moves the robot, after which control is released
    :param recordings: bytes of all recordings together
    :param recordings_reserve: bytes of the disk that recordings leave free
    :param events_of_source: events stored of each source
    :param events_kept: seconds for which events are stored
    :param largest_message: bytes of the largest websocket message accepted from a client that has logged in
    :param largest_sample: bytes of the largest sample accepted from a robot
    :param requests: HTTP requests per second of one user, or of a network of unauthenticated clients; 0
        for no limit
    :param answer_seconds: seconds in which an HTTP request is answered; 0 for no limit
    :param streams: streams that one user may have open; 0 for no limit
    :param connections: that one network may have open, of clients and of robots each; 0 for no limit
    :param alerts: settings of alerts
    :param cluster: settings of a cluster; ``None``: this is the only relay
    :param offload: settings of functions
    :param worker: what it is as a worker; ``None``: it opens its ports itself
    """

    data: Path
    database: str
    http: ListenAddress
    robots: ListenAddress
    tls_cert: Path | None = None
    tls_key: Path | None = None
    origins: tuple[str, ...] = field(default=())
    name: str = ""
    heartbeat: float = limits.HEARTBEAT_SECONDS
    linger: float = limits.LINGER_SECONDS
    client_ping: float = 2.0
    driving_ping: float = 0.1
    stall_limit: float = 5.0
    refresh: float = 0.25
    recordings: int = 10 * 10**9
    recordings_reserve: int = 10**9
    files: FileSettings = field(default_factory=FileSettings)
    explicit_control: bool = False
    control_grace: float = 30.0
    control_request: float = 60.0
    control_idle: float = 600.0
    events_of_source: int = 10_000
    events_kept: float = 30 * 86400.0
    largest_message: int = limits.CLIENT_MESSAGE
    largest_sample: int = limits.ROBOT_SAMPLE
    requests: float = 500.0
    answer_seconds: float = 10.0
    streams: int = 128
    connections: int = 512
    alerts: AlertSettings = field(default_factory=AlertSettings)
    cluster: ClusterSettings | None = None
    offload: OffloadSettings = field(default_factory=OffloadSettings)
    worker: WorkerSettings | None = None

    @property
    def tls(self) -> bool:
        """Whether both listeners use TLS."""
        return self.tls_cert is not None

    @property
    def scheme(self) -> str:
        return "https" if self.tls else "http"

    def url(self, port: int) -> str:
        """The portal's address: the first listed origin, otherwise the address the relay listens on.

        :param port: of HTTP
        """
        if self.origins:
            return self.origins[0].rstrip("/")
        host = self.http.host
        shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)  # noqa: S104
        return f"{self.scheme}://{shown}:{port}"

    @property
    def robots_host(self) -> str:
        """The host that robots dial, or empty: that of the portal's address, otherwise that of a relay on loopback."""
        if self.origins:
            return urlsplit(self.origins[0]).hostname or ""
        return self.robots.host if self.robots.loopback else ""

    @property
    def robots_tls(self) -> bool:
        """Whether robots dial with TLS. A proxy that ends it for browsers does so for robots."""
        return self.tls or (bool(self.origins) and self.origins[0].lower().startswith("https:"))

    @property
    def socket_path(self) -> Path:
        """The local socket for the command line."""
        return self.data / SOCKET_NAME
