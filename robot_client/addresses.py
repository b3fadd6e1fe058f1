"""The addresses of this machine, and whether they have changed."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

try:
    import psutil
except ImportError:  # optional
    psutil = None

CHECK_SECONDS = 3.0
"""Seconds between two looks at the addresses. A change counts when two looks agree."""


def own_addresses() -> frozenset[str]:
    """IPv4 addresses of this machine with their interfaces; empty without psutil.

    Loopback is left out, and IPv6, which DDS does not use by default.
    """
    if psutil is None:
        return frozenset()
    return frozenset(
        f"{name} {each.address}"
        for name, addresses in psutil.net_if_addrs().items()
        for each in addresses
        if each.family == socket.AF_INET and not each.address.startswith("127.")
    )


class AddressWatch:
    """Whether the addresses differ from those at the time when it was made.

    :param read: the addresses now
    :param seconds: a monotonic clock
    """

    def __init__(
        self,
        read: Callable[[], frozenset[str]] = own_addresses,
        seconds: Callable[[], float] = time.monotonic,
    ) -> None:
        self._read = read
        self._seconds = seconds
        self._known = self._latest = read()
        self._due = seconds() + CHECK_SECONDS

    def changed(self) -> bool:
        """Whether two looks in succession have found other addresses. To be called often; it looks rarely."""
        now = self._seconds()
        if now < self._due:
            return False
        self._due = now + CHECK_SECONDS
        before, self._latest = self._latest, self._read()
        return bool(self._latest) and before == self._latest != self._known
