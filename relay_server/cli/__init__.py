"""The command ``switchboard``: runs the relay, and administers it, also while it runs."""

from __future__ import annotations

import os
from pathlib import Path

import click

from relay_server.cli.app import App, examples
from relay_server.cli.lazy import CommandEntry, LazyGroup

_COMMANDS = {
    "serve": CommandEntry("relay_server.cli.serve", "serve", "Run the relay."),
    "demo": CommandEntry("relay_server.cli.demo", "demo", "Run a relay with two simulated robots."),
    "status": CommandEntry(
        "relay_server.cli.status", "status", "Show which robots are online, and with whom."
    ),
    "stop": CommandEntry("relay_server.cli.stop", "stop", "Stop a robot, or all of them."),
    "resume": CommandEntry("relay_server.cli.stop", "resume", "Let a robot that was stopped move again."),
    "realm": CommandEntry("relay_server.cli.realms", "realm", "Keep users and robots apart."),
    "user": CommandEntry("relay_server.cli.users", "user", "Add, list, change and remove users."),
    "group": CommandEntry("relay_server.cli.groups", "group", "Give users rights together."),
    "robot": CommandEntry(
        "relay_server.cli.robots", "robot", "Add, list and remove robots and their keys; orders to many."
    ),
    "right": CommandEntry("relay_server.cli.rights", "right", "Say who may do what on which robot."),
    "token": CommandEntry("relay_server.cli.tokens", "token", "Create, list and revoke access tokens."),
    "program": CommandEntry(
        "relay_server.cli.oauth_clients", "program", "Add, list and revoke programs with key and secret."
    ),
    "alerts": CommandEntry("relay_server.cli.alerts", "alerts", "Show alerts, and say who is told how."),
    "events": CommandEntry("relay_server.cli.events", "events", "Show what happened of late."),
    "directory": CommandEntry(
        "relay_server.cli.directory",
        "directory",
        "Show which services and applications there are, and where.",
    ),
    "audit": CommandEntry("relay_server.cli.audit", "audit", "Read and verify the audit log."),
    "db": CommandEntry("relay_server.cli.database", "db", "Look after the database."),
}

_DEFAULT_DATA = Path("~/.local/share/switchboard")


@click.group(
    cls=LazyGroup,
    entries=_COMMANDS,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=examples(
        "switchboard serve",
        "switchboard user add ann --admin",
        "switchboard robot add rover",
        "switchboard right grant ann rover operator",
        "switchboard --data /srv/switchboard status --json",
    ),
)
@click.option(
    "--data",
    type=click.Path(file_okay=False, path_type=Path),
    envvar="SWITCHBOARD_DATA",
    default=_DEFAULT_DATA,
    show_default=True,
    show_envvar=True,
    help="Folder of the database and the relay's keys.",
)
@click.option(
    "--db",
    metavar="URL",
    envvar="SWITCHBOARD_DB",
    show_envvar=True,
    help="Another database than SQLite in the data folder: postgresql://USER@HOST/NAME. "
    "A password in it belongs in the variable, not on the command line.",
)
@click.version_option(package_name="robot-switchboard", prog_name="switchboard")
@click.pass_context
def main(ctx: click.Context, data: Path, db: str | None) -> None:
    """Reach, watch and drive robots through a relay of your own.

    Changes take effect at once, also in a relay that is running and in what is open there.
    """
    # Whatever the umask was: what is made here is its owner's alone.
    os.umask(0o077)
    ctx.obj = App(data.expanduser(), db)
