"""Entries and queries of the service registry, from the text of a request."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from relay_db.queries import EntryCursor, EntryRecord
from relay_protocol.errors import Invalid
from relay_server.service_registry.entries import (
    DATA,
    EntryInfo,
    EntryQuery,
    Registration,
    TooLarge,
    check_texts,
    cursor_text,
    data_text,
)
from tests.worlds.service_registry import asked

RECORD = EntryRecord(
    "a1", "default", "service", "map", "http://a/", "", 1, "rover", 2, "ann", '{"a":1}', 60.0, 10.12345, 70.0
)


def registration(**fields: Any) -> Registration:
    """A valid registration with these fields changed."""
    return Registration(**{"kind": "service", "name": "map", "address": "http://a/", **fields})


@pytest.mark.parametrize(
    "fields",
    [
        {"kind": "Service"},
        {"kind": "a b"},
        {"kind": "1st"},
        {"kind": "robot"},
        {"kind": "topic"},
        {"kind": "action"},
        {"kind": "camera"},
        {"name": "a\nb"},
        {"name": " map"},
        {"name": "a\u202eb"},
        {"description": "a\x00b"},
    ],
    ids=str,
)
def test_names_that_can_not_be_are_refused(fields: dict[str, Any]) -> None:
    """Names of robots' own entries are refused too."""
    with pytest.raises(Invalid):
        check_texts(registration(**fields))


def test_names_are_words_of_any_language() -> None:
    """They may contain blanks. Service names are allowed too, whether or not a robot has them."""
    check_texts(registration(name="Karte für alle", description="地図"))
    check_texts(registration(kind="app.v2_x-1"))


def test_data_is_a_small_object() -> None:
    """Equal data has one serialised form."""
    assert data_text(registration().data) == "{}"
    assert data_text(msgspec.Raw(b'{"b": "\xc3\xa4", "a": [1]}')) == '{"a":[1],"b":"\\u00e4"}'
    assert len(data_text(msgspec.Raw(b'{"a":"%s"}' % (b"x" * (DATA - 8))))) == DATA
    for body, error in ((b"[]", Invalid), (b"null", Invalid), (b'{"a":"%s"}' % (b"x" * DATA), TooLarge)):
        with pytest.raises(error):
            data_text(msgspec.Raw(body))


def test_an_entry_is_sent_with_its_lease() -> None:
    """Setting the clock back does not extend the lease."""
    reported = msgspec.json.decode(msgspec.json.encode(EntryInfo.of(RECORD, 20.0)))
    assert reported == {
        "id": "a1",
        "kind": "service",
        "name": "map",
        "robot": "rover",
        "address": "http://a/",
        "description": "",
        "data": {"a": 1},
        "user": "ann",
        "ttl": 60.0,
        "registered": 10.123,
        "expires": 70.0,
    }
    assert EntryInfo.of(RECORD, 5.0).expires == 65.0


def test_a_query_becomes_what_is_asked() -> None:
    """Names, patterns, page size and cursor."""
    place = EntryCursor("rover", "service", "Karte für alle", "a1")
    query = {"kind": "service", "robot": "r*", "name": "K*", "realm": "lab", "limit": "1000"}
    found = asked({**query, "after": cursor_text(place)})
    assert found == EntryQuery("service", "r*", "K*", "lab", 1000, place)
    assert asked({}) == EntryQuery()
    longest = EntryCursor("r" * 63, "service", "/" + "x" * 254, f"service:{'r' * 63}:/{'x' * 254}")
    assert asked({"after": cursor_text(longest)}).after == longest


@pytest.mark.parametrize(
    "query",
    [
        {"sort": "name"},
        {"limit": "0"},
        {"limit": "1001"},
        {"limit": "1.5"},
        {"limit": "٣"},
        {"name": "x" * 256},
        {"after": ""},
        {"after": "!"},
        {"after": "AAAA"},
        {"after": "W10"},
        {"after": "x" * 2049},
    ],
    ids=str,
)
def test_a_query_that_makes_no_sense_is_refused(query: dict[str, str]) -> None:
    """With a reason."""
    with pytest.raises(Invalid):
        asked(query)
