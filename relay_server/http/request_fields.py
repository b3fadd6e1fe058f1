"""The fields of a request: bounds that are checked before any parser reads them, and their values."""

from __future__ import annotations

import re

from twisted.web.http_headers import Headers
from twisted.web.server import Request
from werkzeug.http import parse_dict_header

from relay_protocol.errors import Invalid
from relay_protocol.limits import NAME_BYTES
from relay_server.http.limits import extend_time_limit
from relay_server.http.media_types import tags_of

TARGET_BYTES = 8192
"""Longest path and query together."""

FIELDS = 100
"""Most fields of one request."""

FIELD_BYTES = 8192
"""Longest field that is not in :data:`LONGEST`, bytes of all its lines. No parser reads these fields."""

LONGEST = {
    b"accept": 1024,
    b"accept-encoding": 1024,
    b"accept-language": 1024,
    b"authorization": 4096,
    b"connection": 256,
    b"content-length": 20,
    b"content-range": 256,
    b"content-type": 256,
    # Browsers send the cookies of all servers on this host, whatever their ports.
    b"cookie": 8192,
    b"expect": 64,
    b"host": 300,
    b"idempotency-key": 1024,
    b"if-match": 1024,
    b"if-none-match": 1024,
    b"if-range": 256,
    b"last-event-id": 256,
    b"origin": 300,
    b"prefer": 256,
    b"range": 256,
    b"sec-websocket-extensions": 512,
    b"sec-websocket-key": 64,
    b"sec-websocket-protocol": 1024,
    b"sec-websocket-version": 16,
    b"transfer-encoding": 64,
    b"upgrade": 64,
}

_CONTROL = bytes(byte for byte in range(32) if byte != 9) + b"\x7f"


class BadHead(Invalid):
    """A head that is refused.

    :param status: the status line of the answer, number and title
    """

    def __init__(self, status: bytes, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def check_line(line: bytes) -> None:
    """Check one line of a head before it is split.

    :raises BadHead: it continues the previous line, which RFC 9112 section 5.2 lets a server refuse
    """
    if line[:1] in (b" ", b"\t"):
        raise BadHead(b"400 Bad Request", "a header line must not begin with a space or tab (RFC 9112)")


def check_field(line: bytes) -> None:
    """Check one field, ``name: value``, before it is parsed.

    :raises BadHead: name or value is too long, or the value has control characters (RFC 9110 section 5.5)
    """
    name, _, value = line.partition(b":")
    if len(name) > NAME_BYTES:
        raise BadHead(_TOO_LARGE, f"a header field's name may have at most {NAME_BYTES} bytes")
    _check_length(name, len(value.strip(b" \t")))
    if len(value.translate(None, _CONTROL)) != len(value):
        raise BadHead(b"400 Bad Request", f"'{_shown(name)}' must not contain control characters")


_GRAPHIC = bytes(range(0x21, 0x7F))


def check_target(target: bytes) -> None:
    """Check path and query.

    Twisted accepts some bytes beyond ASCII, and for Autobahn, which reads the head of a websocket again, some of these
    end a line or separate words.

    :raises BadHead: they are too long, or have bytes that a URI can't have (RFC 3986 section 2)
    """
    if len(target) > TARGET_BYTES:
        raise BadHead(b"414 URI Too Long", f"path and query may have at most {TARGET_BYTES} bytes together")
    if target.translate(None, _GRAPHIC):
        raise BadHead(
            b"400 Bad Request", "path and query must be ASCII without spaces; write other characters as %XX"
        )


_ABSOLUTE = re.compile(rb"https?://(?P<host>[^/?#@]+)(?P<rest>(?:[/?][^#]*)?)\Z", re.IGNORECASE)


def split_absolute(target: bytes) -> tuple[bytes, bytes] | None:
    """``Host``, and path with query, of a target in absolute form (RFC 9112 section 3.2.2).

    Clients send this form to proxies, and some proxies pass it on.

    :returns: ``None``: the target has another form
    :raises BadHead: scheme or host are not those of HTTP, or it has a user or a fragment
    """
    if target.startswith(b"/") or b"://" not in target:
        return None
    found = _ABSOLUTE.match(target)
    if found is None:
        raise BadHead(b"400 Bad Request", "a whole address in the request line must be http://host/path")
    host, rest = found["host"], found["rest"]
    _check_length(b"host", len(host))
    return host, rest if rest.startswith(b"/") else b"/" + rest


def check_fields(headers: Headers) -> None:
    """Check the length of all fields. A field of several lines counts as one.

    :raises BadHead: one is too long
    """
    for name, values in headers.getAllRawHeaders():
        if len(values) > 1:
            _check_length(name, sum(map(len, values)))


def _check_length(name: bytes, length: int) -> None:
    most = LONGEST.get(name.lower(), FIELD_BYTES)
    if length > most:
        raise BadHead(_TOO_LARGE, f"'{_shown(name)}' may have at most {most} bytes")


def _shown(name: bytes) -> str:
    return name[:40].decode("ascii", "replace")


_TOO_LARGE = b"431 Request Header Fields Too Large"

WAIT = 60.0
"""Longest time that a request may wait, seconds."""

APPLIED = "preference-applied"
"""The header that names the preferences that were applied (RFC 7240 section 3)."""

WARNING = "switchboard-warning"
"""Header of an answer: what went wrong with earlier requests."""


def query_of(request: Request) -> dict[str, str]:
    """The query parameters.

    :raises Invalid: a parameter occurs twice, or is not UTF-8
    """
    found = {}
    for name, values in request.args.items():
        if len(values) > 1:
            raise Invalid(f"the parameter '{name.decode(errors='replace')[:40]}' occurs more than once")
        try:
            found[name.decode()] = values[0].decode()
        except UnicodeDecodeError as error:
            raise Invalid(f"a parameter is not UTF-8: {error.reason}") from None
    return found


def field(request: Request, name: str) -> str | None:
    """A list-valued header with all its lines joined (RFC 9110 section 5.3)."""
    lines = request.requestHeaders.getRawHeaders(name)
    return None if lines is None else ", ".join(lines)


def if_none_match(request: Request) -> frozenset[str]:
    """The entity tags of states that the client has (``If-None-Match``)."""
    return tags_of(field(request, "if-none-match"))


def wait_preferred(request: Request, least: float = 0.0) -> float | None:
    """The seconds of ``Prefer: wait`` (RFC 7240 section 4.3), at most :data:`WAIT`; ``None`` without that preference.

    The answer names the preference as applied. A value that is not a number or less than ``least`` is ignored, as RFC
    7240 asks for preferences.

    :raises Invalid: the header is not UTF-8
    """
    try:
        preferences = parse_dict_header(field(request, "prefer") or "")
    except UnicodeDecodeError as error:
        raise Invalid(f"'prefer' is not UTF-8: {error.reason}") from None
    text = next((text for name, text in preferences.items() if name.lower() == "wait"), None)
    seconds = _number((text or "").partition(";")[0])
    if not seconds >= least:
        return None
    seconds = min(seconds, WAIT)
    extend_time_limit(request, seconds)
    request.setHeader(APPLIED, f"wait={seconds:g}")
    return seconds


def _number(text: str) -> float:
    """The number in a text; NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return float("nan")
