"""Origins from which session cookies are accepted (RFC 6454): the relay's own, and listed ones."""

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
    """The origins that a cookie may come from.

    The relay's own origin is accepted when it is an IP address or ``localhost``. The owner of a host name
    could rebind it, so names must be listed.

    :param scheme: ``http`` or ``https``, as the relay itself speaks
    :param listed: ``https://host[:port]`` each
    :raises Invalid: an entry is not an origin
    """

    def __init__(self, scheme: str, listed: Iterable[str] = ()) -> None:
        self.tls = scheme == "https"
        self._scheme = scheme
        self._listed = {_checked(each) for each in listed}
        self.listed = tuple(map(str, sorted(self._listed)))
        """The listed origins, as browsers write them."""

    def is_listed(self, origin: str) -> bool:
        """Whether an ``Origin`` is listed."""
        return _parse(origin) in self._listed

    def base(self, host: str) -> str:
        """``scheme://host[:port]`` of this relay for a client that sent this ``Host``.

        Behind a proxy with another scheme it is the listed origin of that host.

        :raises Invalid: it is not a host
        """
        if len(host) > NAME or _HOST.match(host) is None:
            raise Invalid("send 'Host' with the name or address of the relay")
        seen = {each: _parse(f"{each}://{host}") for each in ("https", "http")}
        scheme = next((each for each, origin in seen.items() if origin in self._listed), self._scheme)
        return f"{scheme}://{host}"

    def encrypted(self, host: str) -> bool:
        """Whether a browser that sent this ``Host`` uses TLS: the relay does, or the proxy of a listed origin."""
        return self.tls or _parse(f"https://{host}") in self._listed

    @property
    def any_encrypted(self) -> bool:
        """Whether browsers may use TLS: the relay does, or the proxy of a listed origin."""
        return self.tls or any(each.scheme == "https" for each in self._listed)

    def cookie_name(self, name: str, encrypted: bool) -> str:
        """The name under which a cookie is set.

        A browser stores one with the prefix only over TLS, for this host alone, so no other host of the same domain
        can set it.
        """
        return f"__Host-{name}" if encrypted else name

    def cookie_names(self, name: str, host: str) -> tuple[str, ...]:
        """The names under which a cookie counts that came with this ``Host``; the first that is there.

        A proxy may send another ``Host`` than the browser. So the prefix counts everywhere, and a cookie without it
        where the browser is not known to use TLS.
        """
        prefixed = self.cookie_name(name, True)
        return (prefixed,) if self.encrypted(host) else (prefixed, name)

    def check(self, origin: str | None, host: str) -> None:
        """Check a cookie that came with this ``Origin`` and ``Host``.

        :raises Refused: there is no Origin, or it is neither listed nor the relay's own
        """
        if origin is None:
            raise Refused("a session cookie needs an Origin header; programs use an access token instead")
        asked = _parse(origin)
        if asked is not None and asked in self._listed:
            return
        own = _parse(f"{self._scheme}://{host}")
        if asked is None or asked != own or not _unrebindable(asked.host):
            raise Refused(
                f"pages of {origin[:100]} may not use this relay; start it with --origin to allow that"
            )


_PORTS = {"http": 80, "https": 443}


class _Origin(NamedTuple):
    scheme: str
    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}" + ("" if self.port == _PORTS[self.scheme] else f":{self.port}")


def _checked(listed: str) -> _Origin:
    origin = _parse(listed)
    if (
        origin is None
        or urlsplit(listed).path.strip("/")
        or _HOST.match(str(origin).partition("://")[2]) is None
    ):
        raise Invalid(f"'{listed}' is not an origin; write https://host or https://host:port")
    return origin


def _parse(text: str) -> _Origin | None:
    """An origin; ``None`` for anything else, such as ``null``."""
    try:
        parts = urlsplit(text.strip().lower())
        port = parts.port
    except ValueError:
        return None
    standard = _PORTS.get(parts.scheme)
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
