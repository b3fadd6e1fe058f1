"""Long answers, written as fast as the client reads them, and server-sent events."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import Any, Protocol

from twisted.internet.defer import Deferred
from twisted.web.server import Request

from relay_protocol import jsontext
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_server.access import Principal
from relay_server.common.clock import Clock, cancel
from relay_server.common.tcp import NewsFlow, PushProducer
from relay_server.http.endpoint import ApiRequest
from relay_server.http.live_updates import LiveUpdates, Sources

STALL_SECONDS = 30.0
"""Seconds without any byte accepted after which a client is cut."""


class StreamingResponse:
    """A context in which the body of an answer is written."""

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
        """Write a part of the body."""
        if data and not self._request._disconnected:
            self._request.write(data)

    async def room(self) -> None:
        """Wait until the transport accepts more. The wait is cancelled when the client disconnects."""
        while self._paused and not self._request._disconnected:
            self._wake = Deferred()
            timer = self._clock.callLater(STALL_SECONDS, self.cut)
            try:
                await self._wake
            finally:
                self._wake = None
                cancel(timer)

    def cut(self) -> None:
        """Abort the connection, so that the client sees that the answer is incomplete."""
        if not self._request._disconnected:
            self._request.transport.abortConnection()

    def pause(self) -> None:
        """The transport's buffer is full."""
        self._paused = True

    def resume(self) -> None:
        """The transport accepts bytes again."""
        self._paused = False
        wake, self._wake = self._wake, None
        if wake is not None:
            wake.callback(None)


def sent(event: str, body: bytes, id: str | int | None = None) -> bytes:
    """One event on the wire.

    :param body: JSON, in one line
    :param id: position from which a reader continues after a reconnect; ``None`` if it has not changed
    """
    head = b"" if id is None else f"id: {id}\n".encode()
    return head + b"event: " + event.encode() + b"\ndata: " + body + b"\n\n"


QUIET_SECONDS = 5.0
"""Seconds of silence after which a stream sends a keepalive and checks its reader's rights again."""

AGAIN_SECONDS = 1.0
"""Seconds until a database that did not answer is asked again."""

PROVED_SECONDS = 1.0
"""Seconds between checks of the credentials of a stream's reader."""


class NewsFollower(Protocol):
    """Waits for news; see :class:`relay_server.events.service.EventFollower`."""

    def wake(self) -> None:
        """End the wait."""

    async def news(self) -> None:
        """Wait for news."""


class Signal:
    """A follower for news in memory: news that came before anybody waits are not missed."""

    def __init__(self) -> None:
        self._woken = False
        self._waiting: Deferred[None] | None = None

    def wake(self) -> None:
        """See :class:`NewsFollower`."""
        waiting, self._waiting = self._waiting, None
        if waiting is None:
            self._woken = True
        else:
            waiting.callback(None)

    async def news(self) -> None:
        """See :class:`NewsFollower`."""
        if not self._woken:
            self._waiting = Deferred()
            await self._waiting
        self._woken = False


class EventFeed(Protocol):
    """The content of a stream of server-sent events.

    :ivar follower: waits for news
    """

    follower: Any

    async def news(self, principal: Principal) -> tuple[bytes, bool]:
        """Encoded events that the reader may have, and whether more may be ready.

        :raises Unavailable: there may be news later: the database or the robot does not answer
        :raises SwitchboardError: the reader gets no more
        """

    def mark(self) -> bytes:
        """The reader's position, sent while there are no events."""


async def follow(clock: Clock, call: ApiRequest, out: StreamingResponse, feed: EventFeed) -> None:
    """Write events as they come, until the reader disconnects or loses the right."""
    out.write(b": this stream goes on until you leave\n\n")
    proved = clock.seconds()
    due = proved + QUIET_SECONDS
    while call.connected:
        news, more, wait = b"", False, QUIET_SECONDS
        try:
            if clock.seconds() - proved >= PROVED_SECONDS:
                await call.authenticate()
                proved = clock.seconds()
            news, more = await feed.news(call.principal)
        except Unavailable:
            wait = AGAIN_SECONDS
        except SwitchboardError as error:
            out.write(sent("ended", jsontext.encode(str(error))))
            return
        if news or clock.seconds() >= due:
            out.write(news or feed.mark())
            due = clock.seconds() + QUIET_SECONDS
        await out.room()
        if not more:
            await news_within(clock, feed.follower, min(wait, due - clock.seconds()))


async def news_within(clock: Clock, following: NewsFollower, seconds: float) -> None:
    """Wait for news, at most for a number of seconds."""
    timer = clock.callLater(max(0.0, seconds), following.wake)
    try:
        await following.news()
    finally:
        cancel(timer)


class UpdateStream:
    """Live updates as the answer to one request.

    :param principal: authenticates the sender again
    """

    def __init__(
        self,
        clock: Clock,
        request: Request,
        principal: Callable[[], Awaitable[Principal]],
        sources: Sources,
    ) -> None:
        self._clock = clock
        self._request = request
        self._flow: NewsFlow | None = None
        self._updates = LiveUpdates(clock, self, principal, sources)

    async def run(self) -> None:
        """Send updates until the client leaves, accepts nothing more, or its credentials end."""
        self._request.setHeader(b"content-type", b"text/event-stream")
        self._request.setHeader(b"cache-control", b"no-store")
        self._request.setHeader(b"x-accel-buffering", b"no")
        self._flow = NewsFlow(self._updates, self._clock, self._request.transport)
        self._request.registerProducer(self._flow, True)
        try:
            await self._updates.run()
        except Refused:
            self.send("ended", b"{}")
        finally:
            self._flow.end()
            self._request.unregisterProducer()

    def send(self, event: str, body: bytes) -> None:
        """Send one event."""
        self._request.write(b"event: " + event.encode() + b"\ndata: " + body + b"\n\n")

    def made_progress(self) -> bool:
        """Whether the reader has accepted bytes since the last call."""
        return self._flow is not None and self._flow.made_progress()

    def cut(self) -> None:
        """Drop the connection at once: a reader that accepts nothing gets no closing event either."""
        self._request.transport.abortConnection()
