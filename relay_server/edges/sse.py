"""Streams of server-sent events (WHATWG HTML, section 9.2) of what is followed."""

from __future__ import annotations

from relay_server.clock import Clock, cancel
from relay_server.memory import Following


def sent(event: str, body: bytes, id: str | int | None = None) -> bytes:
    """One event on the wire.

    :param body: JSON, in one line
    :param id: where a reader who comes again goes on; ``None`` where he has come no further
    """
    head = b"" if id is None else f"id: {id}\n".encode()
    return head + b"event: " + event.encode() + b"\ndata: " + body + b"\n\n"


async def news_within(clock: Clock, following: Following, seconds: float) -> None:
    """Wait for something new, for so long at most."""
    timer = clock.callLater(max(0.0, seconds), following.wake)
    try:
        await following.news()
    finally:
        cancel(timer)
