"""Twisted's push producer interface in front of whoever wants to know whether a transport takes bytes."""

from __future__ import annotations

from typing import Any, Protocol

from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.tcp import keep_little, tcp_of, unacknowledged

UNDER_WAY_BYTES = 16 * 1024
"""While more than this is not acknowledged, a stream of news counts as full: what comes next would be late."""

AGAIN_SECONDS = 0.02
"""How often that is looked at; the kernel does not tell."""


class Pausable(Protocol):
    """Who writes to a transport."""

    def pause(self) -> None:
        """The transport's buffer is full."""

    def resume(self) -> None:
        """The transport takes bytes again."""


class PushProducer:
    """Register this with a transport (``streaming``)."""

    __slots__ = ("_writes",)

    def __init__(self, writes: Pausable) -> None:
        self._writes = writes

    def pauseProducing(self) -> None:
        """As Twisted says it."""
        self._writes.pause()

    def resumeProducing(self) -> None:
        """As Twisted says it."""
        self._writes.resume()

    def stopProducing(self) -> None:
        """The connection is gone; Twisted tells its protocol too."""


class NewsFlow(PushProducer):
    """The same for a stream of which the newest counts: what waits in the kernel and the network makes it full too.

    :param transport: of the request
    """

    __slots__ = ("_clock", "_left", "_tcp", "_timer")

    def __init__(self, writes: Pausable, clock: Clock, transport: Any) -> None:
        super().__init__(writes)
        self._clock = clock
        self._tcp = tcp_of(transport)
        self._timer: Timer | None = None
        self._left = 0
        if self._tcp is not None:
            keep_little(self._tcp)

    def moves(self) -> bool:
        """Whether the reader has taken something since this was asked last."""
        left, self._left = self._left, 0 if self._tcp is None else unacknowledged(self._tcp)
        return self._left < left

    def pauseProducing(self) -> None:
        """As Twisted says it."""
        cancel(self._timer)
        self._timer = None
        self.moves()
        super().pauseProducing()

    def resumeProducing(self) -> None:
        """Twisted has nothing left; wait until the reader has nearly all of it."""
        if self._tcp is not None and unacknowledged(self._tcp) > UNDER_WAY_BYTES:
            self._timer = self._clock.callLater(AGAIN_SECONDS, self.resumeProducing)
        else:
            self._timer = None
            super().resumeProducing()

    def stopProducing(self) -> None:
        """The connection is gone."""
        self.end()

    def end(self) -> None:
        """The stream is over."""
        cancel(self._timer)
        self._timer = None
