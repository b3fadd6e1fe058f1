"""What we use of Twisted's reactor, as types: its interfaces are zope's, which type checkers can't read."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.defer import Deferred
from twisted.internet.protocol import Factory


class DelayedCall(Protocol):
    """A call to come."""

    def active(self) -> bool:
        """Whether it is still to come."""

    def cancel(self) -> None:
        """Let it not come."""

    def getTime(self) -> float:
        """When it comes, on the clock's seconds."""


class ReactorClock(Protocol):
    """A reactor, or :class:`twisted.internet.task.Clock`."""

    def seconds(self) -> float:
        """The time; only differences mean anything."""

    def callLater(self, delay: float, callable: Callable[..., Any], *args: Any) -> DelayedCall:
        """Call after ``delay`` seconds."""


class DialEndpoint(Protocol):
    """Where to dial."""

    def connect(self, factory: Factory[Any]) -> Deferred[Any]:
        """Dial; fires with the protocol."""


def monotonic_reactor() -> Any:
    """The reactor, on a clock that nobody can set: a watchdog must not wait for a clock put back an hour."""
    from twisted.internet import reactor

    clock: Any = reactor
    clock.seconds = time.monotonic
    return clock
