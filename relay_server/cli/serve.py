"""``switchboard serve``, ``switchboard demo`` and ``switchboard db``."""

from __future__ import annotations

import shlex
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click

from relay_db import schema
from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.limits import CLIENT_MESSAGE, LABEL_LENGTH, MAX_SAMPLE, MIB, MIN_SAMPLE, ROBOT_SAMPLE
from relay_protocol.text import is_printable
from relay_server import logs, run
from relay_server.cli.app import App, examples, json_option, pass_app
from relay_server.cli.output import print_result
from relay_server.cluster import workers
from relay_server.common.data_dir import copy_data
from relay_server.config import (
    AlertSettings,
    ClusterSettings,
    FileSettings,
    ListenAddress,
    OffloadSettings,
    RelaySettings,
)
from relay_server.relay import Relay

DAY = 86400.0
YEARS = 3650
"""Longest time that events are stored, days."""

SECRET_LENGTH = 32
MOST_REQUESTS = 1_000_000
MOST_HEARTBEAT = 60.0
MOST_GB = 1e9
MOST_PROCESSES = 256


@dataclass(frozen=True, kw_only=True)
class ServeOptions:
    """The options of ``serve``, with the names and units of the command line."""

    data: Path | None
    http: str
    robots: str
    tls_cert: Path | None
    tls_key: Path | None
    origins: tuple[str, ...]
    name: str
    heartbeat: float
    recordings_gb: float
    recordings_reserve_gb: float
    files_per_robot_gb: float
    files_per_realm_gb: float
    files_gb: float
    files_reserve_gb: float
    files_storage: str
    events_per_source: int
    events_days: float
    explicit_control: bool
    control_grace: float
    control_request: float
    control_idle: float
    webhook_networks: str
    webhook_deny: str
    apprise_schemes: str
    battery_low: float
    battery_critical: float
    requests_per_second: float
    answer_seconds: float
    streams_per_user: int
    connections_per_network: int
    largest_message_mb: float
    largest_sample_mb: int
    offload_processes: int | None
    offload_folder: Path | None
    offload_robots: str
    offload_scheduler: str
    offload_tls: tuple[str, str, str]
    cluster_bus: str
    cluster_listen: str
    cluster_host: str
    cluster_secret: Path | None
    workers: int
    log_json: bool
    debug: bool

    def check(self) -> None:
        """:raises Invalid: a value is out of range, or two options contradict each other"""
        if (self.tls_cert is None) != (self.tls_key is None):
            raise Invalid("--tls-cert and --tls-key go together")
        if not 0 < self.heartbeat <= MOST_HEARTBEAT:
            raise Invalid(f"--heartbeat must be more than 0 and at most {MOST_HEARTBEAT:g} s")
        if not (0 <= self.recordings_gb <= MOST_GB and 0 <= self.recordings_reserve_gb <= MOST_GB):
            raise Invalid(f"--recordings-gb and --recordings-reserve-gb must be from 0 to {MOST_GB:g}")
        sizes = (self.files_per_robot_gb, self.files_per_realm_gb, self.files_gb, self.files_reserve_gb)
        if not all(0 <= each <= MOST_GB for each in sizes):
            raise Invalid(f"the options --files-… in gigabytes must be from 0 to {MOST_GB:g}")
        if len(self.name) > LABEL_LENGTH or not is_printable(self.name):
            raise Invalid(
                f"--name must be one printable line of at most {LABEL_LENGTH} characters, without U+FFFD"
            )
        if not 0 < self.events_days <= YEARS:
            raise Invalid(f"--events-days must be more than 0 and at most {YEARS}")
        if not 0 <= self.requests_per_second <= MOST_REQUESTS:
            raise Invalid(f"--requests-per-second must be from 0 to {MOST_REQUESTS}")
        self._check_control()
        if self.offload_processes is not None and not 1 <= self.offload_processes <= MOST_PROCESSES:
            raise Invalid(f"--offload-processes must be from 1 to {MOST_PROCESSES}")
        if self.offload_scheduler and (self.offload_processes is not None or self.offload_folder is not None):
            raise Invalid(
                "with --offload-scheduler the processes and the folder of functions are options of 'switchboard worker'"
            )
        if any(self.offload_tls) and not self.offload_scheduler:
            raise Invalid("--offload-tls goes with --offload-scheduler")
        if not 0 <= self._critical <= self.battery_low <= 100:
            raise Invalid("--battery-critical and --battery-low are percent, the first not above the second")

    def _check_control(self) -> None:
        if not (0 <= self.control_grace <= DAY and 0 < self.control_idle <= DAY):
            raise Invalid("--control-grace and --control-idle are seconds: more than 0, at most a day")
        if not self.control_grace < self.control_request <= DAY:
            raise Invalid(
                "--control-request must be more than --control-grace and at most a day: owners may take over in between"
            )

    @property
    def _critical(self) -> float:
        """Percent; 0 (no alert) when alerts of a low battery are switched off."""
        return self.battery_critical if self.battery_low else 0.0

    def _cluster(self) -> ClusterSettings | None:
        """:raises Invalid: an option of a cluster is missing, or can't be used"""
        bus = _listed(self.cluster_bus)
        if not bus:
            return None
        if not self.name and self.workers == 1:
            raise Invalid(
                "--cluster-bus needs --name: robots trust a relay by its name, so all relays have the same"
            )
        secret = self.cluster_secret
        if secret is None and self.workers == 1:
            raise Invalid("--cluster-bus needs --cluster-secret: a file with the secret that all relays have")
        listen = ListenAddress.parse(self.cluster_listen)
        if self.tls_cert is None and not listen.loopback:
            raise Invalid(
                "--cluster-listen without --tls-cert and --tls-key must be a loopback address: commands of clients "
                "and the secret of the cluster cross the network there"
            )
        return ClusterSettings(
            bus,
            listen,
            self.cluster_host or listen.host,
            # Workers without one get theirs from the process that starts them.
            "" if secret is None else _secret(secret),
            # Workers on one machine connect by an address that is not in the certificate.
            self.tls_cert is not None and not (self.workers > 1 and listen.loopback),
        )

    def settings(self, app: App) -> RelaySettings:
        """The relay's settings, in SI units.

        :raises Invalid: an address cannot be parsed
        """
        return RelaySettings(
            data=app.data,
            database=app.database_url,
            http=ListenAddress.parse(self.http),
            robots=ListenAddress.parse(self.robots),
            tls_cert=self.tls_cert,
            tls_key=self.tls_key,
            origins=self.origins,
            name=self.name,
            heartbeat=self.heartbeat,
            recordings=round(self.recordings_gb * 10**9),
            recordings_reserve=round(self.recordings_reserve_gb * 10**9),
            files=FileSettings(
                robot=round(self.files_per_robot_gb * 10**9),
                realm=round(self.files_per_realm_gb * 10**9),
                relay=round(self.files_gb * 10**9),
                reserve=round(self.files_reserve_gb * 10**9),
                storage=self.files_storage,
            ),
            explicit_control=self.explicit_control,
            control_grace=self.control_grace,
            control_request=self.control_request,
            control_idle=self.control_idle,
            events_of_source=self.events_per_source,
            events_kept=self.events_days * DAY,
            largest_message=round(self.largest_message_mb * 10**6),
            largest_sample=self.largest_sample_mb * MIB,
            requests=self.requests_per_second,
            answer_seconds=self.answer_seconds,
            streams=self.streams_per_user,
            connections=self.connections_per_network,
            cluster=self._cluster(),
            alerts=AlertSettings(
                _listed(self.webhook_networks),
                _listed(self.webhook_deny),
                _listed(self.apprise_schemes),
                self.battery_low / 100,
                self._critical / 100,
            ),
            offload=self._offload(),
        )

    def _offload(self) -> OffloadSettings:
        defaults = OffloadSettings()
        return OffloadSettings(
            processes=self.offload_processes or defaults.processes,
            folder=self.offload_folder,
            robots=_listed(self.offload_robots),
            scheduler=self.offload_scheduler,
            tls=self.offload_tls,
        )


