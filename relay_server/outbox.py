"""What waits for a slow receiver: bounded, newest data first to survive, control never dropped.

Used towards clients and towards robots. While the transport takes bytes, everything passes straight through.
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
CONTROL_MESSAGES = 1024
CONTROL_BYTES = 2 * MIB
DROPS_OF = 4096
"""Topics whose drops are counted one by one."""


class Parcel(Protocol):
    """A sample that is made ready for the wire only when its turn comes."""

    size: int

    def open(self, key: Any) -> bytes | None:
        """What goes on the wire for this key; ``None`` when nothing can."""


class _Queue:
    """Samples of one topic that wait, each with the moment it came."""

    __slots__ = ("bytes", "key", "samples")

    def __init__(self, key: Hashable) -> None:
        self.key = key
        self.samples: deque[tuple[float, int, bytes | Parcel]] = deque()
        self.bytes = 0


class Outbox:
    """A queue in front of one transport.

    :param write: puts one message on the transport; only called while it is not paused
    :param seconds: a monotonic clock
    :param overflow: called once when control messages exceed their bound; the receiver must be cut
    """

    __slots__ = (
        "_closed",
        "_control",
        "_control_bytes",
        "_data",
        "_data_bytes",
        "_overflow",
        "_seconds",
        "dropped",
        "drops",
        "passing",
        "paused_since",
        "write",
    )

    def __init__(
        self, write: Callable[[bytes], None], seconds: Callable[[], float], overflow: Callable[[], None]
    ) -> None:
        self.write = write
        self._seconds = seconds
        self._overflow = overflow
        # A deque takes 600 bytes when it is empty; most never have to wait.
        self._control: deque[bytes] | None = None
        self._control_bytes = 0
        self._data: dict[Hashable, _Queue] = {}
        self._data_bytes = 0
        self._closed = False
        self.paused_since: float | None = None
        self.passing = True
        """Neither paused nor closed: what is to be sent may be given to :attr:`write` as well, in one call less."""
        self.dropped = 0
        self.drops: dict[Hashable, int] = {}
        """Samples dropped of each topic that was not forgotten since."""

    @property
    def waiting_bytes(self) -> int:
        """Bytes held back, data and control."""
        return self._data_bytes + self._control_bytes

    def pause(self) -> None:
        """The transport's buffer is full."""
        if self.paused_since is None:
            self.paused_since = self._seconds()
            self.passing = False

    def resume(self) -> None:
        """The transport takes bytes again: control first, then one message a topic in turn."""
        self.paused_since = None
        self.passing = not self._closed
        while self._control and self.paused_since is None and not self._closed:
            message = self._control.popleft()
            self._control_bytes -= len(message)
            self.write(message)
        while self._data and self.paused_since is None and not self._closed:
            key = next(iter(self._data))
            queue = self._data.pop(key)
            self._forget_stale(queue)
            parcel = self._take(queue)
            if queue.samples:
                self._data[key] = queue
            self._put(key, parcel)

    def close(self) -> None:
        """Nothing is written any more; what waited is let go."""
        self._closed = True
        self.passing = False
        self._control = None
        self._data.clear()
        self._control_bytes = self._data_bytes = 0

    def control(self, message: bytes) -> None:
        """Send a message that must not be lost."""
        if self._closed:
            return
        if self.paused_since is None:
            self.write(message)
            return
        if self._control is None:
            self._control = deque()
        self._control.append(message)
        self._control_bytes += len(message)
        if len(self._control) > CONTROL_MESSAGES or self._control_bytes > CONTROL_BYTES:
            self.close()
            self._overflow()

    def data(self, key: Hashable, parcel: bytes | Parcel, depth: int = DATA_PER_TOPIC) -> None:
        """Send a sample of a topic; the oldest give way when they pile up.

        :param key: the topic, and what a :class:`Parcel` is opened with
        :param depth: most samples of this topic that may wait, at least one
        """
        if self._closed:
            return
        if self.paused_since is None:
            message = parcel if isinstance(parcel, bytes) else parcel.open(key)
            if message is not None:
                self.write(message)
            return
        size = len(parcel) if isinstance(parcel, bytes) else parcel.size
        queue = self._data.get(key)
        if queue is None:
            queue = self._data[key] = _Queue(key)
        queue.samples.append((self._seconds(), size, parcel))
        queue.bytes += size
        self._data_bytes += size
        while len(queue.samples) > max(depth, 1):
            self._drop_oldest(queue)
        if self._data_bytes > DATA_BYTES:
            self._make_room()
        while self._data_bytes > 2 * DATA_BYTES and queue.samples:
            # Single samples of many topics: even the newest can't all be kept.
            self._drop_oldest(queue)
        if not queue.samples:
            del self._data[key]

    def _put(self, key: Hashable, parcel: bytes | Parcel) -> None:
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

    def _forget_stale(self, queue: _Queue) -> None:
        oldest = self._seconds() - DATA_AGE
        while len(queue.samples) > 1 and queue.samples[0][0] < oldest:
            self._drop_oldest(queue)

    def _drop_oldest(self, queue: _Queue) -> None:
        self._take(queue)
        self.count_drop(queue.key)

    def count_drop(self, key: Hashable) -> None:
        """A sample of this topic is dropped, here or before it came here."""
        self.dropped += 1
        self.drops[key] = self.drops.get(key, 0) + 1
        if len(self.drops) > DROPS_OF:
            del self.drops[next(iter(self.drops))]

    def _take(self, queue: _Queue) -> bytes | Parcel:
        _, size, parcel = queue.samples.popleft()
        queue.bytes -= size
        self._data_bytes -= size
        return parcel
