"""Pages of collections."""

from __future__ import annotations

import pytest

from relay_protocol.errors import Invalid
from relay_server.resources.page import PageQuery

MEMBERS = {f"/{name}": [f"a/msg/{name.upper()}"] for name in "dcab"}


def names(**query: str) -> tuple[list[str], str]:
    """The names of a page, and behind which there are more."""
    page, after = PageQuery.of(query).page(MEMBERS, lambda types: types)
    return [name for name, _ in page], after


def test_pages_follow_each_other_in_the_order_of_names() -> None:
    """Each names where the next begins, the last one nothing."""
    assert names() == (["/a", "/b", "/c", "/d"], "")
    assert names(limit="2") == (["/a", "/b"], "/b")
    assert names(limit="2", after="/b") == (["/c", "/d"], "")
    assert names(after="/d") == ([], "")


def test_members_are_chosen_by_name_and_type() -> None:
    """By a pattern, and by the whole type."""
    assert names(name="/[bc]")[0] == ["/b", "/c"]
    assert names(type="a/msg/C")[0] == ["/c"]
    assert names(name="/b", type="a/msg/C")[0] == []


def test_what_has_no_types_is_not_asked_for_by_type() -> None:
    """That is told, rather than that there is nothing of this type."""
    assert PageQuery.of({"name": "/b"}, typed=False).name == "/b"
    with pytest.raises(Invalid, match="no parameter 'type'; there are name, after, limit"):
        PageQuery.of({"type": "a/msg/C"}, typed=False)


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
def test_what_makes_no_sense_is_refused(query: dict[str, str]) -> None:
    """In words."""
    with pytest.raises(Invalid):
        PageQuery.of(query)
