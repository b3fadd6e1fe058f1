"""What waits for a slow receiver: bounded, newest data first to survive, control never dropped.

Used towards clients and towards robots. While the transport takes bytes, everything passes straight through. On a thin
connection (:mod:`relay_server.common.pacing`) small samples go before large ones, and a large sample that
held up others
is followed by as much time for them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable
from operator import attrgetter
from typing import Any, Protocol

from relay_protocol.limits import MIB

DATA_BYTES = 2 * MIB
DATA_PER_TOPIC = 128
DATA_AGE = 1.0
THIN_AGE = 0.3
BURST = 4
"""Seconds, seconds, samples: what is older gives way to newer samples of its topic. On a thin connection that is
:data:`THIN_AGE`, but so many samples of a topic are kept for a second: they may be a burst of events, and no stream."""
PATIENCE = 1.0
"""Seconds after which a large sample goes before small ones, or it would wait for ever."""
CONTROL_MESSAGES = 1024
CONTROL_BYTES = 2 * MIB
TAKEN = 8
"""So many times as much control may wait for a receiver that takes bytes: the window, and no longer the kernel, holds
what comes at once."""
SEGMENT = 1400
"""A message of no more bytes, one packet, is never divided, and a command of no more bytes goes ahead."""
DROPS_OF = 4096
"""Topics whose drops are counted one by one."""


class LazyMessage(Protocol):
    """A sample that is made ready for the wire only when its turn comes."""

    size: int

    def open(self, key: Any) -> bytes | None:
        """What goes on the wire for this key; ``None`` when nothing can."""


class _TopicQueue:
    """Samples of one topic that wait, each with the moment it came.

    :ivar commands: whether they are commands
    """

    __slots__ = ("bytes", "commands", "key", "samples")

    def __init__(self, key: Hashable, commands: bool) -> None:
        self.key = key
        self.commands = commands
        self.samples: deque[tuple[float, int, bytes | LazyMessage]] = deque()
        self.bytes = 0


class SendQueue:
    """A queue in front of one transport.

    :param write: puts one message on the transport; only called while it is not paused
    :param seconds: a monotonic clock
    :param overflow: called once when control messages exceed their bound; the receiver must be cut
    :param requests: bytes of requests that may wait besides, see :meth:`has_room`
    """

    __slots__ = (
        "_closed",
        "_control",
        "_control_bytes",
        "_data",
        "_data_bytes",
        "_held_up",
        "_large",
        "_large_since",
        "_open",
        "_opens",
        "_overflow",
        "_requests",
        "_seconds",
        "_sending_since",
        "dropped",
        "drops",
        "held",
        "on_drop",
        "on_hold",
        "passing",
        "paused_since",
        "rate",
        "taking",
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
        # A deque takes 600 bytes when it is empty; most never have to wait.
        self._control: deque[bytes] | None = None
        self._control_bytes = 0
        self._data: dict[Hashable, _TopicQueue] = {}
        self._data_bytes = 0
        self._closed = False
        self.paused_since: float | None = None
        self.held = False
        """Whether the window of the connection is full."""
        self._open = True
        """Neither paused, held nor closed."""
        self.passing = True
        """Whether what is to be sent may be given to :attr:`write` as well, in one call less."""
        self.rate: float | None = None
        """Bytes a second the connection carries, where it has proved to be thin."""
        self._large: int | None = None
        """Samples of more bytes are large; ``None`` where the connection is not thin."""
        self._large_since: float | None = None
        """Since when a large sample waits."""
        self._sending_since: float | None = None
        """Since when a large sample is being sent."""
        self._held_up = False
        """Whether others had to wait for it."""
        self._opens = 0.0
        """When the next large sample may go; 0 once it may."""
        self.taking = _unknown
        """Whether the receiver is known to take bytes."""
        self.dropped = 0
        self.drops: dict[Hashable, int] = {}
        """Samples dropped of each topic that was not forgotten since."""
        self.on_drop: Callable[[Hashable], None] | None = None
        self.on_hold: Callable[[bool], None] | None = None

    @property
    def waiting_bytes(self) -> int:
        """Bytes held back, data and control."""
        return self._data_bytes + self._control_bytes

    def pause(self) -> None:
        """The transport's buffer is full."""
        if self.paused_since is None:
            self.paused_since = self._seconds()
            self._look()

    def resume(self) -> None:
        """The transport takes bytes again: control first, then one message a topic in turn."""
        self.paused_since = None
        self._drain()

    def hold(self, *, large: bool) -> None:
        """The window is full.

        :param large: by a message that is larger than the window, which is being sent
        """
        if large and self._sending_since is None:
            self._sending_since = self._seconds()
            self._held_up = bool(self._data or self._control)
        if not self.held:
            self.held = True
            self._look()
            if self.on_hold is not None:
                self.on_hold(True)

    def release(self) -> None:
        """There is room in the window, and nothing is left of the message that was being sent."""
        self.held = False
        if self._sending_since is not None:
            now = self._seconds()
            self._opens = 2 * now - self._sending_since if self._held_up and self._large is not None else 0.0
            self._sending_since = None
        if self.on_hold is not None:
            self.on_hold(False)
        self._drain()

    @property
    def opens_in(self) -> float:
        """Seconds until :meth:`open` is to be called; 0 if it need not be."""
        return max(0.0, self._opens - self._seconds()) if self._opens else 0.0

    def open(self) -> None:
        """Large samples may go again."""
        self._opens = 0.0
        self._drain()

    def limit(self, large: int | None, rate: float | None) -> None:
        """The connection was measured.

        :param large: bytes from which on a sample counts as large; ``None`` where it is not thin
        :param rate: bytes a second it carries, if it is thin
        """
        self._large, self.rate = large, rate

    def _look(self) -> None:
        self._open = not (self._closed or self.held or self.paused_since is not None)
        self.passing = self._open and not self._opens and not self._data

    def _drain(self) -> None:
        self._look()
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
            parcel = self._take(queue)
            if queue.samples:
                self._data[key] = queue
            self._put(key, parcel)
        self._look()

    def _next(self) -> Hashable:
        """The topic that is next; ``None`` when all that waits is large and may not go yet."""
        limit = self._large
        if limit is None:
            return next(iter(self._data))
        now, large = self._seconds(), None
        shut = now < self._opens
        if not shut and self._large_since is not None:
            patient = now - max(self._large_since, self._opens) <= PATIENCE
        else:
            patient = True
        for key, queue in self._data.items():
            if queue.samples[0][1] <= limit:
                if patient or large is None:
                    return key
            elif large is None:
                large = key
                if not patient:
                    break
        if large is None or shut:
            return None
        self._large_since = None
        return large

    def close(self) -> None:
        """Nothing is written any more; what waited is let go."""
        self._closed = True
        self._look()
        self._control = None
        self._data.clear()
        self._control_bytes = self._data_bytes = 0

    def control(self, message: bytes) -> None:
        """Send a message that must not be lost."""
        if self._closed:
            return
        if self._open and not self._control:
            self.write(message)
            return
        self._held_up = True
        if self._control is None:
            self._control = deque()
        self._control.append(message)
        self._control_bytes += len(message)
        if self._exceeds(1) and (not self.taking() or self._exceeds(TAKEN)):
            self.close()
            self._overflow()

    def _exceeds(self, times: int) -> bool:
        return (
            len(self._control or ()) > times * CONTROL_MESSAGES
            or self._control_bytes > times * CONTROL_BYTES + self._requests
        )

    def has_room(self, size: int) -> bool:
        """Whether a request of so many bytes may be given to :meth:`control`, so that it leaves others their room."""
        messages = len(self._control or ())
        return messages < CONTROL_MESSAGES // 2 and self._control_bytes + size <= self._requests

    def data(
        self,
        key: Hashable,
        parcel: bytes | LazyMessage,
        depth: int = DATA_PER_TOPIC,
        *,
        commands: bool = False,
    ) -> None:
        """Send a sample of a topic; the oldest give way when they pile up.

        :param key: the topic, and what a :class:`LazyMessage` is opened with
        :param depth: most samples of this topic that may wait, at least one
        :param commands: whether samples of this topic are commands, all of them bytes
        """
        if self._closed:
            return
        if self.passing:
            self._put(key, parcel)
            return
        size = len(parcel) if isinstance(parcel, bytes) else parcel.size
        self._note(size)
        queue = self._data.get(key)
        if queue is None:
            queue = self._data[key] = _TopicQueue(key, commands)
        queue.samples.append((self._seconds(), size, parcel))
        queue.bytes += size
        self._data_bytes += size
        while len(queue.samples) > max(depth, 1):
            self._drop_oldest(queue)
        if self._data_bytes > DATA_BYTES:
            self._make_room()
        while self._data_bytes > 2 * DATA_BYTES and queue.samples:
            if len(queue.samples) == 1 and self._data_bytes - queue.bytes <= DATA_BYTES:
                # However large, one that little else waits beside has room.
                break
            # Single samples of many topics: even the newest can't all be kept.
            self._drop_oldest(queue)
        if not queue.samples:
            del self._data[key]
        if self._open:
            self._drain()

    def take_command(self) -> bytes | None:
        """The next small command that waits; topics take turns. ``None`` if none of any topic is next."""
        for queue in self._data.values():
            if queue.commands:
                self._forget_stale(queue)
                if queue.samples[0][1] <= SEGMENT:
                    break
        else:
            return None
        del self._data[queue.key]
        command = self._take(queue)
        if queue.samples:
            self._data[queue.key] = queue
        assert isinstance(command, bytes)
        return command

    def _note(self, size: int) -> None:
        """A sample begins to wait."""
        if self._large is None or size <= self._large:
            self._held_up = True
        elif self._large_since is None:
            self._large_since = self._seconds()

    def _put(self, key: Hashable, parcel: bytes | LazyMessage) -> None:
        message = parcel if isinstance(parcel, bytes) else parcel.open(key)
        if message is not None:
            self.write(message)

    def forget(self, key: Hashable) -> None:
        """Let go of what waits of this topic."""
        self.drops.pop(key, None)
        queue = self._data.pop(key, None)
        if queue is not None:
            self._data_bytes -= queue.bytes

    def _make_room(self) -> None:
        """Drop from the fullest topic first; each keeps its newest sample."""
        while self._data_bytes > DATA_BYTES:
            several = [queue for queue in self._data.values() if len(queue.samples) > 1]
            if not several:
                return
            fullest = max(several, key=attrgetter("bytes"))
            # A quarter at once, or every further sample would cost a search.
            for _ in range(max(1, len(fullest.samples) // 4)):
                self._drop_oldest(fullest)

    def _forget_stale(self, queue: _TopicQueue) -> None:
        now = self._seconds()
        if self._large is not None:
            self._drop_older(queue, now - THIN_AGE, BURST)
        self._drop_older(queue, now - DATA_AGE, 1)

    def _drop_older(self, queue: _TopicQueue, oldest: float, keep: int) -> None:
        while len(queue.samples) > keep and queue.samples[0][0] < oldest:
            self._drop_oldest(queue)

    def _drop_oldest(self, queue: _TopicQueue) -> None:
        self._take(queue)
        self.count_drop(queue.key)

    def count_drop(self, key: Hashable) -> None:
        """A sample of this topic is dropped, here or before it came here."""
        self.dropped += 1
        self.drops[key] = self.drops.get(key, 0) + 1
        if self.on_drop is not None:
            self.on_drop(key)
        if len(self.drops) > DROPS_OF:
            del self.drops[next(iter(self.drops))]

    def _take(self, queue: _TopicQueue) -> bytes | LazyMessage:
        _, size, parcel = queue.samples.popleft()
        queue.bytes -= size
        self._data_bytes -= size
        return parcel


def _unknown() -> bool:
    """Nobody measures whether the receiver takes bytes."""
    return False
