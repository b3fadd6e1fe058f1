"""What a service says of itself. Pure: facts in, findings out."""

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
    """How a service is, and the figures behind that."""

    level: Level
    message: str
    values: Mapping[str, str] = MappingProxyType({})


class InputWatch:
    """Whether an input still comes.

    :param what: the input, as it is named to people
    :param longest: seconds without it after which it counts as silent
    :param clock: seconds, monotonic
    """

    def __init__(self, what: str, longest: float, clock: Callable[[], float]) -> None:
        self._what = what
        self._longest = longest
        self._clock = clock
        self._last: float | None = None

    def came(self) -> None:
        """It has come just now."""
        self._last = self._clock()

    def trouble(self) -> ServiceFinding | None:
        """What to say when it does not come, else ``None``."""
        if self._last is None:
            return ServiceFinding(Level.STALE, f"waiting for {self._what}")
        silent = self._clock() - self._last
        if silent <= self._longest:
            return None
        return ServiceFinding(Level.STALE, f"nothing from {self._what} for {silent:.0f} s")
