"""What can be registered and asked, from the words of a request."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from relay_db.queries import EntryCursor, EntryRecord
from relay_protocol.errors import Invalid
from relay_server.registry.entries import (
    EntryQuery,
    Registration,
    RegistryEntry,
    TooLarge,
    ask_of,
    check_words,
    data_text,
    place_text,
)
from relay_server.registry.limits import DATA

RECORD = EntryRecord(
    "a1", "default", "service", "map", "http://a/", "", 1, "rover", 2, "ann", '{"a":1}', 60.0, 10.12345, 70.0
)


def registration(**fields: Any) -> Registration:
    """One that can be, but for these fields."""
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
    """So are those of what robots have."""
    with pytest.raises(Invalid):
        check_words(registration(**fields))


def test_names_are_words_of_any_language() -> None:
    """With blanks inside; services are registered too, robots have some or not."""
    check_words(registration(name="Karte für alle", description="地図"))
    check_words(registration(kind="app.v2_x-1"))


def test_data_is_a_small_object() -> None:
    """Kept in one form."""
    assert data_text(registration().data) == "{}"
    assert data_text(msgspec.Raw(b'{"b": "\xc3\xa4", "a": [1]}')) == '{"a":[1],"b":"\\u00e4"}'
    assert len(data_text(msgspec.Raw(b'{"a":"%s"}' % (b"x" * (DATA - 8))))) == DATA
    for body, error in ((b"[]", Invalid), (b"null", Invalid), (b'{"a":"%s"}' % (b"x" * DATA), TooLarge)):
        with pytest.raises(error):
            data_text(msgspec.Raw(body))


def test_an_entry_is_told_with_its_lease() -> None:
    """Which no clock that was set back prolongs."""
    told = msgspec.json.decode(msgspec.json.encode(RegistryEntry.of(RECORD, 20.0).told()))
    assert told == {
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
    assert RegistryEntry.of(RECORD, 5.0).told()["expires"] == 65.0


def test_a_query_becomes_what_is_asked() -> None:
    """Names, patterns, how many, and from where on."""
    place = EntryCursor("rover", "service", "Karte für alle", "a1")
    query = {"kind": "service", "robot": "r*", "name": "K*", "realm": "lab", "limit": "1000"}
    asked = ask_of({**query, "after": place_text(place)})
    assert asked == EntryQuery("service", "r*", "K*", "lab", 1000, place)
    assert ask_of({}) == EntryQuery()
    longest = EntryCursor("r" * 63, "service", "/" + "x" * 254, f"service:{'r' * 63}:/{'x' * 254}")
    assert ask_of({"after": place_text(longest)}).after == longest


@pytest.mark.parametrize(
    "query",
    [
        {"sort": "name"},
        {"limit": "0"},
        {"limit": "1001"},
        {"limit": "1e2"},
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
    """In words."""
    with pytest.raises(Invalid):
        ask_of(query)
