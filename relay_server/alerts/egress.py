"""Which addresses messages of users may go to: networks that are refused, and the resolver of host names.

Names are resolved by the system in threads of our own, a few of them for each user. A name server that hangs holds its
thread for as long as the system waits, even if we give up earlier; it delays only lookups of the same user.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from typing import Any

import psutil
from twisted.internet.defer import Deferred, DeferredSemaphore
from twisted.internet.defer import TimeoutError as DeferTimeout
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import Invalid, Unavailable
from relay_server.alerts.schemas import Undelivered
from relay_server.common.database import BoundedThreadPool

Address = IPv4Address | IPv6Address
Network = IPv4Network | IPv6Network

SPECIAL_NETWORKS: tuple[Network, ...] = tuple(
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
"""IANA's registry of special-purpose IPv4 addresses (RFC 6890), and multicast."""

UNICAST = IPv6Network("2000::/3")
"""Global unicast addresses of IPv6 (RFC 4291, section 2.5.4); all others are special."""

SPECIAL_6: tuple[Network, ...] = tuple(
    map(ip_network, ("2001::/23", "2001:db8::/32", "2002::/16", "2620:4f:8000::/48", "3fff::/20"))
)
"""Special networks within :data:`UNICAST`: IANA's registry of special-purpose IPv6 addresses."""

NAT64 = IPv6Network("64:ff9b::/96")
"""Addresses with an IPv4 address in the last 32 bits (RFC 6052), by which they are judged."""


def parse_networks(texts: Iterable[str]) -> tuple[Network, ...]:
    """Parse networks as an administrator writes them.

    :raises Invalid: one is not a network
    """
    found = []
    for text in texts:
        try:
            found.append(ip_network(text.strip()))
        except ValueError:
            raise Invalid(f"'{text}' is not a network; write 192.168.7.0/24 or fd00:7::/64") from None
    return tuple(found)


@dataclass(frozen=True)
class EgressPolicy:
    """Keeps messages out of networks that only the relay can reach.

    :param local: returns the networks that the relay's machine is in; they can change
    :param allowed: special or local networks that the administrator allows
    :param denied: networks that the administrator denies, even within those that are allowed
    """

    local: Callable[[], Collection[Network]]
    allowed: tuple[Network, ...] = ()
    denied: tuple[Network, ...] = ()

    def permitted(self, addresses: Iterable[str]) -> list[str]:
        """The addresses that may be connected to, in their order.

        :raises Undelivered: the system does not report the networks of the machine
        """
        local = self.local()
        return [each for each in addresses if is_permitted(each, self.allowed, self.denied, local)]


def is_permitted(
    text: str,
    allowed: Collection[Network] = (),
    denied: Collection[Network] = (),
    local: Collection[Network] = (),
) -> bool:
    """Whether an address may be connected to; see :class:`EgressPolicy`.

    :param text: as the system's resolver returns it
    """
    try:
        address = ip_address(text)
    except ValueError:
        return False
    address = _embedded_ipv4(address)
    if _within(address, denied):
        return False
    if _within(address, allowed):
        return True
    if _within(address, local):
        return False
    if isinstance(address, IPv4Address):
        return not any(address in network for network in SPECIAL_NETWORKS)
    plain = address in UNICAST and not any(address in network for network in SPECIAL_6)
    return plain and address.scope_id is None


def _within(address: Address, networks: Iterable[Network]) -> bool:
    return any(address in network for network in networks if network.version == address.version)


def _embedded_ipv4(address: Address) -> Address:
    """The IPv4 address that an IPv6 address leads to, else the address itself."""
    if isinstance(address, IPv6Address):
        if address.ipv4_mapped is not None:
            return address.ipv4_mapped
        if address in NAT64:
            return IPv4Address(int(address) & 0xFFFF_FFFF)
    return address


LINK_PREFIX = 64
"""Prefix of an IPv6 network (RFC 4291, section 2.5.4), even if DHCPv6 gave the interface a single address."""

WIDEST_4 = 8
WIDEST_6 = 32
"""An interface with a shorter prefix belongs to a tunnel, which carries everything: only its own address counts."""


def local_networks() -> frozenset[Network]:
    """The networks of all interfaces now.

    :raises Undelivered: the system does not report them
    """
    try:
        interfaces = psutil.net_if_addrs()
    except OSError as error:
        # Under systemd this needs AF_NETLINK in RestrictAddressFamilies.
        words = f"the relay cannot see which networks its machine is in, and sends no messages: {error}"
        raise Undelivered(words, again=True) from None
    found: set[Network] = set()
    for addresses in interfaces.values():
        for each in addresses:
            found.update(networks_of(each.address, each.netmask, each.ptp))
    return frozenset(found)


