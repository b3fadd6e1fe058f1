"""``switchboard program``."""

from __future__ import annotations

from typing import Any

import click

from relay_db import queries
from relay_protocol.realms import full_name
from relay_protocol.scopes import Scope
from relay_server.cli.app import App, LocalChange, examples, json_option, pass_app, user_of
from relay_server.cli.output import moment, show, tell
from relay_server.cli.remove import revoke_numbered


@click.group()
def program() -> None:
    """Programs that get tokens by a key and a secret, over Digest or OAuth 2.0."""


@program.command(
    epilog=examples(
        "switchboard program add ann --label 'nightly report'",
        "switchboard program add ann --scope 'viewer publish:/lights@rover' --json",
    )
)
@click.argument("user")
@click.option(
    "--scope", help="What its tokens may be used for at most: viewer, operator@rover, publish:/lights …"
)
@click.option("--label", default="", help="What it is, one line.")
@json_option
@pass_app
def add(app: App, user: str, scope: str | None, label: str, as_json: bool) -> None:
    """Add a program that acts as USER. Its secret is shown once and not stored."""
    checked = None if scope is None else str(Scope(scope))
    with app.change() as change:
        found = change.user(user)
        added, secret = change.add_program(found, checked, label)
    answer = {
        "key": added.key,
        "secret": secret,
        "id": added.id,
        "user": found.full,
        "scope": checked,
    }
    tell(as_json, answer, f"key     {added.key}", f"secret  {secret}")
    if not as_json:
        click.echo("The secret is not shown again.", err=True)


@program.command("list", epilog=examples("switchboard program list", "switchboard program list --user ann"))
@click.option("--user", metavar="NAME", help="Only programs of this user.")
@json_option
@pass_app
def list_(app: App, user: str | None, as_json: bool) -> None:
    """List programs, without their secrets."""
    with app.reading() as session:
        programs = queries.list_programs(session, None if user is None else user_of(session, user).id)
    cells = (
        (str(each.id), _user(each), each.key, each.scope or "all", moment(each.created), each.label)
        for each in programs
    )
    columns = ("id", "user", "key", "scope", "created", "label")
    show(as_json, (_json(each) for each in programs), columns, cells)


@program.command(epilog=examples("switchboard program revoke 3"))
@click.argument("number", metavar="ID", type=click.IntRange(min=1, max=2**31 - 1))
@json_option
@pass_app
def revoke(app: App, number: int, as_json: bool) -> None:
    """Make the program of number ID and its secret worthless; its tokens end, and what they opened is cut at once."""
    revoke_numbered(app, "program", number, LocalChange.revoke_program, as_json)


def _json(record: queries.OAuthClientRecord) -> dict[str, Any]:
    row = record._asdict()
    for hidden in ("user_id", "verifier"):
        del row[hidden]
    return {**row, "user": _user(record)}


def _user(record: queries.OAuthClientRecord) -> str:
    return full_name(record.user, record.realm)
