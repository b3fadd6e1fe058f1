"""Which addresses the relay may send to: none of special networks, unless its administrator allows them.

A user who chooses where the relay sends must not reach by it what only the relay can reach.
"""

from __future__ import annotations

from collections.abc import Iterable
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network

from relay_protocol.errors import Invalid

Address = IPv4Address | IPv6Address
Network = IPv4Network | IPv6Network

SPECIAL: tuple[Network, ...] = tuple(
    map(
        ip_network,
        (
            "0.0.0.0/8",
            "10.0.0.0/8",
            "100.64.0.0/10",
            "127.0.0.0/8",
            "169.254.0.0/16",
            "172.16.0.0/12",
            "192.0.0.0/24",
            "192.0.2.0/24",
            "192.31.196.0/24",
            "192.52.193.0/24",
            "192.88.99.0/24",
            "192.168.0.0/16",
            "192.175.48.0/24",
            "198.18.0.0/15",
            "198.51.100.0/24",
            "203.0.113.0/24",
            "224.0.0.0/4",
            "240.0.0.0/4",
        ),
    )
)
"""Not for everybody's use: IANA's registry of special-purpose IPv4 addresses (RFC 6890), and multicast."""

UNICAST = IPv6Network("2000::/3")
"""All of IPv6 that is given out to be reached from everywhere; what lies outside is special."""

SPECIAL_6: tuple[Network, ...] = tuple(
    map(ip_network, ("2001::/23", "2001:db8::/32", "2002::/16", "2620:4f:8000::/48", "3fff::/20"))
)
"""Special within it: IANA's registry of special-purpose IPv6 addresses."""

NAT64 = IPv6Network("64:ff9b::/96")
"""Carries an IPv4 address in its last 32 bits (RFC 6052), by which it is judged."""


def networks(texts: Iterable[str]) -> tuple[Network, ...]:
    """Networks as an administrator writes them.

    :raises Invalid: one that is none
    """
    found = []
    for text in texts:
        try:
            found.append(ip_network(text.strip()))
        except ValueError:
            raise Invalid(f"'{text}' is no network; write 192.168.7.0/24 or fd00:7::/64") from None
    return tuple(found)


def allowed(text: str, also: Iterable[Network] = ()) -> bool:
    """Whether this address may be connected to.

    :param text: as the system's resolver gives it
    :param also: networks that the administrator allows
    """
    try:
        address = ip_address(text)
    except ValueError:
        return False
    address = _carried(address)
    if any(address in network for network in also if network.version == address.version):
        return True
    if isinstance(address, IPv4Address):
        return not any(address in network for network in SPECIAL)
    plain = address in UNICAST and not any(address in network for network in SPECIAL_6)
    return plain and address.scope_id is None


def _carried(address: Address) -> Address:
    """The IPv4 address within an IPv6 one, where that is where it leads to."""
    if isinstance(address, IPv6Address):
        if address.ipv4_mapped is not None:
            return address.ipv4_mapped
        if address in NAT64:
            return IPv4Address(int(address) & 0xFFFF_FFFF)
    return address
