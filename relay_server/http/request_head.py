"""Bounds of a request's head, checked before any parser reads it (SPEC section 5).

Several parsers behind this one are slower than linear: werkzeug's for ``Accept`` and entity tags, ``email`` and
``http.cookies`` of Python, Unicode normalisation in ``urllib.parse``. Short fields keep each of them harmless.
"""

from __future__ import annotations

from twisted.web.http_headers import Headers

from relay_protocol.errors import Invalid
from relay_protocol.limits import NAME_BYTES

TARGET_BYTES = 8192
"""Longest path and query together."""

FIELDS = 100
"""Most fields of one request."""

FIELD_BYTES = 8192
"""Longest field, all lines of that name together, unless :data:`LONGEST` has it. No parser reads these."""

LONGEST = {
    b"accept": 1024,
    b"accept-encoding": 1024,
    b"accept-language": 1024,
    b"authorization": 4096,
    b"connection": 256,
    b"content-length": 20,
    b"content-type": 256,
    # Browsers send the cookies of every program on this host, whatever its port.
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
    """A head that is not read further.

    :param status: the status line of the answer, number and title
    """

    def __init__(self, status: bytes, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def check_line(line: bytes) -> None:
    """Check one line of a head as it came, before it is split.

    :raises BadHead: it continues the line before, which RFC 9112 section 5.2 lets a server refuse
    """
    if line[:1] in (b" ", b"\t"):
        raise BadHead(b"400 Bad Request", "a header line must not begin with a space or tab (RFC 9112)")


def check_field(line: bytes) -> None:
    """Check one field, ``name: value``, before its name is looked up and its value read.

    :raises BadHead: name or value is too long, or the value has control characters (RFC 9110 section 5.5)
    """
    name, _, value = line.partition(b":")
    if len(name) > NAME_BYTES:
        raise BadHead(_TOO_LARGE, f"a header field's name may have at most {NAME_BYTES} bytes")
    _check_length(name, len(value.strip(b" \t")))
    if len(value.translate(None, _CONTROL)) != len(value):
        raise BadHead(b"400 Bad Request", f"'{_shown(name)}' must not contain control characters")


def check_target(target: bytes) -> None:
    """Check path and query.

    :raises BadHead: they are too long
    """
    if len(target) > TARGET_BYTES:
        raise BadHead(b"414 URI Too Long", f"path and query may have at most {TARGET_BYTES} bytes together")


def check_fields(headers: Headers) -> None:
    """Check all fields together: what is sent on many lines counts as one field.

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
