"""The clock by which words, looks and answers grow old: the daemon's, that goes on while the machine is suspended."""

from __future__ import annotations

from relay_protocol.clocks import now_ns


def now() -> float:
    """Seconds since the machine started, suspends included where the system can tell."""
    return now_ns() / 1e9
