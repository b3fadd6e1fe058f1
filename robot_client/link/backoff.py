"""Delays before dialling again: exponential backoff with full jitter, and a low cap in the first minute."""

from __future__ import annotations

from collections.abc import Callable

FIRST = 0.5
CAP = 15.0
CAP_OF_FRESH_OUTAGE = 2.0
FRESH_OUTAGE = 60.0
"""Seconds. A relay that restarts is back within a minute, so robots dial often during that time."""

STEADY = 10.0
"""Seconds a link must have been registered for the backoff to start over."""

REFUSED = (30.0, 60.0)
"""Least and most seconds to wait when only a person can resolve the refusal."""

_DOUBLINGS = 16


class Backoff:
    """Computes delays from the failures so far.

    :param random: returns numbers in [0, 1)
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
        """Seconds to wait after the relay refused the robot.

        :param retry_after: seconds the relay requested; ``None`` if only a person can resolve the refusal
        """
        shortest, longest = REFUSED
        if retry_after is None:
            return shortest + self._random() * (longest - shortest)
        return max(0.0, retry_after) * (1.0 + 0.1 * self._random()) + self._random() * FIRST
