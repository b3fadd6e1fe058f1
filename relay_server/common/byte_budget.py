"""Memory that users share: each waits until it has room within its own limit and that of all."""

from __future__ import annotations

from typing import NamedTuple

from twisted.internet.defer import Deferred


class _Waiting(NamedTuple):
    user: int
    size: int
    granted: Deferred[None]


class ByteBudget:
    """Reservations of memory, granted in the order of requests. A user over its own limit does not hold up others.

    :param of_user: most bytes of one user; no reservation may be larger
    :param of_all: most bytes of all users together
    """

    def __init__(self, of_user: int, of_all: int) -> None:
        self._of_user = of_user
        self._of_all = of_all
        self._reserved: dict[int, int] = {}
        self._waiting: list[_Waiting] = []
        self._granting = False

    @property
    def reserved(self) -> int:
        """Bytes of all users together."""
        return sum(self._reserved.values())

    def reserve(self, user: int, size: int) -> Deferred[None]:
        """Reserve memory; fires when it is granted. :meth:`release` must follow, unless it is cancelled before.

        :param user: the user's id
        :param size: bytes
        :raises ValueError: ``size`` is over the limit of a user
        """
        if size > self._of_user:
            raise ValueError(f"{size} bytes exceed the limit of a user, {self._of_user}")
        waiting = _Waiting(user, size, Deferred(lambda _: self._cancelled(waiting)))
        self._waiting.append(waiting)
        self._grant()
        return waiting.granted

    def release(self, user: int, size: int) -> None:
        """Release what was reserved."""
        self._reserved[user] -= size
        if not self._reserved[user]:
            del self._reserved[user]
        self._grant()

    def _cancelled(self, waiting: _Waiting) -> None:
        self._waiting.remove(waiting)
        self._grant()

    def _grant(self) -> None:
        # A grant may reserve and release at once. The loop sees to that too, so that calls do not nest deeply.
        if self._granting:
            return
        self._granting = True
        try:
            while (waiting := self._next()) is not None:
                self._waiting.remove(waiting)
                self._reserved[waiting.user] = self._reserved.get(waiting.user, 0) + waiting.size
                waiting.granted.callback(None)
        finally:
            self._granting = False

    def _next(self) -> _Waiting | None:
        """The oldest request that has room; what is over the limit of all waits before younger ones."""
        room = self._of_all - self.reserved
        full: set[int] = set()
        for waiting in self._waiting:
            if waiting.user in full:
                continue
            if self._reserved.get(waiting.user, 0) + waiting.size > self._of_user:
                full.add(waiting.user)
            else:
                return waiting if waiting.size <= room else None
        return None
