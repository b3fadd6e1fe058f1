"""Diagnostics of services."""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple


class Level(enum.IntEnum):
    """Values of diagnostic_msgs/DiagnosticStatus.level."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class ServiceFinding(NamedTuple):
    """State of a service, with measurements."""

    level: Level
    message: str
    values: Mapping[str, str] = MappingProxyType({})


class InputWatch:
    """Watches whether an input is still received.

    :param what: name of the input, for display
    :param longest: seconds without it after which it counts as silent
    :param clock: seconds, monotonic
    """

    def __init__(self, what: str, longest: float, clock: Callable[[], float]) -> None:
        self._what = what
        self._longest = longest
        self._clock = clock
        self._last: float | None = None

    def received(self) -> None:
        """The input was received now."""
        self._last = self._clock()

    def problem(self) -> ServiceFinding | None:
        """The problem when it is silent, else ``None``."""
        if self._last is None:
            return ServiceFinding(Level.STALE, f"waiting for {self._what}")
        silent = self._clock() - self._last
        if silent <= self._longest:
            return None
        return ServiceFinding(Level.STALE, f"nothing from {self._what} for {silent:.0f} s")
