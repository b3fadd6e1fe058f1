"""``switchboard token``."""

from __future__ import annotations

import time
from typing import Any

import click

from relay_db import queries
from relay_protocol.errors import Invalid
from relay_protocol.scopes import Scope
from relay_server.cli.app import App, LocalChange, examples, json_option, pass_app, user_of
from relay_server.cli.output import duration, moment, parse_duration, show, tell
from relay_server.cli.remove import revoke_numbered


@click.group()
def token() -> None:
    """Create, list and revoke access tokens."""


@token.command(
    epilog=examples(
        "switchboard token create ann --ttl 1h",
        'switchboard token create fleet-report --ttl 30d --label "nightly report" --json',
        "switchboard token create ann --scope 'viewer publish:/lights@rover'",
    )
)
@click.argument("user")
@click.option("--ttl", default="24h", show_default=True, help="How long it is good: 90s, 15m, 1h, 7d, 2w.")
@click.option(
    "--scope", help="What it may be used for, if not for all that USER may: viewer, operator@rover …"
)
@click.option("--label", default="", help="What it is for, one line.")
@json_option
@pass_app
def create(app: App, user: str, ttl: str, scope: str | None, label: str, as_json: bool) -> None:
    """Create a token that acts as USER. It is shown once and not stored."""
    checked = None if scope is None else str(Scope(scope))
    seconds = parse_duration(ttl)
    with app.change() as change:
        found = change.user(user)
        if found.disabled:
            raise Invalid(f"user '{found.full}' is disabled; enable it first")
        number, secret = change.create_token(found, seconds, checked, label)
    answer = {"token": secret, "expires_in": seconds, "id": number, "user": found.full}
    tell(as_json, answer, secret)
    if not as_json:
        # not to stdout, which a script may take as the token
        click.echo(f"Number {number}, good for {duration(seconds)}. It is not shown again.", err=True)


@token.command("list", epilog=examples("switchboard token list", "switchboard token list --user ann"))
@click.option("--user", metavar="NAME", help="Only tokens of this user.")
@json_option
@pass_app
def list_(app: App, user: str | None, as_json: bool) -> None:
    """List tokens and browser sessions, without the tokens themselves."""
    with app.reading() as session:
        found = queries.list_tokens(session, None if user is None else user_of(session, user).id)
        names = {each.id: each.full for each in queries.list_users(session)}
    tokens = [each._replace(user=names[each.user_id]) for each in found]
    now = time.time()
    cells = (
        (
            str(each.id),
            each.user,
            each.kind,
            each.scope or "all",
            _expiry(each, now),
            moment(each.created),
            each.label,
        )
        for each in tokens
    )
    columns = ("id", "user", "kind", "scope", "expires", "created", "label")
    show(as_json, (_json(each) for each in tokens), columns, cells)


@token.command(epilog=examples("switchboard token revoke 7"))
@click.argument("number", metavar="ID", type=click.IntRange(min=1, max=2**31 - 1))
@json_option
@pass_app
def revoke(app: App, number: int, as_json: bool) -> None:
    """Make the token of number ID worthless; what it opened is cut at once."""
    revoke_numbered(app, "token", number, LocalChange.revoke_token, as_json)


def _json(record: queries.TokenRecord) -> dict[str, Any]:
    row = record._asdict()
    del row["user_id"]
    return row


def _expiry(record: queries.TokenRecord, now: float) -> str:
    over = record.expires is not None and record.expires <= now
    return f"{moment(record.expires)} (over)" if over else moment(record.expires)
