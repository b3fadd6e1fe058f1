"""Bounded queue of messages to one receiver, a client or a robot. Old data is dropped first, control never.

While the transport takes bytes, messages are written at once. On a slow connection (:mod:`relay_server.common.pacing`)
small samples go before large ones. A large sample that delayed others is followed by as much time for small ones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, Protocol

from relay_protocol.limits import KIB, MIB, ROBOT_FRAME

DATA_BYTES = 2 * MIB
"""Most bytes of samples that wait for one receiver."""

LASTING_BYTES = ROBOT_FRAME
"""Most bytes of samples that wait for one receiver and are not replaced by newer ones; they count only for this limit.
The relay holds them anyway (:mod:`relay_server.channels.latched`)."""

DATA_PER_TOPIC = 128
"""Most samples of one topic that wait."""

DATA_AGE = 1.0
"""Seconds after which a waiting sample is dropped for newer samples of its topic."""

SLOW_AGE = 0.3
"""The same on a slow connection; the newest :data:`BURST` samples of a topic stay for :data:`DATA_AGE`."""

BURST = 4
"""Newest samples of a topic that :data:`SLOW_AGE` does not drop: they may be events, and not a stream."""

MIDDLING = 2 * KIB
"""On a slow connection a sample of more bytes is sent after smaller ones of other topics."""

MIDDLING_TURN = 16 * KIB
"""Bytes of small samples that are sent before a middling one that waits longer."""

LARGE_WAIT = 1.0
"""Seconds after which a large sample is sent before small ones; otherwise it could wait for ever."""

CONTROL_MESSAGES = 1024
"""Most control messages that wait; one more disconnects the receiver."""

CONTROL_BYTES = 2 * MIB
"""Most bytes of control messages that wait; more disconnect the receiver."""

READING_FACTOR = 8
"""The limits of control messages are this many times higher for a receiver that reads: a burst waits for
the window, although nothing is wrong."""

SEGMENT = 1400
"""Bytes of one packet. A message up to this size is never divided, and such a command is sent before others."""

MAX_COUNTED_TOPICS = 4096
"""Most topics whose drops are counted."""


class LazyMessage(Protocol):
    """A sample that is rendered when it is sent, see :attr:`SendQueue.render`."""

    size: int


class Lasting(NamedTuple):
    """Samples of a topic that newer ones do not replace.

    :param newest: how many of the newest
    :param all_ages: whether the age of none counts, as it is not known which are of another publisher
    """

    newest: int
    all_ages: bool = False


NOT_LASTING = Lasting(0)


class _TopicQueue:
    """Samples of one topic that wait: time of arrival, size, sample, and number of its publisher's connection.

    :ivar commands: whether they are commands
    :ivar counted: whether their bytes count for the limits
    :ivar lasting: those that are not replaced by newer ones
    """

    __slots__ = ("bytes", "commands", "counted", "key", "lasting", "samples")

    def __init__(self, key: Hashable, commands: bool) -> None:
        self.key = key
        self.commands = commands
        self.counted = True
        self.lasting = NOT_LASTING
        self.samples: deque[tuple[float, int, bytes | LazyMessage, int]] = deque()
        self.bytes = 0

    @property
    def all_last(self) -> bool:
        """Whether none of its samples is replaced by a newer one."""
        return len(self.samples) <= self.lasting.newest


class SendQueue:
    """A queue in front of one transport.

    :param write: writes one message to the transport; only called while it is not paused. A websocket and a robot's
        connection replace it by the ``write`` of their writer (:mod:`relay_server.common.socket_writer`)
    :param seconds: a monotonic clock
    :param overflow: called once when control messages exceed their limits; the receiver must be disconnected
    :param requests: most bytes of requests that wait, see :meth:`has_room`
    """

    __slots__ = (
        "_before_middling",
        "_closed",
        "_control",
        "_control_bytes",
        "_data",
        "_data_bytes",
        "_delayed_others",
        "_large",
        "_large_allowed_at",
        "_large_since",
        "_open",
        "_overflow",
        "_requests",
        "_seconds",
        "_sending_since",
        "dropped",
        "drops",
        "on_drop",
        "on_window_full",
        "passing",
        "paused_since",
        "rate",
        "receiver_reads",
        "render",
        "window_full",
        "write",
    )

    def __init__(
        self,
        write: Callable[[bytes], None],
        seconds: Callable[[], float],
        overflow: Callable[[], None],
        requests: int = 0,
    ) -> None:
        self.write = write
        self._seconds = seconds
        self._overflow = overflow
        self._requests = requests
        # An empty deque takes 600 bytes, and most receivers never let messages wait.
        self._control: deque[bytes] | None = None
        self._control_bytes = 0
        self._data: dict[Hashable, _TopicQueue] = {}
        self._data_bytes = 0
        self._closed = False
        self.paused_since: float | None = None
        self.window_full = False
        """Whether the window of the connection is full."""
        self._open = True
        """Neither paused, held nor closed."""
        self.passing = True
        """Whether nothing waits, so that data may be written by :attr:`write` directly, which saves a call."""
        self.rate: float | None = None
        """Bytes per second that the connection carries, where it has proved to be slow."""
        self._large: int | None = None
        """A sample of more bytes is large; ``None``: the connection is not slow."""
        self._large_since: float | None = None
        """Seconds at which the oldest large sample began to wait."""
        self._sending_since: float | None = None
        """Seconds at which the large sample that is being sent was begun."""
        self._delayed_others = False
        self._before_middling = 0
        """Bytes of small samples that were sent before a middling one that waits longer."""
        """Whether messages had to wait for it."""
        self._large_allowed_at = 0.0
        """The clock's time at which the next large sample may be sent; 0: at once."""
        self.receiver_reads = _unknown
        """Returns whether the receiver is known to read."""
        self.dropped = 0
        self.drops: dict[Hashable, int] = {}
        """Dropped samples of each topic that was not forgotten."""
        self.render: Callable[[Any, Any], bytes | None] = _no_renderer
        """Renders a :class:`LazyMessage`, given its key and itself; ``None``: nothing is sent for it."""
        self.on_drop: Callable[[Hashable, int], None] | None = None
        """Called for each sample that is dropped, with its key and its ``source`` (see :meth:`send_droppable`)."""
        self.on_window_full: Callable[[bool], None] | None = None
        """Called with True when the window is full, with False when there is room again."""

    @property
    def waiting_bytes(self) -> int:
        """Bytes that wait, of data and control; without those of :meth:`send_undroppable`."""
        return self._data_bytes + self._control_bytes

    def pause(self) -> None:
        """The transport's buffer is full."""
        if self.paused_since is None:
            self.paused_since = self._seconds()
            self._update_state()

    def resume(self) -> None:
        """The transport takes bytes again: send control first, then one message of each topic in turn."""
        self.paused_since = None
        self._drain()

    def window_filled(self, *, large: bool) -> None:
        """The window of the connection is full.

        :param large: whether by a message larger than the window, which is being sent
        """
        if large and self._sending_since is None:
            self._sending_since = self._seconds()
            self._delayed_others = bool(self._data or self._control)
        if not self.window_full:
            self.window_full = True
            self._update_state()
            if self.on_window_full is not None:
                self.on_window_full(True)

    def window_has_room(self) -> None:
        """There is room in the window, and the message that was being sent is complete."""
        self.window_full = False
        if self._sending_since is not None:
            now = self._seconds()
            # After a large sample the link is left to others for as long as that one has occupied it.
            self._large_allowed_at = (
                2 * now - self._sending_since if self._delayed_others and self._large is not None else 0.0
            )
            self._sending_since = None
        if self.on_window_full is not None:
            self.on_window_full(False)
        self._drain()

    @property
    def large_allowed_in(self) -> float:
        """Seconds until :meth:`allow_large` must be called; 0: it need not be."""
        return max(0.0, self._large_allowed_at - self._seconds()) if self._large_allowed_at else 0.0

    def allow_large(self) -> None:
        """Large samples may be sent again."""
        self._large_allowed_at = 0.0
        self._drain()

    def set_limits(self, large: int | None, rate: float | None) -> None:
        """Set the limits of the connection, as it was measured.

        :param large: a sample of more bytes counts as large; ``None``: the connection is not slow
        :param rate: bytes per second that it carries; ``None``: it is not slow
        """
        self._large, self.rate = large, rate

    def _update_state(self) -> None:
        self._open = not (self._closed or self.window_full or self.paused_since is not None)
        self.passing = self._open and not self._large_allowed_at and not self._data

    def _drain(self) -> None:
        self._update_state()
        while self._control and self._open:
            message = self._control.popleft()
            self._control_bytes -= len(message)
            self.write(message)
        while self._data and self._open:
            key = self._next()
            if key is None:
                break
            queue = self._data.pop(key)
            self._forget_stale(queue)
            sample, _ = self._dequeue(queue)
            if queue.samples:
                self._data[key] = queue
            self._render_and_write(key, sample)
        self._update_state()

    def _next(self) -> Hashable:
        """The topic that is next; ``None``: only large samples wait, and they may not be sent yet."""
        limit = self._large
        if limit is None:
            return next(iter(self._data))
        now, large = self._seconds(), None
        closed_to_large = now < self._large_allowed_at
        if not closed_to_large and self._large_since is not None:
            small_first = now - max(self._large_since, self._large_allowed_at) <= LARGE_WAIT
        else:
            small_first = True
        middling = None
        for key, queue in self._data.items():
            size = queue.samples[0][1]
            if size <= limit and (small_first or large is None):
                if size > MIDDLING and small_first:
                    middling = key if middling is None else middling
                    continue
                if middling is None or self._before_middling < MIDDLING_TURN:
                    self._before_middling += size if middling is not None else 0
                    return key
                break
            if size > limit and large is None:
                large = key
                if not small_first:
                    break
        if middling is not None:
            self._before_middling = 0
            return middling
        if large is None or closed_to_large:
            return None
        self._large_since = None
        return large

    def drop_data(self) -> None:
        """Drop the samples that wait, and count them: the receiver is gone."""
        for queue in list(self._data.values()):
            while queue.samples:
                self._drop_oldest(queue)
        self._data.clear()

    def close(self) -> None:
        """Drop what waits, and write nothing any more."""
        self._closed = True
        self._update_state()
        self._control = None
        self._data.clear()
        self._control_bytes = self._data_bytes = 0

    def send_reliable(self, message: bytes) -> None:
        """Send a message that must not be lost."""
        if self._closed:
            return
        if self._open and not self._control:
            self.write(message)
            return
        self._delayed_others = True
        if self._control is None:
            self._control = deque()
        self._control.append(message)
        self._control_bytes += len(message)
        if self._exceeds(1) and (not self.receiver_reads() or self._exceeds(READING_FACTOR)):
            self.close()
            self._overflow()

    def _exceeds(self, times: int) -> bool:
        return (
            len(self._control or ()) > times * CONTROL_MESSAGES
            or self._control_bytes > times * CONTROL_BYTES + self._requests
        )

    def has_room(self, size: int) -> bool:
        """Whether a request of so many bytes may go to :meth:`send_reliable` and leaves enough room for others."""
        messages = len(self._control or ())
        return messages < CONTROL_MESSAGES // 2 and self._control_bytes + size <= self._requests

    def send_droppable(
        self,
        key: Hashable,
        message: bytes | LazyMessage,
        depth: int = DATA_PER_TOPIC,
        *,
        commands: bool = False,
        lasting: Lasting = NOT_LASTING,
        source: int = 0,
    ) -> None:
        """Send a sample of a topic, or queue it; the oldest are dropped beyond the limits.

        :param key: the topic; a :class:`LazyMessage` is rendered with it
        :param depth: most samples of this topic that wait, at least one
        :param commands: whether samples of this topic are commands, which are all bytes
        :param lasting: samples of this topic that are not replaced by newer ones; those of other topics are dropped
            first
        :param source: number of the connection of the client that has published it, for :attr:`on_drop`
        """
        if not self._must_wait(key, message):
            return
        queue = self._data.get(key)
        if queue is None:
            queue = self._data[key] = _TopicQueue(key, commands)
        queue.lasting = lasting
        self._enqueue(queue, message, source)
        while len(queue.samples) > max(depth, lasting.newest, 1):
            self._drop_oldest(queue)
        if self._data_bytes > DATA_BYTES:
            self._evict()
            self._bound(queue)
        if not queue.samples:
            del self._data[key]
        if self._open:
            self._drain()

    def send_undroppable(self, key: Hashable, message: bytes | LazyMessage) -> None:
        """Send a message in turn with data, or queue it; it is not dropped, and does not count for the limits.

        So it may be larger than all data that may wait. The caller bounds how many wait.

        :param key: a later message with the same key replaces it while it waits
        """
        if not self._must_wait(key, message):
            return
        queue = self._data[key] = _TopicQueue(key, commands=False)
        queue.counted = False
        self._enqueue(queue, message)
        if self._open:
            self._drain()

    def take_command(self) -> bytes | None:
        """Dequeue the next small command, of the topics in turn; ``None``: no topic's next sample is one."""
        for queue in self._data.values():
            if queue.commands:
                self._forget_stale(queue)
                if queue.samples[0][1] <= SEGMENT:
                    break
        else:
            return None
        del self._data[queue.key]
        command, _ = self._dequeue(queue)
        if queue.samples:
            self._data[queue.key] = queue
        assert isinstance(command, bytes)
        return command

    def _must_wait(self, key: Hashable, message: bytes | LazyMessage) -> bool:
        """Write a message if nothing waits; returns whether it must wait instead."""
        if self.passing:
            self._render_and_write(key, message)
            return False
        return not self._closed

    def _enqueue(self, queue: _TopicQueue, message: bytes | LazyMessage, source: int = 0) -> None:
        size = len(message) if isinstance(message, bytes) else message.size
        if self._large is None or size <= self._large:
            self._delayed_others = True
        elif self._large_since is None:
            self._large_since = self._seconds()
        queue.samples.append((self._seconds(), size, message, source))
        if queue.counted:
            queue.bytes += size
            self._data_bytes += size

    def _render_and_write(self, key: Hashable, message: bytes | LazyMessage) -> None:
        rendered = message if isinstance(message, bytes) else self.render(key, message)
        if rendered is not None:
            self.write(rendered)

    def forget(self, key: Hashable) -> None:
        """Drop what waits of a topic, and its count of drops."""
        self.drops.pop(key, None)
        queue = self._data.pop(key, None)
        if queue is not None:
            self._data_bytes -= queue.bytes

    def _bound(self, queue: _TopicQueue) -> None:
        """Drop what :meth:`_evict` has left, if that is still too much, from the topic of the latest sample."""
        lasting = self._lasting_bytes()
        if queue.all_last:
            while lasting > LASTING_BYTES and len(queue.samples) > 1:
                lasting -= queue.samples[0][1]
                self._drop_oldest(queue)
            return
        while self._data_bytes - lasting > 2 * DATA_BYTES and queue.samples:
            if len(queue.samples) == 1 and self._data_bytes - lasting - queue.bytes <= DATA_BYTES:
                # A single sample is kept whatever its size, if little else waits.
                break
            # Single samples of many topics: not even the newest of each can be kept.
            self._drop_oldest(queue)

    def _lasting_bytes(self) -> int:
        """Bytes of the topics of which all samples last."""
        return sum(queue.bytes for queue in self._data.values() if queue.all_last)

    def _evict(self) -> None:
        """Drop from the fullest topic first, lasting ones at the end; each keeps its newest sample, and those that
        last.
        """
        while self._data_bytes - self._lasting_bytes() > DATA_BYTES:
            several = [
                queue for queue in self._data.values() if len(queue.samples) > max(1, queue.lasting.newest)
            ]
            if not several:
                return
            fullest = max(several, key=lambda queue: (not queue.lasting.newest, queue.bytes))
            # Drop a quarter at once, so that not every further sample costs a search.
            more = len(fullest.samples) - max(1, fullest.lasting.newest)
            for _ in range(min(more, max(1, len(fullest.samples) // 4))):
                self._drop_oldest(fullest)

    def _forget_stale(self, queue: _TopicQueue) -> None:
        newest, all_ages = queue.lasting
        if all_ages:
            return
        now = self._seconds()
        if self._large is not None:
            self._drop_older(queue, now - SLOW_AGE, max(BURST, newest))
        self._drop_older(queue, now - DATA_AGE, max(1, newest))

    def _drop_older(self, queue: _TopicQueue, oldest: float, keep: int) -> None:
        while len(queue.samples) > keep and queue.samples[0][0] < oldest:
            self._drop_oldest(queue)

    def _drop_oldest(self, queue: _TopicQueue) -> None:
        _, source = self._dequeue(queue)
        self.count_drop(queue.key, source)

    def count_drop(self, key: Hashable, source: int = 0) -> None:
        """Count a dropped sample of a topic, dropped here or before it came here."""
        self.dropped += 1
        self.drops[key] = self.drops.get(key, 0) + 1
        if self.on_drop is not None:
            self.on_drop(key, source)
        if len(self.drops) > MAX_COUNTED_TOPICS:
            del self.drops[next(iter(self.drops))]

    def _dequeue(self, queue: _TopicQueue) -> tuple[bytes | LazyMessage, int]:
        """The oldest sample of a topic, and its source."""
        _, size, message, source = queue.samples.popleft()
        if queue.counted:
            queue.bytes -= size
            self._data_bytes -= size
        return message, source


def _no_renderer(key: object, message: object) -> bytes | None:
    raise TypeError(f"{message!r} is not bytes, and this queue renders nothing")


def _unknown() -> bool:
    """Without a :class:`~relay_server.common.pacing.Pacer` it is not known whether the receiver reads."""
    return False
