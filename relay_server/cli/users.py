"""``switchboard user``."""

from __future__ import annotations

from typing import Any

import click

from relay_db import queries
from relay_db.names import normal_name
from relay_protocol.errors import Invalid
from relay_protocol.realms import full_name, parted
from relay_server.cli.app import App, examples, json_option, pass_app, user_of, yes_option
from relay_server.cli.names import known_realm, listed, new_name, realm_option
from relay_server.cli.output import show, tell
from relay_server.cli.password_input import new_password_hash, stdin_option
from relay_server.cli.remove import remove_named


@click.group()
def user() -> None:
    """Add, list, change and remove users."""


@user.command(
    epilog=examples(
        "switchboard user add ann",
        "switchboard user add ops --admin --password-stdin < password.txt",
        "switchboard user add fleet-report --no-password",
        "switchboard user add toad@lab1",
    )
)
@click.argument("name")
@click.option("--admin", is_flag=True, help="An administrator: owner of every robot of the realm.")
@stdin_option
@click.option("--no-password", is_flag=True, help="No password: only access tokens let this user in.")
@json_option
@pass_app
def add(app: App, name: str, admin: bool, password_stdin: bool, no_password: bool, as_json: bool) -> None:
    """Add a user NAME, or NAME@REALM. Asks for the password unless told otherwise."""
    if password_stdin and no_password:
        raise click.UsageError("--password-stdin and --no-password exclude each other.")
    bare = normal_name(parted(name)[0], "name of a user")
    with app.reading() as session:
        # before anyone types a password twice for nothing
        _, realm = new_name(session, name)
        if queries.find_user(session, bare, realm) is not None:
            raise Invalid(f"there is a user '{full_name(bare, realm)}' already")
    hashed = None if no_password else new_password_hash(password_stdin)
    with app.change() as change:
        added = change.add_user(bare, realm, hashed, admin=admin)
    tell(as_json, _json(added), f"Added {'administrator' if admin else 'user'} {added.full}.")


@user.command("list", epilog=examples("switchboard user list", "switchboard user list --realm lab1 --json"))
@realm_option
@json_option
@pass_app
def list_(app: App, realm: str | None, as_json: bool) -> None:
    """List all users, or those of one realm."""
    with app.reading() as session:
        users = listed(session, queries.list_users, realm)
    cells = ((each.full, _role(each), _password(each)) for each in users)
    show(as_json, map(_json, users), ("user", "role", "password"), cells)


@user.command(epilog=examples("switchboard user passwd ann", "switchboard user passwd ann --password-stdin"))
@click.argument("name")
@stdin_option
@json_option
@pass_app
def passwd(app: App, name: str, password_stdin: bool, as_json: bool) -> None:
    """Set the password of user NAME; its browser sessions end, its access tokens stay."""
    with app.reading() as session:
        found = user_of(session, name)
        if found.home is not None:
            raise Invalid(f"the password of {found.full} is that of {found.home}; change it there")
    hashed = new_password_hash(password_stdin)
    with app.change() as change:
        found = change.set_password(change.user(name), hashed)
    tell(as_json, _json(found), f"Changed the password of {found.full}.")


@user.command(
    epilog=examples("switchboard user join toad@lab1 lab2", "switchboard user remove toad@lab2 --yes")
)
@click.argument("name")
@click.argument("realm")
@json_option
@pass_app
def join(app: App, name: str, realm: str, as_json: bool) -> None:
    """Give user NAME an account in REALM too, under the same name and with the same password.

    It has no rights there until it is given some. To take it back, remove that account: NAME@REALM.
    """
    with app.change() as change:
        added = change.add_guest(change.user(name), known_realm(change.session, realm))
    tell(as_json, _json(added), f"{added.home} is of the realm {parted(added.full)[1]} too, as {added.full}.")


@user.command(epilog=examples("switchboard user disable ann"))
@click.argument("name")
@json_option
@pass_app
def disable(app: App, name: str, as_json: bool) -> None:
    """Shut user NAME out at once; rights and tokens are kept for later."""
    _set_disabled(app, name, True, as_json)


@user.command(epilog=examples("switchboard user enable ann"))
@click.argument("name")
@json_option
@pass_app
def enable(app: App, name: str, as_json: bool) -> None:
    """Let a disabled user NAME in again."""
    _set_disabled(app, name, False, as_json)


@user.command(epilog=examples("switchboard user remove ann", "switchboard user remove ann --yes"))
@click.argument("name")
@yes_option
@json_option
@pass_app
def remove(app: App, name: str, yes: bool, as_json: bool) -> None:
    """Remove user NAME with its rights and tokens."""
    remove_named(app, "user", name, yes, as_json)


def _set_disabled(app: App, name: str, disabled: bool, as_json: bool) -> None:
    with app.change() as change:
        found = change.set_disabled(change.user(name), disabled)
    sentence = f"{'Disabled' if disabled else 'Enabled'} user {found.full}."
    tell(as_json, _json(found), sentence)


def _json(record: queries.UserRecord) -> dict[str, Any]:
    return {
        "user": record.full,
        "admin": record.admin,
        "disabled": record.disabled,
        "password": record.password_hash is not None,
        "guest_of": record.home,
    }


def _password(record: queries.UserRecord) -> str:
    if record.home is not None:
        return f"that of {record.home}"
    return "yes" if record.password_hash else "no"


def _role(record: queries.UserRecord) -> str:
    role = "admin" if record.admin else "user"
    return f"{role}, disabled" if record.disabled else role
