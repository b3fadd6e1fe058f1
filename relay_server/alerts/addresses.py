"""Which addresses the relay may send to: none of special networks, nor of those its machine is in, unless its
administrator allows them.

A user who chooses where the relay sends must not reach by it what only the relay can reach.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Fence:
    """Keeps messages out of networks that only the relay can reach.

    :param attached: the networks that the relay's machine is in, asked whenever something is judged
    :param also: networks that the administrator allows
    :param never: networks that the administrator denies, also within those that are allowed
    """

    attached: Callable[[], Collection[Network]]
    also: tuple[Network, ...] = ()
    never: tuple[Network, ...] = ()

    def passed(self, texts: Iterable[str]) -> list[str]:
        """Those of these addresses that may be connected to, in their order.

        :raises Undelivered: nobody can say which networks the machine is in
        """
        refused = self.attached()
        return [each for each in texts if allowed(each, self.also, self.never, refused)]


def allowed(
    text: str,
    also: Collection[Network] = (),
    never: Collection[Network] = (),
    attached: Collection[Network] = (),
) -> bool:
    """Whether this address may be connected to.

    :param text: as the system's resolver gives it
    :param also: networks that the administrator allows
    :param never: networks that he denies
    :param attached: networks that the machine is in
    """
    try:
        address = ip_address(text)
    except ValueError:
        return False
    address = _carried(address)
    if _within(address, never):
        return False
    if _within(address, also):
        return True
    if _within(address, attached):
        return False
    if isinstance(address, IPv4Address):
        return not any(address in network for network in SPECIAL)
    plain = address in UNICAST and not any(address in network for network in SPECIAL_6)
    return plain and address.scope_id is None


def _within(address: Address, networks: Iterable[Network]) -> bool:
    return any(address in network for network in networks if network.version == address.version)


def _carried(address: Address) -> Address:
    """The IPv4 address within an IPv6 one, where that is where it leads to."""
    if isinstance(address, IPv6Address):
        if address.ipv4_mapped is not None:
            return address.ipv4_mapped
        if address in NAT64:
            return IPv4Address(int(address) & 0xFFFF_FFFF)
    return address
