"""Checks shell wildcards from outside, because compiling some of them takes long and blocks the reactor."""

from __future__ import annotations

from relay_protocol.errors import Invalid

MAX_WILDCARDS = 16
"""Most wildcards of one pattern."""


def check_pattern(pattern: str) -> str:
    """Check that a pattern compiles in well under a millisecond, and return it.

    Character classes beyond ASCII take ``re`` up to 100 ms.

    :raises Invalid: too many wildcards, or a character class in a pattern beyond ASCII
    """
    if sum(map(pattern.count, "*?[")) > MAX_WILDCARDS:
        raise Invalid(
            f"'{pattern[:40]}' has over {MAX_WILDCARDS} wildcards (*, ? and [); write a simpler pattern"
        )
    if "[" in pattern and not pattern.isascii():
        raise Invalid(f"'{pattern[:40]}' has a [ and characters beyond ASCII; use one without the other")
    return pattern
