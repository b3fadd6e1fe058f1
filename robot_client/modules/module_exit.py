"""How a run of a module ended, in words. The standard library alone, as the runner uses it."""

from __future__ import annotations

import signal
from typing import Any, NamedTuple


class ModuleExit(NamedTuple):
    """How a run ended.

    :param code: exit code, ``None`` if a signal ended it or it never began
    :param signal: number of the signal, or ``None``
    :param error: why it never began, or what happened to its runner
    :param stopped: whether its runner had been asked to stop it
    :param ready: whether it was ready before
    :param memory_mb: its limit of memory, MiB, if its output said that memory is short; otherwise 0
    :param log_lost: its latest lines, so many, that could not be written into its log
    """

    code: int | None = None
    signal: int | None = None
    error: str = ""
    stopped: bool = False
    ready: bool = False
    memory_mb: int = 0
    log_lost: int = 0

    @classmethod
    def of(cls, message: dict[str, Any]) -> ModuleExit:
        """From the runner's event ``exit``."""
        return cls(**{name: message[name] for name in cls._fields if name in message})

    @property
    def succeeded(self) -> bool:
        """Whether the program ended by itself and reported no error."""
        return self.code == 0

    def __str__(self) -> str:
        lost = f"; the last {self.log_lost} lines of its output could not be logged" if self.log_lost else ""
        memory = f"; it reported that memory is short, of which it has memory_mb = {self.memory_mb}"
        return self._reason + memory * bool(self.memory_mb) + lost

    @property
    def _reason(self) -> str:
        if self.error:
            return self.error
        if self.signal is not None:
            return f"ended by signal {self.signal} ({_signal_name(self.signal)})"
        return f"exit code {self.code}"


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return "unknown"
