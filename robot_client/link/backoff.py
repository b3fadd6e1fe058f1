"""When to dial again: exponential backoff with full jitter, quick at first, never giving up."""

from __future__ import annotations

from collections.abc import Callable

FIRST = 0.5
CAP = 15.0
CAP_OF_FRESH_OUTAGE = 2.0
FRESH_OUTAGE = 60.0
"""A relay that restarts is back within a minute: until then robots dial often enough to be back with it."""

STEADY = 10.0
"""A link that was registered this long was a good one; the next outage starts afresh."""

REFUSED = (30.0, 60.0)
"""When only a person can help, asking more often helps nobody."""

_DOUBLINGS = 16


class Backoff:
    """Counts failures and says how long to wait.

    :param random: gives numbers in [0, 1)
    """

    def __init__(self, random: Callable[[], float]) -> None:
        self._random = random
        self._failures = 0
        self._waited = 0.0

    def after_loss(self, registered_for: float) -> float:
        """Seconds to wait after a link that could not be made or was lost.

        :param registered_for: seconds it was registered, 0 when it never was
        """
        if registered_for >= STEADY:
            self._failures = 0
            self._waited = 0.0
        cap = CAP_OF_FRESH_OUTAGE if self._waited < FRESH_OUTAGE else CAP
        delay: float = self._random() * min(cap, FIRST * 2.0 ** min(self._failures, _DOUBLINGS))
        self._failures += 1
        self._waited += max(delay, 0.05)
        return delay

    def after_refusal(self, retry_after: float | None) -> float:
        """Seconds to wait after the relay said no.

        :param retry_after: what the relay asked for, seconds; ``None`` when only a person can help
        """
        least, most = REFUSED
        if retry_after is None:
            return least + self._random() * (most - least)
        return max(0.0, retry_after) * (1.0 + 0.1 * self._random()) + self._random() * FIRST
