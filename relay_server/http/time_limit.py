"""How long a client waits for an answer at most (SPEC section 5)."""

from __future__ import annotations

from collections.abc import Awaitable, Coroutine
from typing import Any, TypeVar, cast

from twisted.internet.defer import CancelledError, Deferred
from twisted.web.server import Request

from relay_protocol.errors import Unavailable
from relay_server.common.clock import Timer, cancel

T = TypeVar("T")

ROBOT_SECONDS = 15.0
"""What a request about a robot has beyond that: the robot may have to open a channel first, and then to answer."""


class NoAnswer(Unavailable):
    """The time for an answer is over."""

    code = "no_answer"

    def __init__(self, seconds: float) -> None:
        super().__init__(
            f"there was no answer within {seconds:g} s: the database or the robot does not answer. Whether it is done "
            "all the same is not known: look before you send it again, or send it with an Idempotency-Key"
        )


def allow(request: Request, seconds: float) -> None:
    """The request has so much more time, for what its sender has asked to wait for, or a robot may need."""
    request.__dict__["allowed"] = request.__dict__.get("allowed", 0.0) + seconds


async def in_time(request: Request, work: Awaitable[T]) -> T:
    """Do the work of a request; what takes too long is given up. An answer that has begun may go on for ever.

    :raises NoAnswer: it is given up
    """
    reactor, limit = request.site.reactor, request.site.limits.answer_seconds
    running: Deferred[T] = Deferred.fromCoroutine(cast("Coroutine[Deferred[Any], Any, T]", work))
    began = reactor.seconds()
    timer: Timer | None = None
    late = False

    def look() -> None:
        nonlocal timer, late
        left = began + limit + request.__dict__.get("allowed", 0.0) - reactor.seconds()
        if left > 0:
            timer = reactor.callLater(left, look)
        elif not request.startedWriting:
            late = True
            running.cancel()

    if limit > 0:
        timer = reactor.callLater(limit, look)
    try:
        return await running
    except CancelledError:
        if late:
            raise NoAnswer(reactor.seconds() - began) from None
        raise
    finally:
        cancel(timer)
