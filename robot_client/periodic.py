"""Work that goes on whatever fails in it: a failure is logged, and what comes after it is done all the same."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from twisted.internet.task import LoopingCall
from twisted.logger import Logger

LOG_EVERY = 60.0
"""Seconds between two failures of one round that are logged."""


def run_safely(log: Logger, what: str, step: Callable[..., object], *arguments: Any) -> None:
    """Do a step on which what comes after it must not hang.

    :param what: the words to log if it fails
    """
    try:
        step(*arguments)
    except Exception:
        log.failure(what)


class PeriodicTasks:
    """Steps done again and again, each also after it has failed: a loop of Twisted's would end, without a word.

    :param steps: what to do, and after how many seconds each time
    :param clock: for timers
    """

    def __init__(self, steps: Iterable[tuple[Callable[[], None], float]], clock: Any) -> None:
        self._loops = [(LoopingCall(_PeriodicTask(step, every, clock)), every) for step, every in steps]
        for loop, _ in self._loops:
            loop.clock = clock

    def start(self) -> None:
        """Begin, with a pause."""
        for loop, every in self._loops:
            loop.start(every, now=False)

    def stop(self) -> None:
        """Do them no more."""
        for loop, _ in self._loops:
            if loop.running:
                loop.stop()


class _PeriodicTask:
    def __init__(self, step: Callable[[], None], every: float, clock: Any) -> None:
        self._step = step
        self._every = every
        self._clock = clock
        self._silent_until = clock.seconds()
        self._log = Logger("rounds")

    def __call__(self) -> None:
        try:
            self._step()
        except Exception:
            now = self._clock.seconds()
            if now >= self._silent_until:
                self._silent_until = now + LOG_EVERY
                self._log.failure(
                    "what is done every {every:g} s failed; it is tried again", every=self._every
                )
