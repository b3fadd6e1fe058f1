"""Addresses to listen on, and settings made from them."""

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
    """Names, IPv4 and IPv6 in brackets; port 0 is any free one."""
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
def test_what_is_no_address_is_refused_in_words(text: str) -> None:
    """The sentence shows what was given and the form that is wanted."""
    with pytest.raises(Invalid, match="write HOST:PORT"):
        ListenAddress.parse(text)


def test_tls_decides_the_scheme() -> None:
    """With a certificate both listeners speak TLS, without one neither."""
    here = ListenAddress("localhost", 0)
    plain = RelaySettings(Path("data"), "sqlite://", here, here)
    secure = RelaySettings(Path("data"), "sqlite://", here, here, Path("cert"), Path("key"))
    assert (plain.tls, plain.scheme) == (False, "http")
    assert (secure.tls, secure.scheme) == (True, "https")
    assert plain.socket_path == Path("data/relay.sock")
