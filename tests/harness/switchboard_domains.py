"""ROS domains for tests, none of them twice at a time, whatever else runs on this machine."""

from __future__ import annotations

import random
import socket
from collections import deque

_LATEST = 24
"""More than live at a time in one process; those before are given free."""

_taken: deque[socket.socket] = deque(maxlen=_LATEST)


def free_domain() -> int:
    """A ROS domain nobody on this machine uses, and no other test process chooses now."""
    for domain in random.sample(range(1, 100), 99):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                # Where the first participant of a domain listens (DDSI-RTPS 2.2, section 9.6.1.4).
                probe.bind(("127.0.0.1", 7400 + 250 * domain + 10))
            except OSError:
                continue
        lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            # A name in Linux's abstract space: gone with the process, however that ends.
            lock.bind(f"\0switchboard test domain {domain}")
        except OSError:
            lock.close()
            continue
        _taken.append(lock)
        return domain
    raise AssertionError("no ROS domain is free on this machine")
