"""Tells those who follow a robot's control of changes, ten times a second at most."""

from __future__ import annotations

from collections.abc import Callable, Hashable

from relay_server.clock import Clock, Timer

INTERVAL = 0.1
"""Least seconds between two tellings; what changes meanwhile is told together."""


class Pushing:
    """Who wants to hear of changes, and when they did the last time."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._followers: dict[Hashable, Callable[[], None]] = {}
        self._timer: Timer | None = None
        self._told_at = -INTERVAL

    def follow(self, follower: Hashable, tell: Callable[[], None]) -> None:
        """From now on this one is told, by this call."""
        self._followers[follower] = tell

    def forget(self, follower: Hashable) -> None:
        """This one no more."""
        self._followers.pop(follower, None)

    def push(self) -> None:
        """Something is another: tell all when all that changes now has changed."""
        if self._timer is None and self._followers:
            pause = max(0.0, self._told_at + INTERVAL - self._clock.seconds())
            self._timer = self._clock.callLater(pause, self._tell)

    def _tell(self) -> None:
        self._timer = None
        self._told_at = self._clock.seconds()
        for tell in list(self._followers.values()):
            tell()
