"""``switchboard audit``."""

from __future__ import annotations

import json

import click

from relay_db import queries
from relay_server.cli.app import App, examples, json_option, pass_app
from relay_server.cli.failure import Failure
from relay_server.cli.output import moment, show, show_json, tell


@click.group()
def audit() -> None:
    """Read and verify the audit log."""


@audit.command(
    "list", epilog=examples("switchboard audit list", "switchboard audit list --limit 1000 --json")
)
@click.option("--limit", default=100, show_default=True, type=click.IntRange(1, 1_000_000))
@json_option
@pass_app
def list_(app: App, limit: int, as_json: bool) -> None:
    """List who did what when from where, the latest last."""
    with app.reading() as session:
        entries = queries.list_audit(session, limit)[::-1]
    cells = (
        (
            str(each.id),
            moment(each.at),
            each.actor,
            each.action,
            each.target,
            each.origin,
            json.dumps(each.data) if each.data else "",
        )
        for each in entries
    )
    columns = ("id", "at", "who", "what", "whom", "from", "data")
    show(as_json, (each._asdict() for each in entries), columns, cells)


@audit.command(epilog=examples("switchboard audit verify && echo whole"))
@json_option
@pass_app
def verify(app: App, as_json: bool) -> None:
    """Check that no entry was changed, removed or put in; exit code 1 if one was."""
    with app.reading() as session:
        broken = queries.verify_audit(session)
    if broken is None:
        tell(as_json, {"whole": True, "first_broken": None}, "The audit log is whole.")
        return
    if as_json:
        show_json({"whole": False, "first_broken": broken})
    raise Failure(f"the audit log was tampered with: the first broken entry is number {broken}")
