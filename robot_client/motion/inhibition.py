"""Topics that the relay has ordered to say nothing for a while, or their last value (SPEC 2.4, 2.5)."""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol import link
from relay_protocol.errors import NotFound, Unavailable
from relay_protocol.limits import FACTS
from robot_client.motion.robot_port import RobotPort
from robot_client.motion.safety import MILLI
from robot_client.motion.state_reporter import Inhibition
from robot_client.twisted_types import DelayedCall, ReactorClock


class Inhibitions:
    """Knows which topics say nothing now.

    :param changed: called when there are others
    :param clock: for timers
    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds
    """

    def __init__(
        self, body: RobotPort, changed: Callable[[], None], clock: ReactorClock, now: Callable[[], int]
    ) -> None:
        self.silent: dict[str, bool] = {}
        """Topics that say nothing now, and whether they say their last value instead."""
        self.told: dict[str, Inhibition] = {}
        """The same, for the relay to know."""
        self._body = body
        self._changed = changed
        self._clock = clock
        self._now = now
        self._timers: dict[str, DelayedCall] = {}

    def order(self, message: link.Inhibit) -> None:
        """Begin an inhibition, go on with it, or end it.

        :raises NotFound: there is no such topic
        :raises Unavailable: there are too many
        """
        topic, types = self._body.topic(message.resource)
        if not message.ms:
            self._end(topic)
            return
        if not types:
            raise NotFound(f"there is no topic {topic} on this robot")
        if topic not in self.silent and len(self.silent) >= FACTS:
            raise Unavailable(f"{FACTS} topics are inhibited already")
        self.told[topic] = Inhibition(message.hold, self._now() + message.ms * MILLI, message.by)
        self._disarm(topic)
        self._timers[topic] = self._clock.callLater(message.ms / 1000, self._end, topic)
        if self.silent.get(topic) != message.hold:
            self.silent[topic] = message.hold
            self._body.silence(topic)
        self._changed()

    def end(self) -> None:
        """Who ordered them is gone."""
        for topic in list(self.silent):
            self._end(topic)

    def _end(self, topic: str) -> None:
        self._disarm(topic)
        if self.silent.pop(topic, None) is None:
            return
        del self.told[topic]
        self._body.silence(topic)
        self._changed()

    def _disarm(self, topic: str) -> None:
        timer = self._timers.pop(topic, None)
        if timer is not None and timer.active():
            timer.cancel()
