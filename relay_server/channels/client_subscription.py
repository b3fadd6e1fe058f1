"""One client's subscription to one topic: its throttle, its queue, and notifications about it."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple, Protocol

from relay_protocol import link, rosbridge
from relay_protocol.errors import Refused
from relay_protocol.limits import MIB
from relay_server.channels.encodings import PLAIN, MessageEncoding
from relay_server.channels.samples import Rendered, RenderError, Sample, output_format_for
from relay_server.channels.thinning import least_thinning
from relay_server.common.clock import Clock, Timer

THROTTLE_SECONDS = 3600.0
"""Longest throttle; a client that requests more gets this."""

MAX_REQUESTS = 64
"""Most ``subscribe`` operations of one client for one topic, which are merged."""

QUEUE_LENGTH = 1000
"""Longest queue; a client that requests more gets this."""

QUEUE_BYTES = 2 * MIB
"""Most bytes that wait within the throttle of one subscription; the newest sample may be larger."""

QUEUES_BYTES = 8 * MIB
"""Most bytes that wait in the throttles of one client; the newest sample of each topic is kept even beyond it."""

PLAIN_NOTICE_SECONDS = 60.0
"""Least seconds between notices that a client gets plain JSON because its CPU quota is used up."""

SLOW_NOTICE_SECONDS = 10.0
"""Least seconds between notices that samples of a topic are dropped because the client's connection is slow, and
between those that the robot's link is."""

SLOW_LINK = "slow_link"
SLOW_ROBOT = "slow_robot"
"""Reasons for samples that a robot has not sent: newer ones replaced them, or it was too busy (SPEC 2.5)."""

LINK_TOO_SLOW = (
    "samples are dropped, as the robot's link is too slow for all that is subscribed. Subscribe with a throttle_rate, "
    "or to fewer or smaller topics"
)
ROBOT_TOO_SLOW = (
    "samples are dropped, as the robot's computer is too busy to send them; subscribe to fewer topics"
)
_DROP_WARNINGS = {SLOW_LINK: LINK_TOO_SLOW, SLOW_ROBOT: ROBOT_TOO_SLOW}

_LEVELS = {
    RenderError.BROKEN: "error",
    RenderError.NOT_CDR: "error",
    RenderError.TOO_LARGE: "warning",
    RenderError.NOT_SENT: "error",
}


