"""Pings to the robot over the channel's own link, for clients that want to know how far it is."""

from __future__ import annotations

from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from relay_protocol.errors import Unavailable
from relay_server.channels.robot_link import RobotLinkState


class ChannelPings:
    """One ping serves all who ask while it is under way."""

    def __init__(self, wire: RobotLinkState) -> None:
        self._wire = wire
        self._waiting: list[Deferred[float]] = []

    def ask(self) -> Deferred[float]:
        """Seconds; fails with :class:`Unavailable` when the link is not there, or ends first."""
        waiting: Deferred[float] = Deferred()
        if self._wire.link is None:
            waiting.errback(Unavailable(f"robot {self._wire.robot.name} is not connected"))
            return waiting
        self._waiting.append(waiting)
        if len(self._waiting) == 1:
            self._wire.link.round_trip().addBoth(self._came_back)
        return waiting

    def _came_back(self, result: float | Failure) -> None:
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            if not each.called:
                each.errback(result) if isinstance(result, Failure) else each.callback(result)
