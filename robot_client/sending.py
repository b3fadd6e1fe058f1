"""When samples are written: batched, as far as the transport takes them, held ones when their time has come."""

from __future__ import annotations

import time
from collections.abc import Callable

from relay_protocol.limits import KIB
from robot_client.reactors import Clock, Timer
from robot_client.uplink import Uplink
from robot_client.wire import Wire

CHUNK = 64 * KIB
AT_ONCE = 8
"""Chunks written before others have their turn on the reactor: a link that takes all is no reason to keep it."""


class Sending:
    """The uplink of one channel, with its timers.

    :param after: takes what is to be called when the samples that came together are all there; they share a write
    :param frame_limit: largest frame the relay takes, bytes
    :param wall: what samples are stamped by, nanoseconds
    """

    def __init__(
        self,
        wire: Wire,
        clock: Clock,
        after: Callable[[Callable[[], None]], None],
        frame_limit: int,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        self.uplink = Uplink(clock.seconds, frame_limit)
        self._wire = wire
        self._clock = clock
        self._after = after
        self._wall = wall
        self._awaited = False
        self._closed = False
        self._flush: Timer | None = None
        self._release: Timer | None = None

    def offer(self, number: int, body: bytes, stamp: int = 0) -> None:
        """Take one sample; see :meth:`robot_client.uplink.Uplink.offer`.

        :param stamp: nanoseconds since 1970; 0 for now
        """
        taken = self.uplink.offer(number, stamp or self._wall(), body)
        if self.uplink.held:
            self.arm()
        if taken and not self._awaited and not self.uplink.paused:
            self._awaited = True
            self._after(self.flush)

    def repeat(self, number: int, stamp: int, body: bytes) -> None:
        """Take a sample that publishers keep; see :meth:`robot_client.uplink.Uplink.repeat`."""
        if self.uplink.repeat(number, stamp, body) and not self.uplink.paused:
            self.flush()

    def unmute(self, number: int) -> None:
        """Let a subscription speak again; see :meth:`robot_client.uplink.Uplink.unmute`."""
        if self.uplink.unmute(number):
            self.flush()

    def end(self, number: int) -> None:
        """End a subscription; see :meth:`robot_client.uplink.Uplink.close`."""
        self.uplink.close(number)
        self.flush()

    def flush(self) -> None:
        """Write what waits, as far as the transport takes it."""
        self._awaited = False
        if self._closed:
            return
        if self._flush is not None and self._flush.active():
            self._flush.cancel()
        self._flush = None
        for _ in range(AT_ONCE):
            chunk = self.uplink.take(CHUNK)
            if chunk:
                self._wire.write(chunk)
            if self.uplink.paused or not self.uplink.ready:
                return
        self._flush = self._clock.callLater(0, self.flush)

    def pause(self) -> None:
        """The transport is full."""
        self.uplink.paused = True
        self.uplink.trim()

    def resume(self) -> None:
        """The transport has room again."""
        self.uplink.paused = False
        self.flush()

    def close(self) -> None:
        """Write no more."""
        self._closed = True
        for timer in (self._flush, self._release):
            if timer is not None and timer.active():
                timer.cancel()

    def arm(self) -> None:
        """See that the next sample held back by a throttle goes when it is due."""
        due = self.uplink.next_due()
        if self._release is not None and self._release.active():
            if due is not None and self._release.getTime() <= due:
                return
            self._release.cancel()
        self._release = None
        if due is not None:
            self._release = self._clock.callLater(max(0.0, due - self._clock.seconds()), self._let_go)

    def _let_go(self) -> None:
        self._release = None
        self.uplink.release()
        self.flush()
        self.arm()
