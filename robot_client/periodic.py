"""Steps and periodic tasks whose failures are logged and do not stop what follows."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from twisted.internet.task import LoopingCall
from twisted.logger import Logger

LOG_EVERY = 60.0
"""Seconds between two logged failures of one task."""


def run_safely(log: Logger, message: str, step: Callable[..., object], *arguments: Any) -> None:
    """Run a step; if it raises, log that and return.

    :param message: to log with the failure
    """
    try:
        step(*arguments)
    except Exception:
        log.failure(message)


class PeriodicTasks:
    """Steps that are repeated, also after failures, which would end a :class:`LoopingCall`.

    :param steps: each step with its interval, seconds
    :param clock: for timers
    """

    def __init__(self, steps: Iterable[tuple[Callable[[], None], float]], clock: Any) -> None:
        self._loops = [(LoopingCall(_PeriodicTask(step, every, clock)), every) for step, every in steps]
        for loop, _ in self._loops:
            loop.clock = clock

    def start(self) -> None:
        """Start; each step first runs after its interval."""
        for loop, every in self._loops:
            loop.start(every, now=False)

    def stop(self) -> None:
        """Stop all steps."""
        for loop, _ in self._loops:
            if loop.running:
                loop.stop()


class _PeriodicTask:
    def __init__(self, step: Callable[[], None], every: float, clock: Any) -> None:
        self._step = step
        self._every = every
        self._clock = clock
        self._quiet_until = clock.seconds()
        self._log = Logger("periodic")

    def __call__(self) -> None:
        try:
            self._step()
        except Exception:
            now = self._clock.seconds()
            if now >= self._quiet_until:
                self._quiet_until = now + LOG_EVERY
                self._log.failure(
                    "a task that runs every {every:g} s failed; it continues", every=self._every
                )
