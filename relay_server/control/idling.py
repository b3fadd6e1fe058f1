"""Control that nobody uses is free again after a time."""

from __future__ import annotations

from collections.abc import Callable

from relay_server.clock import Clock, Timer, cancel


class Idling:
    """Watches how long whoever has control has given no command.

    :param seconds: without a command, after which it is over
    :param latest: the clock's time of the latest command
    :param over: called when it is
    """

    def __init__(
        self, clock: Clock, seconds: float, latest: Callable[[], float], over: Callable[[], None]
    ) -> None:
        self._clock = clock
        self._seconds = seconds
        self._latest = latest
        self._over = over
        self._since = 0.0
        self._timer: Timer | None = None

    def begin(self) -> None:
        """Somebody has control now."""
        self.end()
        self._since = self._clock.seconds()
        self._timer = self._clock.callLater(self._seconds, self._look)

    def end(self) -> None:
        """Nobody has it any more."""
        cancel(self._timer)
        self._timer = None

    def _look(self) -> None:
        self._timer = None
        left = max(self._since, self._latest()) + self._seconds - self._clock.seconds()
        # A clock's rounding must not make it look a thousand times.
        if left > 0.001:
            self._timer = self._clock.callLater(left, self._look)
        else:
            self._over()
