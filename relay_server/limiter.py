"""Failed logins, counted per account and network, before a password is ever hashed."""

from __future__ import annotations

import ipaddress
from collections import OrderedDict, deque
from collections.abc import Callable

FAILURES = 10
WINDOW = 15 * 60.0
KEYS = 10_000
"""Pairs of account and network remembered; the longest unused are forgotten first."""


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


class LoginLimiter:
    """At most :data:`FAILURES` failures per account and network in :data:`WINDOW` seconds.

    The pair is what is limited, so nobody can lock an account from afar.

    :param seconds: a monotonic clock
    """

    def __init__(self, seconds: Callable[[], float]) -> None:
        self._seconds = seconds
        self._failures: OrderedDict[tuple[str, str], deque[float]] = OrderedDict()

    def wait(self, account: str, address: str) -> float:
        """Seconds until another try is allowed; 0 when it is allowed now."""
        times = self._failures.get((account, network_of(address)))
        if times is None:
            return 0.0
        now = self._seconds()
        while times and times[0] <= now - WINDOW:
            times.popleft()
        if len(times) < FAILURES:
            return 0.0
        return times[0] + WINDOW - now

    def failed(self, account: str, address: str) -> None:
        """Count one failure. Call before hashing begins, and :meth:`succeeded` when it went well."""
        key = (account, network_of(address))
        times = self._failures.setdefault(key, deque(maxlen=FAILURES))
        times.append(self._seconds())
        self._failures.move_to_end(key)
        while len(self._failures) > KEYS:
            self._failures.popitem(last=False)

    def succeeded(self, account: str, address: str) -> None:
        """Forget the failures of this pair."""
        self._failures.pop((account, network_of(address)), None)
