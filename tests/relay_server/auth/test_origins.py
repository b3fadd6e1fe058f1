"""Origins whose cookies count."""

from __future__ import annotations

import pytest

from relay_protocol.errors import Invalid, Refused
from relay_server.auth.origins import Origins
from relay_server.http.limits import ConnectionLimits


def taken(origins: Origins, origin: str | None, host: str) -> bool:
    """Whether a cookie with this origin counts."""
    try:
        origins.check(origin, host)
    except Refused:
        return False
    return True


@pytest.mark.parametrize("host", ["127.0.0.1:9090", "[::1]:9090", "localhost:9090", "192.0.2.4:9090"])
def test_the_relays_own_pages_count_by_address(host: str) -> None:
    """Pages that are reached by an address or localhost need no list."""
    assert taken(Origins("http"), f"http://{host}", host)


@pytest.mark.parametrize(
    ("origin", "host"),
    [
        (None, "127.0.0.1:9090"),
        ("null", "127.0.0.1:9090"),
        ("", "127.0.0.1:9090"),
        ("http://127.0.0.1", "127.0.0.1:9090"),
        ("http://127.0.0.1:9091", "127.0.0.1:9090"),
        ("http://localhost:9090", "127.0.0.1:9090"),
        ("https://127.0.0.1:9090", "127.0.0.1:9090"),
        ("http://evil.example", "127.0.0.1:9090"),
        ("http://127.0.0.1.evil.example:9090", "127.0.0.1:9090"),
        ("http://[bad", "[bad"),
        ("http://:9090", ":9090"),
        ("file://", ""),
        ("http://127.0.0.1:99999", "127.0.0.1:99999"),
        ("chrome-extension://127.0.0.1:9090", "127.0.0.1:9090"),
    ],
)
def test_other_pages_and_junk_do_not(origin: str | None, host: str) -> None:
    """These are: no Origin, an opaque one, another port, host or scheme, and invalid ones."""
    assert not taken(Origins("http"), origin, host)


def test_a_name_that_could_be_rebound_must_be_listed() -> None:
    """The owner of a name can point it here, so that Host and Origin agree. Only a list can decide."""
    assert not taken(Origins("http"), "http://evil.example:9090", "evil.example:9090")
    listed = Origins("http", ["https://relay.example"])
    assert taken(listed, "https://relay.example", "127.0.0.1:9090")
    assert taken(listed, "HTTPS://Relay.Example:443", "relay.example")
    assert not taken(listed, "http://relay.example", "relay.example")
    assert not taken(listed, "https://relay.example:8443", "relay.example")


def test_null_is_never_listed_by_accident() -> None:
    """Otherwise all invalid values would be the same origin. They are refused at start."""
    for junk in ("null", "relay.example", "", "https://", "https://[x", "https://relay.example/app", "*"):
        with pytest.raises(Invalid, match="not an origin"):
            Origins("http", [junk])
    assert not taken(Origins("http", ["https://relay.example"]), "null", "relay.example")


def test_an_address_holds_so_many_connections_and_no_more() -> None:
    """Refused connections count until they are closed. No data about closed connections is kept."""
    cap = ConnectionLimits(2)
    assert [cap.enter("a") for _ in range(3)] == [True, True, False]
    assert cap.enter("b")
    cap.leave("a")
    cap.leave("a")
    assert cap.enter("a")
    cap.leave("a")
    cap.leave("a")
    cap.leave("b")
    assert not cap._counts


@pytest.mark.parametrize(
    ("host", "base"),
    [
        ("127.0.0.1:9090", "http://127.0.0.1:9090"),
        ("[::1]:9090", "http://[::1]:9090"),
        ("robots.example", "https://robots.example"),
        ("robots.example:443", "https://robots.example:443"),
        ("robots.example:9090", "http://robots.example:9090"),
    ],
)
def test_addresses_are_the_public_ones(host: str, base: str) -> None:
    """Behind a TLS proxy these are the listed origins."""
    assert Origins("http", ["https://robots.example"]).base(host) == base


@pytest.mark.parametrize("host", ["", "a b", "a/b", "a:b", '"', "a" * 300, "user@host", "http://a"])
def test_invalid_host_makes_no_address(host: str) -> None:
    """It would appear in every answer."""
    with pytest.raises(Invalid, match="Host"):
        Origins("http").base(host)
