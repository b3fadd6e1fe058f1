"""ROS domains for tests, unique on this machine."""

from __future__ import annotations

import random
import socket
from collections import deque

_LATEST = 16
"""More than live at a time in one process; those before are given free. Four processes leave many of them free."""

_DOMAINS = [*range(1, 100), *range(215, 232)]
"""Those between have the ports from which Linux chooses for connections. The last, 232, has a test of its own."""

_taken: deque[socket.socket] = deque(maxlen=_LATEST)


def free_domain() -> int:
    """A ROS domain that no process on this machine uses, and that no other test process selects now."""
    for domain in random.sample(_DOMAINS, len(_DOMAINS)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                # The port of a domain's first participant (DDSI-RTPS 2.2, section 9.6.1.4).
                probe.bind(("127.0.0.1", 7400 + 250 * domain + 10))
            except OSError:
                continue
        lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            # A name in Linux's abstract namespace ends with the process in any case.
            lock.bind(f"\0switchboard test domain {domain}")
        except OSError:
            lock.close()
            continue
        _taken.append(lock)
        return domain
    raise AssertionError("no ROS domain is free on this machine")
