"""Tasks at fixed rates in one thread. It reads the clock, but never waits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

Task = Callable[[], None]


@dataclass
class _Entry:
    period: float
    task: Task
    catch_up: int
    due: float


class Schedule:
    """Runs tasks when they are due.

    :param clock: seconds, monotonic
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._entries: list[_Entry] = []

    def every(self, period: float, task: Task, catch_up: int = 1) -> None:
        """Run a task now and then periodically.

        :param period: seconds
        :param catch_up: most runs after a delay; further missed runs are skipped
        """
        self._entries.append(_Entry(period, task, catch_up, self._clock()))

    def run_due(self) -> float:
        """Run due tasks, and return the seconds until the next one."""
        for entry in self._entries:
            for _ in range(entry.catch_up):
                if self._clock() < entry.due:
                    break
                entry.task()
                entry.due += entry.period
            missed = (self._clock() - entry.due) // entry.period
            if missed > 0:
                entry.due += missed * entry.period
        return max(0.0, min(entry.due for entry in self._entries) - self._clock())
