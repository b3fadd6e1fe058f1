"""The networks that this machine is in: its own addresses, and what it reaches without a router.

Also where these are addresses of the Internet: a packet to one's own address passes no firewall, and what hangs on the
same cable need not be meant for everybody.
"""

from __future__ import annotations

from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address

import psutil

from relay_server.alerts.addresses import Network
from relay_server.alerts.message import Undelivered

LINK = 64
"""A network of IPv6 has this prefix (RFC 4291, section 2.5.4), also where DHCPv6 gave the interface one address."""

WIDEST_4 = 8
WIDEST_6 = 32
"""An interface with more of the Internet on its cable than this is a tunnel's: only its own address counts."""


def networks() -> frozenset[Network]:
    """The networks of all interfaces as they are now.

    :raises Undelivered: the system does not say
    """
    try:
        interfaces = psutil.net_if_addrs()
    except OSError as error:
        # Under systemd, RestrictAddressFamilies must have AF_NETLINK for it.
        words = f"the relay can't see which networks its machine is in, and sends nothing: {error}"
        raise Undelivered(words, again=True) from None
    found: set[Network] = set()
    for addresses in interfaces.values():
        for each in addresses:
            found.update(around(each.address, each.netmask, each.ptp))
    return frozenset(found)


def around(address: str, netmask: str | None, peer: str | None = None) -> set[Network]:
    """The networks that an address of an interface stands for; none where it is no IP address.

    :param address: as the system writes it, also with the interface's name behind a ``%``
    :param netmask: as an address; ``None`` where the system knows none
    :param peer: the other end of a point-to-point link
    """
    try:
        own = ip_address(address.partition("%")[0])
    except ValueError:
        return set()
    found = {_network(own, own.max_prefixlen if netmask is None else _prefix(netmask))}
    return found | around(peer, None) if peer else found


def _prefix(netmask: str) -> int:
    return int(ip_address(netmask)).bit_count()


def _network(own: IPv4Address | IPv6Address, prefix: int) -> Network:
    if isinstance(own, IPv4Address):
        return IPv4Network((own, prefix if prefix >= WIDEST_4 else own.max_prefixlen), strict=False)
    return IPv6Network((own, min(prefix, LINK) if prefix >= WIDEST_6 else LINK), strict=False)
