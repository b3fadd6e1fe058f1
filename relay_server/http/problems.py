"""Errors as problem details (RFC 9457): their status, title and headers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from twisted.web.server import Request

from relay_db.queries import AlreadyExists, QuotaExceeded
from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage, NotFound, Refused, SwitchboardError, Unavailable
from relay_server.access import BadCredentials
from relay_server.alerts.service import TooManyRuleChanges as TooManyRules
from relay_server.auth.authenticator import TooManyTries
from relay_server.common.errors import NotDone, NothingReceived
from relay_server.common.etags import PreconditionFailed
from relay_server.common.freshness_tokens import FreshnessTokenExpired, FreshnessTokenRequired
from relay_server.control.stopping import StoppedSince
from relay_server.events.writer import EventQueueFull
from relay_server.http.idempotency import KeyReused
from relay_server.http.limits import TooManyRequests, TooManyStreams
from relay_server.http.media_types import NotAcceptable, UnsupportedMediaType
from relay_server.in_process_sessions.in_process_port import MaybeDone
from relay_server.realms.realm_change import LastAdministrator
from relay_server.realms.service import TooManyChanges as TooManyOfRealm
from relay_server.service_registry.entries import TooLarge
from relay_server.service_registry.service import MatchNeeded, TooManyEntryChanges
from relay_server.video.errors import TooManyStreamStarts


class WrongMethod(SwitchboardError):
    """The resource does not support this method.

    :ivar allow: the supported methods, as in ``Allow``
    """

    code = "method_not_allowed"

    def __init__(self, takes: Iterable[str]) -> None:
        methods = set(takes)
        # HEAD works wherever GET does.
        self.allow = ", ".join(sorted(methods | ({"HEAD"} if "GET" in methods else set())))
        super().__init__(f"this address does not support that method; use {self.allow}")


_TITLES = {
    400: "Bad request",
    401: "Not logged in",
    403: "Refused",
    404: "Not found",
    405: "Method not allowed",
    406: "Not acceptable",
    409: "Conflict",
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
    504: "Timeout",
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
    (TooManyEntryChanges, 429),
    (TooManyOfRealm, 429),
    (LastAdministrator, 409),
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
    (NothingReceived, 504),
    (TooManyStreamStarts, 429),
    (TooManyRules, 429),
    (Unavailable, 503),
]

_LATER = (
    TooManyTries,
    TooManyRequests,
    TooManyStreamStarts,
    TooManyRules,
    TooManyEntryChanges,
    TooManyOfRealm,
    EventQueueFull,
)
"""Errors that carry ``Retry-After``."""


def problem(request: Request, status: int, detail: str, **more: Any) -> bytes:
    """Set status and headers of an error; returns the body."""
    request.setResponseCode(status)
    request.setHeader(b"content-type", b"application/problem+json")
    request.setHeader(b"cache-control", b"no-store")
    return problem_body(status, detail, **more)


def problem_body(status: int, detail: str, **more: Any) -> bytes:
    """The body of an error."""
    title = _TITLES.get(status, "Error")
    return jsontext.encode(
        {"type": "about:blank", "title": title, "status": status, "detail": detail, **more}
    )


def problem_of(request: Request, error: SwitchboardError) -> bytes:
    """The same for an exception, with the headers and fields that its status requires."""
    if isinstance(error, _LATER):
        request.setHeader(b"retry-after", str(int(error.retry_after) + 1).encode())
    if isinstance(error, BadCredentials):
        request.setHeader(b"www-authenticate", b"Bearer")
    if isinstance(error, WrongMethod):
        request.setHeader(b"allow", error.allow.encode())
    status = getattr(error, "http_status", None) or next(
        (status for kind, status in _STATUS if isinstance(error, kind)), 500
    )
    more: dict[str, Any] = dict(getattr(error, "problem_fields", {}))
    if isinstance(error, (NotAcceptable, UnsupportedMediaType)):
        more["available"] = error.available
    if isinstance(error, MaybeDone):
        more["title"] = "Perhaps done"
    return problem(request, status, str(error), code=error.code, **more)
