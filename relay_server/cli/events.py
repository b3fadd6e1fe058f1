"""``switchboard events``."""

from __future__ import annotations

import contextlib
import csv
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence

import click

from relay_db import queries
from relay_db.queries import EventCursor, EventSearch, StoredEventRecord
from relay_protocol.errors import Invalid
from relay_protocol.realms import full_name
from relay_server.cli.app import App, examples, json_option, pass_app
from relay_server.cli.names import known_realm, of_one_realm, one_realm_option
from relay_server.cli.output import moment, say, show, show_json
from relay_server.events.query import EventFormatter, EventQuery, ask_of, chosen
from relay_server.events.service import EventVisibility

FOLLOW_SECONDS = 0.5
"""How often it is looked for new ones."""

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
    "--source", metavar="NAME", help="Only from this source; with * at its end from all that begin so."
)
@click.option("--kind", metavar="NAME", help="Only of this kind, in the same way.")
@click.option("--robot", metavar="NAME", help="Only about this robot, in the same way.")
@click.option("--user", metavar="NAME", help="Only what this user did or wrote.")
@one_realm_option
@click.option("--last", metavar="SECONDS", help="Only of the last so many seconds.")
@click.option(
    "--limit", default=LATEST, show_default=True, type=click.IntRange(1, 1_000_000), help="How many."
)
@click.option("--csv", "as_csv", is_flag=True, help="Print CSV, the newest first.")
@click.option("--follow", is_flag=True, help="Go on with what is new, until Ctrl-C.")
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
    """Show what happened of late in a realm, the latest last. With --follow --json an event is a line."""
    if as_csv and (as_json or follow):
        raise Invalid("--csv goes without --json and --follow")
    named = {what: name for what, name in (("robot", robot), ("user", user)) if name is not None}
    realm, names = of_one_realm(list(named.values()), realm)
    options = {"source": source, "kind": kind, "last": last, **dict(zip(named, names, strict=True))}
    ask = ask_of({name: value for name, value in options.items() if value is not None}, time.time())
    with app.reading() as session:
        realm = known_realm(session, realm)
        # Before it is looked: what is written meanwhile is told then, and not passed over.
        latest = queries.latest_memory(session, realm)
        robots = queries.list_robots(session, realm)
    sight = _sight(realm, {each.id: each.name for each in robots}, ask)
    forms = EventFormatter({each.id: each.full for each in robots})
    found = _found(app, sight.ask, limit)
    if as_csv:
        table = csv.writer(sys.stdout)
        table.writerow(EventFormatter.COLUMNS)
        table.writerows(forms.cells(each) for each in found)
        return
    rows = [each for each in found if each.number <= latest][::-1]
    if follow:
        tell = _json_line if as_json else _line
        with contextlib.suppress(KeyboardInterrupt):
            for each in rows:
                tell(forms, each)
            _follow(app, sight, latest, lambda event: tell(forms, event))
        return
    columns = ("id", "at", "source", "kind", "robot", "user", "data")
    show(as_json, (_json(forms, each) for each in rows), columns, (_cells(forms, each) for each in rows))


def _sight(realm: str, names: dict[int, str], ask: EventQuery) -> EventVisibility:
    """Whoever may read the database may see all of it."""
    return EventVisibility(
        EventSearch(
            realm,
            chosen(ask, names),
            ask.robot is None,
            True,
            ask.source,
            ask.kind,
            ask.user,
            ask.since,
        ),
        names,
    )


def _found(app: App, ask: EventSearch, limit: int) -> Iterator[StoredEventRecord]:
    """The newest first, a page at a time."""
    place: EventCursor | None = None
    while limit > 0:
        with app.reading() as session:
            page = queries.recall(session, ask, place, min(limit, PAGE))
        yield from map(_with_realm, page.events)
        limit, place = limit - len(page.events), page.place
        if place is None:
            return


def _follow(app: App, sight: EventVisibility, number: int, tell: Callable[[StoredEventRecord], None]) -> None:
    while True:
        with app.reading() as session:
            news = queries.memories_since(session, sight.ask.realm, number, PAGE)
        for each in news:
            if sight.shows(each):
                tell(_with_realm(each))
        number = news[-1].number if news else number
        sys.stdout.flush()
        if len(news) < PAGE:
            time.sleep(FOLLOW_SECONDS)


def _with_realm(event: StoredEventRecord) -> StoredEventRecord:
    """With its user's name for the whole relay. Who sits at the relay's machine is no user: he has a space in his."""
    if event.user is None or " " in event.user:
        return event
    return event._replace(user=full_name(event.user, event.realm))


def _json(forms: EventFormatter, event: StoredEventRecord) -> dict[str, object]:
    return {**forms.json(event), "data": json.loads(event.data)}


def _json_line(forms: EventFormatter, event: StoredEventRecord) -> None:
    show_json(_json(forms, event))


def _line(forms: EventFormatter, event: StoredEventRecord) -> None:
    say("  ".join(each for each in _cells(forms, event)[1:] if each))


def _cells(forms: EventFormatter, event: StoredEventRecord) -> Sequence[str]:
    data = "" if event.data == "{}" else event.data
    about = forms.robot(event) or "", event.user or ""
    return str(event.number), moment(event.at), event.source, event.kind, *about, data
