"""Scopes: what a token may be used for, in the terms of rights, never more than its user may (RFC 6749 section 3.3).

A scope is a list of items separated by single spaces. An item is a level (``viewer``), or an operation on resources
(``publish:/cmd_vel``), for all robots or, with ``@`` and a name or pattern, for some (``operator@cleaner-*``,
``subscribe:/scan@rover``); or it is ``admin``, for what is no question of one robot.
"""

from __future__ import annotations

import fnmatch
import re
from functools import cached_property
from typing import NamedTuple

from relay_protocol.errors import Invalid
from relay_protocol.limits import NAME
from relay_protocol.rights import Grant, Level, Operation, includes, needed, parse_pattern
from relay_protocol.wildcards import see_cheap

ADMIN = "admin"

ITEMS = 64
"""Most items of one scope."""

_WILD = re.compile(r"[*?\[]")
_TOKEN = re.compile(r"[\x21\x23-\x5b\x5d-\x7e]+\Z")


class _Item(NamedTuple):
    """One item but ``admin``.

    :param robots: a shell pattern
    """

    what: str
    robots: str

    @property
    def grant(self) -> Grant:
        """The right it names."""
        return Grant(None, (self.what,)) if ":" in self.what else Grant(Level(self.what))

    def within(self, other: _Item) -> bool:
        """Whether the other is sure to cover all that this covers."""
        return _narrower(self.robots, other.robots) and self._less(other)

    def _less(self, other: _Item) -> bool:
        (own_operation, own_colon, own_resource), (operation, colon, resource) = (
            self.what.partition(":"),
            other.what.partition(":"),
        )
        if own_colon and colon:
            return operation in ("*", own_operation) and _narrower(own_resource, resource)
        if colon:
            return False
        if own_colon:
            return own_operation != "*" and includes(Level(other.what), needed(Operation(own_operation)))
        return includes(Level(other.what), Level(self.what))


class Scope:
    """What one token may be used for.

    :param text: as it is asked for, told and stored
    :raises Invalid: no items, too many, or one that can't be read
    """

    def __init__(self, text: str) -> None:
        items = list(dict.fromkeys(text.split(" ", ITEMS)))
        if len(items) > ITEMS:
            raise Invalid(f"a scope may have {ITEMS} items")
        self.admin = ADMIN in items
        """Whether it covers administration."""
        self._items = [_parse(each) for each in items if each != ADMIN]
        self._text = " ".join(items)

    def __str__(self) -> str:
        return self._text

    @property
    def anywhere(self) -> bool:
        """Whether it means the same in every realm: it names no robots, and covers no administration."""
        return not self.admin and all(each.robots == "*" for each in self._items)

    def on(self, robot: str) -> tuple[Grant, ...]:
        """What it covers on a robot; nothing where the token must not even show that there is one."""
        return tuple(grant for pattern, grant in self._compiled if pattern.match(robot))

    def within(self, other: Scope) -> bool:
        """Whether each item is covered by one of the other, as those of a refreshed token must be (section 6)."""
        return self.admin <= other.admin and all(
            any(each.within(wider) for wider in other._items) for each in self._items
        )

    @cached_property
    def _compiled(self) -> list[tuple[re.Pattern[str], Grant]]:
        return [(re.compile(fnmatch.translate(each.robots)), each.grant) for each in self._items]


def _narrower(pattern: str, other: str) -> bool:
    """Whether all that a shell pattern matches is matched by another, as far as that is plain."""
    if other in ("*", pattern):
        return True
    return not _WILD.search(pattern) and fnmatch.fnmatchcase(pattern, other)


def _parse(text: str) -> _Item:
    if not text:
        raise Invalid(
            "a scope is one item or more, separated by single spaces, as in 'viewer operator@rover'"
        )
    if len(text) > NAME or not _TOKEN.match(text):
        raise Invalid(
            f"an item of a scope has at most {NAME} printable ASCII characters, no quotes and no backslash"
        )
    what, at, robots = text.rpartition("@")
    if not at:
        what, robots = text, "*"
    if not robots:
        raise Invalid(f"'{text}' names no robot after the @")
    see_cheap(robots)
    if ":" in what:
        parse_pattern(what)
    elif what not in [str(each) for each in Level]:
        raise Invalid(
            f"'{what}' is no scope; it is {ADMIN}, viewer, operator, owner or operation:resource, and may end in "
            "@robot, as in operator@rover"
        )
    return _Item(what, robots)
