"""What names stand for, asked of the system in threads of our own, of which no user has more than a few.

A name server that hangs holds a thread for as long as the system waits for it, however soon we give up; so a place is
let go only when its thread is done, and who has none left waits for himself alone.
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
from relay_server.alerts.message import Undelivered
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
"""Not for everybody's use: IANA's registry of special-purpose IPv4 addresses (RFC 6890), and multicast."""

UNICAST = IPv6Network("2000::/3")
"""All of IPv6 that is given out to be reached from everywhere; what lies outside is special."""

SPECIAL_6: tuple[Network, ...] = tuple(
    map(ip_network, ("2001::/23", "2001:db8::/32", "2002::/16", "2620:4f:8000::/48", "3fff::/20"))
)
"""Special within it: IANA's registry of special-purpose IPv6 addresses."""

NAT64 = IPv6Network("64:ff9b::/96")
"""Carries an IPv4 address in its last 32 bits (RFC 6052), by which it is judged."""


def parse_networks(texts: Iterable[str]) -> tuple[Network, ...]:
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
class EgressPolicy:
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
        return not any(address in network for network in SPECIAL_NETWORKS)
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


LINK = 64
"""A network of IPv6 has this prefix (RFC 4291, section 2.5.4), also where DHCPv6 gave the interface one address."""

WIDEST_4 = 8
WIDEST_6 = 32
"""An interface with more of the Internet on its cable than this is a tunnel's: only its own address counts."""


def local_networks() -> frozenset[Network]:
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


SECONDS = 5.0
THREADS = 16
LOOKUPS = 2
"""Names of one user that are looked up at a time."""

WAITING = 64

SPECIAL_NAMES = "it is in a network that this relay does not send to"

_log = Logger()


class NameResolver:
    """The system's resolver.

    :param reactor: calls results back
    """

    def __init__(self, reactor: Any) -> None:
        self._reactor = reactor
        self._threads = BoundedThreadPool(
            reactor, "alert-names", THREADS, WAITING, "too many names are looked up", only_reads=True
        )
        self._places: dict[int, DeferredSemaphore] = {}

    def start(self) -> None:
        """Start the first thread."""
        self._threads.start()

    def stop(self) -> None:
        """Finish what is under way; blocks for as long as that takes."""
        self._threads.stop()

    async def addresses(self, host: str, port: int, user: int) -> list[str]:
        """All addresses of a host, each once; an address stands for itself, and nobody is asked.

        :param user: for whom: his lookups that hang are in nobody else's way
        :raises Undelivered: there are none, or nobody says so in time
        """
        literal = _literal(host)
        if literal is not None:
            return [literal]
        asked = Deferred.fromCoroutine(self._look_up(host, port, user))
        try:
            return await asked.addTimeout(SECONDS, self._reactor)
        except (OSError, UnicodeError, DeferTimeout, Unavailable):
            raise unreachable(host, "nobody knows an address of it now") from None

    async def _look_up(self, host: str, port: int, user: int) -> list[str]:
        places = self._places.setdefault(user, DeferredSemaphore(LOOKUPS))
        try:
            await places.acquire()
            # Whoever waits may give up: that leaves the thread at work, and its place taken.
            answer: Deferred[list[str]] = Deferred()
            looking = Deferred.fromCoroutine(self._threads.run(_ask, host, port))
            looking.addBoth(self._looked, places, user, answer)
            return await answer
        finally:
            self._tidy(places, user)

    def _looked(self, result: Any, places: DeferredSemaphore, user: int, answer: Deferred[list[str]]) -> None:
        places.release()
        self._tidy(places, user)
        if isinstance(result, Failure):
            answer.errback(result)
        else:
            answer.callback(result)

    def _tidy(self, places: DeferredSemaphore, user: int) -> None:
        if places.tokens == places.limit and self._places.get(user) is places:
            del self._places[user]


def unreachable(host: str, why: str) -> Undelivered:
    """What people are told of a host that nothing can be sent to.

    Of a name only the log knows which it is: names of the relay's own networks are nobody else's business.

    :param why: for the log
    """
    if _literal(host) is not None:
        return Undelivered(f"{host}: {SPECIAL_NAMES}; its administrator can allow that", again=False)
    _log.info("nothing can be sent to '{host}': {why}", host=host, why=why)
    words = f"nobody knows an address of '{host}' now, or {SPECIAL_NAMES}; its administrator can allow that"
    return Undelivered(words, again=True)


def _literal(host: str) -> str | None:
    """An address as the system would write it."""
    try:
        return str(ip_address(host))
    except ValueError:
        return None


def _ask(host: str, port: int) -> list[str]:
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(str(each[4][0]) for each in found))
