"""Server-sent events (WHATWG HTML section 9.2): what a page is told, for programs that speak plain HTTP."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from twisted.web.server import Request

from relay_protocol.errors import Refused
from relay_server.access import Principal
from relay_server.common.clock import Clock, cancel
from relay_server.common.push_producer import NewsFlow
from relay_server.events.service import EventFollower
from relay_server.http.live_updates import LiveUpdates
from relay_server.http.update_sources import Sources


def sent(event: str, body: bytes, id: str | int | None = None) -> bytes:
    """One event on the wire.

    :param body: JSON, in one line
    :param id: where a reader who comes again goes on; ``None`` where he has come no further
    """
    head = b"" if id is None else f"id: {id}\n".encode()
    return head + b"event: " + event.encode() + b"\ndata: " + body + b"\n\n"


async def news_within(clock: Clock, following: EventFollower, seconds: float) -> None:
    """Wait for something new, for so long at most."""
    timer = clock.callLater(max(0.0, seconds), following.wake)
    try:
        await following.news()
    finally:
        cancel(timer)


class UpdateStream:
    """The answer to one request.

    :param principal: who sends a request
    """

    def __init__(
        self,
        clock: Clock,
        request: Request,
        principal: Callable[[Request], Awaitable[Principal]],
        sources: Sources,
    ) -> None:
        self._clock = clock
        self._request = request
        self._flow: NewsFlow | None = None
        self._telling = LiveUpdates(clock, self, lambda: principal(request), sources)

    async def run(self) -> None:
        """Until the client leaves, takes nothing any more, or its credentials end."""
        self._request.setHeader(b"content-type", b"text/event-stream")
        self._request.setHeader(b"cache-control", b"no-store")
        self._request.setHeader(b"x-accel-buffering", b"no")
        self._flow = NewsFlow(self._telling, self._clock, self._request.transport)
        self._request.registerProducer(self._flow, True)
        try:
            await self._telling.run()
        except Refused:
            self.tell("ended", b"{}")
        finally:
            self._flow.end()
            self._request.unregisterProducer()

    def tell(self, event: str, body: bytes) -> None:
        """One event."""
        self._request.write(b"event: " + event.encode() + b"\ndata: " + body + b"\n\n")

    def moves(self) -> bool:
        """Whether it has taken something since this was asked last."""
        return self._flow is not None and self._flow.moves()

    def cut(self) -> None:
        """Whoever takes nothing reads no farewell."""
        self._request.transport.abortConnection()
