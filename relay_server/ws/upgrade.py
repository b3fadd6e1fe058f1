"""Hands a connection that asks to become a websocket over to Autobahn."""

from __future__ import annotations

from typing import Any

from autobahn.twisted.resource import WebSocketResource
from twisted.web.server import Request

READ = frozenset(
    {
        b"authorization",
        b"connection",
        b"cookie",
        b"host",
        b"origin",
        b"sec-websocket-extensions",
        b"sec-websocket-key",
        b"sec-websocket-protocol",
        b"sec-websocket-version",
        b"upgrade",
    }
)
"""Fields that Autobahn or the relay reads in a handshake."""


class WebSocketUpgrade(WebSocketResource):
    """Gives Autobahn the fields that are read, in ASCII.

    Autobahn splits a head by ``str.splitlines``, for which more characters end a line than for HTTP (0x85, which many
    letters have in UTF-8): a value could become a field of its own.
    """

    def render(self, request: Request) -> Any:
        """Take the connection over."""
        headers = request.requestHeaders
        for name, values in list(headers.getAllRawHeaders()):
            if name.lower() in READ:
                ascii_only = [each.decode("ascii", "replace").encode("ascii", "replace") for each in values]
                headers.setRawHeaders(name, ascii_only)
            else:
                headers.removeHeader(name)
        return super().render(request)
