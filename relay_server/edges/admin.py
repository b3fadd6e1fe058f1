"""The local socket: HTTP over a unix socket that only the relay's own user can open (mode 0600)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from klein import Klein
from twisted.internet.defer import Deferred
from twisted.web.server import Request

from relay_protocol import jsontext


class AdminSocket:
    """``GET /status`` and ``POST /refresh`` for the admin command line.

    :param status: what the relay knows now
    :param refresh: takes up changes in the database at once
    """

    app = Klein()

    def __init__(self, status: Callable[[], dict[str, Any]], refresh: Callable[[], Awaitable[None]]) -> None:
        self._status = status
        self._refresh = refresh

    @app.route("/status", methods=["GET"])
    def status(self, request: Request) -> bytes:
        request.setHeader(b"content-type", b"application/json")
        return jsontext.encode(self._status())

    @app.route("/refresh", methods=["POST"])
    def refresh(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._take_up(request))

    async def _take_up(self, request: Request) -> bytes:
        await self._refresh()
        request.setResponseCode(204)
        return b""
