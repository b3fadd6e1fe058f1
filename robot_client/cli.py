"""The command ``switchboard-robot``."""

from __future__ import annotations

import functools
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from msgspec.structs import replace
from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from relay_protocol.command_output import OutputGroup
from relay_protocol.errors import Invalid, NotFound, SwitchboardError
from relay_protocol.identity import check_robot_name
from relay_protocol.realms import split_name
from relay_protocol.text import escape_unprintable
from robot_client import config, logs
from robot_client.command_line import examples
from robot_client.link.addresses import RelayAddresses
from robot_client.link.enrolment import Enrolment, StateFolder
from robot_client.link.enrolment import enroll as enroll_key
from robot_client.link.tls import endpoint, is_loopback, split_address
from robot_client.modules import log_ring
from robot_client.modules.local_orders import send_local_order
from robot_client.modules.module_run import stop_left_running
from robot_client.motion.stop_store import DiskStopStore
from robot_client.run import DaemonProcess, agent
from robot_client.stop_signals import exit_on_signals, stop_reactor_on_signals
from robot_client.twisted_types import monotonic_reactor

FOLLOW_SECONDS = 0.25
"""Seconds between two checks for new lines of a log."""

_ENROLL = (
    "switchboard-robot enroll --relay relay.example.org:9091 --tls --robot rover --code - --state ./rover",
    "switchboard-robot enroll --relay 127.0.0.1:9091 --robot rover --code CODE --state ./rover",
)
_RUN = (
    "switchboard-robot run --state ./rover",
    "switchboard-robot run --state ./rover --config robot.toml --log-json",
    "switchboard-robot run --state ./rover --use-sim-time   # beside a simulator that publishes /clock",
)

state_option = click.option(
    "--state",
    envvar="SWITCHBOARD_ROBOT_STATE",
    required=True,
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder with the robot's key and enrolment.",
)


def report_errors(command: Callable[..., Any]) -> Callable[..., Any]:
    """Print a :class:`SwitchboardError` to standard error and exit with code 1."""

    @functools.wraps(command)
    def run(*args: Any, **options: Any) -> Any:
        try:
            return command(*args, **options)
        except SwitchboardError as error:
            raise click.ClickException(escape_unprintable(str(error))) from None

    return run


@click.group(
    cls=OutputGroup,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=examples(_ENROLL[0], _RUN[0]),
)
@click.version_option(package_name="robot-switchboard", message="%(version)s")
def main() -> None:
    """Connect this robot to a Switchboard relay."""
    # New files are accessible to their owner alone, whatever the umask was.
    os.umask(0o077)


@main.command(epilog=examples(*_ENROLL))
@click.option(
    "--relay",
    required=True,
    metavar="HOST:PORT,…",
    help="The relay's address for robots; of a cluster the addresses of several relays.",
)
@click.option("--robot", required=True, metavar="NAME", help="This robot's name at the relay.")
@click.option(
    "--code",
    required=True,
    help="Enrolment code; '-' reads it from standard input, which keeps it out of the process list.",
)
@state_option
@click.option(
    "--tls/--no-tls",
    default=None,
    help="Use TLS. Default: only with --ca or --server-name.",
)
@click.option(
    "--ca",
    type=click.Path(dir_okay=False),
    help="PEM file of authorities to trust, instead of the system's; a copy is stored in the state folder.",
)
@click.option("--server-name", default="", help="Name in the relay's certificate, where it is not HOST.")
@click.option("--replace", is_flag=True, help="Replace an existing enrolment.")
@report_errors
def enroll(
    relay: str,
    robot: str,
    code: str,
    state: Path,
    tls: bool | None,
    ca: str | None,
    server_name: str,
    replace: bool,
) -> None:
    """Create this robot's key and register it at a relay."""
    host, port = split_address(RelayAddresses(relay).current)
    check_robot_name(split_name(robot)[0])
    folder = StateFolder(state)
    if folder.enrolled and not replace:
        raise Invalid(f"{state} already holds an enrolment; use another folder, or --replace")
    if tls is None:
        tls = bool(ca or server_name)
    if not tls and (ca or server_name):
        raise Invalid("--ca and --server-name need TLS; leave out --no-tls")
    warn_if_plain(host, tls)
    if code == "-":
        if sys.stdin.isatty():
            click.echo("Enrolment code: ", nl=False, err=True)
        code = sys.stdin.readline()
    code = code.strip()
    reactor = monotonic_reactor()
    relay_endpoint = endpoint(reactor, host, port, tls, ca or "", server_name)
    authorities = Path(ca).read_bytes() if ca else b""
    preparation = folder.prepare()
    try:
        enrolled = _wait(
            reactor, enroll_key(reactor, relay_endpoint, robot, code, preparation.public_key, agent())
        )
    except BaseException:
        preparation.abandon()
        raise
    preparation.commit(
        Enrolment(address=relay, robot=robot, relay=enrolled.relay, tls=tls, server_name=server_name),
        authorities,
    )
    click.echo(
        escape_unprintable(
            f"enrolled as {robot} at {enrolled.relay}; run: switchboard-robot run --state {state}"
        )
    )


