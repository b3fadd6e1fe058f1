"""One client's interest in one topic."""

from __future__ import annotations

from typing import Protocol

from relay_protocol import rosbridge
from relay_protocol.errors import Refused
from relay_server.channel.sample import Sample
from relay_server.clock import Clock, Timer
from relay_server.forms import PLAIN

THROTTLE_SECONDS = 3600.0
"""Longest throttle; a client that asks for more gets this."""

ASKS = 64
"""Subscriptions of one client to one topic, merged into one listener."""


class Receiver(Protocol):
    """A session, as a topic's listeners use it."""

    def deliver(self, listener: Listener, parcel: Sample | bytes) -> None:
        """Queue a sample for the client."""


class Listener:
    """One client's interest in one topic: its subscriptions merged, as rosbridge does.

    :param name: the topic as the client writes it
    """

    def __init__(self, clock: Clock, receiver: Receiver, name: str) -> None:
        self._clock = clock
        self._receiver = receiver
        self.name = name
        self.throttle = 0.0
        """Least seconds between two samples: the least any of the subscriptions asks for."""
        self.depth = 0
        """Samples that may wait for this client; 0 leaves it to the relay."""
        self.form = PLAIN
        self._asks: dict[rosbridge.Id, rosbridge.Subscribe] = {}
        self._next_at = 0.0
        self._waiting: Sample | None = None
        self._timer: Timer | None = None

    def add(self, ask: rosbridge.Subscribe) -> None:
        """One more subscription, or another one under the same id.

        :raises Refused: too many on this topic
        """
        if ask.id not in self._asks and len(self._asks) >= ASKS:
            raise Refused(f"at most {ASKS} subscriptions to one topic can be held on one connection")
        self._asks[ask.id] = ask
        self._merge()

    def remove(self, id: rosbridge.Id) -> bool:
        """One subscription less; whether any are left."""
        self._asks.pop(id, None)
        self._merge()
        return bool(self._asks)

    def _merge(self) -> None:
        asks = self._asks.values()
        least = min((ask.throttle_rate for ask in asks), default=0.0) / 1000
        self.throttle = min(max(0.0, least), THROTTLE_SECONDS)
        self.depth = max(0, max((ask.queue_length for ask in asks), default=0))

    def offer(self, sample: Sample) -> None:
        """A new sample. Within the throttle the newest waits, so the last of a burst always arrives."""
        throttle = self.throttle
        if throttle:
            now = self._clock.seconds()
            if now < self._next_at:
                self._waiting = sample
                if self._timer is None:
                    self._timer = self._clock.callLater(self._next_at - now, self._due)
                return
            self._next_at = now + throttle
        # What waited under a longer throttle is older than this one.
        self.close()
        self._send(sample)

    def replay(self, sample: Sample) -> None:
        """A latched sample for a late joiner; each is of another publisher, so no throttle drops any."""
        self._send(sample)

    def close(self) -> None:
        """Stop; nothing more is sent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._waiting = None

    def _due(self) -> None:
        self._timer = None
        sample, self._waiting = self._waiting, None
        if sample is not None:
            self._next_at = self._clock.seconds() + self.throttle
            self._send(sample)

    def _send(self, sample: Sample) -> None:
        self._receiver.deliver(self, sample)
