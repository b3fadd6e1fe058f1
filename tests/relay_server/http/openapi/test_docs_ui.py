"""The OpenAPI document as a page."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest

from relay_server.http.openapi.document import document
from relay_server.http.openapi.http import operations, page

EMPTY = {"meta", "link", "img", "br", "wbr"}


class Reader(HTMLParser):
    """Reads a page, and checks that each element is closed in its parent."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Opens an element."""
        given = dict(attrs)
        self.ids += [given["id"] or ""] if "id" in given else []
        self.links += [given[name] or "" for name in ("href", "src") if name in given]
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        """Closes an element."""
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def text() -> str:
    """The page of all endpoints."""
    return page(document(operations(), "1.2.3", "sb"))


@pytest.fixture(scope="module")
def reader(text: str) -> Reader:
    """The parsed page."""
    reader = Reader()
    reader.feed(text)
    assert not reader.open
    return reader


def test_the_page_needs_no_other_host_and_no_script(text: str, reader: Reader) -> None:
    """All its links point to itself or the relay."""
    assert all(each.startswith(("#", "/")) and not each.startswith("//") for each in reader.links)
    assert "<script" not in text
    assert "url(" not in text
    assert not re.search(r"\son\w+=", text)


def test_every_operation_and_every_type_has_its_place(reader: Reader) -> None:
    """Each link within the page has a target."""
    assert len(reader.ids) == len(set(reader.ids))
    assert {each.id for each in operations()} <= set(reader.ids)
    assert {each[1:] for each in reader.links if each.startswith("#")} <= set(reader.ids)


def test_speech_is_not_html() -> None:
    """Descriptions and names are escaped."""
    made = document(operations(), "<b>1</b>", "sb")
    made["tags"][0]["description"] = "<i>`a<b`</i>"
    text = page(made)
    assert "<b>1</b>" not in text
    assert "&lt;i&gt;<code>a&lt;b</code>&lt;/i&gt;" in text
