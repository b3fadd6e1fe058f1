"""Addresses to listen on, and the settings made from them."""

from __future__ import annotations

from pathlib import Path

import pytest

from relay_protocol.errors import Invalid
from relay_server.config import ListenAddress, RelaySettings


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("127.0.0.1:9090", "127.0.0.1", 9090),
        ("localhost:0", "localhost", 0),
        ("[::1]:9091", "::1", 9091),
        ("relay.example:65535", "relay.example", 65535),
    ],
)
def test_an_address_is_read_and_written_alike(text: str, host: str, port: int) -> None:
    """Names, IPv4, and IPv6 in brackets; port 0 means any free one."""
    endpoint = ListenAddress.parse(text)
    assert (endpoint.host, endpoint.port) == (host, port)
    assert str(endpoint) == text


@pytest.mark.parametrize(
    "text",
    [
        "",
        ":9090",
        "localhost",
        "localhost:",
        "localhost:99999",
        "localhost:-1",
        "localhost:http",
        "localhost:80/path",
        "user@localhost:80",
        "::1:9090:",
        "[::1",
        "[]:80",
    ],
)
def test_invalid_address_is_refused_with_a_reason(text: str) -> None:
    """The error has the value and the expected form."""
    with pytest.raises(Invalid, match="write HOST:PORT"):
        ListenAddress.parse(text)


def test_tls_decides_the_scheme() -> None:
    """With a certificate both listeners use TLS, otherwise neither."""
    here = ListenAddress("localhost", 0)
    plain = RelaySettings(Path("data"), "sqlite://", here, here)
    secure = RelaySettings(Path("data"), "sqlite://", here, here, Path("cert"), Path("key"))
    assert (plain.tls, plain.scheme) == (False, "http")
    assert (secure.tls, secure.scheme) == (True, "https")
    assert (plain.robots_tls, secure.robots_tls) == (False, True)
    assert plain.socket_path == Path("data/relay.sock")


@pytest.mark.parametrize(
    ("origins", "listens", "host", "tls"),
    [
        ((), "0.0.0.0:9091", "", False),
        ((), "127.0.0.1:9091", "127.0.0.1", False),
        ((), "[::1]:9091", "::1", False),
        (("https://robots.example.org:9090", "http://x"), "0.0.0.0:9091", "robots.example.org", True),
        (("https://robots.example.org",), "127.0.0.1:9091", "robots.example.org", True),
        (("http://[2001:db8::7]:9090",), "[::]:9091", "2001:db8::7", False),
    ],
)
def test_robots_dial_the_host_of_the_portal(
    origins: tuple[str, ...], listens: str, host: str, tls: bool
) -> None:
    """Behind a proxy too, which listens there for both."""
    here = ListenAddress("localhost", 0)
    found = RelaySettings(Path("data"), "sqlite://", here, ListenAddress.parse(listens), origins=origins)
    assert (found.robots_host, found.robots_tls) == (host, tls)
