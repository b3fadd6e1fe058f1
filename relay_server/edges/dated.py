"""Answers with the moment at which they were made, which whoever moves the robot gives back (SPEC section 1.13)."""

from __future__ import annotations

from collections.abc import Awaitable
from typing import Any

from twisted.web.server import Request

from relay_server.edges.api import STREAMED
from relay_server.moments import HEADER, Moments


async def dated(request: Request, moments: Moments, work: Awaitable[Any]) -> Any:
    """What the work gives; its answer has the moment also when that fails."""
    try:
        return await work
    finally:
        request.setHeader(HEADER, moments.now())


async def dated_in_form(request: Request, moments: Moments, work: Awaitable[Any]) -> Any:
    """The same of what may come in another form than JSON, as bytes."""
    answer = await dated(request, moments, work)
    if not isinstance(answer, bytes):
        return answer
    # All headers are there now.
    request.write(answer)
    return STREAMED
