"""The command ``switchboard-robot``."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from msgspec.structs import replace
from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from relay_protocol.errors import Invalid, SwitchboardError
from relay_protocol.identity import check_robot_name
from relay_protocol.realms import parted
from relay_protocol.text import inert
from robot_client import config, logs
from robot_client.help_text import examples
from robot_client.link.enrolment import enroll as hand_in
from robot_client.link.identity import Enrolment, StateFolder
from robot_client.link.tls import endpoint, is_loopback, split_address
from robot_client.motion.stop_store import DiskStopStore
from robot_client.run import Runner, agent
from robot_client.twisted_types import monotonic_reactor

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


def in_words(command: Callable[..., Any]) -> Callable[..., Any]:
    """Errors of ours become a sentence on stderr and exit code 1."""

    @functools.wraps(command)
    def run(*args: Any, **options: Any) -> Any:
        try:
            return command(*args, **options)
        except SwitchboardError as error:
            raise click.ClickException(inert(str(error))) from None

    return run


@click.group(context_settings={"help_option_names": ["-h", "--help"]}, epilog=examples(_ENROLL[0], _RUN[0]))
@click.version_option(package_name="robot-switchboard", message="%(version)s")
def main() -> None:
    """Bring this robot to a Switchboard relay."""
    # Whatever the umask was: what is made here is its owner's alone.
    os.umask(0o077)


@main.command(epilog=examples(*_ENROLL))
@click.option("--relay", required=True, metavar="HOST:PORT", help="Where the relay takes robots.")
@click.option("--robot", required=True, metavar="NAME", help="This robot's name at the relay.")
@click.option(
    "--code",
    required=True,
    help="Enrolment code; '-' reads it from standard input, which keeps it out of the list of processes.",
)
@state_option
@click.option("--tls/--no-tls", default=None, help="TLS towards the relay. Default: plain, with a warning.")
@click.option("--ca", type=click.Path(dir_okay=False), help="PEM file of the only authorities to trust.")
@click.option("--server-name", default="", help="Name in the relay's certificate, if it is not HOST.")
@click.option("--replace", is_flag=True, help="Replace an enrolment that is there already.")
@in_words
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
    """Make this robot's key and register it at a relay."""
    host, port = split_address(relay)
    check_robot_name(parted(robot)[0])
    folder = StateFolder(state)
    if folder.enrolled and not replace:
        raise Invalid(f"{state} holds an enrolment already; give another folder, or --replace")
    if tls is None:
        tls = bool(ca or server_name)
    if not tls and (ca or server_name):
        raise Invalid("--ca and --server-name mean TLS; leave out --no-tls")
    _warn_if_plain(host, tls)
    if code == "-":
        code = sys.stdin.readline()
    code = code.strip()
    ca_path = str(Path(ca).resolve()) if ca else ""
    reactor = monotonic_reactor()
    where = endpoint(reactor, host, port, tls, ca_path, server_name)
    preparation = folder.prepare()
    try:
        enrolled = _wait(reactor, hand_in(reactor, where, robot, code, preparation.public_key, agent()))
    except BaseException:
        preparation.abandon()
        raise
    preparation.commit(
        Enrolment(
            address=relay, robot=robot, relay=enrolled.relay, tls=tls, ca=ca_path, server_name=server_name
        )
    )
    click.echo(inert(f"enrolled as {robot} at {enrolled.relay}; run: switchboard-robot run --state {state}"))


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
    "--log-json", is_flag=True, envvar="SWITCHBOARD_ROBOT_LOG_JSON", help="Log a JSON object per line."
)
@click.option(
    "--use-sim-time",
    is_flag=True,
    help="The robot's time is what /clock says; also a setting, ros.use_sim_time.",
)
@in_words
def run(state: Path, config_path: Path | None, log_json: bool, use_sim_time: bool) -> None:
    """Keep this robot at its relay until told to stop."""
    settings = config.load(config_path, os.environ)
    if use_sim_time:
        settings = replace(settings, ros=replace(settings.ros, use_sim_time=True))
    enrolment, me = StateFolder(state).load()
    _warn_if_plain(split_address(enrolment.address)[0], enrolment.tls)
    logs.begin(log_json)
    reactor = monotonic_reactor()
    runner = Runner(reactor, settings, enrolment, me, DiskStopStore(state))
    runner.start()
    reactor.addSystemEventTrigger("before", "shutdown", runner.stop)
    reactor.run()


def _warn_if_plain(host: str, tls: bool) -> None:
    if not tls and not is_loopback(host):
        click.echo(
            f"warning: the link to {inert(host)} is not encrypted; who is between can read and drive: use --tls",
            err=True,
        )


def _wait(reactor: Any, result: Deferred[Any]) -> Any:
    """Run the reactor until a result is there, and return it.

    :raises SwitchboardError: what it failed with; also when interrupted
    """
    outcome: list[Any] = []

    def arrived(value: Any) -> None:
        outcome.append(value)
        reactor.callLater(0, reactor.stop)

    result.addBoth(arrived)
    reactor.run()
    if not outcome:
        raise Invalid("interrupted; nothing was enrolled")
    if isinstance(outcome[0], Failure):
        outcome[0].raiseException()
    return outcome[0]


if __name__ == "__main__":
    sys.exit(main())
