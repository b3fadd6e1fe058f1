"""Which robots an order means: by names, patterns of names, and groups."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import NamedTuple

from relay_protocol.wildcards import see_cheap

GROUP = "group:"
"""How the name of a group begins in an order. No robot's name can: it has no colon."""


WILD = frozenset("*?[")
"""By one of these a pattern is told from a name."""


def is_name(asked: str) -> bool:
    """Whether what an order says is the name of one robot, and neither a pattern nor a group."""
    return not asked.startswith(GROUP) and WILD.isdisjoint(asked)


class Selection(NamedTuple):
    """What an order means.

    :param robots: names, each once, in their order
    :param unmatched: what of the order means no robot
    """

    robots: list[str]
    unmatched: list[str]


def select_robots(
    asked: Iterable[str], robots: Collection[str], groups: Mapping[str, Collection[str]]
) -> Selection:
    """Find the robots that are meant.

    :param asked: names, patterns with shell wildcards, ``group:<name>``
    :param robots: names of those that may be meant
    :param groups: the names of their robots by their own, which is in lower case
    :raises Invalid: a pattern that costs too much
    """
    known = set(robots)
    found: set[str] = set()
    unmatched = []
    for each in dict.fromkeys(asked):
        if each.startswith(GROUP):
            these = known & set(groups.get(each.removeprefix(GROUP).lower(), ()))
        elif each in known or is_name(each):
            # A thousand names must not each be held against all robots.
            these = known & {each}
        else:
            see_cheap(each)
            these = {name for name in known if fnmatchcase(name, each)}
        found |= these
        if not these:
            unmatched.append(each)
    return Selection(sorted(found), unmatched)
