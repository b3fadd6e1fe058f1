"""How many connections one address may hold."""

from __future__ import annotations

from collections import Counter


class AddressCap:
    """Counts connections per address.

    :param most: connections one address may hold at a time
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._counts: Counter[str] = Counter()

    def enter(self, address: str) -> bool:
        """Count one more; False when that is one too many. Either way :meth:`leave` must follow."""
        self._counts[address] += 1
        return self._counts[address] <= self._most

    def leave(self, address: str) -> None:
        """One less."""
        self._counts[address] -= 1
        if self._counts[address] <= 0:
            del self._counts[address]
