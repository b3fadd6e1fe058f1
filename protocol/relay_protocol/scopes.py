"""Scopes of tokens (RFC 6749 section 3.3). A token never allows more than its user's rights.

A scope is a list of items separated by single spaces. An item is a level (``viewer``), or an operation on resources
(``publish:/cmd_vel``), for all robots or, with ``@`` and a name or pattern, for some (``operator@cleaner-*``,
``subscribe:/scan@rover``); or it is ``admin``, for administration.
"""

from __future__ import annotations

import fnmatch
import re
from functools import cached_property
from typing import NamedTuple

from relay_protocol.errors import Invalid
from relay_protocol.limits import NAME
from relay_protocol.rights import Grant, Level, Operation, includes, parse_pattern, required_level
from relay_protocol.wildcards import check_pattern

ADMIN = "admin"

ITEMS = 64
"""Most items of one scope."""

_WILD = re.compile(r"[*?\[]")
_TOKEN = re.compile(r"[\x21\x23-\x5b\x5d-\x7e]+\Z")


class _Item(NamedTuple):
    """One item other than ``admin``.

    :param permission: a level, or ``operation:resource``
    :param robots: shell pattern
    """

    permission: str
    robots: str

    @property
    def grant(self) -> Grant:
        """The equivalent right."""
        return Grant(None, (self.permission,)) if ":" in self.permission else Grant(Level(self.permission))

    def within(self, other: _Item) -> bool:
        """Whether the other certainly covers everything this covers; false when that is not obvious."""
        return _pattern_within(self.robots, other.robots) and self._permission_within(other)

    def _permission_within(self, other: _Item) -> bool:
        (own_operation, own_colon, own_resource), (operation, colon, resource) = (
            self.permission.partition(":"),
            other.permission.partition(":"),
        )
        if own_colon and colon:
            return operation in ("*", own_operation) and _pattern_within(own_resource, resource)
        if colon:
            return False
        if own_colon:
            return own_operation != "*" and includes(
                Level(other.permission), required_level(Operation(own_operation))
            )
        return includes(Level(other.permission), Level(self.permission))


class Scope:
    """The scope of one token.

    :param text: as requested, shown and stored
    :raises Invalid: no items, too many, or an unknown one
    """

    def __init__(self, text: str) -> None:
        items = list(dict.fromkeys(text.split(" ", ITEMS)))
        if len(items) > ITEMS:
            raise Invalid(f"a scope has at most {ITEMS} items")
        self.admin = ADMIN in items
        """Whether it covers administration."""
        self._items = [_parse(each) for each in items if each != ADMIN]
        self._text = " ".join(items)

    def __str__(self) -> str:
        return self._text

    @property
    def realm_independent(self) -> bool:
        """Whether it means the same in every realm: no item names robots, and none is ``admin``."""
        return not self.admin and all(each.robots == "*" for each in self._items)

    def on(self, robot: str) -> tuple[Grant, ...]:
        """The rights it covers on a robot; empty when the token must not even disclose that the robot exists."""
        return tuple(grant for pattern, grant in self._compiled if pattern.match(robot))

    def within(self, other: Scope) -> bool:
        """Whether every item is covered by one of the other, as in a refreshed token (RFC 6749 section 6)."""
        return self.admin <= other.admin and all(
            any(each.within(wider) for wider in other._items) for each in self._items
        )

    @cached_property
    def _compiled(self) -> list[tuple[re.Pattern[str], Grant]]:
        return [(re.compile(fnmatch.translate(each.robots)), each.grant) for each in self._items]


def _pattern_within(pattern: str, other: str) -> bool:
    """Whether one shell pattern certainly matches only names the other matches; false when that is not obvious."""
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
    permission, at, robots = text.rpartition("@")
    if not at:
        permission, robots = text, "*"
    if not robots:
        raise Invalid(f"'{text}' names no robot after the @")
    check_pattern(robots)
    if ":" in permission:
        parse_pattern(permission)
    elif permission not in [str(each) for each in Level]:
        raise Invalid(
            f"'{permission}' is not a scope; write {ADMIN}, viewer, operator, owner or operation:resource, with "
            "@robot at the end if needed, as in operator@rover"
        )
    return _Item(permission, robots)
