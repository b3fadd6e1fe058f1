"""Protocols for the used parts of Twisted's reactor; type checkers can't read its zope interfaces."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.defer import Deferred
from twisted.internet.protocol import Factory


class DelayedCall(Protocol):
    """See :class:`twisted.internet.interfaces.IDelayedCall`."""

    def active(self) -> bool:
        """Whether it has neither run nor been cancelled."""

    def cancel(self) -> None:
        """Cancel it."""

    def getTime(self) -> float:
        """When it runs, on the clock, seconds."""


class ReactorClock(Protocol):
    """A reactor, or :class:`twisted.internet.task.Clock`."""

    def seconds(self) -> float:
        """Seconds since an arbitrary moment."""

    def callLater(self, delay: float, callable: Callable[..., Any], *args: Any) -> DelayedCall:
        """Call after ``delay`` seconds."""


class DialEndpoint(Protocol):
    """A client endpoint."""

    def connect(self, factory: Factory[Any]) -> Deferred[Any]:
        """Connect; fires with the protocol."""


def monotonic_reactor() -> Any:
    """The reactor with a monotonic clock: a watchdog must not be delayed when the wall clock is set back."""
    from twisted.internet import reactor

    clock: Any = reactor
    clock.seconds = time.monotonic
    return clock
