"""The command ``switchboard``: runs the relay and administers it, also while it runs."""

from __future__ import annotations

import os
from pathlib import Path

import click

from relay_server.cli.app import App, CommandEntry, LazyGroup, examples

_COMMANDS = {
    "serve": CommandEntry("relay_server.cli.serve", "serve", "Run the relay."),
    "demo": CommandEntry("relay_server.cli.serve", "demo", "Run a relay with two simulated robots."),
    "status": CommandEntry(
        "relay_server.cli.status", "status", "Show the robots that are online, and their users."
    ),
    "stop": CommandEntry("relay_server.cli.stop", "stop", "Stop a robot, or all of them."),
    "resume": CommandEntry("relay_server.cli.stop", "resume", "Let a stopped robot move again."),
    "cluster": CommandEntry(
        "relay_server.cli.cluster", "cluster", "Show the relays that serve the same robots."
    ),
    "drain": CommandEntry(
        "relay_server.cli.cluster", "drain", "Move robots and clients to the other relays of a cluster."
    ),
    "realm": CommandEntry("relay_server.cli.realms", "realm", "Keep users and robots in separate realms."),
    "user": CommandEntry("relay_server.cli.users", "user", "Add, list, change and remove users."),
    "group": CommandEntry("relay_server.cli.users", "group", "Put users into groups that share rights."),
    "robot": CommandEntry(
        "relay_server.cli.robots",
        "robot",
        "Add, list and remove robots and their keys; send orders to many robots.",
    ),
    "module": CommandEntry(
        "relay_server.cli.modules",
        "module",
        "List, start, stop and restart modules of a robot; read their logs.",
    ),
    "file": CommandEntry("relay_server.cli.files", "file", "List, read, add and remove files of robots."),
    "pipe": CommandEntry(
        "relay_server.cli.pipes", "pipe", "Carry topics from robot to robot: list, add, start, stop, remove."
    ),
    "worker": CommandEntry(
        "relay_server.cli.worker", "worker", "Run functions for a relay, as a worker of its Dask scheduler."
    ),
    "top": CommandEntry("relay_server.cli.modules", "top", "Watch the processes of a robot."),
    "right": CommandEntry("relay_server.cli.users", "right", "Grant, list and revoke rights on robots."),
    "role": CommandEntry("relay_server.cli.roles", "role", "Load, show, save, query and remove Roles."),
    "token": CommandEntry("relay_server.cli.tokens", "token", "Create, list and revoke access tokens."),
    "foxglove-url": CommandEntry(
        "relay_server.cli.foxglove_urls",
        "foxglove_url",
        "Create, list and revoke URLs by which Foxglove and Lichtblick open a robot.",
    ),
    "oauth-client": CommandEntry(
        "relay_server.cli.tokens",
        "oauth_client",
        "Add, list and revoke OAuth clients, which log in with a key and a secret.",
    ),
    "alerts": CommandEntry("relay_server.cli.alerts", "alerts", "Show alerts, and set up notifications."),
    "events": CommandEntry("relay_server.cli.events", "events", "Show recent events."),
    "directory": CommandEntry(
        "relay_server.cli.directory",
        "directory",
        "Show registered services and applications and their addresses.",
    ),
    "audit": CommandEntry("relay_server.cli.events", "audit", "Read and verify the audit log."),
    "db": CommandEntry("relay_server.cli.serve", "db", "Create, upgrade or copy the database."),
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
    help="Folder with the database and the relay's keys. --data and --db may also stand behind a command.",
)
@click.option(
    "--db",
    metavar="URL",
    envvar="SWITCHBOARD_DB",
    show_envvar=True,
    help="A database other than SQLite in the data folder: postgresql://USER@HOST/NAME. "
    "Put a password into the variable, never on the command line.",
)
@click.version_option(package_name="robot-switchboard", prog_name="switchboard")
@click.pass_context
def main(ctx: click.Context, data: Path, db: str | None) -> None:
    """Reach, watch and drive robots through a relay of your own.

    Changes take effect at once. A running relay applies them to open connections too.
    """
    # Files belong to the current user alone, whatever the umask was.
    os.umask(0o077)
    ctx.obj = App(data.expanduser(), db)
