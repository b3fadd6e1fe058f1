"""Entity tags of states (RFC 9110 sections 8.8.3 and 13.1)."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable

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


_COMPRESSED = re.compile(r"(?:--?|;)(?:gzip|deflate|br|zstd)\Z")
"""What proxies that compress an answer append to its tag: Apache, Caddy, Jetty and others."""


def as_given(tags: Iterable[str | None]) -> frozenset[str]:
    """Tags of a request, also as the relay gave them to a proxy that compresses.

    :param tags: without ``W/`` and quotation marks; werkzeug has ``None`` for the empty tag, which no state has
    """
    return frozenset(form for each in tags if each for form in (each, _COMPRESSED.sub("", each)))


def names(header: str, etag: str) -> bool:
    """Whether ``If-Match`` or ``If-None-Match`` names a state by its tag.

    Weak tags count too: proxies that compress make strong ones weak, and the relay compares whole states.
    """
    tags = parse_etags(header)
    return tags.star_tag or etag.removeprefix("W/").strip('"') in as_given(tags.as_set(include_weak=True))


def check_match(etag: str, match: str) -> None:
    """Check that a state is one of those in ``If-Match`` (RFC 9110 section 13.1.1).

    :raises PreconditionFailed: it does not
    """
    if not names(match, etag):
        raise PreconditionFailed("it has changed since you read it; read it again")
