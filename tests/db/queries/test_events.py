"""The event log, on both databases: written, found, counted and deleted events."""

from __future__ import annotations

import json
from typing import Any

import pytest
from sqlalchemy import text
from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import (
    EventCursor,
    EventSearch,
    NameCondition,
    NewStoredEvent,
    StoredEventRecord,
    event_search,
    events,
)
from relay_protocol.errors import Unavailable

ALL = EventSearch("default", frozenset({1, 2}), True, admin=True)


def new(at: float, source: str = "app", kind: str = "x", **fields: Any) -> NewStoredEvent:
    """An event; values that are no column are its data."""
    realm, robot, user = (fields.pop(name, None) for name in ("realm", "robot_id", "user"))
    data = json.dumps(fields, sort_keys=True, separators=(",", ":"))
    return NewStoredEvent(realm or "default", at, source, kind, robot, user, data)


def remembered(database: Database, *new_ones: NewStoredEvent) -> list[StoredEventRecord]:
    """Writes them in one transaction."""
    with database.begin() as s:
        return queries.store_events(s, new_ones)


def found(database: Database, **ask: Any) -> list[int]:
    """Numbers of all matching events."""
    place: EventCursor | None = None
    numbers: list[int] = []
    with database.reading() as s:
        while True:
            page = queries.search_events(s, ALL._replace(**ask), place, 1000)
            numbers += [each.number for each in page.events]
            place = page.cursor
            if place is None:
                return numbers


def counted(database: Database, **ask: Any) -> int:
    """The number of matching events."""
    with database.reading() as s:
        place, count = None, 0
        while True:
            more, numbers, place = queries.count_events(s, ALL._replace(**ask), place, 3)
            assert len(numbers) == (more if more <= 3 else 0)
            count += more
            if place is None:
                return count


def test_an_event_of_an_unknown_realm_is_not_stored(database: Database) -> None:
    """The others of the transaction are; each has a result in its place."""
    with database.begin() as s:
        kept = queries.store_events(s, [new(1.0, realm="gone"), new(1.0), new(2.0, realm="gone"), new(3.0)])
        queries.add_event_uses(s, {("gone", 1): 2})
    assert [each and each.number for each in kept] == [None, 1, None, 2]


