"""Inhibited topics: for a while they send nothing to the relay, or only their last value (SPEC 2.4, 2.5)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from relay_protocol import link
from relay_protocol.errors import NotFound, Unavailable
from relay_protocol.limits import LIST_ITEMS
from robot_client.motion.command_age import MILLI
from robot_client.motion.robot_port import RobotPort
from robot_client.twisted_types import DelayedCall, ReactorClock


class Inhibition(NamedTuple):
    """A topic that delivers nothing, or its last value.

    :param hold: deliver the last value in the place of each new one
    :param until: own clock, nanoseconds
    """

    hold: bool
    until: int
    by: str


class Inhibitions:
    """Keeps which topics are inhibited, and ends inhibitions in time.

    :param changed: called when the inhibitions have changed
    :param clock: for timers
    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds
    """

    def __init__(
        self, robot: RobotPort, changed: Callable[[], None], clock: ReactorClock, now: Callable[[], int]
    ) -> None:
        self.inhibited: dict[str, bool] = {}
        """Inhibited topics, and whether each holds its last value."""
        self.by_topic: dict[str, Inhibition] = {}
        """The inhibitions by topic, as reported to the relay."""
        self._robot = robot
        self._changed = changed
        self._clock = clock
        self._now = now
        self._timers: dict[str, DelayedCall] = {}

    def handle(self, message: link.Inhibit) -> None:
        """Begin an inhibition, prolong it, or end it (0 ms).

        :raises NotFound: there is no such topic
        :raises Unavailable: too many topics are inhibited
        """
        topic, types = self._robot.find_topic(message.resource)
        if not message.ms:
            self._end(topic)
            return
        if not types:
            raise NotFound(f"there is no topic {topic} on this robot")
        if topic not in self.inhibited and len(self.inhibited) >= LIST_ITEMS:
            raise Unavailable(f"{LIST_ITEMS} topics are inhibited already")
        self.by_topic[topic] = Inhibition(message.hold, self._now() + message.ms * MILLI, message.by)
        self._cancel_timer(topic)
        self._timers[topic] = self._clock.callLater(message.ms / 1000, self._end, topic)
        if self.inhibited.get(topic) != message.hold:
            self.inhibited[topic] = message.hold
            self._robot.update_inhibition(topic)
        self._changed()

    def end(self) -> None:
        """End all inhibitions, as the relay that ordered them is gone."""
        for topic in list(self.inhibited):
            self._end(topic)

    def _end(self, topic: str) -> None:
        self._cancel_timer(topic)
        if self.inhibited.pop(topic, None) is None:
            return
        del self.by_topic[topic]
        self._robot.update_inhibition(topic)
        self._changed()

    def _cancel_timer(self, topic: str) -> None:
        timer = self._timers.pop(topic, None)
        if timer is not None and timer.active():
            timer.cancel()