class SampleReceiver(Protocol):
    """Receives the samples of a subscription: a client's :class:`~relay_server.sessions.context.ClientContext`, whose
    ``deliver`` is that of its port; a recording; or a part of the channel itself.
    """

    plain_instead: int
    """Messages sent as plain JSON because a costlier encoding exceeded the user's CPU quota."""

    queued_bytes: int
    """Bytes that wait in the throttles of all its subscriptions, which update the number."""

    def deliver(self, subscription: ClientSubscription, sample: Sample) -> None:
        """Send or queue a sample for the client."""

    def dropped(self, subscription: ClientSubscription) -> None:
        """Count a sample that the client will not get."""

    def notify(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Send a status, if the client has requested that level."""

    def warn_of_drops(self, text: str, id: rosbridge.Id = None) -> None:
        """Warn of samples that the robot's link does not carry, unless the receiver shows the counts itself."""


class SubscribeRequest(NamedTuple):
    """One ``subscribe`` operation, and the encoding it requests."""

    operation: rosbridge.Subscribe
    encoding: MessageEncoding


class ClientSubscription:
    """One client's subscription to one topic. Several ``subscribe`` operations are merged, as rosbridge_suite does.

    :param topic: its full name
    """

    __slots__ = (
        "_clock",
        "_link_notice_at",
        "_notified_errors",
        "_notified_ids",
        "_plain_notice_at",
        "_queued_bytes",
        "_receiver",
        "_requests",
        "_sent_at",
        "_slow_notice_at",
        "_timer",
        "_waiting",
        "depth",
        "format",
        "thin",
        "throttle",
        "topic",
    )

    def __init__(self, clock: Clock, receiver: SampleReceiver, topic: str) -> None:
        self._clock = clock
        self._receiver = receiver
        self.topic = topic
        self.throttle = 0.0
        """Least seconds between two samples: the shortest that any operation requests."""
        self.thin: link.Thinning | None = None
        """Of point clouds: the least thinning that its operations request; ``None``: all points."""
        self.depth = 0
        """Most samples that wait for this client: the most that any operation requests; 0: the relay decides."""
        self.format = output_format_for((topic,), PLAIN)
        """Of the operations: all spellings of the topic, the latest compression and the least size of fragments."""
        self._requests: dict[tuple[str, rosbridge.Id], SubscribeRequest] = {}
        self._notified_errors: set[RenderError] = set()
        self._notified_ids: frozenset[rosbridge.Id] = frozenset()
        """Ids of the operations of whose failure the client was notified."""
        self._plain_notice_at = -PLAIN_NOTICE_SECONDS
        self._slow_notice_at = self._link_notice_at = -SLOW_NOTICE_SECONDS
        self._sent_at = -THROTTLE_SECONDS
        # An empty deque takes 600 bytes, and most subscriptions never have a throttle.
        self._waiting: deque[Sample] | None = None
        self._queued_bytes = 0
        self._timer: Timer | None = None

    @property
    def robot_throttle(self) -> float:
        """Least seconds between two samples that the robot must send; a client that queues samples needs all."""
        return 0.0 if self._queues else self.throttle

    @property
    def _queues(self) -> bool:
        """Whether more than the newest sample may wait within the throttle."""
        return self.depth > 1

    @property
    def raw(self) -> bool:
        """Whether the client gets samples as the robot sends them, so that their type need not be known."""
        return self.format.encoding.compression == "cbor-raw"

    def add(self, operation: rosbridge.Subscribe, encoding: MessageEncoding = PLAIN) -> None:
        """Add an operation, or replace the one with the same name and id.

        :raises Refused: there are too many on this topic
        """
        key = (operation.topic, operation.id)
        if key not in self._requests and len(self._requests) >= MAX_REQUESTS:
            raise Refused(f"at most {MAX_REQUESTS} subscriptions to one topic can be held on one connection")
        # The latest is the last, also when it replaces one.
        self._requests.pop(key, None)
        self._requests[key] = SubscribeRequest(operation, encoding)
        self._notified_errors.clear()
        self._notified_ids -= {operation.id}
        self._merge()

    def remove(self, name: str, id: rosbridge.Id) -> bool:
        """Remove an operation; returns whether any are left.

        :param name: the topic as the client writes it; another spelling than in ``subscribe`` is accepted
        """
        if self._requests.pop((name, id), None) is None:
            for key in [key for key in self._requests if key[1] == id]:
                del self._requests[key]
        if self._requests:
            self._merge()
        return bool(self._requests)

    def _merge(self) -> None:
        operations = [each.operation for each in self._requests.values()]
        encodings = [each.encoding for each in self._requests.values()]
        least = min(operation.throttle_rate for operation in operations) / 1000
        self.throttle = min(max(0.0, least), THROTTLE_SECONDS)
        self.thin = least_thinning(operation.thin for operation in operations)
        self.depth = min(max(0, max(operation.queue_length for operation in operations)), QUEUE_LENGTH)
        size = min((encoding.fragment_size for encoding in encodings if encoding.fragment_size), default=0)
        names = tuple(dict.fromkeys(operation.topic for operation in operations))
        self.format = output_format_for(names, MessageEncoding(encodings[-1].compression, size))
        if self._timer is not None:
            self._evict()
            self._timer.cancel()
            self._start_timer()

    def receive(self, sample: Sample) -> None:
        """Deliver a new sample. Within the throttle it waits, in a queue or as the newest: the last of a burst arrives.

        Source: rosbridge v2 protocol, section 3.3.4, ``queue_length``.
        """
        throttle = self.throttle
        if throttle:
            now = self._clock.seconds()
            if now < self._sent_at + throttle or (self._queues and self._waiting):
                self._queue(sample)
                return
            self._sent_at = now
        if self._timer is not None:
            # Samples that wait under an earlier, longer throttle are older than this one.
            if self._queues:
                self._send_all()
            else:
                self.close()
        self._receiver.deliver(self, sample)

    def replay(self, sample: Sample) -> None:
        """Deliver a latched sample to a late joiner. Each is of another publisher, so no throttle drops any."""
        self._receiver.deliver(self, sample)

    def samples_dropped(self, loss: link.SamplesDropped) -> None:
        """The robot has dropped samples: warn the client, not too often, if it or its link is too slow."""
        words, now = _DROP_WARNINGS.get(loss.reason), self._clock.seconds()
        if words is not None and now >= self._link_notice_at + SLOW_NOTICE_SECONDS:
            self._link_notice_at = now
            self._receiver.warn_of_drops(f"{self.topic}: {words}", self.latest)

    def report(self, rendered: Rendered) -> bytes | None:
        """Notify the client of a problem with a rendered sample; returns the frames to send, if there are any."""
        if rendered.error is RenderError.TOO_COSTLY:
            self._plain_instead(rendered.words)
        elif rendered.error is not None:
            self.notify_error(rendered.error, rendered.words)
        return rendered.frames

    def notify_error(self, error: RenderError, words: str) -> None:
        """Notify the client of an error of samples: once for each id, until it subscribes again."""
        if error not in self._notified_errors:
            self._notified_errors.add(error)
            for id in self.ids:
                self._receiver.notify(_LEVELS[error], f"{self.topic}: {words}", id)

    def warn(self, words: str) -> None:
        """Send a warning about the topic, for each id."""
        for id in self.ids:
            self._receiver.notify("warning", f"subscribe {self.topic}: {words}", id)

    def fail(self, words: str) -> None:
        """Notify the client that the topic can't be subscribed: once for each id, until it subscribes again or
        :meth:`clear_failures`.
        """
        for id in self.ids:
            if id not in self._notified_ids:
                self._notified_ids |= {id}
                self._receiver.notify("error", f"subscribe {self.topic}: {words}", id)

    def clear_failures(self) -> None:
        """The topic could be subscribed; the client is notified of the next failure."""
        self._notified_ids = frozenset()

    @property
    def latest(self) -> rosbridge.Id:
        """The id of the latest operation."""
        return next(reversed(self._requests))[1]

    @property
    def ids(self) -> list[rosbridge.Id]:
        """The ids of its operations."""
        return list(dict.fromkeys(id for _, id in self._requests))

    def _plain_instead(self, words: str) -> None:
        self._receiver.plain_instead += 1
        now = self._clock.seconds()
        if now >= self._plain_notice_at + PLAIN_NOTICE_SECONDS:
            self._plain_notice_at = now
            self._receiver.notify("warning", f"{self.topic}: {words}", self.latest)

    def too_slow(self, words: str) -> None:
        """Notify the client, not too often, that samples are dropped because its connection is slow.

        :param words: advice
        """
        now = self._clock.seconds()
        if now >= self._slow_notice_at + SLOW_NOTICE_SECONDS:
            self._slow_notice_at = now
            self._receiver.notify("warning", f"{self.topic}: samples are dropped: {words}", self.latest)

    def close(self) -> None:
        """Stop the throttle and drop what waits in it."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        while self._waiting:
            self._dequeue()

    def _queue(self, sample: Sample) -> None:
        if self._waiting is None:
            self._waiting = deque()
        self._waiting.append(sample)
        self._queued_bytes += sample.size
        self._receiver.queued_bytes += sample.size
        self._evict()
        if self._timer is None:
            self._start_timer()

    def _evict(self) -> None:
        """Drop the oldest samples beyond the limits; the newest is always kept."""
        receiver = self._receiver
        while self._waiting and (
            len(self._waiting) > max(self.depth, 1)
            or (
                len(self._waiting) > 1
                and (self._queued_bytes > QUEUE_BYTES or receiver.queued_bytes > QUEUES_BYTES)
            )
        ):
            self._dequeue()
            if self._queues:
                # Otherwise the newest replaces the one before, as requested.
                receiver.dropped(self)

    def _dequeue(self) -> Sample:
        assert self._waiting
        sample = self._waiting.popleft()
        self._queued_bytes -= sample.size
        self._receiver.queued_bytes -= sample.size
        return sample

    def _start_timer(self) -> None:
        left = self._sent_at + self.throttle - self._clock.seconds()
        self._timer = self._clock.callLater(max(0.0, left), self._send_next)

    def _send_next(self) -> None:
        self._timer = None
        if not self.throttle:
            self._send_all()
        elif self._waiting:
            self._sent_at = self._clock.seconds()
            self._receiver.deliver(self, self._dequeue())
            # Delivering may have closed the connection.
            if self._waiting and self._timer is None:
                self._start_timer()

    def _send_all(self) -> None:
        """Deliver all that waits, as there is no throttle any more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        while self._waiting:
            self._receiver.deliver(self, self._dequeue())
