"""``switchboard events`` and ``switchboard audit``."""

from __future__ import annotations

import contextlib
import csv
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence

import click
import msgspec

from relay_db import queries
from relay_db.queries import EventCursor, EventSearch, StoredEventRecord
from relay_protocol.errors import Invalid
from relay_protocol.realms import full_name
from relay_server.cli.app import (
    App,
    Failure,
    examples,
    existing_realm,
    json_option,
    one_realm_option,
    pass_app,
    resolve_realm,
)
from relay_server.cli.output import format_time, print_json, print_line, print_list, print_result
from relay_server.events.query import (
    EventFormatter,
    EventQuery,
    EventVisibility,
    matching_robots,
    parse_query,
)

FOLLOW_SECONDS = 0.5
"""How often new events are looked for."""

LATEST = 100
PAGE = 500


@click.command(
    epilog=examples(
        "switchboard events --robot rover --last 60",
        "switchboard events --kind 'control.*' --follow",
        "switchboard events --realm lab1 --robot 'cleaner-*'",
        "switchboard events --source greeting --limit 100000 --csv > greeted.csv",
    )
)
@click.option(
    "--source",
    metavar="NAME",
    help="Only events of this source; a * at the end matches all sources that begin so.",
)
@click.option("--kind", metavar="NAME", help="Only events of this kind; * as for --source.")
@click.option("--robot", metavar="NAME", help="Only events about this robot; * as for --source.")
@click.option("--user", metavar="NAME", help="Only events that this user caused or wrote.")
@one_realm_option
@click.option("--last", metavar="SECONDS", help="Only events of the last SECONDS.")
@click.option(
    "--limit", default=LATEST, show_default=True, type=click.IntRange(1, 1_000_000), help="How many."
)
@click.option("--csv", "as_csv", is_flag=True, help="Print CSV, the newest first.")
@click.option("--follow", is_flag=True, help="Continue with new events, until Ctrl-C.")
@json_option
@pass_app
def events(
    app: App,
    source: str | None,
    kind: str | None,
    robot: str | None,
    user: str | None,
    realm: str | None,
    last: str | None,
    limit: int,
    as_csv: bool,
    follow: bool,
    as_json: bool,
) -> None:
    """Show the recent events of a realm, the latest last. With --follow --json each event is one line."""
    if as_csv and (as_json or follow):
        raise Invalid("--csv cannot be combined with --json or --follow")
    named = {what: name for what, name in (("robot", robot), ("user", user)) if name is not None}
    realm, names = resolve_realm(list(named.values()), realm)
    options = {"source": source, "kind": kind, "last": last, **dict(zip(named, names, strict=True))}
    search = parse_query({name: value for name, value in options.items() if value is not None}, time.time())
    with app.reading() as session:
        realm = existing_realm(session, realm)
        # Read before the search, so that events which are written meanwhile are followed and not skipped.
        latest = queries.latest_event_number(session, realm)
        robots = queries.list_robots(session, realm)
    visibility = _visibility(realm, {each.id: each.name for each in robots}, search)
    formatter = EventFormatter({each.id: each.full for each in robots})
    found = _latest_events(app, visibility.search, limit)
    if as_csv:
        table = csv.writer(sys.stdout)
        table.writerow(EventFormatter.COLUMNS)
        table.writerows(formatter.cells(each) for each in found)
        return
    rows = [each for each in found if each.number <= latest][::-1]
    if follow:
        print_event = _json_line if as_json else _line
        with contextlib.suppress(KeyboardInterrupt):
            for each in rows:
                print_event(formatter, each)
            _follow(app, visibility, latest, lambda event: print_event(formatter, event))
        return
    columns = ("id", "at", "source", "kind", "robot", "user", "data")
    print_list(
        as_json,
        (_json(formatter, each) for each in rows),
        columns,
        (_cells(formatter, each) for each in rows),
    )


def _visibility(realm: str, names: dict[int, str], search: EventQuery) -> EventVisibility:
    """An operator with access to the database may see all events."""
    return EventVisibility(
        EventSearch(
            realm,
            matching_robots(search, names),
            without_robot=search.robot is None,
            admin=True,
            source=search.source,
            kind=search.kind,
            user=search.user,
            since=search.since,
        ),
        names,
    )


def _latest_events(app: App, search: EventSearch, limit: int) -> Iterator[StoredEventRecord]:
    """Newest first, one page at a time."""
    place: EventCursor | None = None
    while limit > 0:
        with app.reading() as session:
            page = queries.search_events(session, search, place, min(limit, PAGE))
        yield from map(_with_realm, page.events)
        limit, place = limit - len(page.events), page.cursor
        if place is None:
            return


def _follow(
    app: App, visibility: EventVisibility, number: int, print_event: Callable[[StoredEventRecord], None]
) -> None:
    while True:
        with app.reading() as session:
            news = queries.events_since(session, visibility.search.realm, number, PAGE)
        for each in news:
            if visibility.matches(each):
                print_event(_with_realm(each))
        number = news[-1].number if news else number
        sys.stdout.flush()
        if len(news) < PAGE:
            time.sleep(FOLLOW_SECONDS)


def _with_realm(event: StoredEventRecord) -> StoredEventRecord:
    """The event with its user's full name. An operator of the relay's machine is not a user; their name has a
    space."""
    if event.user is None or " " in event.user:
        return event
    return event._replace(user=full_name(event.user, event.realm))


def _json(formatter: EventFormatter, event: StoredEventRecord) -> dict[str, object]:
    return {**msgspec.structs.asdict(formatter.info(event)), "data": json.loads(event.data)}


def _json_line(formatter: EventFormatter, event: StoredEventRecord) -> None:
    print_json(_json(formatter, event))


def _line(formatter: EventFormatter, event: StoredEventRecord) -> None:
    print_line("  ".join(each for each in _cells(formatter, event)[1:] if each))


def _cells(formatter: EventFormatter, event: StoredEventRecord) -> Sequence[str]:
    data = "" if event.data == "{}" else event.data
    about = formatter.robot(event) or "", event.user or ""
    return str(event.number), format_time(event.at), event.source, event.kind, *about, data


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
    """List changes with their user, time and address, the latest last."""
    with app.reading() as session:
        entries = queries.list_audit(session, limit)[::-1]
    cells = (
        (
            str(each.id),
            format_time(each.at),
            each.actor,
            each.action,
            each.target,
            each.origin,
            json.dumps(each.data) if each.data else "",
        )
        for each in entries
    )
    columns = ("id", "at", "actor", "action", "target", "from", "data")
    print_list(as_json, (each._asdict() for each in entries), columns, cells)


@audit.command(epilog=examples("switchboard audit verify && echo whole"))
@json_option
@pass_app
def verify(app: App, as_json: bool) -> None:
    """Check that no entry was changed, removed or inserted. The exit code is 1 if one was."""
    with app.reading() as session:
        broken = queries.verify_audit(session)
    if broken is None:
        print_result(as_json, {"whole": True, "first_broken": None}, "The audit log is intact.")
        return
    if as_json:
        print_json({"whole": False, "first_broken": broken})
    raise Failure(f"the audit log was tampered with: the first broken entry is number {broken}")
