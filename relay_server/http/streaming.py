"""A long answer, no faster than it is taken."""

from __future__ import annotations

from types import TracebackType

from twisted.internet.defer import Deferred
from twisted.web.server import Request

from relay_server.common.clock import Clock, cancel
from relay_server.common.push_producer import PushProducer

STALL_SECONDS = 30.0
"""Who takes nothing for so long is cut."""


class StreamingResponse:
    """The answer to a request, while this is open."""

    def __init__(self, clock: Clock, request: Request) -> None:
        self._clock = clock
        self._request = request
        self._paused = False
        self._wake: Deferred[None] | None = None

    async def __aenter__(self) -> StreamingResponse:
        self._request.setHeader(b"cache-control", b"no-store")
        self._request.setHeader(b"x-accel-buffering", b"no")
        self._request.registerProducer(PushProducer(self), True)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._request._disconnected:
            self._request.unregisterProducer()

    def write(self, data: bytes) -> None:
        """Some more of it."""
        if data and not self._request._disconnected:
            self._request.write(data)

    async def room(self) -> None:
        """Wait until the transport takes more; who leaves meanwhile has the waiting cancelled."""
        while self._paused and not self._request._disconnected:
            self._wake = Deferred()
            timer = self._clock.callLater(STALL_SECONDS, self.cut)
            try:
                await self._wake
            finally:
                self._wake = None
                cancel(timer)

    def cut(self) -> None:
        """End the connection: what was sent is not all."""
        if not self._request._disconnected:
            self._request.transport.abortConnection()

    def pause(self) -> None:
        """The transport's buffer is full."""
        self._paused = True

    def resume(self) -> None:
        """The transport takes bytes again."""
        self._paused = False
        wake, self._wake = self._wake, None
        if wake is not None:
            wake.callback(None)
