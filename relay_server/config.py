"""Settings of one relay. Read once, by the composition root."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from relay_protocol import limits
from relay_protocol.errors import Invalid


@dataclass(frozen=True)
class ListenAddress:
    """Where to listen: a host (name or address) and a TCP port, 0 for any free one."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> ListenAddress:
        """``HOST:PORT``, with an IPv6 address in brackets.

        :raises Invalid: not of that form
        """
        try:
            parts = urlsplit("//" + text)
            port = parts.port
        except ValueError:
            port = None
            parts = urlsplit("//")
        if not parts.hostname or port is None or parts.path or parts.username:
            raise Invalid(f"'{text}' is no address to listen on; write HOST:PORT, as in 127.0.0.1:9090")
        return cls(parts.hostname, port)

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach it."""
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
    """What an operator can set of alerts.

    :param webhook_networks: private networks, and those of the machine itself, that messages may go to
    :param webhook_deny: further networks that messages may not go to
    :param apprise_schemes: beginnings of apprise's URLs that users may have messages sent by
    :param battery_low: charge, 0 to 1, at which an alert begins; 0 is never
    :param battery_critical: charge at which it becomes worse
    """

    webhook_networks: tuple[str, ...] = ()
    webhook_deny: tuple[str, ...] = ()
    apprise_schemes: tuple[str, ...] = ()
    battery_low: float = 0.2
    battery_critical: float = 0.1


@dataclass(frozen=True)
class RelaySettings:
    """What an operator can set.

    :param data: folder of the embedded database, the local socket and the pid file
    :param database: SQLAlchemy URL
    :param tls_cert: PEM chain; both it and ``tls_key``, or neither
    :param origins: further origins (``https://host[:port]``) whose pages may use cookies here
    :param heartbeat: seconds between pings on a robot link
    :param linger: seconds a channel stays open after its last client
    :param client_ping: seconds between pings to an idle client
    :param driving_ping: seconds between pings to a client that is driving
    :param stall_limit: seconds a client may take nothing before it is cut
    :param refresh: seconds between looks at the database's revision counter
    :param explicit_control: no command takes control of a robot: it is taken by asking for it
    :param control_grace: seconds who has control has to answer a request, before an owner may take over
    :param control_request: seconds who has control has to answer a request, before it lapses
    :param control_idle: seconds without a command that moves, after which control is free again
    :param recordings: bytes all recordings together may have
    :param recordings_reserve: bytes of the disk they leave free
    :param events_of_source: events that each source may have in the memory
    :param events_kept: seconds after which the memory lets an event go
    :param largest_message: bytes of the largest websocket message taken from a client that has logged in
    :param largest_sample: bytes of the largest sample taken from a robot
    :param requests: HTTP requests a second of one user, or of a network in which nobody is known; 0: as many as come
    :param answer_seconds: seconds in which a request by HTTP is answered; 0: no limit
    :param streams: streams that one user may have open; 0: as many as come
    :param alerts: what people are told of, and where that may go
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
    connections_per_address: int = 512
    recordings: int = 10 * 10**9
    recordings_reserve: int = 10**9
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
    alerts: AlertSettings = field(default_factory=AlertSettings)

    @property
    def tls(self) -> bool:
        """Whether both listeners speak TLS."""
        return self.tls_cert is not None

    @property
    def scheme(self) -> str:
        """``https`` with TLS, else ``http``."""
        return "https" if self.tls else "http"

    def url(self, port: int) -> str:
        """Where people go: the first origin that was listed, else where the relay listens.

        :param port: the one it listens on for HTTP
        """
        if self.origins:
            return self.origins[0].rstrip("/")
        host = self.http.host
        shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)  # noqa: S104
        return f"{self.scheme}://{shown}:{port}"

    @property
    def socket_path(self) -> Path:
        """The local socket the admin command line talks to."""
        return self.data / "relay.sock"
