"""Which pages' cookies count here (RFC 6454): the relay's own, and those that were listed."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable
from typing import NamedTuple
from urllib.parse import urlsplit

from relay_protocol.errors import Invalid, Refused
from relay_protocol.limits import NAME

_HOST = re.compile(r"(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(?::[0-9]{1,5})?\Z")


class Origins:
    """The list of origins a cookie may come from.

    The relay's own origin counts when it is an address or ``localhost``: a host name could be rebound by whoever
    owns it, so a name must be listed.

    :param scheme: ``http`` or ``https``, what the relay itself speaks
    :param listed: ``https://host[:port]`` each
    :raises Invalid: something listed is no origin
    """

    def __init__(self, scheme: str, listed: Iterable[str] = ()) -> None:
        self.tls = scheme == "https"
        self._scheme = scheme
        self._listed = {_checked(each) for each in listed}

    def base(self, host: str) -> str:
        """``scheme://host[:port]`` of this relay for who asks it by this ``Host``.

        Behind a proxy that speaks another scheme, the origin that people see is a listed one.

        :raises Invalid: it is no host
        """
        if len(host) > NAME or _HOST.match(host) is None:
            raise Invalid("send 'Host' with the name or address the relay is asked by")
        seen = {each: _parse(f"{each}://{host}") for each in ("https", "http")}
        scheme = next((each for each, origin in seen.items() if origin in self._listed), self._scheme)
        return f"{scheme}://{host}"

    def check(self, origin: str | None, host: str) -> None:
        """Take or refuse a cookie that came with this ``Origin`` and ``Host``.

        :raises Refused: no Origin at all, or one that is neither listed nor the relay's own
        """
        if origin is None:
            raise Refused("a session cookie counts only with an Origin header; programs use an access token")
        asked = _parse(origin)
        if asked is not None and asked in self._listed:
            return
        own = _parse(f"{self._scheme}://{host}")
        if asked is None or asked != own or not _unrebindable(asked.host):
            raise Refused(
                f"pages of {origin[:100]} may not use this relay; start it with --origin to allow that"
            )


class _Origin(NamedTuple):
    scheme: str
    host: str
    port: int


def _checked(listed: str) -> _Origin:
    origin = _parse(listed)
    if origin is None or urlsplit(listed).path.strip("/"):
        raise Invalid(f"'{listed}' is no origin; write https://host or https://host:port")
    return origin


def _parse(text: str) -> _Origin | None:
    """An origin, ``None`` for what is none, such as ``null``."""
    try:
        parts = urlsplit(text.strip().lower())
        port = parts.port
    except ValueError:
        return None
    standard = {"http": 80, "https": 443}.get(parts.scheme)
    if standard is None or not parts.hostname:
        return None
    return _Origin(parts.scheme, parts.hostname, port or standard)


def _unrebindable(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
