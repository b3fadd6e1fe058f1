"""No address in a special network may be reached unless it is allowed."""

from __future__ import annotations

from ipaddress import ip_address, ip_network

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol.errors import Invalid
from relay_server.alerts.egress import EgressPolicy, is_permitted, parse_networks


@pytest.mark.parametrize("address", ["8.8.8.8", "93.184.215.14", "2606:2800:21f:cb07::1", "64:ff9b::808:808"])
def test_public_addresses_are_allowed(address: str) -> None:
    assert is_permitted(address)


@pytest.mark.parametrize(
    "address",
    [
        "0.0.0.0", "0.1.2.3", "10.0.0.1", "100.64.0.1", "127.0.0.1", "127.9.9.9", "169.254.169.254", "172.16.0.1",
        "172.31.255.255", "192.0.0.1", "192.0.2.1", "192.168.1.1", "198.18.0.1", "198.51.100.1", "203.0.113.1",
        "224.0.0.1", "239.255.255.255", "240.0.0.1", "255.255.255.255",
        "::", "::1", "::7f00:1", "::ffff:127.0.0.1", "::ffff:10.0.0.1", "64:ff9b::a00:1", "64:ff9b:1::1",
        "100::1", "2001::1", "2001:db8::1", "2002:7f00:1::", "3fff::1", "5f00::1", "fc00::1", "fd12::1", "fe80::1",
        "fe80::1%eth0", "fec0::1", "ff02::1", "2606:2800::1%eth0",
        "", "localhost", "1.2.3", "0x7f000001", "2130706433", "127.1", "8.8.8.8 ",
    ],
)  # fmt: skip
def test_special_addresses_are_not(address: str) -> None:
    assert not is_permitted(address)


def test_an_administrator_can_allow_networks() -> None:
    allowed = parse_networks(["192.168.7.0/24", "fd00:7::/64"])
    assert is_permitted("192.168.7.9", allowed)
    assert is_permitted("::ffff:192.168.7.9", allowed)
    assert is_permitted("fd00:7::9", allowed)
    assert not is_permitted("192.168.8.9", allowed)
    assert not is_permitted("fd00:8::9", allowed)


HOME = parse_networks(["2606:2800:21f:cb07::/64", "93.184.215.0/24"])


@pytest.mark.parametrize(
    "address",
    ["2606:2800:21f:cb07::9", "93.184.215.14", "::ffff:93.184.215.14", "64:ff9b::5db8:d70e"],
)
def test_networks_the_machine_is_in_are_refused_though_all_the_world_may_send_there(address: str) -> None:
    assert is_permitted(address)
    assert not is_permitted(address, local=HOME)
    assert is_permitted(address, HOME, local=HOME)
    assert is_permitted("2606:2800:21f:cb08::9", local=HOME)


def test_denied_networks_within_allowed_ones_stay_denied() -> None:
    """An administrator allows one machine of a network, or public addresses behind a router."""
    denied = parse_networks(["10.0.0.7/32", "93.184.215.0/24", "2606:2800:21f::/48"])
    allowed = parse_networks(["10.0.0.0/8", "93.184.215.0/28"])
    for address in ("10.0.0.7", "93.184.215.14", "2606:2800:21f:1::9"):
        assert not is_permitted(address, allowed, denied)
    assert is_permitted("10.0.0.8", allowed, denied)
    assert is_permitted("8.8.8.8", allowed, denied)


def test_where_the_machine_is_counts_as_it_is_when_something_is_judged() -> None:
    """Interfaces come and go while the relay runs."""
    now = list(HOME)
    policy = EgressPolicy(lambda: now, denied=parse_networks(["8.8.8.8/32"]))
    asked = ["8.8.8.8", "93.184.215.14", "8.8.4.4"]
    assert policy.permitted(asked) == ["8.8.4.4"]
    now.clear()
    assert policy.permitted(asked) == ["93.184.215.14", "8.8.4.4"]


@pytest.mark.parametrize("text", ["", "intranet", "192.168.7.1/24", "10.0.0.0/33"])
def test_an_invalid_network_has_a_clear_error(text: str) -> None:
    with pytest.raises(Invalid, match="is not a network"):
        parse_networks([text])


@given(st.ip_addresses())
def test_local_addresses_are_refused(address: object) -> None:
    """Two independent lists of networks agree."""
    plain = ip_address(str(address))
    if is_permitted(str(plain)) and plain not in ip_network("64:ff9b::/96"):
        assert plain.is_global
        assert not (plain.is_private or plain.is_loopback or plain.is_link_local or plain.is_multicast)
