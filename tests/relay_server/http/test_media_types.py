"""Content negotiation."""

from __future__ import annotations

import pytest

from relay_server.common.etags import tag_of
from relay_server.http.media_types import (
    EVENTS,
    FORMS,
    JSON,
    JSON_LD,
    RDF_XML,
    TURTLE,
    MediaType,
    NotAcceptable,
    UnsupportedMediaType,
    of_any_form,
    preferred,
    sent,
    tags_of,
    wanted,
)


@pytest.mark.parametrize(
    ("accept", "form"),
    [
        (None, JSON),
        ("", JSON),
        ("*/*", JSON),
        ("application/json; charset=utf-8", JSON),
        ("application/*", JSON),
        ("text/*", TURTLE),
        ("text/turtle", TURTLE),
        ("text/turtle, */*", TURTLE),
        ("text/turtle;q=0.5, application/rdf+xml;q=0.7, */*;q=0.1", RDF_XML),
        ('application/ld+json;profile="http://www.w3.org/ns/json-ld#expanded"', JSON_LD),
        ("application/json;q=0, */*;q=0.5", RDF_XML),
        ("TEXT/TURTLE", TURTLE),
        ("text/event-stream", EVENTS),
        ("text/event-stream;q=0.9, application/json", JSON),
    ],
)
def test_the_preferred_form_is_sent(accept: str | None, form: MediaType) -> None:
    """By the qualities in ``Accept``; JSON by default."""
    assert wanted(accept, (*FORMS, EVENTS)) is form


@pytest.mark.parametrize("accept", ["text/html", "application/json;q=0", "text/event-stream"])
def test_a_client_that_accepts_no_form_gets_the_list_of_forms(accept: str) -> None:
    with pytest.raises(NotAcceptable, match="text/turtle") as refused:
        wanted(accept)
    assert refused.value.available == [each.media for each in FORMS]


@pytest.mark.parametrize(
    ("accept", "form"),
    [
        (None, JSON),
        ("text/html, */*;q=0.8", JSON),
        ("text/html", JSON),
        ("application/json;q=0", JSON),
        ("application/json, text/event-stream", JSON),
        ("text/event-stream;q=0, */*", JSON),
        ("application/json;q=0.5, Text/Event-Stream", EVENTS),
    ],
)
def test_the_first_form_is_sent_to_clients_that_accept_none(accept: str | None, form: MediaType) -> None:
    assert preferred(accept, (JSON, EVENTS)) is form


def test_the_form_of_a_body() -> None:
    """Parameters are ignored; unsupported types are refused."""
    assert sent("Text/Turtle; charset=utf-8") is TURTLE
    for unknown in (None, "", "text/plain", "text/event-stream"):
        with pytest.raises(UnsupportedMediaType, match=r"application/rdf\+xml"):
            sent(unknown)


def test_entity_tags_differ_by_media_type() -> None:
    base = tag_of(b"1")
    tags = {each: each.tag(base) for each in FORMS}
    assert len(set(tags.values())) == len(FORMS) and tags[JSON] == base
    for form in FORMS:
        assert form.bases(frozenset(tags.values())) == {base}
        assert form.bases(frozenset({tags[each] for each in FORMS if each is not form})) == frozenset()


def test_a_state_may_be_changed_after_reading_it_in_any_form() -> None:
    """``If-Match`` is about the state; a weak tag matches nothing."""
    base = tag_of(b"1")
    for form in FORMS:
        assert of_any_form(form.tag(base)) == base
        assert of_any_form(f"W/{form.tag(base)}") == of_any_form(form.tag(base))
    assert of_any_form("*") == "*" and of_any_form(None) is None
    assert tags_of(f'W/{base}, "b"') == {base, '"b"'}
