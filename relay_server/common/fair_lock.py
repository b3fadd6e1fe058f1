"""Who has the one thread that makes what takes long, and who waits for it."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from twisted.internet.defer import Deferred

from relay_protocol.errors import Unavailable

PIECES = 2
"""Of one user that wait or are made at a time; further ones are refused."""

WAITING = 64
"""Of all users."""


class FairLock:
    """One piece at a time, in the order in which they were asked for."""

    def __init__(self) -> None:
        self._pieces: Counter[int] = Counter()
        self._waiting: deque[Deferred[None]] = deque()
        self._taken = False
        self._passing_on = False

    @asynccontextmanager
    async def turn(self, user: int) -> AsyncIterator[None]:
        """Wait for a turn, and have it as long as the block lasts.

        :param user: for whom, by id
        :raises Unavailable: he has :data:`PIECES` here already, or all have :data:`WAITING`
        """
        if self._pieces[user] >= PIECES:
            raise Unavailable(f"{PIECES} of your resources are being converted already; wait for one of them")
        if self._pieces.total() >= WAITING:
            raise Unavailable("too much is being converted; try again in a moment")
        self._pieces[user] += 1
        try:
            turn: Deferred[None] = Deferred()
            self._waiting.append(turn)
            self._pass_on()
            await turn
            self._taken = True
            try:
                yield
            finally:
                self._taken = False
        finally:
            self._pieces -= Counter({user: 1})
            self._pass_on()

    def _pass_on(self) -> None:
        """Give the turn to who waits longest. A loop, not a recursion: many may give it back at once."""
        if self._passing_on:
            return
        self._passing_on = True
        try:
            while self._waiting and not self._taken:
                self._waiting.popleft().callback(None)
        finally:
            self._passing_on = False
