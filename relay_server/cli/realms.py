"""``switchboard realm``."""

from __future__ import annotations

from collections import Counter

import click

from relay_db import queries
from relay_server.cli.app import App, examples, json_option, pass_app, sure, yes_option
from relay_server.cli.naming import known_realm
from relay_server.cli.output import show, tell


@click.group()
def realm() -> None:
    """Keep users and robots of one relay apart: names are unique within one realm.

    The whole relay knows somebody of the realm lab1 as toad@lab1. A name without @ is of the realm default.
    """


@realm.command(epilog=examples("switchboard realm add lab1"))
@click.argument("name")
@json_option
@pass_app
def add(app: App, name: str, as_json: bool) -> None:
    """Add a realm NAME."""
    with app.change() as change:
        added = queries.add_realm(change.session, name)
        change.audit("realm.add", added.name)
    tell(as_json, {"realm": added.name}, f"Added realm {added.name}.")


@realm.command("list", epilog=examples("switchboard realm list", "switchboard realm list --json"))
@json_option
@pass_app
def list_(app: App, as_json: bool) -> None:
    """List all realms, and how many users and robots are in them."""
    with app.reading() as session:
        realms = queries.list_realms(session)
        users = Counter(each.realm for each in queries.list_users(session))
        robots = Counter(each.realm for each in queries.list_robots(session))
    names = [each.name for each in realms]
    rows = ({"realm": name, "users": users[name], "robots": robots[name]} for name in names)
    cells = ((name, str(users[name]), str(robots[name])) for name in names)
    show(as_json, rows, ("realm", "users", "robots"), cells)


@realm.command(epilog=examples("switchboard realm remove lab1 --yes"))
@click.argument("name")
@yes_option
@json_option
@pass_app
def remove(app: App, name: str, yes: bool, as_json: bool) -> None:
    """Remove realm NAME with its events and its directory, once nobody and no robot is in it any more."""
    with app.reading() as session:
        name = known_realm(session, name)
    sure(f"Remove realm {name} with its events and its directory?", yes)
    with app.change() as change:
        queries.remove_realm(change.session, name)
        change.audit("realm.remove", name)
    tell(as_json, {"realm": name, "removed": True}, f"Removed realm {name}.")
