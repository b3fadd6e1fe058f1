"""Patterns that somebody sends cost little, whatever they say; and are refused wherever they come in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from relay_protocol.errors import Invalid
from relay_protocol.link.control import MotionPolicy
from relay_protocol.rights import parse_pattern
from relay_protocol.scopes import Scope
from relay_protocol.wildcards import MOST, see_cheap
from relay_server.fleet.selection import select_robots
from relay_server.registry.entries import ask_of
from relay_server.resources.page import PageQuery

DEAR = ["[Ā-힣]", "*" * (MOST + 1), "a?" * (MOST + 1), "[a]" * (MOST + 1)]
TAKEN_BY: list[Callable[[str], Any]] = [
    see_cheap,
    lambda pattern: parse_pattern(f"*:/{pattern}"),
    lambda pattern: Scope(f"call:/{pattern}@rover"),
    lambda pattern: PageQuery.of({"name": pattern}),
    lambda pattern: ask_of({"name": pattern}),
    lambda pattern: ask_of({"robot": pattern}),
    lambda pattern: select_robots([pattern], ["rover"], {}),
]


@pytest.mark.parametrize("pattern", DEAR)
@pytest.mark.parametrize("taken", TAKEN_BY)
def test_what_costs_much_is_refused(taken: Callable[[str], Any], pattern: str) -> None:
    """Many wildcards, and classes of characters that names do not have."""
    with pytest.raises(Invalid):
        taken(pattern)


@pytest.mark.parametrize("pattern", ["", "*", "/cam_[ab]/*", "?" * MOST, "größe-*", "[a-z]*"])
def test_what_people_write_is_taken(pattern: str) -> None:
    """Also letters beyond ASCII, where they stand for themselves."""
    assert see_cheap(pattern) == pattern


@pytest.mark.parametrize("field", ["topics", "services", "actions"])
def test_a_robot_that_tells_such_patterns_is_told_so(field: str) -> None:
    """Its message can't be read; by itself it makes none."""
    with pytest.raises(msgspec.ValidationError, match="has a \\[ and characters beyond ASCII"):
        msgspec.convert({field: ["/x", DEAR[0]]}, MotionPolicy)
    with pytest.raises(ValueError, match="over 16 wildcards"):
        MotionPolicy(**{field: [DEAR[1]]})