def test_a_realm_that_goes_meanwhile_takes_nothing_along(
    postgresql: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    with postgresql.begin() as s:
        queries.add_realm(s, "lab")
    looked_up = events._realms

    def removed_then(s: Session) -> dict[str, int]:
        found = looked_up(s)
        with postgresql.begin() as other:
            queries.remove_realm(other, "lab")
        return found

    monkeypatch.setattr(events, "_realms", removed_then)
    kept = remembered(postgresql, new(1.0, realm="lab"), new(2.0))
    assert [each and each.number for each in kept] == [None, 1]


def test_a_realm_is_not_removed_while_events_are_written_to_it(postgresql: Database) -> None:
    with postgresql.begin() as s:
        queries.add_realm(s, "lab")
    with postgresql.begin() as writing:
        assert events._locked_realms(writing, {"lab", "nowhere", "\0"}).keys() == {"lab"}
        with pytest.raises(Unavailable, match="locked"), postgresql.begin() as s:
            queries.remove_realm(s, "lab")


def test_events_are_numbered_within_their_realm(database: Database) -> None:
    """In the given order, without gaps, across transactions."""
    with database.begin() as s:
        queries.add_realm(s, "lab")
    kept = remembered(database, new(1.0), new(1.0, realm="lab"), new(1.0, n=1))
    assert [(each.realm, each.number) for each in kept] == [("default", 1), ("lab", 1), ("default", 2)]
    assert [each.number for each in remembered(database, new(2.0), new(0.5, realm="lab"))] == [3, 2]
    with database.reading() as s:
        assert (queries.latest_event_number(s, "default"), queries.latest_event_number(s, "lab")) == (3, 2)
        assert queries.latest_event_number(s, "elsewhere") == 0
        since = queries.events_since(s, "default", 1, 10)
        assert queries.event_counts(s) == {"default": 3, "lab": 2}
    assert [(each.number, each.data, each.use_count) for each in since] == [(2, '{"n":1}', 0), (3, "{}", 0)]
    assert found(database, realm="lab") == [1, 2]


def test_numbers_are_never_given_twice(database: Database) -> None:
    remembered(database, new(1.0), new(2.0))
    with database.begin() as s:
        assert queries.delete_events(s, "default", [1, 2, 7]) == 2
    assert [each.number for each in remembered(database, new(3.0))] == [3]


ASKS: list[tuple[dict[str, Any], list[int]]] = [
    ({}, [6, 5, 4, 3, 2, 1]),
    ({"source": NameCondition("app")}, [6, 5, 1]),
    ({"source": NameCondition("a", prefix=True)}, [6, 5, 2, 1]),
    ({"source": NameCondition("A", prefix=True)}, []),
    ({"source": NameCondition("", prefix=True)}, [6, 5, 4, 3, 2, 1]),
    ({"kind": NameCondition("greeted")}, [5, 1]),
    ({"kind": NameCondition("greeted"), "source": NameCondition("app")}, [5, 1]),
    ({"kind": NameCondition("r", prefix=True), "user": "ann"}, []),
    ({"user": "ann"}, [5, 1]),
    ({"robots": frozenset({1}), "without_robot": False}, [4, 3]),
    ({"robots": frozenset({1, 2}), "without_robot": False}, [4, 3, 2]),
    ({"robots": frozenset({1})}, [6, 5, 4, 3, 1]),
    ({"robots": frozenset(), "without_robot": False}, []),
    ({"since": 3.0}, [6, 5, 4, 3]),
    ({"since": 3.0, "until": 5.0}, [4, 3]),
    ({"admin": False}, [5, 4, 3, 2, 1]),
    ({"admin": False, "robots": frozenset()}, [5, 1]),
    ({"data": (("who", "ann"),)}, [5, 1]),
    ({"data": (("who", "ann"), ("n", "1"))}, [1]),
    ({"data": (("n", "1"),)}, [6, 1]),
    ({"data": (("n", '"1"'),)}, []),
    ({"data": (("deep", "1"),)}, []),
    ({"data": (("yes", "true"),)}, [4]),
    ({"data": (("who", "änn"),)}, [2]),
    ({"data": (("who", "%"),)}, []),
]


def test_matching_events_are_found_and_counted(database: Database) -> None:
    remembered(
        database,
        new(1.0, kind="greeted", user="ann", who="ann", n=1),
        new(2.0, source="anna", kind="Robot", robot_id=2, who="änn"),
        new(3.0, source="relay:rover", kind="robot.online", robot_id=1, n=11, far={"deep": 1}),
        new(4.0, source="relay:rover", kind="login", robot_id=1, yes=True, who="ann "),
        new(5.0, kind="greeted", user="ann", who="ann", n=2),
        new(6.0, kind="login.odd", n="1"),
    )
    for ask, numbers in ASKS:
        assert found(database, **ask) == numbers, ask
        assert counted(database, **ask) == len(numbers), ask


def test_the_relays_own_are_for_insiders_where_they_are_about_no_robot(database: Database) -> None:
    remembered(database, new(1.0, source="relay", kind="x"), new(2.0, kind="login.refused"), new(3.0))
    assert found(database, admin=False) == [3]
    assert found(database) == [3, 2, 1]


def test_a_page_goes_on_where_the_last_one_ended(database: Database) -> None:
    remembered(database, *(new(at) for at in (5.0, 5.0, 1.0, 5.0, 9.0, 5.0)))
    assert found(database) == [5, 6, 4, 2, 1, 3]
    with database.reading() as s:
        first = queries.search_events(s, ALL, None, 3)
        second = queries.search_events(s, ALL, first.cursor, 3)
    assert [each.number for each in first.events + second.events] == [5, 6, 4, 2, 1, 3]


def test_search_reads_a_bounded_number_of_rows(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    """It returns a cursor, and in the end no row is skipped."""
    monkeypatch.setattr(event_search, "MAX_SCANNED", 50)
    monkeypatch.setattr(event_search, "_SLICES", (5, 10, 50))
    remembered(database, *(new(float(each), n=each % 7) for each in range(200)))
    with database.reading() as s:
        page = queries.search_events(s, ALL._replace(data=(("n", "6"),)), None, 1000)
        assert page.cursor is not None and page.cursor.number == 151
        assert len(page.events) == 7
    assert found(database, data=(("n", "6"),)) == [200 - each for each in range(200) if (199 - each) % 7 == 6]
    assert counted(database, data=(("n", "6"),)) == 28
    assert counted(database) == 200


def test_rows_that_lie_apart_are_looked_at_by_fewer(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of them takes longer. A page that ends with the last of them is the last page."""
    monkeypatch.setattr(event_search, "MAX_SCANNED", 8)
    monkeypatch.setattr(event_search, "MAX_SCANNED_SCATTERED", 4)
    monkeypatch.setattr(event_search, "_SLICES", (1, 2, 8))
    rows = [new(float(n), f"s{n % 2}", f"k{n % 2}", user=f"u{n % 2}", robot_id=1 + n % 2) for n in range(16)]
    remembered(database, *rows)
    with database.reading() as s:
        one_robot = {"robots": frozenset({1}), "without_robot": False}
        for ask in (
            {"source": NameCondition("s0")},
            {"kind": NameCondition("k0")},
            {"user": "u0"},
            one_robot,
        ):
            first = queries.count_events(s, ALL._replace(**ask), None, 4)
            assert first == (4, [15, 13, 11, 9], EventCursor(8.0, 9)), ask
            assert queries.search_events(s, ALL._replace(**ask), None, 10).cursor == first.cursor, ask
            assert queries.count_events(s, ALL._replace(**ask), first.cursor, 3) == (4, [], None), ask
        for whole in (
            {},
            {"kind": NameCondition("k", prefix=True)},
            {"source": NameCondition("s", prefix=True)},
        ):
            first = queries.count_events(s, ALL._replace(**whole), None, 0)
            assert first == (8, [], EventCursor(8.0, 9)), whole
            assert queries.search_events(s, ALL._replace(**whole), first.cursor, 100).cursor is None, whole


def test_the_least_used_go_first_then_the_oldest_and_the_newest_are_spared(database: Database) -> None:
    remembered(database, *(new(float(each)) for each in range(1, 31)), new(1.0, source="other"))
    with database.begin() as s:
        queries.add_event_uses(s, {("default", each): 2 for each in range(1, 11)} | {("default", 12): 1})
        queries.add_event_uses(s, {("default", 99): 1})
    with database.reading() as s:
        assert queries.surplus_events(s, "default", "app", 30, 100) == []
        assert queries.surplus_events(s, "default", "app", 20, 100) == [11, *range(13, 22)]
        assert queries.surplus_events(s, "default", "app", 20, 3) == [11, 13, 14]
        # Of 10 that may stay only the newest one is kept.
        gone = queries.surplus_events(s, "default", "app", 10, 100)
        assert gone == [11, *range(13, 30), 12, 1]
        assert queries.sources_over_quota(s, 29) == [("default", "app")]
        used = {each.number: each.use_count for each in queries.events_since(s, "default", 0, 100)}
    assert (used[1], used[12], used[20]) == (2, 1, 0)


def test_the_old_are_found_by_age_and_by_number(database: Database) -> None:
    """Oldest first."""
    remembered(database, new(3.0), new(1.0), new(2.0))
    with database.reading() as s:
        assert queries.oldest_events(s, "default", 3.0, 10) == [2, 3]
        assert queries.oldest_events(s, "default", None, 10) == [2, 3, 1]
        assert queries.oldest_events(s, "default", None, 1) == [2]
        assert queries.oldest_events(s, "elsewhere", None, 10) == []


PLANS: dict[str, dict[str, Any]] = {
    "ix_stored_event_at": {},
    "ix_stored_event_source": {"source": NameCondition("s1"), "kind": NameCondition("k1"), "user": "u1"},
    "ix_stored_event_kind": {"kind": NameCondition("k1"), "since": 5.0},
    "ix_stored_event_user": {"user": "u1", "source": NameCondition("s", prefix=True)},
    "ix_stored_event_robot": {"robots": frozenset({1}), "without_robot": False, "kind": NameCondition("k1")},
}


def test_kinds_of_query_use_their_index(database: Database) -> None:
    """In its order, without sorting more rows than are read; for later pages too."""
    rows = [new(float(n), f"s{n % 5}", f"k{n % 5}", user=f"u{n % 5}", robot_id=n % 5) for n in range(5000)]
    remembered(database, *rows)
    with database.connection() as connection:
        connection.execute(text("ANALYZE"))
    with database.reading() as s:
        explain = "EXPLAIN QUERY PLAN" if s.get_bind().dialect.name == "sqlite" else "EXPLAIN"
        for index, ask in PLANS.items():
            for place in (None, EventCursor(4000.0, 4000)):
                asks = ALL._replace(**ask)
                part = event_search._slice(event_search._shape(s, asks, place)).element
                values = {**event_search._values(s, asks), **event_search._cursor_values(place), "size": 100}
                names = part.compile(s.get_bind()).params
                bound = part.params({name: values[name] for name in names if name in values})
                query = bound.compile(s.get_bind(), compile_kwargs={"literal_binds": True})
                plan = "\n".join(str(row) for row in s.execute(text(f"{explain} {query}")))
                assert f" {index} " in plan, plan
                assert "TEMP B-TREE" not in plan and "Sort" not in plan, plan
