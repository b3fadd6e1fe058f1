"""Selection of an order's robots."""

from __future__ import annotations

from fnmatch import fnmatchcase

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_server.fleet import order as module
from relay_server.fleet.order import Selection, select_robots

ROBOTS = ("cleaner-1", "cleaner-2", "cleaner-10", "other")
GROUPS = {"cleaners": ("cleaner-1", "cleaner-2", "secret"), "mine": ("other",), "empty": ()}


@pytest.mark.parametrize(
    ("asked", "robots", "unmatched"),
    [
        (["cleaner-1"], ["cleaner-1"], []),
        (["cleaner-*"], ["cleaner-1", "cleaner-10", "cleaner-2"], []),
        (["cleaner-?", "other", "other"], ["cleaner-1", "cleaner-2", "other"], []),
        (["cleaner-[2-9]"], ["cleaner-2"], []),
        (["*"], sorted(ROBOTS), []),
        (["group:cleaners"], ["cleaner-1", "cleaner-2"], []),
        (["group:Mine", "cleaner-1"], ["cleaner-1", "other"], []),
        (
            ["group:empty", "group:nowhere", "Other", "tank", "tank"],
            [],
            ["group:empty", "group:nowhere", "Other", "tank"],
        ),
        (["group:*"], [], ["group:*"]),
    ],
)
def test_names_patterns_and_groups(asked: list[str], robots: list[str], unmatched: list[str]) -> None:
    """Each robot is selected once, robots without the right never; an empty selection is an error."""
    assert select_robots(asked, ROBOTS, GROUPS) == Selection(robots, unmatched)


def test_a_name_is_looked_up_and_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand names are not matched against all robots, whether they exist or not."""
    compared: list[str] = []
    monkeypatch.setattr(module, "fnmatchcase", lambda name, pattern: compared.append(pattern))
    assert select_robots(["other", "tank", "Other"], ROBOTS, GROUPS) == Selection(
        ["other"], ["tank", "Other"]
    )
    assert compared == []


@given(st.lists(st.text("ab*?[]", max_size=5), max_size=4), st.sets(st.text("ab", min_size=1, max_size=4)))
def test_unmatched_text_is_no_command(asked: list[str], robots: set[str]) -> None:
    """All matches are listed."""
    found = select_robots(asked, robots, {})
    assert found.robots == sorted(
        name for name in robots if any(fnmatchcase(name, each) or each == name for each in asked)
    )
