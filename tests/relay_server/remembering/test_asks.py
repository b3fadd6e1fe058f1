"""What is asked of the memory is read from a query, and everything else is refused in words."""

from __future__ import annotations

import csv
import io

import pytest

from relay_db.queries import EventCursor, NameIs, StoredEventRecord
from relay_protocol.errors import Invalid
from relay_server.events.query import EventFormatter, EventQuery, ask_of, place_text

NOW = 1_000_000.0


@pytest.mark.parametrize(
    ("query", "ask"),
    [
        ({}, EventQuery()),
        (
            {"source": "app", "kind": "greet*"},
            EventQuery(source=NameIs("app"), kind=NameIs("greet", prefix=True)),
        ),
        ({"robot": "*", "user": "ann"}, EventQuery(robot=NameIs("", prefix=True), user="ann")),
        ({"since": "12.5", "until": "2001-09-09T01:46:40Z"}, EventQuery(since=12.5, until=1e9)),
        ({"since": "2001-09-09T03:46:40 02:00"}, EventQuery(since=1e9)),
        ({"last": "60"}, EventQuery(since=NOW - 60)),
        ({"data.person": "ann", "data.": ""}, EventQuery(data=(("person", "ann"), ("", "")))),
        ({"limit": "1000", "count": "true"}, EventQuery(limit=1000, counts=True)),
    ],
)
def test_a_query_is_read(query: dict[str, str], ask: EventQuery) -> None:
    """Names and their beginnings, moments in two forms, fields of the data."""
    assert ask_of(query, NOW) == ask


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
def test_what_makes_no_sense_is_refused(query: dict[str, str]) -> None:
    """Also numbers that only look so."""
    with pytest.raises(Invalid):
        ask_of(query, NOW)


def test_a_place_comes_back_to_the_last_digit() -> None:
    """As text for an address."""
    place = EventCursor(1e9 + 1 / 3, 2**40)
    assert ask_of({"after": place_text(place)}, NOW).after == place


@pytest.mark.parametrize("words", ["=1+1", "+1", "-1", "@x", "＝1", "\tx", 'a,b"c', "plain", "'x"])
def test_a_table_holds_no_formula(words: str) -> None:
    """What begins like one gets an apostrophe; everything else comes back as it was."""
    event = StoredEventRecord(7, "default", 1.5, words, "k", 1, None, '{"a":"=1"}', 3)
    line = io.StringIO(newline="")
    csv.writer(line).writerow(EventFormatter({1: "rover"}).cells(event))
    (cells,) = csv.reader(io.StringIO(line.getvalue(), newline=""))
    dangerous = words[0] in "=+-@＝\t"
    assert cells == ["7", "1.5", f"'{words}" if dangerous else words, "k", "rover", "", "3", '{"a":"=1"}']
