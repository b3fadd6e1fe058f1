"""What may stand in the directory as an address: a URI that tells no secret and runs nothing."""

from __future__ import annotations

import re
from urllib.parse import parse_qsl, urlsplit

from relay_protocol.errors import Invalid
from relay_server.directory.limits import ADDRESS

SECRETS = frozenset(
    {
        "access_token",
        "api_key",
        "apikey",
        "auth",
        "authorization",
        "client_secret",
        "credential",
        "credentials",
        "mac",
        "passwd",
        "password",
        "pwd",
        "refresh_token",
        "secret",
        "session",
        "ticket",
        "token",
    }
)
"""Fields of a query that are credentials by their names."""

RUNS = frozenset({"about", "blob", "data", "file", "filesystem", "javascript", "vbscript", "view-source"})
"""Schemes by which a link in a page would run something, or look into the reader's own machine."""

_TEXT = re.compile(r"(?:[A-Za-z0-9\-._~:/?#\[\]@!$&'()*+,;=]|%[0-9A-Fa-f]{2})+\Z")
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*\Z")


def check_address(text: str) -> str:
    """An address: ``scheme://host…`` (RFC 3986), or the path of something on this relay.

    :raises Invalid: it is none, or holds a credential
    """
    if not 0 < len(text) <= ADDRESS:
        raise Invalid(f"'address' must have 1 to {ADDRESS} characters")
    if not _TEXT.match(text):
        raise Invalid(
            "'address' is no URI (RFC 3986): it has ASCII letters, digits and signs, everything else as %XX"
        )
    try:
        parts = urlsplit(text)
        host, _ = parts.hostname, parts.port
    except ValueError:
        raise Invalid("'address' is no URI: its host or port can't be") from None
    if not text.startswith("/") or text.startswith("//"):
        if not _SCHEME.match(parts.scheme) or not host:
            raise Invalid("'address' is scheme://host…, or a path on this relay that begins with one /")
        if parts.scheme in RUNS:
            raise Invalid(f"'address' must not be of the scheme '{parts.scheme}'")
    if "@" in parts.netloc:
        raise Invalid(
            "'address' must not have a user or password in it: everybody who sees the entry reads it"
        )
    for part in (parts.query, parts.fragment):
        for field, _ in parse_qsl(part, keep_blank_values=True):
            if field.casefold() in SECRETS:
                raise Invalid(f"'address' must hold no credential, and '{field}' in it is one by its name")
    return text