@click.command(
    epilog=examples(
        "switchboard serve --data /var/lib/switchboard --http 0.0.0.0:9090 --robots 0.0.0.0:9091 \\",
        "    --tls-cert chain.pem --tls-key key.pem --origin https://robots.example.org:9090",
        "switchboard serve --http 127.0.0.1:0 --robots 127.0.0.1:0",
    )
)
@click.option(
    "--data",
    type=click.Path(file_okay=False, path_type=Path),
    help="Data folder. It and --db URL, a database other than SQLite in it, may stand before 'serve' or behind it.",
)
@click.option(
    "--http",
    default="127.0.0.1:9090",
    metavar="HOST:PORT",
    show_default=True,
    envvar="SWITCHBOARD_HTTP",
    help="Address for browsers and rosbridge clients. Port 0 takes any free one.",
)
@click.option(
    "--robots",
    default="127.0.0.1:9091",
    metavar="HOST:PORT",
    show_default=True,
    envvar="SWITCHBOARD_ROBOTS",
    help="Address that robots dial.",
)
@click.option("--tls-cert", type=click.Path(dir_okay=False, path_type=Path), help="PEM certificate chain.")
@click.option("--tls-key", type=click.Path(dir_okay=False, path_type=Path), help="PEM private key.")
@click.option(
    "--origin",
    "origins",
    multiple=True,
    metavar="URL",
    help="Origin of the portal's address, as https://robots.example.org:9090. Repeatable.",
)
@click.option(
    "--name", default="", help="Name of the relay, which robots sign; invented and stored when not given."
)
@click.option("--heartbeat", default=1.25, show_default=True, help="Seconds between pings on robot links.")
@click.option(
    "--recordings-gb",
    default=10.0,
    show_default=True,
    help="Largest size of all recordings together, gigabytes. 0 switches recording off.",
)
@click.option(
    "--recordings-reserve-gb",
    default=1.0,
    show_default=True,
    help="Disk space to leave free, gigabytes. With less, recordings end and none begins.",
)
@click.option(
    "--offload-processes",
    type=int,
    metavar="N",
    help="Functions that run at a time on this machine. By default one for each CPU, at most 4.",
)
@click.option(
    "--offload-folder",
    type=click.Path(file_okay=False, exists=True, path_type=Path),
    help="Folder of functions (*.py), beside those of installed packages.",
)
@click.option(
    "--offload-robots",
    default="*",
    show_default=True,
    metavar="PATTERNS",
    help="Functions that robots may run, separated by commas (shell wildcards).",
)
@click.option(
    "--offload-scheduler",
    default="",
    metavar="ADDRESS",
    envvar="SWITCHBOARD_OFFLOAD_SCHEDULER",
    help="Run functions on the workers of this Dask scheduler: tls://HOST:PORT, or tcp://127.0.0.1:PORT.",
)
@click.option(
    "--offload-tls",
    nargs=3,
    default=("", "", ""),
    metavar="CA CERT KEY",
    help="PEM files for a tls:// scheduler: its CA, the relay's certificate and its key.",
)
@click.option(
    "--files-per-robot-gb",
    default=10.0,
    show_default=True,
    help="Largest size of all files of a robot together, gigabytes. 0: no files.",
)
@click.option(
    "--files-per-realm-gb",
    default=50.0,
    show_default=True,
    help="Largest size of all files of a realm together, gigabytes.",
)
@click.option(
    "--files-gb", default=100.0, show_default=True, help="Largest size of all files together, gigabytes."
)
@click.option(
    "--files-reserve-gb",
    default=1.0,
    show_default=True,
    help="Disk space to leave free, gigabytes. With less, no file is accepted.",
)
@click.option(
    "--files-storage",
    envvar="SWITCHBOARD_FILES_STORAGE",
    show_envvar=True,
    default="",
    metavar="URL",
    help="S3-compatible storage of files and finished recordings, such as s3://bucket/folder."
    " By default they are in the data folder.",
)
@click.option(
    "--events-per-source",
    default=10_000,
    show_default=True,
    type=click.IntRange(10, 1_000_000),
    help="Most events that are stored of each source; the least used and oldest are dropped first.",
)
@click.option(
    "--events-days",
    default=30.0,
    show_default=True,
    help="How long events are stored, days.",
)
@click.option(
    "--explicit-control",
    is_flag=True,
    help="Control is only given when a client asks for it, never by a first command.",
)
@click.option(
    "--control-grace",
    default=30.0,
    show_default=True,
    help="Seconds that a holder of control has to answer a request; after that an owner may take over.",
)
@click.option(
    "--control-request",
    default=60.0,
    show_default=True,
    help="Seconds that a holder of control has to answer a request; after that it lapses, and others may ask.",
)
@click.option(
    "--control-idle",
    default=600.0,
    show_default=True,
    help="Seconds without a command that moves the robot, after which control is released.",
)
@click.option(
    "--webhook-networks",
    default="",
    metavar="NETWORKS",
    envvar="SWITCHBOARD_WEBHOOK_NETWORKS",
    help="Private or local networks that alerts may be sent to, as 192.168.7.0/24,fd00:7::/64.",
)
@click.option(
    "--webhook-deny",
    default="",
    metavar="NETWORKS",
    envvar="SWITCHBOARD_WEBHOOK_DENY",
    help="Public networks that alerts must not be sent to.",
)
@click.option(
    "--apprise-schemes",
    default="",
    metavar="SCHEMES",
    envvar="SWITCHBOARD_APPRISE_SCHEMES",
    help="Apprise services that users may have alerts sent by, as mailtos,ntfys. Needs the extra 'alerts'.",
)
@click.option(
    "--battery-low",
    default=20.0,
    show_default=True,
    help="Battery charge that raises an alert, percent; 0 switches it off.",
)
@click.option(
    "--battery-critical",
    default=10.0,
    show_default=True,
    help="Battery charge that raises an error, percent.",
)
@click.option(
    "--requests-per-second",
    default=500.0,
    show_default=True,
    help="HTTP requests and handshakes per second of one user, or of a network of unauthenticated clients. "
    "Bursts may be ten times as large. Stops are never limited. 0: no limit.",
)
@click.option(
    "--answer-seconds",
    default=10.0,
    show_default=True,
    type=click.FloatRange(min=0),
    help="Seconds in which HTTP requests are answered. Requests that need a robot have 15 s more, plus the "
    "time that the client asks to wait. 0: no limit.",
)
@click.option(
    "--streams-per-user",
    default=128,
    show_default=True,
    type=click.IntRange(min=0),
    help="Streams that one user may have open: events, topics, cameras, pages of the portal. 0: no limit.",
)
@click.option(
    "--connections-per-network",
    default=512,
    show_default=True,
    type=click.IntRange(min=0),
    help="Connections that clients of one network (an IPv4 address, an IPv6 /64) may have open; its robots may have as "
    "many. Raise it behind a load balancer that shows the relay its own address. 0: no limit.",
)
@click.option(
    "--cluster-bus",
    default="",
    metavar="URLS",
    envvar="SWITCHBOARD_CLUSTER_BUS",
    help="NATS servers, as nats://10.0.0.1:4222,nats://10.0.0.2:4222: this relay is one of several that serve the "
    "same robots, with the same --db and --name. Needs the extra 'cluster'.",
)
@click.option(
    "--cluster-listen",
    default="127.0.0.1:0",
    metavar="HOST:PORT",
    show_default=True,
    envvar="SWITCHBOARD_CLUSTER_LISTEN",
    help="Where the other relays connect.",
)
@click.option(
    "--cluster-host",
    default="",
    metavar="HOST",
    envvar="SWITCHBOARD_CLUSTER_HOST",
    help="Name or address at which the other relays reach this one; with TLS a name of its certificate. By default "
    "that of --cluster-listen.",
)
@click.option(
    "--cluster-secret",
    type=click.Path(dir_okay=False, path_type=Path),
    envvar="SWITCHBOARD_CLUSTER_SECRET",
    help="File with a secret of at least 32 characters that all relays have; as from 'openssl rand -hex 32'.",
)
@click.option(
    "--workers",
    type=click.IntRange(1, MOST_PROCESSES),
    default=1,
    show_default=True,
    metavar="N",
    help="Processes that serve robots and clients, as a cluster behind the ports of this machine. Needs PostgreSQL and "
    "--cluster-bus.",
)
@click.option(
    "--largest-message-mb",
    type=click.FloatRange(0.1, 100),
    default=CLIENT_MESSAGE / 10**6,
    show_default=True,
    help="Largest websocket message accepted from a client that has logged in, MB, as max_message_size of "
    "rosbridge_server.",
)
@click.option(
    "--largest-sample-mb",
    type=click.IntRange(MIN_SAMPLE // MIB, MAX_SAMPLE // MIB),
    default=ROBOT_SAMPLE // MIB,
    show_default=True,
    help="Largest message accepted from a robot (a point cloud, a map), MiB. Each takes several times as much memory.",
)
@click.option("--log-json", is_flag=True, help="Log one JSON object per line.")
@click.option("--debug", is_flag=True, help="Log more.")
@pass_app
def serve(app: App, /, **options: Any) -> None:
    """Run the relay until SIGTERM or Ctrl-C.

    Prints READY with both ports once everything listens. SIGHUP reads the TLS certificate again. The very first start
    prints a one-time login link for the user 'admin'.
    """
    given = ServeOptions(**options)
    if given.data is not None:
        app.data = given.data
    given.check()
    try:
        app.data.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise Unavailable(
            f"the data folder {app.data} cannot be created: {error.strerror}; give another --data"
        ) from None
    if given.workers > 1:
        sys.exit(_run_workers(given, app))
    settings = given.settings(app)
    logs.begin(given.log_json, given.debug, later=logs.later)
    sys.exit(run.run(settings, _ready))


def _run_workers(given: ServeOptions, app: App) -> int:
    """Run a worker, or the process that starts the workers; returns the exit code.

    :raises Invalid: workers can't be used with these options
    """
    workers.check_database(app.database_url, _listed(given.cluster_bus))
    settings, worker = given.settings(app), workers.this_worker()
    if worker is None:
        logs.begin(given.log_json, given.debug)
        own_secret = given.cluster_secret is None
        return workers.WorkerSupervisor(
            run.monotonic_reactor(), settings, given.workers, secret=own_secret
        ).run()
    if given.cluster_secret is None:
        assert settings.cluster is not None
        secret = _secret(workers.secret_file(app.data))
        settings = replace(settings, cluster=replace(settings.cluster, secret=secret))
    logs.begin(given.log_json, given.debug, later=logs.later, worker=worker.number)
    return run.run(workers.settings_of(worker, settings), _ready)


def _secret(path: Path) -> str:
    """:raises Invalid: the file can't be read, or the secret is too short"""
    try:
        secret = path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise Invalid(f"--cluster-secret {path} can't be read: {getattr(error, 'strerror', error)}") from None
    if len(secret) < SECRET_LENGTH or not (secret.isascii() and secret.isprintable()) or " " in secret:
        raise Invalid(
            f"--cluster-secret must hold at least {SECRET_LENGTH} letters and digits, as from 'openssl rand -hex 32'"
        )
    return secret


def _listed(text: str) -> tuple[str, ...]:
    return tuple(each.strip() for each in text.split(",") if each.strip())


def _ready(relay: Relay, link: str | None) -> None:
    if link is not None:
        password = ["switchboard", "--data", str(relay.settings.data), "user", "passwd", "admin"]
        click.echo(
            f"No user of the data folder {relay.settings.data.absolute()} can log in yet. "
            f"Open this once, within an hour, as 'admin' "
            f"(for a password: {shlex.join(password)}):\n  {link}"
        )
    click.echo(f"READY http={relay.http_port} robots={relay.robots_port}")
    sys.stdout.flush()


@click.command(
    epilog=examples(
        "switchboard demo",
        "switchboard demo --http 127.0.0.1:9090 --data ./demo",
        "switchboard demo --http 127.0.0.1:9090 --origin http://localhost:8000",
        "switchboard demo --home   # and a lamp, a blind, a door contact and a thermostat",
        "switchboard demo --cluster   # three relays, of which two may be killed",
        "switchboard demo --http 0.0.0.0:9090   # reachable from other machines",
    )
)
@click.option(
    "--data",
    type=click.Path(file_okay=False, path_type=Path),
    help="Store everything in this folder instead of a temporary one.",
)
@click.option(
    "--http", default="127.0.0.1:0", metavar="HOST:PORT", show_default=True, help="Port 0 takes any free one."
)
@click.option("--robots", default="127.0.0.1:0", metavar="HOST:PORT", show_default=True)
@click.option("--home", is_flag=True, help="Add a simulated home with MQTT devices; needs Mosquitto.")
@click.option("--cluster", is_flag=True, help="Run three relays with PostgreSQL and NATS.")
@click.option(
    "--origin",
    "origins",
    multiple=True,
    metavar="ORIGIN",
    help="Origin of a page of your own that may use the relay; needs --http with a port.",
)
def demo(
    data: Path | None, http: str, robots: str, home: bool, cluster: bool, origins: tuple[str, ...]
) -> None:
    """Run a relay with two simulated ROS 2 robots and three users, until Ctrl-C.

    Prints READY with the address once both robots are online.
    """
    from relay_server.config import ListenAddress
    from relay_server.demo.run import run_demo

    with ExitStack() as stack:
        if data is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="switchboard-demo-")))
        else:
            folder = data.absolute()
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        code = run_demo(
            folder,
            ListenAddress.parse(http),
            ListenAddress.parse(robots),
            home=home,
            cluster=cluster,
            origins=origins,
        )
    sys.exit(code)


@click.group()
def db() -> None:
    """Create, upgrade or copy the database."""


@db.command(epilog=examples("switchboard --data /var/lib/switchboard db backup /mnt/backup/monday"))
@click.argument("folder", type=click.Path(path_type=Path))
@json_option
@pass_app
def backup(app: App, folder: Path, as_json: bool) -> None:
    """Copy the SQLite database and the relay's name into a new FOLDER.

    A relay may run meanwhile. Recordings and files of robots are not copied. FOLDER is a complete data folder: to
    restore it, start a relay with it.
    """
    app.check_database()
    copy_data(app.data, app.database_url, folder)
    print_result(as_json, {"folder": str(folder)}, f"Copied the database and the relay's name into {folder}.")


@db.command(
    epilog=examples(
        "switchboard db upgrade",
        "SWITCHBOARD_DB=postgresql://switchboard@db/switchboard switchboard db upgrade",
    )
)
@json_option
@pass_app
def upgrade(app: App, as_json: bool) -> None:
    """Create the tables, or upgrade them. The relay does the same when it starts."""
    with app.database(create=True) as database:
        answer = {"database": database.url, "schema": schema.HEAD}
    print_result(as_json, answer, f"{database.url} has schema {schema.HEAD}.")
