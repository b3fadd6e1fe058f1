"""``switchboard directory``."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator

import click
from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import EntryRecord, EntrySearch
from relay_protocol.errors import NotFound
from relay_protocol.realms import DEFAULT_REALM, full_name
from relay_server.cli.app import App, examples, json_option, pass_app, robot_of, sure, yes_option
from relay_server.cli.names import known_realm, of_one_realm, one_realm_option
from relay_server.cli.output import moment, show, tell
from relay_server.registry.audit import audited
from relay_server.registry.entries import RegistryEntry, event

PAGE = 1000


@click.group(
    invoke_without_command=True,
    epilog=examples(
        "switchboard directory",
        "switchboard directory --kind application --json",
        "switchboard directory --robot rover",
        "switchboard directory --realm lab1",
        "switchboard directory remove 5f2c8a41d09b6e7733c1a2f4",
    ),
)
@click.option("--kind", metavar="KIND", help="Only of this kind.")
@click.option("--robot", metavar="NAME", help="Only what is about this robot.")
@one_realm_option
@json_option
@click.pass_context
@pass_app
def directory(
    app: App, ctx: click.Context, kind: str | None, robot: str | None, realm: str | None, as_json: bool
) -> None:
    """List services and applications of a realm that have registered themselves, and where they are.

    What robots have, their topics, services, actions and cameras, is told over HTTP: GET /api/v1/directory.
    """
    if ctx.invoked_subcommand is not None:
        return
    now = time.time()
    where, names = of_one_realm([] if robot is None else [robot], realm)
    with app.reading() as session:
        where = known_realm(session, where)
        about = frozenset(robot_of(session, full_name(each, where)).id for each in names)
        ask = EntrySearch(where, about if names else None, not names, kind)
        found = list(_entries(session, ask, now))
    columns = ("id", "kind", "name", "robot", "address", "user", "expires")
    show(as_json, (_json(each, now) for each in found), columns, _cells(found))


@directory.command(epilog=examples("switchboard directory remove 5f2c8a41d09b6e7733c1a2f4 --yes"))
@click.argument("id")
@one_realm_option
@yes_option
@json_option
@pass_app
def remove(app: App, id: str, realm: str | None, yes: bool, as_json: bool) -> None:
    """Take an entry out. A program that is still there enters itself again when it finds that out."""
    with app.reading() as session:
        where = known_realm(session, realm or DEFAULT_REALM)
        there = _see(queries.get_entry(session, where, id, time.time()), id)
    sure(f"Remove the {there.kind} {there.name} of {full_name(there.user, where)} from the directory?", yes)
    now = time.time()
    with app.change() as change:
        gone = _see(queries.remove_entry(change.session, id, now, counts=True), id)
        change.audit("directory.remove", gone.id, **audited(gone))
        queries.remember(change.session, [event("removed", gone, now, None)])
    tell(as_json, {"id": gone.id, "removed": True}, f"Removed the {gone.kind} {gone.name}.")


def _see(found: EntryRecord | None, id: str) -> EntryRecord:
    """:raises NotFound: there is none"""
    if found is None:
        raise NotFound(f"there is no entry '{id}'; see 'switchboard directory'")
    return found


def _entries(session: Session, ask: EntrySearch, now: float) -> Iterator[EntryRecord]:
    while True:
        page = queries.list_entries(session, ask, now, PAGE)
        yield from page
        if len(page) < PAGE:
            return
        ask = ask._replace(after=RegistryEntry.of(page[-1], now).place)


def _full(record: EntryRecord) -> EntryRecord:
    """With names for the whole relay."""
    robot = record.robot and full_name(record.robot, record.realm)
    return record._replace(robot=robot, user=full_name(record.user, record.realm))


def _json(record: EntryRecord, now: float) -> dict[str, object]:
    return {**RegistryEntry.of(_full(record), now).told(), "data": json.loads(record.data)}


def _cells(found: Iterable[EntryRecord]) -> Iterator[tuple[str, ...]]:
    for each in map(_full, found):
        yield each.id, each.kind, each.name, each.robot or "", each.address, each.user, moment(each.expires)
