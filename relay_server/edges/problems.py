"""Errors as problem details (RFC 9457): which status, which words."""

from __future__ import annotations

from typing import Any

from twisted.web.server import Request

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage, NotFound, Refused, SwitchboardError, Unavailable
from relay_server.alerts.desk import TooOften as TooManyRules
from relay_server.auth import BadCredentials, TooManyTries
from relay_server.control import NotDone
from relay_server.video import NothingCame, TooOften

_TITLES = {
    400: "Bad request",
    401: "Not logged in",
    403: "Refused",
    404: "Not found",
    405: "Method not allowed",
    409: "Not done",
    413: "Too large",
    415: "Unsupported media type",
    416: "Range not satisfiable",
    426: "Upgrade required",
    429: "Too many requests",
    500: "Internal error",
    503: "Unavailable",
    504: "Nothing came in time",
}

_STATUS: list[tuple[type[SwitchboardError], int]] = [
    (BadCredentials, 401),
    (TooManyTries, 429),
    (NotFound, 404),
    (Refused, 403),
    (Invalid, 400),
    (MalformedMessage, 400),
    (NotDone, 409),
    (NothingCame, 504),
    (TooOften, 429),
    (TooManyRules, 429),
    (Unavailable, 503),
]


def problem(request: Request, status: int, detail: str, **more: Any) -> bytes:
    """An error in words: status and headers are set, the body is returned."""
    request.setResponseCode(status)
    request.setHeader(b"content-type", b"application/problem+json")
    request.setHeader(b"cache-control", b"no-store")
    title = _TITLES.get(status, "Error")
    body = {"type": "about:blank", "title": title, "status": status, "detail": detail, **more}
    return jsontext.encode(body)


def problem_of(request: Request, error: SwitchboardError) -> bytes:
    """The same for an error of ours, with what its status wants to be said beside."""
    if isinstance(error, (TooManyTries, TooOften, TooManyRules)):
        request.setHeader(b"retry-after", str(int(error.retry_after) + 1).encode())
    if isinstance(error, BadCredentials):
        request.setHeader(b"www-authenticate", b"Bearer")
    status = next((status for kind, status in _STATUS if isinstance(error, kind)), 500)
    return problem(request, status, str(error), code=error.code)
