"""A page of a collection: which of its members, by name and type, and where the next page begins."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Any, NamedTuple, TypeVar

from relay_protocol.errors import Invalid
from relay_protocol.limits import NAME
from relay_protocol.wildcards import see_cheap

T = TypeVar("T")

PAGE = 100
"""Members of a page of which nobody says how long it should be."""

LONGEST = 1000


class PageQuery(NamedTuple):
    """What is asked of a collection.

    :param name: pattern with shell wildcards
    :param type: of the members
    :param after: the name behind which the page begins
    :param limit: most members of the page
    """

    name: str = "*"
    type: str = ""
    after: str = ""
    limit: int = PAGE

    @classmethod
    def of(cls, query: Mapping[str, str], *, typed: bool = True) -> PageQuery:
        """From the parameters of a request.

        :param typed: whether the members have types to be asked for by
        :raises Invalid: one that there is not, or with a value that it can't have
        """
        see_known(query, *(each for each in cls._fields if typed or each != "type"))
        if any(len(each) > NAME for each in query.values()):
            raise Invalid(f"a parameter may have {NAME} characters at most")
        text = query.get("limit", str(PAGE))
        if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= LONGEST:
            raise Invalid(f"'limit' must be a number from 1 to {LONGEST}")
        return cls(
            see_cheap(query.get("name", "*")), query.get("type", ""), query.get("after", ""), int(text)
        )

    def page(self, members: Mapping[str, T], types: Any) -> tuple[list[tuple[str, T]], str]:
        """The members meant, in the order of their names, and the name behind which there are more, or ``""``.

        :param types: gives the types of a member
        """
        found = [
            (name, each)
            for name, each in sorted(members.items())
            if name > self.after
            and fnmatchcase(name, self.name)
            and (not self.type or self.type in types(each))
        ]
        more = found[self.limit - 1][0] if len(found) > self.limit else ""
        return found[: self.limit], more


def see_known(query: Mapping[str, str], *names: str) -> None:
    """See that the parameters of a request are some of these.

    :raises Invalid: there is another one
    """
    strange = query.keys() - set(names)
    if strange:
        raise Invalid(f"there is no parameter '{min(strange)[:40]}'; there are {', '.join(names)}")