def networks_of(address: str, netmask: str | None, peer: str | None = None) -> set[Network]:
    """The networks of an interface's address; none if it is not an IP address.

    :param address: as the system writes it, possibly with the interface's name after a ``%``
    :param netmask: as an address; ``None`` if the system knows none
    :param peer: the other end of a point-to-point link
    """
    try:
        own = ip_address(address.partition("%")[0])
    except ValueError:
        return set()
    found = {_network(own, own.max_prefixlen if netmask is None else _prefix(netmask))}
    return found | networks_of(peer, None) if peer else found


def _prefix(netmask: str) -> int:
    return int(ip_address(netmask)).bit_count()


def _network(own: IPv4Address | IPv6Address, prefix: int) -> Network:
    if isinstance(own, IPv4Address):
        return IPv4Network((own, prefix if prefix >= WIDEST_4 else own.max_prefixlen), strict=False)
    return IPv6Network((own, min(prefix, LINK_PREFIX) if prefix >= WIDEST_6 else LINK_PREFIX), strict=False)


LOOKUP_SECONDS = 5.0
THREADS = 16
LOOKUPS = 2
"""Lookups of one user at a time."""

MAX_WAITING = 64

NOT_PERMITTED = "it is in a network that this relay does not send to"

_log = Logger()


class NameResolver:
    """The system's resolver.

    :param reactor: calls results back
    """

    def __init__(self, reactor: Any) -> None:
        self._reactor = reactor
        self._threads = BoundedThreadPool(
            reactor, "alert-names", THREADS, MAX_WAITING, "too many names are looked up", only_reads=True
        )
        self._slots: dict[int, DeferredSemaphore] = {}

    def start(self) -> None:
        """Start the first thread."""
        self._threads.start()

    def stop(self) -> None:
        """Finish running lookups; blocks until they have ended."""
        self._threads.stop()

    async def addresses(self, host: str, port: int, user: int) -> list[str]:
        """All addresses of a host, each once. An address is returned as it is.

        :param user: number of the user; each has a few lookups at a time
        :raises Undelivered: there is none, or no answer came in time
        """
        literal = _literal(host)
        if literal is not None:
            return [literal]
        lookup = Deferred.fromCoroutine(self._look_up(host, port, user))
        try:
            return await lookup.addTimeout(LOOKUP_SECONDS, self._reactor)
        except (OSError, UnicodeError, DeferTimeout, Unavailable):
            raise unreachable(host, "no address was found") from None

    async def _look_up(self, host: str, port: int, user: int) -> list[str]:
        slots = self._slots.setdefault(user, DeferredSemaphore(LOOKUPS))
        try:
            await slots.acquire()
            # The caller may give up while the thread goes on, so the slot is released when the thread has ended.
            answer: Deferred[list[str]] = Deferred()
            running = Deferred.fromCoroutine(self._threads.run(_resolve, host, port))
            running.addBoth(self._resolved, slots, user, answer)
            return await answer
        finally:
            self._drop_unused(slots, user)

    def _resolved(
        self, result: Any, slots: DeferredSemaphore, user: int, answer: Deferred[list[str]]
    ) -> None:
        slots.release()
        self._drop_unused(slots, user)
        if isinstance(result, Failure):
            answer.errback(result)
        else:
            answer.callback(result)

    def _drop_unused(self, slots: DeferredSemaphore, user: int) -> None:
        if slots.tokens == slots.limit and self._slots.get(user) is slots:
            del self._slots[user]


def unreachable(host: str, why: str) -> Undelivered:
    """The error of a host that no message can be sent to.

    For a name it does not say whether the name is unknown or not permitted: users must not learn names of the relay's
    own networks. The log has the reason.

    :param why: for the log
    """
    if _literal(host) is not None:
        return Undelivered(f"{host}: {NOT_PERMITTED}; its administrator can allow that", again=False)
    _log.info("no message can be sent to '{host}': {why}", host=host, why=why)
    words = f"no address of '{host}' was found, or {NOT_PERMITTED}; its administrator can allow that"
    return Undelivered(words, again=True)


def _literal(host: str) -> str | None:
    """The normal form of an address; ``None`` for a name."""
    try:
        return str(ip_address(host))
    except ValueError:
        return None


def _resolve(host: str, port: int) -> list[str]:
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(str(each[4][0]) for each in found))
