"""Failed logins, counted per account and network, before a password is ever hashed."""

from __future__ import annotations

import hashlib
import ipaddress
from collections import OrderedDict, deque
from collections.abc import Callable

from relay_db.names import findable
from relay_protocol.realms import parted

FAILURES = 10
WINDOW = 15 * 60.0
KEYS = 10_000
"""Pairs of account and network remembered; the longest unused are forgotten first."""


FAILURES_OF_NETWORK = 100
"""Failures of one network on all accounts together, so that guessing names is no way around :data:`FAILURES`."""


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
    return f"{findable(name)}@{findable(realm)}"


def robot(claimed: str) -> str:
    """What a robot claims to be, however long that is: each text is another one."""
    return hashlib.sha256(claimed.encode("utf-8", "surrogatepass")).hexdigest()


class LoginLimiter:
    """At most :data:`FAILURES` failures per account and network in :data:`WINDOW` seconds, and per network
    :data:`FAILURES_OF_NETWORK`.

    The pair is what is limited, so nobody can lock an account from afar.

    An account of ``None`` stands for tries that name nobody (login links): only the network is counted. Robots that
    prove themselves are accounts too.

    :param seconds: a monotonic clock
    :param of_network: failures of one network on all accounts together, if not :data:`FAILURES_OF_NETWORK`
    :param known_as: what an account is known as: :func:`person` or :func:`robot`
    """

    def __init__(
        self,
        seconds: Callable[[], float],
        of_network: int | None = None,
        known_as: Callable[[str], str] = person,
    ) -> None:
        self._seconds = seconds
        self._known_as = known_as
        self._of_network = of_network
        self._failures: OrderedDict[_Key, deque[float]] = OrderedDict()

    def wait(self, account: str | None, address: str) -> float:
        """Seconds until another try is allowed; 0 when it is allowed now."""
        return max(self._wait(key, most) for key, most in self._keys(account, address))

    def _wait(self, key: _Key, most: int) -> float:
        times = self._failures.get(key)
        if times is None:
            return 0.0
        now = self._seconds()
        while times and times[0] <= now - WINDOW:
            times.popleft()
        if len(times) < most:
            return 0.0
        return times[0] + WINDOW - now

    def failed(self, account: str | None, address: str) -> None:
        """Count one failure. Call before hashing begins, and :meth:`succeeded` when it went well."""
        for key, most in self._keys(account, address):
            times = self._failures.setdefault(key, deque(maxlen=most))
            times.append(self._seconds())
            self._failures.move_to_end(key)
        while len(self._failures) > KEYS:
            self._failures.popitem(last=False)

    def forgive(self, account: str | None, address: str) -> None:
        """Take the latest failure back: nothing was tried."""
        for key, _ in self._keys(account, address):
            times = self._failures.get(key)
            if times:
                times.pop()

    def succeeded(self, account: str | None, address: str) -> None:
        """Forget the failures of this account here; the network's other failures stay."""
        self.forgive(account, address)
        if account is not None:
            self._failures.pop((self._known_as(account), network_of(address)), None)

    def _keys(self, account: str | None, address: str) -> list[tuple[_Key, int]]:
        """What a try counts for, with the most failures each."""
        network = network_of(address)
        keys: list[tuple[_Key, int]] = [((None, network), self._of_network or FAILURES_OF_NETWORK)]
        if account is not None:
            keys.append(((self._known_as(account), network), FAILURES))
        return keys


_Key = tuple[str | None, str]
