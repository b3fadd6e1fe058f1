"""Names and their realms on the command line: where something new goes, whose list is wanted, whom one order means."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, TypeVar

import click
from sqlalchemy.orm import Session

from relay_db.names import normal_name, normalise
from relay_db.queries.realms import realm_id
from relay_protocol.errors import Invalid, NotFound
from relay_protocol.realms import DEFAULT_REALM, parted

_MORE_THAN_A_NAME = frozenset("*?[:")
"""What patterns of names have in them, and groups of robots (``group:cleaners``)."""


class _OfRealm(Protocol):
    @property
    def realm(self) -> str: ...


_Record = TypeVar("_Record", bound=_OfRealm)

realm_option: Callable[[Any], Any] = click.option("--realm", metavar="NAME", help="Only of this realm.")

one_realm_option: Callable[[Any], Any] = click.option(
    "--realm", metavar="NAME", help="Of this realm, not of the default one."
)


def known_realm(session: Session, realm: str) -> str:
    """The name of a realm that is there, in its one form.

    :raises NotFound: there is no such realm
    """
    try:
        realm_id(session, realm)
    except NotFound:
        raise NotFound(
            f"there is no realm '{realm}'; see 'switchboard realm list', or add it with 'switchboard realm add'"
        ) from None
    return normalise(realm)


def new_name(session: Session, text: str) -> tuple[str, str]:
    """The name of something new, and the realm it is to be in.

    :raises NotFound: there is no such realm
    """
    name, realm = parted(text)
    return name, known_realm(session, realm)


def listed(
    session: Session, query: Callable[[Session, str | None], Iterable[_Record]], realm: str | None
) -> list[_Record]:
    """What a query lists of one realm, or of all: the default realm first.

    :raises NotFound: there is no such realm
    """
    found = query(session, None if realm is None else known_realm(session, realm))
    return sorted(found, key=lambda each: (each.realm != DEFAULT_REALM, each.realm))


def of_one_realm(asked: Sequence[str], realm: str | None = None) -> tuple[str, list[str]]:
    """The realm in which all is meant that somebody asks for at once, and what it is called there.

    :param asked: names, patterns, ``group:NAME``; a name may have its realm: ``mobile@lab2``
    :param realm: the one that was named besides; without it what has no realm is of the default one
    :raises Invalid: they are of several realms, a pattern or a group has one, or a realm can't be
    """
    wanted = DEFAULT_REALM if realm is None else _realm(realm)
    realms = set() if realm is None else {wanted}
    names = []
    for each in asked:
        name, at, _ = each.partition("@")
        if at and not _MORE_THAN_A_NAME.isdisjoint(name):
            raise Invalid(f"'{each}' is no name of one robot; write '{name}' and give its realm by --realm")
        realms.add(_realm(parted(each)[1]) if at else wanted)
        names.append(name)
    if len(realms) > 1:
        several = " and ".join(f"'{each}'" for each in sorted(realms))
        raise Invalid(f"these are of the realms {several}; one realm at a time, please")
    return next(iter(realms), wanted), names


def _realm(name: str) -> str:
    return normal_name(name, "name of a realm")
