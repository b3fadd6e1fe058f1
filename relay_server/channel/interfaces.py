"""Which types a robot can tell the definition of, asked for once on each link."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred, fail, succeed

from relay_protocol import link
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.channel.wire import Wire


class Interfaces:
    """Asks the robot for the names of its types, when somebody wants to know, and keeps the answer."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._known: list[str] | None = None
        self._waiting: list[Deferred[list[str]]] = []

    def names(self) -> Deferred[list[str]]:
        """Fires with full names in order; fails in words when the robot does not tell them or is lost."""
        if self._known is not None:
            return succeed(self._known)
        if self._wire.link is None:
            return fail(Unavailable(f"robot {self._wire.robot.name} is not connected"))
        waiting: Deferred[list[str]] = Deferred(self._given_up)
        self._waiting.append(waiting)
        if len(self._waiting) == 1:
            self._wire.send(link.GetInterfaces())
        return waiting

    def told(self, message: link.Interfaces) -> None:
        """The robot's answer; one nobody asked for is let go."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            self._known = message.types
        for each in waiting:
            each.callback(message.types)

    def refused(self, reason: str) -> None:
        """The robot does not tell."""
        self._fail(Unavailable(f"robot {self._wire.robot.name} does not tell its types: {reason}"))

    def reset(self) -> None:
        """The link is gone; what comes back may have other packages installed."""
        self._known = None
        self._fail(Unavailable(f"robot {self._wire.robot.name} lost its connection"))

    def _given_up(self, waiting: Deferred[Any]) -> None:
        # When the last one has given up the next one asks anew.
        self._waiting.remove(waiting)

    def _fail(self, error: SwitchboardError) -> None:
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.errback(error)