@main.command(epilog=examples(*_RUN))
@state_option
@click.option(
    "--config",
    "config_path",
    envvar="SWITCHBOARD_ROBOT_CONFIG",
    type=click.Path(dir_okay=False, path_type=Path),
    help="TOML file with settings.",
)
@click.option(
    "--log-json", is_flag=True, envvar="SWITCHBOARD_ROBOT_LOG_JSON", help="Log one JSON object per line."
)
@click.option(
    "--use-sim-time",
    is_flag=True,
    help="Take the robot's time from /clock; the same as the setting ros.use_sim_time.",
)
@report_errors
def run(state: Path, config_path: Path | None, log_json: bool, use_sim_time: bool) -> None:
    """Run the daemon until it is stopped."""
    settings = config.load(config_path, os.environ)
    if use_sim_time:
        settings = replace(settings, ros=replace(settings.ros, use_sim_time=True))
    folder = StateFolder(state)
    enrolment, identity = folder.load()
    folder.lock()
    modules = state / "modules"
    exit_on_signals(functools.partial(stop_left_running, modules))
    for each in RelayAddresses(enrolment.address):
        warn_if_plain(split_address(each)[0], enrolment.tls)
    logs.begin(log_json, logs.later)
    reactor = monotonic_reactor()
    process = DaemonProcess(reactor, settings, enrolment, identity, DiskStopStore(state), modules)
    process.start(before_modules=functools.partial(stop_reactor_on_signals, reactor))
    reactor.addSystemEventTrigger("before", "shutdown", process.stop)
    reactor.run()


@main.command(
    "log",
    epilog=examples(
        "switchboard-robot log base --state ./rover",
        "switchboard-robot log base --state ./rover --lines 500 -f",
        "switchboard-robot log base --state ./rover --level error",
    ),
)
@click.argument("module")
@state_option
@click.option(
    "--lines",
    type=click.IntRange(1),
    default=50,
    show_default=True,
    help="Number of lines to show, the newest.",
)
@click.option(
    "--level",
    type=click.Choice(log_ring.LEVELS),
    default=log_ring.LEVELS[0],
    help="Only lines of this level, or a more severe one.",
)
@click.option(
    "--before", type=click.IntRange(0), metavar="OFFSET", help="Lines in front of those shown before."
)
@click.option("-f", "--follow", is_flag=True, help="Wait for new lines, and show them.")
@report_errors
def show_log(module: str, state: Path, lines: int, level: str, before: int | None, follow: bool) -> None:
    """Show the log of a module. Where there are earlier lines, the last line on stderr says how to see them."""
    if follow and before is not None:
        raise Invalid("--before does not go with --follow")
    folder = state / "modules" / module
    if "/" in module or not folder.is_dir():
        known = sorted(each.name for each in (state / "modules").glob("*/"))
        raise NotFound(f"there is no log of '{module}'; modules with logs: {', '.join(known) or 'none'}")
    page = log_ring.read_before(folder / "log", before, lines, level)
    while not page.lines and page.previous:
        page = log_ring.read_before(folder / "log", page.previous, lines, level)
    _print_lines(page.lines)
    if not follow and page.previous:
        click.echo(f"earlier lines: --before {page.previous}", err=True)
    while follow:
        if not page.lines:
            time.sleep(FOLLOW_SECONDS)
        page = log_ring.read(folder / "log", page.next, level=level)
        _print_lines(page.lines)


def _print_lines(lines: list[log_ring.ModuleLogLine]) -> None:
    for line in lines:
        at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(line.at))
        click.echo(f"{at} {line.stream:<3} {line.level:<5} {escape_unprintable(line.text)}")


@main.group(
    epilog=examples(
        "switchboard-robot module list --state ./rover",
        "switchboard-robot module restart base --state ./rover",
    )
)
def module() -> None:
    """List, start, stop and restart modules on the robot itself, also when no relay is in reach.

    The daemon must run, and this command as the same user.
    """


@module.command("list", epilog=examples("switchboard-robot module list --state ./rover"))
@state_option
@report_errors
def list_modules(state: Path) -> None:
    """List the modules with their states."""
    now = time.time()
    for each in send_local_order(state / "modules", "list")["modules"]:
        pid = f"PID {each['pid']}" if each["pid"] else ""
        last = f"last: {each['last_exit']}" if each["last_exit"] else ""
        why = f"why: {each['why']}" if each["why"] else ""
        fields = (
            f"{each['name']:<20} {each['state']:<12} {max(0, now - each['since']):>6.0f} s",
            pid,
            last,
            why,
        )
        click.echo(escape_unprintable("  ".join(each for each in fields if each)))


def _add_order(action: str, sentence: str) -> None:
    @module.command(
        action,
        help=sentence,
        epilog=examples(f"switchboard-robot module {action} base --state ./rover"),
    )
    @click.argument("module_name", metavar="MODULE")
    @state_option
    @report_errors
    def order(module_name: str, state: Path) -> None:
        send_local_order(state / "modules", action, module_name)
        click.echo(f"The daemon has accepted: {action} {escape_unprintable(module_name)}.")


_add_order("start", "Start MODULE.")
_add_order("stop", "Stop MODULE. It stays stopped until it is started, or the machine is.")
_add_order("restart", "Stop MODULE, and start it again.")


def warn_if_plain(host: str, tls: bool) -> None:
    """Print a warning if a link over the network is not encrypted."""
    if not tls and not is_loopback(host):
        click.echo(
            f"warning: the link to {escape_unprintable(host)} is not encrypted, so others can read it; use --tls",
            err=True,
        )


def _wait(reactor: Any, result: Deferred[Any]) -> Any:
    """Run the reactor until a Deferred fires, and return its result.

    :raises SwitchboardError: it failed, or the program was interrupted
    """
    outcome: list[Any] = []

    def fired(value: Any) -> None:
        outcome.append(value)
        reactor.callLater(0, reactor.stop)

    result.addBoth(fired)
    reactor.run()
    if not outcome:
        raise Invalid("interrupted; nothing was enrolled")
    if isinstance(outcome[0], Failure):
        outcome[0].raiseException()
    return outcome[0]


if __name__ == "__main__":
    sys.exit(main())
