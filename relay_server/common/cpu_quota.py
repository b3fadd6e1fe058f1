"""CPU quotas, so that one user's requests can't starve the others.

Costly work is timed, and the time is taken from a quota that refills at a constant rate. Quotas count per user, not per
connection, so opening many connections does not help.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

REQUESTS = 0.25
REQUESTS_RESERVE = 1.0
"""CPU seconds per second for one user's requests, and most CPU seconds saved up, as connecting costs much."""

DEBT = 5.0
"""Most CPU seconds by which a user may overdraw the quota of requests. Beyond it their connections are closed."""

ENCODINGS = 0.25
ENCODINGS_OF_USER = 0.1
ENCODINGS_RESERVE = 0.05
"""CPU seconds per second for costly encodings (SPEC 1.6) of all users and of one; most seconds saved up."""


class CpuQuota:
    """CPU time that refills. The last work may overdraw it, because its cost is known only afterwards.

    :param share: CPU seconds per second
    :param reserve: most CPU seconds saved up
    :param seconds: a monotonic clock
    """

    __slots__ = ("_at", "_left", "_reserve", "_seconds", "_share")

    def __init__(self, share: float, reserve: float, seconds: Callable[[], float]) -> None:
        self._share = share
        self._reserve = reserve
        self._seconds = seconds
        self._left = reserve
        self._at = seconds()

    @property
    def left(self) -> float:
        """CPU seconds left; negative when overdrawn."""
        now = self._seconds()
        self._left = min(self._reserve, self._left + max(0.0, now - self._at) * self._share)
        self._at = now
        return self._left

    def spend(self, work: float) -> None:
        """Subtract CPU seconds."""
        self._left = self.left - work


class UserQuota:
    """The CPU quotas of one user, over all of their connections.

    :param everyone: quota of all users for costly encodings
    :param seconds: a monotonic clock
    :param worked: CPU seconds used so far
    """

    __slots__ = ("__weakref__", "_encodings", "_everyone", "requests", "worked")

    def __init__(self, everyone: CpuQuota, seconds: Callable[[], float], worked: Callable[[], float]) -> None:
        self.worked = worked
        self.requests = CpuQuota(REQUESTS, REQUESTS_RESERVE, seconds)
        self._encodings = CpuQuota(ENCODINGS_OF_USER, ENCODINGS_RESERVE, seconds)
        self._everyone = everyone

    @property
    def may_encode(self) -> bool:
        """Whether a costly encoding may be made now."""
        return self._encodings.left > 0 and self._everyone.left > 0

    @contextmanager
    def encoding(self) -> Iterator[None]:
        """Time the making of a costly encoding."""
        began = self.worked()
        try:
            yield
        finally:
            work = self.worked() - began
            self._encodings.spend(work)
            self._everyone.spend(work)


class UserQuotas:
    """The quotas of all users. They are kept, so a user who reconnects has what is left.

    :param seconds: a monotonic clock
    :param worked: CPU seconds used so far
    """

    def __init__(self, seconds: Callable[[], float], worked: Callable[[], float]) -> None:
        self._seconds = seconds
        self._worked = worked
        self._encodings = CpuQuota(ENCODINGS, ENCODINGS_RESERVE, seconds)
        self._of: dict[int, UserQuota] = {}

    def of(self, user: int) -> UserQuota:
        """The quotas of a user.

        :param user: the user's id
        """
        found = self._of.get(user)
        if found is None:
            found = self._of[user] = UserQuota(self._encodings, self._seconds, self._worked)
        return found
