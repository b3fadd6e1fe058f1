"""Errors as problem details (RFC 9457): which status, which words."""

from __future__ import annotations

from typing import Any

from twisted.web.server import Request

from relay_db.queries import AlreadyExists, QuotaExceeded
from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage, NotFound, Refused, SwitchboardError, Unavailable
from relay_server.access import BadCredentials
from relay_server.alerts.service import TooManyRuleChanges as TooManyRules
from relay_server.auth.authenticator import TooManyTries
from relay_server.common.freshness_tokens import FreshnessTokenExpired, FreshnessTokenRequired
from relay_server.control.commands import NotDone
from relay_server.control.stopping import StoppedSince
from relay_server.events.writer import EventQueueFull
from relay_server.http.idempotency import KeyReused
from relay_server.http.media_types import NotAcceptable, UnsupportedMediaType
from relay_server.http.method_not_allowed import WrongMethod
from relay_server.http.rate_limits import TooManyRequests, TooManyStreams
from relay_server.http_sessions.loopback_client import MaybeDone
from relay_server.realms.realm_change import Needed
from relay_server.realms.service import TooManyChanges as TooManyOfRealm
from relay_server.registry.entries import TooLarge
from relay_server.registry.service import MatchNeeded, TooManyRegistryChanges
from relay_server.resources.etags import PreconditionFailed
from relay_server.video.ports import NoFrame, TooManyStreamStarts

_TITLES = {
    400: "Bad request",
    401: "Not logged in",
    403: "Refused",
    404: "Not found",
    405: "Method not allowed",
    406: "Not acceptable",
    409: "Not done",
    412: "Precondition failed",
    413: "Too large",
    415: "Unsupported media type",
    416: "Range not satisfiable",
    422: "Unprocessable content",
    426: "Upgrade required",
    428: "Precondition required",
    429: "Too many requests",
    500: "Internal error",
    503: "Unavailable",
    504: "Nothing came in time",
}

_STATUS: list[tuple[type[SwitchboardError], int]] = [
    (BadCredentials, 401),
    (TooManyTries, 429),
    (TooManyRequests, 429),
    (TooManyStreams, 429),
    (NotFound, 404),
    (WrongMethod, 405),
    (FreshnessTokenRequired, 428),
    (MatchNeeded, 428),
    (AlreadyExists, 409),
    (QuotaExceeded, 409),
    (TooManyRegistryChanges, 429),
    (TooManyOfRealm, 429),
    (Needed, 409),
    (TooLarge, 413),
    (FreshnessTokenExpired, 412),
    (StoppedSince, 412),
    (PreconditionFailed, 412),
    (KeyReused, 422),
    (NotAcceptable, 406),
    (UnsupportedMediaType, 415),
    (Refused, 403),
    (Invalid, 400),
    (MalformedMessage, 400),
    (NotDone, 409),
    (MaybeDone, 409),
    (NoFrame, 504),
    (TooManyStreamStarts, 429),
    (TooManyRules, 429),
    (Unavailable, 503),
]

_LATER = (
    TooManyTries,
    TooManyRequests,
    TooManyStreamStarts,
    TooManyRules,
    TooManyRegistryChanges,
    TooManyOfRealm,
    EventQueueFull,
)
"""What may be tried again after some time."""


def problem(request: Request, status: int, detail: str, **more: Any) -> bytes:
    """An error in words: status and headers are set, the body is returned."""
    request.setResponseCode(status)
    request.setHeader(b"content-type", b"application/problem+json")
    request.setHeader(b"cache-control", b"no-store")
    return problem_body(status, detail, **more)


def problem_body(status: int, detail: str, **more: Any) -> bytes:
    """The body of such an answer."""
    title = _TITLES.get(status, "Error")
    return jsontext.encode(
        {"type": "about:blank", "title": title, "status": status, "detail": detail, **more}
    )


def problem_of(request: Request, error: SwitchboardError) -> bytes:
    """The same for an error of ours, with what its status wants to be said beside."""
    if isinstance(error, _LATER):
        request.setHeader(b"retry-after", str(int(error.retry_after) + 1).encode())
    if isinstance(error, BadCredentials):
        request.setHeader(b"www-authenticate", b"Bearer")
    if isinstance(error, WrongMethod):
        request.setHeader(b"allow", error.allow.encode())
    status = next((status for kind, status in _STATUS if isinstance(error, kind)), 500)
    more: dict[str, Any] = {}
    if isinstance(error, (NotAcceptable, UnsupportedMediaType)):
        more["available"] = error.available
    if isinstance(error, MaybeDone):
        more["title"] = "Perhaps done"
    return problem(request, status, str(error), code=error.code, **more)
