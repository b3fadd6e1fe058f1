"""The addresses of this machine, and whether they have changed."""

from __future__ import annotations

import ctypes
import socket
import time
from collections.abc import Callable, Iterable
from pathlib import Path

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


_LIBRARIES = ("libfastrtps.so", "libfastdds.so")
_READ_INTERFACES = "_ZN8eprosima10SystemInfo17update_interfacesEv"
"""``eprosima::SystemInfo::update_interfaces()``."""


def read_interfaces_again() -> None:
    """Let Fast DDS read the addresses of this machine again, if this process has loaded it.

    It reads them once for each process. A participant that is made after they have changed would listen at the former
    ones, and find no node that starts afterwards. Versions that have no such function read them for each participant,
    as other middleware does.
    """
    for line in Path("/proc/self/maps").read_text().splitlines():
        path = line.split(maxsplit=5)[-1]
        if Path(path).name.startswith(_LIBRARIES):
            update = getattr(ctypes.CDLL(path), _READ_INTERFACES, None)
            if update is not None:
                update()
            return


SERVICES = frozenset(("obstacles", "battery", "gps", "markers", "faces", "speech", "navigator"))
"""Names of the nodes of services. They are made again too, as those of daemons. So they are not waited for."""

SIMULATOR = "switchboard_sim"
"""Name of the node of simulated robots."""


def finds_others(before: frozenset[str], now: frozenset[str], nodes: Iterable[str]) -> bool:
    """Whether a participant that is made now finds the nodes that run.

    It does if it has an address that they listen at, too. Otherwise it would lose them, and they would not find it.

    :param before: addresses when they were started
    :param nodes: full names of the nodes that run
    """
    names = {each.rpartition("/")[2] for each in nodes} - SERVICES
    return bool(before & now) or all("switchboard_" in each and each != SIMULATOR for each in names)


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

    def changed(self, nodes: Callable[[], Iterable[str]] = tuple) -> bool:
        """Whether two looks in succession have found other addresses, with which a new participant finds those nodes.

        To be called often; it looks rarely.

        :param nodes: returns the full names of the nodes that run
        """
        now = self._seconds()
        if now < self._due:
            return False
        self._due = now + CHECK_SECONDS
        before, self._latest = self._latest, self._read()
        if not self._latest or not before == self._latest != self._known:
            return False
        return finds_others(self._known, self._latest, nodes())
