"""``switchboard token`` and ``switchboard oauth-client``."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import click

from relay_db import queries
from relay_protocol.errors import Invalid, NotFound
from relay_protocol.realms import full_name
from relay_server.cli.app import (
    App,
    LocalChange,
    examples,
    json_option,
    number_argument,
    parse_scope,
    pass_app,
    user_id,
)
from relay_server.cli.output import format_duration, format_time, parse_duration, print_list, print_result


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
@click.option("--ttl", default="24h", show_default=True, help="How long it is valid: 90s, 15m, 1h, 7d, 2w.")
@click.option("--scope", help="Limits the token to some rights of USER: viewer, operator@rover …")
@click.option("--label", default="", help="What the token is for, one line.")
@json_option
@pass_app
def create(app: App, user: str, ttl: str, scope: str | None, label: str, as_json: bool) -> None:
    """Create a token that acts as USER. It is shown once and not stored."""
    checked = parse_scope(scope)
    seconds = parse_duration(ttl)
    with app.change() as change:
        found = change.user(user)
        if found.disabled:
            raise Invalid(f"user '{found.full}' is disabled; enable it first")
        number, secret = change.create_token(found, seconds, checked, label)
    answer = {"token": secret, "expires_in": seconds, "id": number, "user": found.full}
    print_result(as_json, answer, secret)
    if not as_json:
        # Not to stdout, which a script may take as the token.
        click.echo(f"Token {number}, valid for {format_duration(seconds)}. It is not shown again.", err=True)


@token.command("list", epilog=examples("switchboard token list", "switchboard token list --user ann"))
@click.option("--user", metavar="NAME", help="Only tokens of this user.")
@json_option
@pass_app
def list_(app: App, user: str | None, as_json: bool) -> None:
    """List tokens and browser sessions, without the tokens themselves."""
    with app.reading() as session:
        found = queries.list_tokens(session, user_id(session, user))
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
            format_time(each.created),
            each.label,
        )
        for each in tokens
    )
    columns = ("id", "user", "kind", "scope", "expires", "created", "label")
    print_list(as_json, (_json(each) for each in tokens), columns, cells)


@token.command(epilog=examples("switchboard token revoke 7"))
@number_argument
@json_option
@pass_app
def revoke(app: App, number: int, as_json: bool) -> None:
    """Revoke the token of number ID. Connections that use it are cut at once."""
    _revoke(app, "token", number, LocalChange.revoke_token, as_json)


def _json(record: queries.TokenRecord) -> dict[str, Any]:
    row = record._asdict()
    del row["user_id"]
    return row


def _expiry(record: queries.TokenRecord, now: float) -> str:
    over = record.expires is not None and record.expires <= now
    return f"{format_time(record.expires)} (over)" if over else format_time(record.expires)


# --- OAuth clients ----------------------------------------------------------------------------------------


@click.group()
def oauth_client() -> None:
    """Manage OAuth clients: programs that get tokens with a key and a secret, by HTTP Digest or OAuth 2.0."""


@oauth_client.command(
    "add",
    epilog=examples(
        "switchboard oauth-client add ann --label 'nightly report'",
        "switchboard oauth-client add ann --scope 'viewer publish:/lights@rover' --json",
    ),
)
@click.argument("user")
@click.option(
    "--scope", help="The most that its tokens may be used for: viewer, operator@rover, publish:/lights …"
)
@click.option("--label", default="", help="Its purpose, one line.")
@json_option
@pass_app
def add_client(app: App, user: str, scope: str | None, label: str, as_json: bool) -> None:
    """Add an OAuth client that acts as USER. Its secret is shown once and not stored."""
    checked = parse_scope(scope)
    with app.change() as change:
        found = change.user(user)
        added, secret = change.add_oauth_client(found, checked, label)
    answer = {
        "key": added.key,
        "secret": secret,
        "id": added.id,
        "user": found.full,
        "scope": checked,
    }
    print_result(as_json, answer, f"key     {added.key}", f"secret  {secret}")
    if not as_json:
        click.echo("The secret is not shown again.", err=True)


@oauth_client.command(
    "list", epilog=examples("switchboard oauth-client list", "switchboard oauth-client list --user ann")
)
@click.option("--user", metavar="NAME", help="Only OAuth clients of this user.")
@json_option
@pass_app
def list_clients(app: App, user: str | None, as_json: bool) -> None:
    """List OAuth clients, without their secrets."""
    with app.reading() as session:
        oauth_clients = queries.list_oauth_clients(session, user_id(session, user))
    cells = (
        (str(each.id), _user(each), each.key, each.scope or "all", format_time(each.created), each.label)
        for each in oauth_clients
    )
    columns = ("id", "user", "key", "scope", "created", "label")
    print_list(as_json, (_client_json(each) for each in oauth_clients), columns, cells)


@oauth_client.command("revoke", epilog=examples("switchboard oauth-client revoke 3"))
@number_argument
@json_option
@pass_app
def revoke_client(app: App, number: int, as_json: bool) -> None:
    """Revoke the OAuth client of number ID and its secret. Its tokens end, and their connections are cut at once."""
    _revoke(app, "OAuth client", number, LocalChange.revoke_oauth_client, as_json)


def _client_json(record: queries.OAuthClientRecord) -> dict[str, Any]:
    row = record._asdict()
    for hidden in ("user_id", "digest_ha1"):
        del row[hidden]
    return {**row, "user": _user(record)}


def _user(record: queries.OAuthClientRecord) -> str:
    return full_name(record.user, record.realm)


def _revoke(
    app: App, what: str, number: int, revoke: Callable[[LocalChange, int], bool], as_json: bool
) -> None:
    """Revoke a token or an OAuth client, with an audit entry.

    :param what: ``token`` or ``OAuth client``; its command is spelled with a hyphen
    :param revoke: returns false when there is none
    :raises NotFound: there is none of this number
    """
    command = what.lower().replace(" ", "-")
    with app.change() as change:
        if not revoke(change, number):
            raise NotFound(f"there is no {what} {number}; see 'switchboard {command} list'")
    print_result(as_json, {"id": number, "revoked": True}, f"Revoked {what} {number}.")
