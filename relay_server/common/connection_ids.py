"""Numbers of clients, by which robots and people tell them apart; and names of what robots join.

They are drawn, not counted: who sees his own one after the other must not learn how many others come to the relay.
"""

from __future__ import annotations

import secrets
from collections import OrderedDict
from collections.abc import Callable, Iterable

MOST = 1 << 31
KEPT = 1 << 16
"""Numbers given last that are not given again: more than there are clients at a time, and what robots remember."""


def name_of(stem: str, taken: Iterable[str], draw: Callable[[], str] = lambda: secrets.token_hex(4)) -> str:
    """A name that none of those that are taken is.

    :param stem: what it begins with
    :param draw: an unguessable text
    """
    others = set(taken)
    name = f"{stem}{draw()}"
    while name in others:
        name = f"{stem}{draw()}"
    return name


def _drawn() -> int:
    return secrets.randbelow(MOST) + 1


class ConnectionIds:
    """Gives each client a number that no other has or had a while ago.

    :param draw: an unguessable number from 1 to :data:`MOST`
    """

    def __init__(self, draw: Callable[[], int] = _drawn) -> None:
        self._draw = draw
        self._given: OrderedDict[int, None] = OrderedDict()

    def take(self) -> int:
        """The next one."""
        number = self._draw()
        while number in self._given:
            number = self._draw()
        self._given[number] = None
        if len(self._given) > KEPT:
            self._given.popitem(last=False)
        return number
