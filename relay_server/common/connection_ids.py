"""Connection ids of clients, and names of channels and streams.

They are random, not counted: a user who sees their own ids must not learn how many others connect.
"""

from __future__ import annotations

import secrets
from collections import OrderedDict
from collections.abc import Callable, Iterable

MOST = 1 << 31
KEPT = 1 << 16
"""Number of latest ids that are not used again: more than clients at a time, and more than robots remember."""


def unused_name(
    stem: str, taken: Iterable[str], draw: Callable[[], str] = lambda: secrets.token_hex(4)
) -> str:
    """A name that is not taken.

    :param stem: the beginning of the name
    :param draw: returns an unguessable text
    """
    others = set(taken)
    name = f"{stem}{draw()}"
    while name in others:
        name = f"{stem}{draw()}"
    return name


def _drawn() -> int:
    return secrets.randbelow(MOST) + 1


class ConnectionIds:
    """Gives each client an id that no other client has or had recently.

    :param draw: returns an unguessable number from 1 to :data:`MOST`
    """

    def __init__(self, draw: Callable[[], int] = _drawn) -> None:
        self._draw = draw
        self._given: OrderedDict[int, None] = OrderedDict()

    def take(self) -> int:
        """A new id."""
        number = self._draw()
        while number in self._given:
            number = self._draw()
        self._given[number] = None
        if len(self._given) > KEPT:
            self._given.popitem(last=False)
        return number
