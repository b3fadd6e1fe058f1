"""Pages of collections."""

from __future__ import annotations

import pytest

from relay_protocol.errors import Invalid
from relay_server.http.router import decode_query
from relay_server.resources.page import PageQuery, TypedPageQuery

MEMBERS = {f"/{name}": [f"a/msg/{name.upper()}"] for name in "dcab"}


def names(**query: str) -> tuple[list[str], str]:
    """Names on a page, and its cursor."""
    page, after = decode_query(query, TypedPageQuery).page(MEMBERS, lambda types: types)
    return [name for name, _ in page], after


def test_pages_follow_each_other_in_the_order_of_names() -> None:
    """Each has the cursor of the next; the last one has none."""
    assert names() == (["/a", "/b", "/c", "/d"], "")
    assert names(limit="2") == (["/a", "/b"], "/b")
    assert names(limit="2", after="/b") == (["/c", "/d"], "")
    assert names(after="/d") == ([], "")


def test_members_are_chosen_by_name_and_type() -> None:
    """By a pattern for the name, and by the exact type."""
    assert names(name="/[bc]")[0] == ["/b", "/c"]
    assert names(type="a/msg/C")[0] == ["/c"]
    assert names(name="/b", type="a/msg/C")[0] == []


def test_untyped_names_are_not_requested_by_type() -> None:
    """The error says so, instead of an empty page."""
    assert decode_query({"name": "/b"}, PageQuery).name == "/b"
    with pytest.raises(Invalid, match="no parameter 'type'; known parameters: name, after, limit"):
        decode_query({"type": "a/msg/C"}, PageQuery)


@pytest.mark.parametrize(
    "query",
    [
        {"limit": "0"},
        {"limit": "1001"},
        {"limit": "²"},
        {"limit": "-1"},
        {"sort": "name"},
        {"name": "x" * 10_000},
    ],
    ids=range(6),
)
def test_invalid_value_is_refused(query: dict[str, str]) -> None:
    """With a reason."""
    with pytest.raises(Invalid):
        decode_query(query, TypedPageQuery)
