"""``switchboard serve``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.limits import CLIENT_MESSAGE, LABEL, LEAST_SAMPLE, MIB, MOST_SAMPLE, ROBOT_SAMPLE
from relay_protocol.text import legible
from relay_server.cli.app import App, examples, pass_app

if TYPE_CHECKING:
    from relay_server.service import Relay

DAY = 86400.0
YEARS = 3650
"""Longest that events are kept, days."""

MOST_REQUESTS = 1_000_000
MOST_HEARTBEAT = 60.0
MOST_GB = 1e9


@click.command(
    epilog=examples(
        "switchboard serve --data /var/lib/switchboard --http 0.0.0.0:9090 --robots 0.0.0.0:9091 \\",
        "    --tls-cert chain.pem --tls-key key.pem --origin https://robots.example.org:9090",
        "switchboard serve --http 127.0.0.1:0 --robots 127.0.0.1:0",
    )
)
@click.option(
    "--data", type=click.Path(file_okay=False, path_type=Path), help="Data folder (also before 'serve')."
)
@click.option(
    "--http",
    default="127.0.0.1:9090",
    metavar="HOST:PORT",
    show_default=True,
    envvar="SWITCHBOARD_HTTP",
    help="Where browsers and rosbridge clients come in. Port 0: any free one.",
)
@click.option(
    "--robots",
    default="127.0.0.1:9091",
    metavar="HOST:PORT",
    show_default=True,
    envvar="SWITCHBOARD_ROBOTS",
    help="Where robots dial in.",
)
@click.option("--tls-cert", type=click.Path(dir_okay=False, path_type=Path), help="PEM certificate chain.")
@click.option("--tls-key", type=click.Path(dir_okay=False, path_type=Path), help="PEM private key.")
@click.option(
    "--origin",
    "origins",
    multiple=True,
    metavar="URL",
    help="Origin under which people open the portal, as https://robots.example.org:9090. May be repeated.",
)
@click.option("--name", default="", help="Name robots sign for; made up once when not given.")
@click.option("--heartbeat", default=1.25, show_default=True, help="Seconds between pings on robot links.")
@click.option(
    "--recordings-gb",
    default=10.0,
    show_default=True,
    help="How much recordings may take in all, gigabytes. 0: nothing is recorded.",
)
@click.option(
    "--recordings-reserve-gb",
    default=1.0,
    show_default=True,
    help="How much of the disk stays free, gigabytes: with less, recordings end and none begins.",
)
@click.option(
    "--events-per-source",
    default=10_000,
    show_default=True,
    type=click.IntRange(10, 1_000_000),
    help="How many events each source may have in the memory; the least used and oldest go first.",
)
@click.option(
    "--events-days",
    default=30.0,
    show_default=True,
    help="How long the memory keeps an event, days.",
)
@click.option(
    "--explicit-control",
    is_flag=True,
    help="A robot nobody controls obeys nobody: control is taken by asking for it, never by a first command.",
)
@click.option(
    "--control-grace",
    default=30.0,
    show_default=True,
    help="Seconds who has control has to answer a request; then an owner may take over.",
)
@click.option(
    "--control-request",
    default=60.0,
    show_default=True,
    help="Seconds who has control has to answer a request; then it lapses, and others may ask.",
)
@click.option(
    "--control-idle",
    default=600.0,
    show_default=True,
    help="Seconds without a command that moves, after which control is free again.",
)
@click.option(
    "--webhook-networks",
    default="",
    metavar="NETWORKS",
    envvar="SWITCHBOARD_WEBHOOK_NETWORKS",
    help="Networks that alerts may be sent to though private or this machine's own, as 192.168.7.0/24,fd00:7::/64.",
)
@click.option(
    "--webhook-deny",
    default="",
    metavar="NETWORKS",
    envvar="SWITCHBOARD_WEBHOOK_DENY",
    help="Networks that alerts may not be sent to though they have public addresses.",
)
@click.option(
    "--apprise-schemes",
    default="",
    metavar="SCHEMES",
    envvar="SWITCHBOARD_APPRISE_SCHEMES",
    help="Services that users may have alerts sent by, as mailtos,ntfys. Needs the extra 'alerts'.",
)
@click.option(
    "--battery-low",
    default=20.0,
    show_default=True,
    help="Percent at which a battery is an alert; 0: never.",
)
@click.option("--battery-critical", default=10.0, show_default=True, help="Percent at which it is worse.")
@click.option(
    "--requests-per-second",
    default=500.0,
    show_default=True,
    help="HTTP requests and handshakes of one user, or of a network in which nobody has logged in; ten times as many "
    "at once. Never held back: stops. 0: no limit.",
)
@click.option(
    "--answer-seconds",
    default=10.0,
    show_default=True,
    type=click.FloatRange(min=0),
    help="Seconds in which a request by HTTP is answered; what is asked of a robot has 15 s more, and what the client "
    "asks to wait for. 0: no limit.",
)
@click.option(
    "--streams-per-user",
    default=128,
    show_default=True,
    type=click.IntRange(min=0),
    help="Streams that one user may have open: events, topics, cameras, pages of the portal. 0: no limit.",
)
@click.option(
    "--largest-message-mb",
    type=click.FloatRange(0.1, 100),
    default=CLIENT_MESSAGE / 10**6,
    show_default=True,
    help="Largest websocket message taken from a client that has logged in, MB, as max_message_size of "
    "rosbridge_server.",
)
@click.option(
    "--largest-sample-mb",
    type=click.IntRange(LEAST_SAMPLE // MIB, MOST_SAMPLE // MIB),
    default=ROBOT_SAMPLE // MIB,
    show_default=True,
    help="Largest message taken from a robot (a point cloud, a map), MiB. Each takes several times as much memory.",
)
@click.option("--log-json", is_flag=True, help="Log one JSON object a line.")
@click.option("--debug", is_flag=True, help="Log more.")
@pass_app
def serve(
    app: App,
    data: Path | None,
    http: str,
    robots: str,
    tls_cert: Path | None,
    tls_key: Path | None,
    origins: tuple[str, ...],
    name: str,
    heartbeat: float,
    recordings_gb: float,
    recordings_reserve_gb: float,
    events_per_source: int,
    events_days: float,
    explicit_control: bool,
    control_grace: float,
    control_request: float,
    control_idle: float,
    webhook_networks: str,
    webhook_deny: str,
    apprise_schemes: str,
    battery_low: float,
    battery_critical: float,
    requests_per_second: float,
    answer_seconds: float,
    streams_per_user: int,
    largest_message_mb: float,
    largest_sample_mb: int,
    log_json: bool,
    debug: bool,
) -> None:
    """Run the relay until SIGTERM or Ctrl-C.

    Prints READY with both ports once everything listens. SIGHUP reads the TLS certificate again. On the very first
    start a one-time login link for the user 'admin' is printed.
    """
    from relay_server import logs
    from relay_server.config import AlertSettings, ListenAddress, RelaySettings
    from relay_server.run import run

    if data is not None:
        app.data = data
    if (tls_cert is None) != (tls_key is None):
        raise Invalid("--tls-cert and --tls-key go together")
    if not 0 < heartbeat <= MOST_HEARTBEAT:
        raise Invalid(f"--heartbeat must be more than 0 and at most {MOST_HEARTBEAT:g} s")
    if not (0 <= recordings_gb <= MOST_GB and 0 <= recordings_reserve_gb <= MOST_GB):
        raise Invalid(f"--recordings-gb and --recordings-reserve-gb must be from 0 to {MOST_GB:g}")
    if len(name) > LABEL or not legible(name):
        raise Invalid(f"--name must be one printable line of at most {LABEL} characters, without U+FFFD")
    if not 0 < events_days <= YEARS:
        raise Invalid(f"--events-days must be more than 0 and at most {YEARS}")
    if not 0 <= requests_per_second <= MOST_REQUESTS:
        raise Invalid(f"--requests-per-second must be from 0 to {MOST_REQUESTS}")
    _check_control(control_grace, control_request, control_idle)
    if battery_low == 0:
        battery_critical = 0.0
    if not 0 <= battery_critical <= battery_low <= 100:
        raise Invalid("--battery-critical and --battery-low are percent, the first not above the second")
    try:
        app.data.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise Unavailable(
            f"the data folder {app.data} can't be made: {error.strerror}; give another --data"
        ) from None
    settings = RelaySettings(
        data=app.data,
        database=app.database_url,
        http=ListenAddress.parse(http),
        robots=ListenAddress.parse(robots),
        tls_cert=tls_cert,
        tls_key=tls_key,
        origins=origins,
        name=name,
        heartbeat=heartbeat,
        recordings=round(recordings_gb * 10**9),
        recordings_reserve=round(recordings_reserve_gb * 10**9),
        explicit_control=explicit_control,
        control_grace=control_grace,
        control_request=control_request,
        control_idle=control_idle,
        events_of_source=events_per_source,
        events_kept=events_days * DAY,
        largest_message=round(largest_message_mb * 10**6),
        largest_sample=largest_sample_mb * MIB,
        requests=requests_per_second,
        answer_seconds=answer_seconds,
        streams=streams_per_user,
        alerts=AlertSettings(
            _listed(webhook_networks),
            _listed(webhook_deny),
            _listed(apprise_schemes),
            battery_low / 100,
            battery_critical / 100,
        ),
    )
    logs.begin(log_json, debug, later=logs.later)
    sys.exit(run(settings, _ready))


def _listed(text: str) -> tuple[str, ...]:
    return tuple(each.strip() for each in text.split(",") if each.strip())


def _ready(relay: Relay, link: str | None) -> None:
    if link is not None:
        click.echo(
            f"Nobody can log in yet. Open this once, within an hour, as 'admin' "
            f"(for a password: switchboard user passwd admin):\n  {link}"
        )
    click.echo(f"READY http={relay.http_port} robots={relay.robots_port}")
    sys.stdout.flush()


def _check_control(grace: float, request: float, idle: float) -> None:
    """See that the times of control make sense, seconds.

    :raises Invalid: they don't
    """
    if not (0 <= grace <= DAY and 0 < idle <= DAY):
        raise Invalid("--control-grace and --control-idle are seconds: more than 0, at most a day")
    if not grace < request <= DAY:
        raise Invalid(
            "--control-request must be more than --control-grace and at most a day: in between owners take over"
        )
