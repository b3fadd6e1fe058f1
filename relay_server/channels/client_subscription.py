"""One client's interest in one topic."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple, Protocol

from relay_protocol import rosbridge
from relay_protocol.errors import Refused
from relay_protocol.limits import MIB
from relay_server.channels.encodings import PLAIN, TOO_COSTLY, MessageEncoding
from relay_server.channels.samples import RenderError, Sample, output_format_for
from relay_server.common.clock import Clock, Timer
from relay_server.common.cpu_quota import UserQuota

THROTTLE_SECONDS = 3600.0
"""Longest throttle; a client that asks for more gets this."""

ASKS = 64
"""Subscriptions of one client to one topic, merged into one listener."""

QUEUE_LENGTH = 1000
"""Longest queue; a client that asks for more gets this."""

QUEUE_BYTES = 2 * MIB
"""Most bytes that wait within the throttle of one listener; the newest sample may be larger."""

QUEUES_BYTES = 8 * MIB
"""Most bytes that wait within the throttles of one client; the newest sample of each topic may be beyond it."""

PLAINLY_SECONDS = 60.0
"""How often a client is told that it gets plain JSON because it has used up its share of the processor."""

TOO_SLOW_SECONDS = 10.0
"""How often a client is told that samples of a topic are dropped because its connection is thin."""

_LEVELS = {
    RenderError.BROKEN: "error",
    RenderError.NOT_CDR: "error",
    RenderError.TOO_LARGE: "warning",
    RenderError.NOT_SENT: "error",
}


class SubscriberPort(Protocol):
    """A session, as a topic's listeners use it."""

    plain_instead: int
    """Messages sent as plain JSON because a costlier form was not affordable."""

    queued_bytes: int
    """Bytes that wait within the throttles of all its listeners; they keep it."""

    @property
    def allowance(self) -> UserQuota:
        """What its user may have of the processor."""

    def deliver(self, listener: ClientSubscription, parcel: Sample) -> None:
        """Queue a sample for the client."""

    def dropped(self, listener: ClientSubscription) -> None:
        """Count a sample that the client will not get."""

    def tell(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Report something in words, to clients that want to hear it."""


class SubscribeRequest(NamedTuple):
    """One subscription, and the form it asks for."""

    ask: rosbridge.Subscribe
    form: MessageEncoding


class ClientSubscription:
    """One client's interest in one topic: its subscriptions merged, as rosbridge does.

    :param topic: its full name
    """

    __slots__ = (
        "_asks",
        "_clock",
        "_failed",
        "_plainly_at",
        "_queued_bytes",
        "_receiver",
        "_sent_at",
        "_timer",
        "_told",
        "_too_slow_at",
        "_waiting",
        "depth",
        "throttle",
        "topic",
        "wish",
    )

    def __init__(self, clock: Clock, receiver: SubscriberPort, topic: str) -> None:
        self._clock = clock
        self._receiver = receiver
        self.topic = topic
        self.throttle = 0.0
        """Least seconds between two samples: the least any of the subscriptions asks for."""
        self.depth = 0
        """Samples that may wait for this client: the most any subscription asks for; 0 leaves it to the relay."""
        self.wish = output_format_for((topic,), PLAIN)
        """The names the topic is subscribed by, latest compression and least size of fragments."""
        self._asks: dict[tuple[str, rosbridge.Id], SubscribeRequest] = {}
        self._told: set[RenderError] = set()
        self._failed: frozenset[rosbridge.Id] = frozenset()
        """Ids of the subscriptions whose failure the client was told."""
        self._plainly_at = -PLAINLY_SECONDS
        self._too_slow_at = -TOO_SLOW_SECONDS
        self._sent_at = -THROTTLE_SECONDS
        # A deque takes 600 bytes when it is empty; most never have a throttle.
        self._waiting: deque[Sample] | None = None
        self._queued_bytes = 0
        self._timer: Timer | None = None

    @property
    def allowance(self) -> UserQuota:
        """What its user may have of the processor."""
        return self._receiver.allowance

    @property
    def spared(self) -> float:
        """Least seconds between two samples of the robot that this one needs: who wants them queued needs all."""
        return 0.0 if self.depth else self.throttle

    @property
    def raw(self) -> bool:
        """Whether samples are wanted as the robot sends them, so that their type need not be known."""
        return self.wish.form.compression == "cbor-raw"

    def add(self, ask: rosbridge.Subscribe, form: MessageEncoding = PLAIN) -> None:
        """One more subscription, or another one under the same name and id.

        :raises Refused: too many on this topic
        """
        key = (ask.topic, ask.id)
        if key not in self._asks and len(self._asks) >= ASKS:
            raise Refused(f"at most {ASKS} subscriptions to one topic can be held on one connection")
        # The latest is the last, also when it replaces one.
        self._asks.pop(key, None)
        self._asks[key] = SubscribeRequest(ask, form)
        self._told.clear()
        self._failed -= {ask.id}
        self._merge()

    def remove(self, name: str, id: rosbridge.Id) -> bool:
        """One subscription less; whether any are left.

        :param name: the topic as the client writes it. Another spelling than in ``subscribe`` will do.
        """
        if self._asks.pop((name, id), None) is None:
            for key in [key for key in self._asks if key[1] == id]:
                del self._asks[key]
        if self._asks:
            self._merge()
        return bool(self._asks)

    def _merge(self) -> None:
        asks = [each.ask for each in self._asks.values()]
        forms = [each.form for each in self._asks.values()]
        least = min(ask.throttle_rate for ask in asks) / 1000
        self.throttle = min(max(0.0, least), THROTTLE_SECONDS)
        self.depth = min(max(0, max(ask.queue_length for ask in asks)), QUEUE_LENGTH)
        size = min((form.fragment_size for form in forms if form.fragment_size), default=0)
        names = tuple(dict.fromkeys(ask.topic for ask in asks))
        self.wish = output_format_for(names, MessageEncoding(forms[-1].compression, size))
        if self._timer is not None:
            self._make_room()
            self._timer.cancel()
            self._wait()

    def offer(self, sample: Sample) -> None:
        """A new sample. Within the throttle it waits, in a queue or as the newest, so the last of a burst arrives.

        Source: rosbridge v2 protocol, section 3.3.4, ``queue_length``.
        """
        throttle = self.throttle
        if throttle:
            now = self._clock.seconds()
            if now < self._sent_at + throttle or (self.depth and self._waiting):
                self._queue(sample)
                return
            self._sent_at = now
        if self._timer is not None:
            # What waited under a longer throttle is older than this one.
            if self.depth:
                self._send_all()
            else:
                self.close()
        self._receiver.deliver(self, sample)

    def replay(self, sample: Sample) -> None:
        """A latched sample for a late joiner; each is of another publisher, so no throttle drops any."""
        self._receiver.deliver(self, sample)

    def missed(self, count: int) -> None:
        """Samples of the topic did not come from the robot; for who keeps count of them."""

    def complain(self, flaw: RenderError, words: str) -> None:
        """Tell the client why it does not get what it asked for: once for each id, until it asks again."""
        if flaw not in self._told:
            self._told.add(flaw)
            for id in self.ids:
                self._receiver.tell(_LEVELS[flaw], f"{self.topic}: {words}", id)

    def warn(self, words: str) -> None:
        """Tell the client of something it should know, for each of its subscriptions."""
        for id in self.ids:
            self._receiver.tell("warning", f"subscribe {self.topic}: {words}", id)

    def fail(self, words: str) -> None:
        """Tell the client that it gets nothing, and why: once for each id, until it asks again or that has passed."""
        for id in self.ids:
            if id not in self._failed:
                self._failed |= {id}
                self._receiver.tell("error", f"subscribe {self.topic}: {words}", id)

    def mended(self) -> None:
        """What made it fail has passed; what comes next is news."""
        self._failed = frozenset()

    @property
    def latest(self) -> rosbridge.Id:
        """The id of the latest subscription."""
        return next(reversed(self._asks))[1]

    @property
    def ids(self) -> list[rosbridge.Id]:
        """Of its subscriptions."""
        return list(dict.fromkeys(id for _, id in self._asks))

    def plainly(self) -> None:
        """A sample comes as plain JSON for once: tell the client now and then."""
        self._receiver.plain_instead += 1
        now = self._clock.seconds()
        if now >= self._plainly_at + PLAINLY_SECONDS:
            self._plainly_at = now
            self._receiver.tell("warning", f"{self.topic}: {TOO_COSTLY}", self.latest)

    def too_slow(self, words: str) -> None:
        """A sample is dropped because the client's connection is thin: tell the client now and then.

        :param words: what it can do
        """
        now = self._clock.seconds()
        if now >= self._too_slow_at + TOO_SLOW_SECONDS:
            self._too_slow_at = now
            self._receiver.tell("warning", f"{self.topic}: samples are dropped: {words}", self.latest)

    def close(self) -> None:
        """Stop; nothing more is sent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        while self._waiting:
            self._take()

    def _queue(self, sample: Sample) -> None:
        if self._waiting is None:
            self._waiting = deque()
        elif self._waiting and not self.depth:
            # It gives way to a newer one by the client's own wish: no drop.
            self._take()
        self._waiting.append(sample)
        self._queued_bytes += sample.size
        self._receiver.queued_bytes += sample.size
        self._make_room()
        if self._timer is None:
            self._wait()

    def _make_room(self) -> None:
        """The oldest give way; the newest always stays."""
        receiver = self._receiver
        while self._waiting and (
            len(self._waiting) > max(self.depth, 1)
            or (
                len(self._waiting) > 1
                and (self._queued_bytes > QUEUE_BYTES or receiver.queued_bytes > QUEUES_BYTES)
            )
        ):
            self._take()
            receiver.dropped(self)

    def _take(self) -> Sample:
        assert self._waiting
        sample = self._waiting.popleft()
        self._queued_bytes -= sample.size
        self._receiver.queued_bytes -= sample.size
        return sample

    def _wait(self) -> None:
        left = self._sent_at + self.throttle - self._clock.seconds()
        self._timer = self._clock.callLater(max(0.0, left), self._due)

    def _due(self) -> None:
        self._timer = None
        if not self.throttle:
            self._send_all()
        elif self._waiting:
            self._sent_at = self._clock.seconds()
            self._receiver.deliver(self, self._take())
            # The client may be gone by what was sent.
            if self._waiting and self._timer is None:
                self._wait()

    def _send_all(self) -> None:
        """The throttle was lifted."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        while self._waiting:
            self._receiver.deliver(self, self._take())
