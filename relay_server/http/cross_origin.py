"""Pages of listed origins: their requests (CORS, Fetch standard section 3.3), and frames of theirs.

No answer names ``*``: the session cookie counts here. Pages of other origins get no field, so their browsers keep the
answers from them.
"""

from __future__ import annotations

from twisted.web.server import Request

from relay_server.auth.origins import Origins
from relay_server.http.limits import TooManyRequests
from relay_server.http.problems import problem_of

METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE")

REQUEST_FIELDS = (
    "Accept",
    "Authorization",
    "Content-Range",
    "Content-Type",
    "Idempotency-Key",
    "If-Match",
    "If-None-Match",
    "If-Range",
    "Last-Event-ID",
    "Prefer",
    "Range",
    "Switchboard-Freshness",
)
"""Fields that a page may send."""

ANSWER_FIELDS = (
    "Accept-Ranges",
    "Allow",
    "Content-Disposition",
    "Content-Length",
    "Content-Range",
    "ETag",
    "Link",
    "Location",
    "Preference-Applied",
    "RateLimit",
    "RateLimit-Policy",
    "Retry-After",
    "Switchboard-Freshness",
    "Switchboard-Warning",
    "Vary",
    "WWW-Authenticate",
    "X-Instead",
    "X-Reduced",
    "X-Timestamp",
)
"""Fields that a page may read."""

PREFLIGHT_SECONDS = 600
"""Seconds for which a browser remembers the answer to a preflight."""

_ALLOWED = {
    b"access-control-allow-methods": ", ".join(METHODS).encode(),
    b"access-control-allow-headers": ", ".join(REQUEST_FIELDS).encode(),
    b"access-control-max-age": b"%d" % PREFLIGHT_SECONDS,
}
_EXPOSED = ", ".join(ANSWER_FIELDS).encode()


class CrossOrigin:
    """The rules for pages of listed origins."""

    def __init__(self, origins: Origins) -> None:
        self._origins = origins
        self.any_encrypted = origins.any_encrypted
        self._ancestors = " ".join(origins.listed).encode()

    def allow(self, request: Request) -> bool:
        """Allow the page to read the answer if its origin is listed.

        :returns: whether the request is a preflight, which is answered
        """
        if not self._origins.listed:
            return False
        request.responseHeaders.addRawHeader(b"vary", b"Origin")
        origin = request.getHeader("origin")
        if origin is None or not self._origins.is_listed(origin):
            return False
        request.from_listed_page = True
        request.setHeader(b"access-control-allow-origin", origin.encode())
        request.setHeader(b"access-control-allow-credentials", b"true")
        if request.method != b"OPTIONS" or request.getHeader("access-control-request-method") is None:
            request.setHeader(b"access-control-expose-headers", _EXPOSED)
            return False
        self._answer_preflight(request)
        return True

    @staticmethod
    def _answer_preflight(request: Request) -> None:
        body = b""
        try:
            request.site.limits.of_network(request)
            request.setResponseCode(204)
            for name, value in _ALLOWED.items():
                request.setHeader(name, value)
        except TooManyRequests as error:
            body = problem_of(request, error)
            request.setHeader(b"content-length", b"%d" % len(body))
        request.write(body)
        request.finish()

    def allow_frames(self, request: Request) -> None:
        """Allow pages of listed origins to show the answer in a frame."""
        if not self._ancestors:
            return
        name = b"content-security-policy"
        (policy,) = request.responseHeaders.getRawHeaders(name)
        request.setHeader(
            name, policy.replace(b"frame-ancestors 'none'", b"frame-ancestors " + self._ancestors)
        )
        request.responseHeaders.removeHeader(b"x-frame-options")
