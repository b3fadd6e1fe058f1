"""Pages of a collection: members by name and type, and the beginning of the next page."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta

from relay_protocol.limits import NAME
from relay_protocol.wildcards import check_pattern

T = TypeVar("T")

PAGE = 100
"""Members of a page by default."""

LONGEST = 1000


Text = Annotated[str, Meta(max_length=NAME)]


class PageQuery(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Query for a page of a collection.

    :param name: a name, with shell wildcards
    :param limit: most members of the page; 100 by default
    :param after: ``next`` of the page before
    """

    name: Text = "*"
    after: Text = ""
    limit: Annotated[int, Meta(ge=1, le=LONGEST)] = PAGE

    def __post_init__(self) -> None:
        check_pattern(self.name)

    @property
    def wanted_type(self) -> str:
        """The type that members must have, or empty."""
        return ""

    def page(self, members: Mapping[str, T], types: Any) -> tuple[list[tuple[str, T]], str]:
        """The members of the page, by name, and ``after`` of the next page, or ``""``.

        :param types: gives the types of a member
        """
        found = [
            (name, each)
            for name, each in sorted(members.items())
            if name > self.after
            and fnmatchcase(name, self.name)
            and (not self.wanted_type or self.wanted_type in types(each))
        ]
        more = found[self.limit - 1][0] if len(found) > self.limit else ""
        return found[: self.limit], more


class TypedPageQuery(PageQuery, frozen=True, forbid_unknown_fields=True):
    """Query for a page of a collection whose members have types.

    :param type: a type
    """

    type: Text = ""

    @property
    def wanted_type(self) -> str:
        """The type that members must have, or empty."""
        return self.type
