"""Shell wildcards that somebody sends: what is made of them must cost little, as it is made where all are served."""

from __future__ import annotations

from relay_protocol.errors import Invalid

MOST = 16
"""Wildcards of one pattern."""


def see_cheap(pattern: str) -> str:
    """See that a pattern can be made ready in well under a millisecond, whatever it says.

    Classes of characters beyond ASCII take the standard library's ``re`` up to a tenth of a second.

    :raises Invalid: too many wildcards, or a class with characters that names do not have
    """
    if sum(map(pattern.count, "*?[")) > MOST:
        raise Invalid(f"'{pattern[:40]}' has over {MOST} wildcards (*, ? and [); write a simpler pattern")
    if "[" in pattern and not pattern.isascii():
        raise Invalid(f"'{pattern[:40]}' has a [ and characters beyond ASCII; use one without the other")
    return pattern
