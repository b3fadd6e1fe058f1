"""``switchboard db``."""

from __future__ import annotations

import click

from relay_db import schema
from relay_server.cli.app import App, examples, json_option, pass_app
from relay_server.cli.output import tell


@click.group()
def db() -> None:
    """Look after the database."""


@db.command(
    epilog=examples(
        "switchboard db upgrade",
        "SWITCHBOARD_DB=postgresql://switchboard@db/switchboard switchboard db upgrade",
    )
)
@json_option
@pass_app
def upgrade(app: App, as_json: bool) -> None:
    """Create the tables, or bring them up to date. The relay does the same when it starts."""
    with app.database() as database:
        answer = {"database": database.url, "schema": schema.HEAD}
    tell(as_json, answer, f"{database.url} has schema {schema.HEAD}.")
