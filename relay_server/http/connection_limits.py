"""How many connections one network may hold, and how many strangers may be here at a time."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from typing import Any

from relay_protocol.limits import MIB
from relay_server.auth.login_limiter import network_of

STRANGERS = 2000
"""Connections of all the world that have not proved who they are."""

UNSENT_BYTES = 32 * MIB
"""Answers that clients of one network do not take may have so many bytes together."""


class Slot:
    """A place among the strangers, given back when somebody is known or gone, whichever is first.

    :param give_back: called once
    """

    def __init__(self, give_back: Callable[[], None]) -> None:
        self._give_back: Callable[[], None] | None = give_back

    def give_back(self) -> None:
        """The place is free again; a second time does nothing."""
        give_back, self._give_back = self._give_back, None
        if give_back is not None:
            give_back()


class ConnectionLimits:
    """Counts connections per network (see :func:`relay_server.auth.login_limiter.network_of`), and strangers.

    :param most: connections one network may hold at a time
    :param strangers: connections of all networks that have not proved who they are
    """

    def __init__(self, most: int, strangers: int = STRANGERS) -> None:
        self._most = most
        self._strangers = strangers
        self._counts: Counter[str] = Counter()

    def enter(self, address: str) -> bool:
        """Count one more; False when that is one too many. Either way :meth:`leave` must follow."""
        network = network_of(address)
        self._counts[network] += 1
        return self._counts[network] <= self._most

    def leave(self, address: str) -> None:
        """One less."""
        network = network_of(address)
        self._counts[network] -= 1
        if self._counts[network] <= 0:
            del self._counts[network]

    def stranger(self) -> Slot | None:
        """A place for one more who is not known yet; ``None`` when there is none."""
        if self._strangers <= 0:
            return None
        self._strangers -= 1
        return Slot(self._back)

    def _back(self) -> None:
        self._strangers += 1


class SharedBytes(bytes):
    """What the relay holds once for as long as it runs: answers that wait for their clients take no memory by it."""


class Unsent:
    """Counts bytes of answers that wait for their clients, per network.

    :param most: bytes of one network; beyond that its connection that has waited longest is cut
    """

    def __init__(self, most: int = UNSENT_BYTES) -> None:
        self._most = most
        self._waiting: defaultdict[str, dict[Any, int]] = defaultdict(dict)

    def add(self, address: str, channel: Any, size: int) -> None:
        """A connection that takes nothing holds so many bytes; it held none before, or they were removed.

        Of a connection that holds none nothing is noted: to cut it would free nothing.
        """
        if size <= 0:
            return
        waiting = self._waiting[network_of(address)]
        waiting[channel] = size
        while sum(waiting.values()) > self._most:
            oldest = next(iter(waiting))
            del waiting[oldest]
            oldest.transport.abortConnection()

    def remove(self, address: str, channel: Any) -> None:
        """It takes them, or has gone."""
        network = network_of(address)
        waiting = self._waiting.get(network, {})
        waiting.pop(channel, None)
        if not waiting:
            self._waiting.pop(network, None)
