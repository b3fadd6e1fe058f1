"""Failed logins, counted by account, by network and by both, before a password is ever hashed."""

from __future__ import annotations

import hashlib
import ipaddress
from collections import OrderedDict, deque
from collections.abc import Callable

from relay_db.names import normalise
from relay_protocol.realms import parted

FAILURES = 10
WINDOW = 15 * 60.0
KEYS = 10_000
"""Pairs of account and network remembered; the longest unused are forgotten first."""


FAILURES_OF_NETWORK = 100
"""Failures of one network on all accounts together, so that guessing names is no way around :data:`FAILURES`."""

FAILURES_OF_ACCOUNT = 20
ACCOUNT_WINDOW = 3600.0
"""Failures on one account, of all networks together that it has not logged in from; seconds in which they count."""

NETWORKS = 16
"""Networks remembered of each account, the latest; of :data:`KEYS` accounts."""


def network_of(address: str) -> str:
    """The network an address counts for: /32 of IPv4, /64 of IPv6 (one household, one server)."""
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv6Address):
        if parsed.ipv4_mapped:
            return str(parsed.ipv4_mapped)
        return str(ipaddress.ip_network((parsed, 64), strict=False))
    return str(parsed)


def person(account: str) -> str:
    """A user, however his name is written."""
    name, realm = parted(account)
    return f"{normalise(name)}@{normalise(realm)}"


def robot(claimed: str) -> str:
    """What a robot claims to be, however long that is: each text is another one."""
    return hashlib.sha256(claimed.encode("utf-8", "surrogatepass")).hexdigest()


class LoginLimiter:
    """At most :data:`FAILURES` failures per account and network in :data:`WINDOW` seconds, and per network
    :data:`FAILURES_OF_NETWORK`.

    With ``of_account`` an account has a limit over all networks that it never logged in from, too: a password is no
    easier to guess for those who have many addresses. From the networks it has logged in from nobody can lock it.

    An account of ``None`` stands for tries that name nobody (login links): only the network is counted. Robots that
    prove themselves are accounts too.

    :param seconds: a monotonic clock
    :param of_network: failures of one network on all accounts together, if not :data:`FAILURES_OF_NETWORK`
    :param known_as: what an account is known as: :func:`person` or :func:`robot`
    :param of_account: failures on one account in :data:`ACCOUNT_WINDOW` seconds; ``None``: no limit, for secrets that
        nobody can guess
    """

    def __init__(
        self,
        seconds: Callable[[], float],
        of_network: int | None = None,
        known_as: Callable[[str], str] = person,
        of_account: int | None = None,
    ) -> None:
        self._seconds = seconds
        self._known_as = known_as
        self._of_network = of_network
        self._of_account = of_account
        self._failures: OrderedDict[_Key, deque[float]] = OrderedDict()
        self._networks: OrderedDict[str, OrderedDict[str, None]] = OrderedDict()
        """By account, those it has logged in from."""

    def wait(self, account: str | None, address: str) -> float:
        """Seconds until another try is allowed; 0 when it is allowed now."""
        return max(self._wait(*each) for each in self._keys(account, address))

    def _wait(self, key: _Key, most: int, window: float) -> float:
        times = self._failures.get(key)
        if times is None:
            return 0.0
        now = self._seconds()
        while times and times[0] <= now - window:
            times.popleft()
        if len(times) < most:
            return 0.0
        return times[0] + window - now

    def failed(self, account: str | None, address: str) -> None:
        """Count one failure. Call before hashing begins, and :meth:`succeeded` when it went well."""
        for key, most, _ in self._keys(account, address):
            times = self._failures.setdefault(key, deque(maxlen=most))
            times.append(self._seconds())
            self._failures.move_to_end(key)
        while len(self._failures) > KEYS:
            self._failures.popitem(last=False)

    def forgive(self, account: str | None, address: str) -> None:
        """Take the latest failure back: nothing was tried."""
        for key, _, _ in self._keys(account, address):
            times = self._failures.get(key)
            if times:
                times.pop()

    def succeeded(self, account: str | None, address: str) -> None:
        """Forget the failures of this account here; the network's other failures stay, and the account's elsewhere."""
        self.forgive(account, address)
        if account is not None:
            self._failures.pop((self._known_as(account), network_of(address)), None)
            self.remember(account, address)

    def remember(self, account: str, address: str) -> None:
        """An account has logged in from here."""
        if self._of_account is None:
            return
        known = self._known_as(account)
        networks = self._networks.setdefault(known, OrderedDict())
        self._networks.move_to_end(known)
        networks[network_of(address)] = None
        networks.move_to_end(network_of(address))
        if len(networks) > NETWORKS:
            networks.popitem(last=False)
        if len(self._networks) > KEYS:
            self._networks.popitem(last=False)

    def _keys(self, account: str | None, address: str) -> list[tuple[_Key, int, float]]:
        """What a try counts for, with the most failures each, and the seconds in which they count."""
        network = network_of(address)
        keys: list[tuple[_Key, int, float]] = [
            ((None, network), self._of_network or FAILURES_OF_NETWORK, WINDOW)
        ]
        if account is None:
            return keys
        known = self._known_as(account)
        keys.append(((known, network), FAILURES, WINDOW))
        if self._of_account is not None and network not in self._networks.get(known, ()):
            keys.append(((known, None), self._of_account, ACCOUNT_WINDOW))
        return keys


_Key = tuple[str | None, str | None]
"""Account and network; ``None`` for all of them."""
