"""``switchboard group``."""

from __future__ import annotations

from typing import Any

import click

from relay_db import queries
from relay_protocol.errors import Invalid
from relay_protocol.realms import full_name
from relay_server.cli.app import App, examples, json_option, pass_app, yes_option
from relay_server.cli.names import listed, new_name, realm_option
from relay_server.cli.output import show, tell
from relay_server.cli.remove import remove_named


@click.group()
def group() -> None:
    """Give users rights together."""


@group.command(epilog=examples("switchboard group add lab", "switchboard group add lab@lab1"))
@click.argument("name")
@json_option
@pass_app
def add(app: App, name: str, as_json: bool) -> None:
    """Add a group NAME, or NAME@REALM."""
    with app.change() as change:
        added = change.add_group(*new_name(change.session, name))
    tell(as_json, _json(added), f"Added group {added.full}.")


@group.command("list", epilog=examples("switchboard group list", "switchboard group list --realm lab1"))
@realm_option
@json_option
@pass_app
def list_(app: App, realm: str | None, as_json: bool) -> None:
    """List all groups, or those of one realm, and who is in them."""
    with app.reading() as session:
        groups = listed(session, queries.list_groups, realm)
    cells = ((each.full, ", ".join(_members(each))) for each in groups)
    show(as_json, map(_json, groups), ("group", "members"), cells)


@group.command(epilog=examples("switchboard group remove lab --yes"))
@click.argument("name")
@yes_option
@json_option
@pass_app
def remove(app: App, name: str, yes: bool, as_json: bool) -> None:
    """Remove group NAME with its rights; its members stay users."""
    remove_named(app, "group", name, yes, as_json)


@group.command(epilog=examples("switchboard group join lab ann"))
@click.argument("group_name", metavar="GROUP")
@click.argument("user_name", metavar="USER")
@json_option
@pass_app
def join(app: App, group_name: str, user_name: str, as_json: bool) -> None:
    """Put USER into GROUP."""
    with app.change() as change:
        found, member = change.group(group_name), change.user(user_name)
        change.join(found, member)
        found = change.group(group_name)
    tell(as_json, _json(found), f"{member.full} is in group {found.full}.")


@group.command(epilog=examples("switchboard group leave lab ann"))
@click.argument("group_name", metavar="GROUP")
@click.argument("user_name", metavar="USER")
@json_option
@pass_app
def leave(app: App, group_name: str, user_name: str, as_json: bool) -> None:
    """Take USER out of GROUP."""
    with app.change() as change:
        found, member = change.group(group_name), change.user(user_name)
        if not change.leave(found, member):
            raise Invalid(f"{member.full} is not in group {found.full}")
        found = change.group(group_name)
    tell(as_json, _json(found), f"{member.full} is no longer in group {found.full}.")


def _json(record: queries.GroupRecord) -> dict[str, Any]:
    return {"group": record.full, "members": _members(record)}


def _members(record: queries.GroupRecord) -> list[str]:
    return [full_name(each, record.realm) for each in record.members]
