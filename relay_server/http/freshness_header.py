"""Answers with the moment at which they were made, which whoever moves the robot gives back (SPEC section 1.13)."""

from __future__ import annotations

from collections.abc import Awaitable
from typing import Any

from twisted.web.server import Request

from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.http.api import STREAMED


async def dated(request: Request, moments: FreshnessTokens, work: Awaitable[Any]) -> Any:
    """What the work gives; its answer has the moment also when that fails."""
    try:
        return await work
    finally:
        request.setHeader(HEADER, moments.now())


async def dated_in_form(request: Request, moments: FreshnessTokens, work: Awaitable[Any]) -> Any:
    """The same of what may come in another form than JSON, as bytes."""
    answer = await dated(request, moments, work)
    if not isinstance(answer, bytes):
        return answer
    # All headers are there now.
    request.write(answer)
    return STREAMED
