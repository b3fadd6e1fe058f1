"""Patterns of peers are cheap to match, for any content; costly ones are refused everywhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from relay_protocol.errors import Invalid
from relay_protocol.link.motion import MotionPolicy
from relay_protocol.rights import parse_pattern
from relay_protocol.scopes import Scope
from relay_protocol.wildcards import MAX_WILDCARDS, check_pattern
from relay_server.fleet.order import select_robots
from relay_server.http.router import decode_query
from relay_server.resources.page import PageQuery
from relay_server.service_registry.entries import EntryParameters

DEAR = ["[Ā-힣]", "*" * (MAX_WILDCARDS + 1), "a?" * (MAX_WILDCARDS + 1), "[a]" * (MAX_WILDCARDS + 1)]
TAKEN_BY: list[Callable[[str], Any]] = [
    check_pattern,
    lambda pattern: parse_pattern(f"*:/{pattern}"),
    lambda pattern: Scope(f"call:/{pattern}@rover"),
    lambda pattern: decode_query({"name": pattern}, PageQuery),
    lambda pattern: decode_query({"name": pattern}, EntryParameters).wanted(),
    lambda pattern: decode_query({"robot": pattern}, EntryParameters).wanted(),
    lambda pattern: select_robots([pattern], ["rover"], {}),
]


@pytest.mark.parametrize("pattern", DEAR)
@pytest.mark.parametrize("taken", TAKEN_BY)
def test_costly_request_is_refused(taken: Callable[[str], Any], pattern: str) -> None:
    """Many wildcards, and classes of characters that names do not have."""
    with pytest.raises(Invalid):
        taken(pattern)


@pytest.mark.parametrize("pattern", ["", "*", "/cam_[ab]/*", "?" * MAX_WILDCARDS, "größe-*", "[a-z]*"])
def test_usual_notations_are_accepted(pattern: str) -> None:
    """Also letters beyond ASCII, which match themselves."""
    assert check_pattern(pattern) == pattern


@pytest.mark.parametrize("field", ["topics", "services", "actions"])
def test_a_robot_that_sends_such_patterns_gets_an_error(field: str) -> None:
    """Its message is refused; the robot's software itself sends none."""
    with pytest.raises(msgspec.ValidationError, match="has a \\[ and characters beyond ASCII"):
        msgspec.convert({field: ["/x", DEAR[0]]}, MotionPolicy)
    with pytest.raises(ValueError, match="over 16 wildcards"):
        MotionPolicy(**{field: [DEAR[1]]})
