"""Limits failed logins by account, by network and by both, before a password is hashed."""

from __future__ import annotations

import hashlib
import ipaddress
from collections import OrderedDict, deque
from collections.abc import Callable

from relay_db.names import normalise
from relay_protocol.errors import SwitchboardError
from relay_protocol.realms import split_name

FAILURES = 10
WINDOW = 15 * 60.0
KEYS = 10_000
"""Pairs of account and network that are remembered; those unused longest are forgotten first."""


FAILURES_OF_NETWORK = 100
"""Failures of one network on all accounts together, so that guessing names does not get around
:data:`FAILURES`."""


class TooManyTries(SwitchboardError):
    """Too many failures; try again after ``retry_after`` seconds."""

    code = "too_many_tries"

    def __init__(self, retry_after: float) -> None:
        super().__init__(
            f"too many failed logins from your network, or of this account; try again in {int(retry_after) + 1} s"
        )
        self.retry_after = retry_after


def network_of(address: str) -> str:
    """The network that an address belongs to: /32 of IPv4, /64 of IPv6 (one household, one server)."""
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
    """The key of a user's account, however the name is written. Names that no account can have share no key."""
    name, realm = split_name(account)
    normal = normalise(name), normalise(realm)
    return "@".join(normal) if all(normal) else digest(account)


def digest(claimed: str) -> str:
    """A key of bounded length for any claimed name; different texts have different keys."""
    return hashlib.sha256(claimed.encode("utf-8", "surrogatepass")).hexdigest()


class LoginLimiter:
    """Allows :data:`FAILURES` failures per account and network in :data:`WINDOW` seconds, and
    :data:`FAILURES_OF_NETWORK` per network.

    Tries without an account (login links) pass ``None``: only the network is counted. Robots that prove their
    identity are accounts too.

    :param seconds: a monotonic clock
    :param of_network: failures of one network on all accounts together, if not :data:`FAILURES_OF_NETWORK`
    :param known_as: makes the key of an account: :func:`person` or :func:`digest`
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
        """Seconds until another try is allowed; 0 if it is allowed now."""
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
        """Count one failure. Call this before hashing begins, and :meth:`succeeded` if it went well."""
        for key, most, _ in self._keys(account, address):
            times = self._failures.setdefault(key, deque(maxlen=most))
            times.append(self._seconds())
            self._failures.move_to_end(key)
        while len(self._failures) > KEYS:
            self._failures.popitem(last=False)

    def forgive(self, account: str | None, address: str) -> None:
        """Take the latest failure back: no secret was tried."""
        for key, _, _ in self._keys(account, address):
            times = self._failures.get(key)
            if times:
                times.pop()

    def succeeded(self, account: str | None, address: str) -> None:
        """Forget the failures of this account from this network. Other failures of both stay."""
        self.forgive(account, address)
        if account is not None:
            self._failures.pop((self._known_as(account), network_of(address)), None)

    def _keys(self, account: str | None, address: str) -> list[tuple[_Key, int, float]]:
        """The counters of a try, each with its limit and its window in seconds."""
        network = network_of(address)
        keys: list[tuple[_Key, int, float]] = [
            ((None, network), self._of_network or FAILURES_OF_NETWORK, WINDOW)
        ]
        if account is None:
            return keys
        keys.append(((self._known_as(account), network), FAILURES, WINDOW))
        return keys


_Key = tuple[str | None, str | None]
"""Account and network; ``None`` stands for all of them."""
