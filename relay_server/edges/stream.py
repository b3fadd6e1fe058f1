"""Server-sent events (WHATWG HTML section 9.2): what a page shows, at every change."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from twisted.internet.defer import Deferred
from twisted.web.server import Request

from relay_protocol import jsontext
from relay_protocol.errors import Refused, Unavailable
from relay_server.access import Principal
from relay_server.auth import BadCredentials
from relay_server.clock import Clock, cancel

STREAM_SECONDS = 5.0
COALESCE_SECONDS = 0.25
STALL_SECONDS = 5.0
"""A client that takes nothing of its stream for so long is cut."""

FIRST = "robots"
"""The event that is told at least every :data:`STREAM_SECONDS`; the others when they are another list."""

Source = Callable[[Principal], Awaitable[list[dict[str, Any]]]]
"""What somebody may see of something now."""


class EventStream:
    """One stream: each event has the name of its source, and holds a list under that name.

    :param principal: who sends a request; asked again each time, for it may be over
    :param on_change: has a listener called at every change; returns what ends that
    """

    def __init__(
        self,
        clock: Clock,
        request: Request,
        principal: Callable[[Request], Awaitable[Principal]],
        sources: Mapping[str, Source],
        on_change: Callable[[Callable[[], None]], Callable[[], None]],
    ) -> None:
        self._clock = clock
        self._request = request
        self._principal = principal
        self._sources = sources
        self._on_change = on_change
        self._told: dict[str, list[dict[str, Any]]] = {}
        self._dirty = False
        """Whether anything has changed since what was told last was looked up."""
        self._wake: Deferred[None] | None = None
        self._paused_since: float | None = None

    async def run(self) -> None:
        """Until the client leaves, takes nothing any more, or its credentials end."""
        self._request.setHeader(b"content-type", b"text/event-stream")
        self._request.setHeader(b"cache-control", b"no-store")
        self._request.setHeader(b"x-accel-buffering", b"no")
        stop = self._on_change(self._changed)
        self._request.registerProducer(self, True)
        try:
            while not self._request._disconnected:
                if self._paused_since is None:
                    await self._tell()
                elif self._clock.seconds() - self._paused_since > STALL_SECONDS:
                    self._request.transport.abortConnection()
                    return
                await self._sleep(COALESCE_SECONDS)
                await self._until_change()
        except (BadCredentials, Refused):
            self._request.write(b"event: ended\ndata: {}\n\n")
        finally:
            stop()
            self._request.unregisterProducer()

    async def _tell(self) -> None:
        self._dirty = False
        try:
            principal = await self._principal(self._request)
            for name, source in self._sources.items():
                self._write(name, await source(principal))
        except Unavailable:
            # What is open goes on; the next look may do better.
            return

    def _write(self, name: str, now: list[dict[str, Any]]) -> None:
        if name == FIRST or now is not self._told.get(name):
            self._told[name] = now
            body = jsontext.encode({name: now})
            self._request.write(b"event: " + name.encode() + b"\ndata: " + body + b"\n\n")

    # --- Twisted's push producer ---

    def pauseProducing(self) -> None:
        """The transport's buffer is full."""
        self._paused_since = self._clock.seconds()

    def resumeProducing(self) -> None:
        """The transport takes bytes again."""
        self._paused_since = None
        self._changed()

    def stopProducing(self) -> None:
        """The client has left; the request's own end follows."""

    # --- waiting ---

    def _changed(self) -> None:
        self._dirty = True
        self._wake_up()

    def _wake_up(self) -> None:
        wake, self._wake = self._wake, None
        if wake is not None:
            wake.callback(None)

    async def _until_change(self) -> None:
        if self._dirty:
            return
        wake: Deferred[None] = Deferred()
        self._wake = wake
        timer = self._clock.callLater(STREAM_SECONDS, self._wake_up)
        try:
            await wake
        finally:
            self._wake = None
            cancel(timer)

    async def _sleep(self, seconds: float) -> None:
        done: Deferred[None] = Deferred()
        timer = self._clock.callLater(seconds, done.callback, None)
        try:
            await done
        finally:
            cancel(timer)
