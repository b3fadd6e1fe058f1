"""Memory of messages that clients have begun and not finished: bytes of one user over all connections, and time.

Websocket frames count when they begin, so a frame over the limit is refused before any of its memory is taken.
"""

from __future__ import annotations

from relay_protocol.limits import MESSAGE_RATE, MESSAGE_SECONDS

PIECE_OVERHEAD = 64
"""Bytes that a frame or fragment counts for beside its own; empty ones take memory too."""


def time_limit(size: int) -> float:
    """Seconds in which a message must be finished.

    :param size: bytes of it so far
    """
    return MESSAGE_SECONDS + size / MESSAGE_RATE


class UnfinishedBytes:
    """Bytes of unfinished messages, by user.

    :param most: bytes of one user over all connections
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self._of: dict[int, int] = {}

    def count(self, user: int) -> UnfinishedCount:
        """A count for a new connection of a user.

        :param user: the user's id
        """
        return UnfinishedCount(self, user)

    def of(self, user: int) -> int:
        """Bytes of one user."""
        return self._of.get(user, 0)

    def add(self, user: int, size: int) -> None:
        """Count bytes of a user, or no longer, if negative."""
        left = self.of(user) + size
        if left:
            self._of[user] = left
        else:
            self._of.pop(user, None)


class UnfinishedCount:
    """The bytes of unfinished messages of one connection, which count against its user."""

    __slots__ = ("_all", "_user", "held")

    def __init__(self, all: UnfinishedBytes, user: int) -> None:
        self._all = all
        self._user = user
        self.held = 0

    @property
    def refusal(self) -> str:
        """Why :meth:`take` has refused."""
        return f"unfinished messages of one user have at most {self._all.most} bytes, over all connections"

    def take(self, size: int) -> bool:
        """Count bytes that are going to be held; false if the user has too many."""
        if self._all.of(self._user) + size > self._all.most:
            return False
        self._all.add(self._user, size)
        self.held += size
        return True

    def give_back(self, size: int) -> None:
        """Count bytes no longer. After :meth:`close` this has no effect."""
        size = min(size, self.held)
        self._all.add(self._user, -size)
        self.held -= size

    def close(self) -> None:
        """The connection is gone, and what it held with it."""
        self.give_back(self.held)
