"""Entity tags of states (RFC 9110 sections 8.8.3 and 13.1)."""

from __future__ import annotations

import hashlib

from werkzeug.http import parse_etags

from relay_protocol.errors import Refused


class PreconditionFailed(Refused):
    """The resource that was to be changed has another state than the client expects."""

    code = "not_as_before"


def tag_of(value: bytes) -> str:
    """A strong entity tag (RFC 9110 section 8.8.3)."""
    return f'"{hashlib.sha256(value).hexdigest()[:24]}"'


def weak(etag: str) -> str:
    """A weak tag: representations with it may differ in insignificant ways (RFC 9110 section 8.8.1)."""
    return f"W/{etag}"


def check_match(etag: str, match: str) -> None:
    """Check that a state is one of those in ``If-Match`` (RFC 9110 section 13.1.1).

    :raises PreconditionFailed: it does not
    """
    if not parse_etags(match).contains(etag.strip('"')):
        raise PreconditionFailed("it has changed since you read it; read it again")
