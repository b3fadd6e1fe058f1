"""When samples are written: batched, as far as the transport takes them, held ones when their time has come."""

from __future__ import annotations

import time
from collections.abc import Callable

from relay_protocol import link
from robot_client.reactors import Clock, Timer
from robot_client.uplink import Uplink
from robot_client.wire import Wire

TELL_SECONDS = 1.0
"""The relay is told no more often what was lost."""

AT_ONCE = 8
"""Chunks written before others have their turn on the reactor: a link that takes all is no reason to keep it."""


class Sending:
    """The uplink of one channel, with its timers.

    :param after: takes what is to be called when the samples that came together are all there; they share a write
    :param frame_limit: largest frame the relay takes, bytes
    :param wall: what samples are stamped by, nanoseconds
    :param sample_limit: largest sample that may go in parts, bytes; 0 for what fits into a frame
    :param lost: takes what is to be told of samples that were not sent
    """

    def __init__(
        self,
        wire: Wire,
        clock: Clock,
        after: Callable[[Callable[[], None]], None],
        frame_limit: int,
        wall: Callable[[], int] = time.time_ns,
        *,
        sample_limit: int = 0,
        lost: Callable[[link.Lost], None] = lambda loss: None,
    ) -> None:
        self.uplink = Uplink(clock.seconds, frame_limit, sample_limit)
        self._lost = lost
        self._telling: Timer | None = None
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
        if self.uplink.lost:
            self._tell_later()
        if taken and not self._awaited and not self.uplink.paused:
            self._awaited = True
            self._after(self.flush)

    def repeat(self, number: int, stamp: int, body: bytes) -> None:
        """Take a sample that publishers keep; see :meth:`robot_client.uplink.Uplink.repeat`."""
        if self.uplink.repeat(number, stamp, body) and not self.uplink.paused:
            self.flush()
        if self.uplink.lost:
            self._tell_later()

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
        if self.uplink.lost:
            self._tell_later()
        for _ in range(AT_ONCE):
            room = self._wire.room
            chunk = self.uplink.take(room, room)
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
        for timer in (self._flush, self._release, self._telling):
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

    def _tell_later(self) -> None:
        """Tell of what was lost in a moment: when a link is slow, much is lost at a time."""
        if not self._closed and (self._telling is None or not self._telling.active()):
            self._telling = self._clock.callLater(TELL_SECONDS, self._tell)

    def _tell(self) -> None:
        lost, self.uplink.lost = self.uplink.lost, {}
        for (number, reason), loss in lost.items():
            self._lost(link.Lost(number=number, reason=reason, count=loss.count, size=loss.size))

    def _let_go(self) -> None:
        self._release = None
        self.uplink.release()
        self.flush()
        self.arm()
