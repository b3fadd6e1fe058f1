"""``switchboard realm``."""

from __future__ import annotations

from collections import Counter

import click

from relay_db import queries
from relay_protocol.errors import Invalid
from relay_server.cli.app import App, confirm, examples, existing_realm, json_option, pass_app, yes_option
from relay_server.cli.output import print_list, print_result


@click.group()
def realm() -> None:
    """Keep users and robots of one relay apart: names are unique within one realm.

    Outside its realm the user toad of lab1 is called toad@lab1. A name without @ belongs to the realm
    'default'.
    """


@realm.command(epilog=examples("switchboard realm add lab1"))
@click.argument("name")
@json_option
@pass_app
def add(app: App, name: str, as_json: bool) -> None:
    """Add the realm NAME."""
    with app.change() as change:
        added = queries.add_realm(change.session, name)
        change.audit("realm.add", added.name)
    print_result(as_json, {"realm": added.name}, f"Added realm {added.name}.")


@realm.command("list", epilog=examples("switchboard realm list", "switchboard realm list --json"))
@json_option
@pass_app
def list_(app: App, as_json: bool) -> None:
    """List all realms with the numbers of their users and robots."""
    with app.reading() as session:
        realms = queries.list_realms(session)
        users = Counter(each.realm for each in queries.list_users(session))
        robots = Counter(each.realm for each in queries.list_robots(session))
        for shared in queries.robot_shares(session).values():
            robots.update(shared)
    rows = (
        {
            "realm": each.name,
            "users": users[each.name],
            "robots": robots[each.name],
            "events_days": each.events_days,
        }
        for each in realms
    )
    cells = (
        (each.name, str(users[each.name]), str(robots[each.name]), _retention(each.events_days))
        for each in realms
    )
    print_list(as_json, rows, ("realm", "users", "robots", "events stored"), cells)


@realm.command(
    "set",
    epilog=examples(
        "switchboard realm set lab1 --events-days 7", "switchboard realm set lab1 --events-days relay"
    ),
)
@click.argument("name")
@click.option(
    "--events-days",
    required=True,
    metavar="DAYS",
    help="Days for which the realm's events are stored; 'relay' for the value of 'serve --events-days'.",
)
@json_option
@pass_app
def set_(app: App, name: str, events_days: str, as_json: bool) -> None:
    """Set how long events of realm NAME are stored. A running relay follows within ten minutes."""
    days = None if events_days == "relay" else _days(events_days)
    with app.change() as change:
        name = existing_realm(change.session, name)
        change.keep_events(name, days)
    result = {"realm": name, "events_days": days}
    print_result(as_json, result, f"Events of realm {name} are stored {_retention(days)}.")


def _days(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise Invalid("--events-days is a number of days, or 'relay'") from None


def _retention(days: float | None) -> str:
    return "as long as the relay's" if days is None else f"for {days:g} days"


@realm.command(epilog=examples("switchboard realm remove lab1 --yes"))
@click.argument("name")
@yes_option
@json_option
@pass_app
def remove(app: App, name: str, yes: bool, as_json: bool) -> None:
    """Remove realm NAME with its events and its directory. It must have no users and no robots."""
    with app.reading() as session:
        name = existing_realm(session, name)
    confirm(f"Remove realm {name} with its events and its directory?", yes)
    with app.change() as change:
        queries.remove_realm(change.session, name)
        change.audit("realm.remove", name)
    print_result(as_json, {"realm": name, "removed": True}, f"Removed realm {name}.")
