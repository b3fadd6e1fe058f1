"""``switchboard directory``."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator

import click
import msgspec
from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import EntryRecord, EntrySearch
from relay_protocol.errors import NotFound
from relay_protocol.realms import DEFAULT_REALM, full_name
from relay_server.cli.app import (
    App,
    confirm,
    examples,
    existing_realm,
    get_robot,
    json_option,
    one_realm_option,
    pass_app,
    resolve_realm,
    yes_option,
)
from relay_server.cli.output import format_time, print_list, print_result
from relay_server.service_registry.changes import audited
from relay_server.service_registry.entries import EntryInfo, stored_event

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
@click.option("--kind", metavar="KIND", help="Only entries of this kind.")
@click.option("--robot", metavar="NAME", help="Only entries about this robot.")
@one_realm_option
@json_option
@click.pass_context
@pass_app
def directory(
    app: App, ctx: click.Context, kind: str | None, robot: str | None, realm: str | None, as_json: bool
) -> None:
    """List the services and applications that are registered in a realm, and their addresses.

    Topics, services, actions and cameras of robots are listed over HTTP: GET /api/v1/directory.
    """
    if ctx.invoked_subcommand is not None:
        return
    now = time.time()
    in_realm, names = resolve_realm([] if robot is None else [robot], realm)
    with app.reading() as session:
        in_realm = existing_realm(session, in_realm)
        about = frozenset(get_robot(session, full_name(each, in_realm)).id for each in names)
        search = EntrySearch(in_realm, about if names else None, not names, kind)
        found = list(_entries(session, search, now))
    columns = ("id", "kind", "name", "robot", "address", "user", "expires")
    print_list(as_json, (_json(each, now) for each in found), columns, _cells(found))


@directory.command(epilog=examples("switchboard directory remove 5f2c8a41d09b6e7733c1a2f4 --yes"))
@click.argument("id")
@one_realm_option
@yes_option
@json_option
@pass_app
def remove(app: App, id: str, realm: str | None, yes: bool, as_json: bool) -> None:
    """Remove the entry ID. A program that still runs registers again when it notices."""
    with app.reading() as session:
        in_realm = existing_realm(session, realm or DEFAULT_REALM)
        entry = _require(queries.get_entry(session, in_realm, id, time.time()), id)
    confirm(
        f"Remove the {entry.kind} {entry.name} of {full_name(entry.user, in_realm)} from the directory?", yes
    )
    now = time.time()
    with app.change() as change:
        removed = _require(queries.remove_entry(change.session, id, now, announce=True), id)
        change.audit("directory.remove", removed.id, **audited(removed))
        queries.store_events(change.session, [stored_event("removed", removed, now, None)])
    print_result(
        as_json,
        {"id": removed.id, "removed": True},
        f"Removed the {removed.kind} {removed.name}.",
    )


def _require(found: EntryRecord | None, id: str) -> EntryRecord:
    if found is None:
        raise NotFound(f"there is no entry '{id}'; see 'switchboard directory'")
    return found


def _entries(session: Session, search: EntrySearch, now: float) -> Iterator[EntryRecord]:
    while True:
        page = queries.list_entries(session, search, now, PAGE)
        yield from page
        if len(page) < PAGE:
            return
        search = search._replace(after=EntryInfo.of(page[-1], now).cursor)


def _full(record: EntryRecord) -> EntryRecord:
    """The record with names that are unique in the whole relay."""
    robot = record.robot and full_name(record.robot, record.realm)
    return record._replace(robot=robot, user=full_name(record.user, record.realm))


def _json(record: EntryRecord, now: float) -> dict[str, object]:
    entry = msgspec.structs.asdict(EntryInfo.of(_full(record), now))
    return {**entry, "data": json.loads(record.data)}


def _cells(found: Iterable[EntryRecord]) -> Iterator[tuple[str, ...]]:
    for each in map(_full, found):
        yield (
            each.id,
            each.kind,
            each.name,
            each.robot or "",
            each.address,
            each.user,
            format_time(each.expires),
        )
