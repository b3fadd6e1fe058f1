"""Queries of the event log; invalid ones are refused with a reason."""

from __future__ import annotations

import csv
import io

import pytest

from relay_db.queries import EventCursor, NameCondition, StoredEventRecord
from relay_protocol.errors import Invalid
from relay_server.events.query import EventFormatter, EventQuery, cursor_text, parse_query

NOW = 1_000_000.0


@pytest.mark.parametrize(
    ("query", "ask"),
    [
        ({}, EventQuery()),
        (
            {"source": "app", "kind": "greet*"},
            EventQuery(source=NameCondition("app"), kind=NameCondition("greet", prefix=True)),
        ),
        ({"robot": "*", "user": "ann"}, EventQuery(robot=NameCondition("", prefix=True), user="ann")),
        ({"since": "12.5", "until": "2001-09-09T01:46:40Z"}, EventQuery(since=12.5, until=1e9)),
        ({"since": "2001-09-09T03:46:40 02:00"}, EventQuery(since=1e9)),
        ({"last": "60"}, EventQuery(since=NOW - 60)),
        ({"data.person": "ann", "data.": ""}, EventQuery(data=(("person", "ann"), ("", "")))),
        ({"limit": "1000", "count": "true"}, EventQuery(limit=1000, counts=True)),
    ],
)
def test_a_query_is_read(query: dict[str, str], ask: EventQuery) -> None:
    """Names and their prefixes, times in two formats, fields of the data."""
    assert parse_query(query, NOW) == ask


@pytest.mark.parametrize(
    "query",
    [
        {"sauce": "x"},
        {"kind": "*greet"},
        {"kind": "x" * 256},
        {"kind": "\0"},
        {"since": "yesterday"},
        {"since": "nan"},
        {"since": "-1"},
        {"since": "2001-09-09"},
        {"since": "2001-09-09T01:46:40"},
        {"since": "١"},
        {"since": "1", "last": "1"},
        {"last": "0"},
        {"last": "1e9"},
        {"limit": "0"},
        {"limit": "1001"},
        {"limit": "00000100"},
        {"limit": "١"},
        {"count": "1"},
        {"after": "x"},
        {"after": "bmFuIDE"},
        {"after": "MSAx" * 30},
        {f"data.{n}": "" for n in range(9)},
    ],
)
def test_invalid_requests_are_refused(query: dict[str, str]) -> None:
    with pytest.raises(Invalid):
        parse_query(query, NOW)


def test_a_place_comes_back_to_the_last_digit() -> None:
    place = EventCursor(1e9 + 1 / 3, 2**40)
    assert parse_query({"after": cursor_text(place)}, NOW).after == place


@pytest.mark.parametrize("words", ["=1+1", "+1", "-1", "@x", "＝1", "\tx", 'a,b"c', "plain", "'x"])
def test_a_table_holds_no_formula(words: str) -> None:
    event = StoredEventRecord(7, "default", 1.5, words, "k", 1, None, '{"a":"=1"}', 3)
    line = io.StringIO(newline="")
    csv.writer(line).writerow(EventFormatter({1: "rover"}).cells(event))
    (cells,) = csv.reader(io.StringIO(line.getvalue(), newline=""))
    dangerous = words[0] in "=+-@＝\t"
    assert cells == ["7", "1.5", f"'{words}" if dangerous else words, "k", "rover", "", "3", '{"a":"=1"}']
