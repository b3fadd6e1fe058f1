"""Shares of the relay's processor, so that no user can take it from the others by asking for much.

What is costly is timed while it is done, and the time is taken from a share that fills again as time goes by. Counted
by user, not by connection: many connections are no way around it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

REQUESTS = 0.25
REQUESTS_RESERVE = 1.0
"""Of a second, what one user's requests may take each second, and what may be saved up: connecting asks for much."""

DEBT = 5.0
"""Seconds of the processor one user may be over that. Then whoever asks for more is cut."""

FORMS = 0.25
FORMS_OF_USER = 0.1
FORMS_RESERVE = 0.05
"""The same for the costly forms of messages (SPEC section 1.6): of all together, of one user, and what may be saved."""


class Quota:
    """A share of time. What is done last may overdraw it: nobody knows before what it will take.

    :param share: seconds of work each second
    :param reserve: seconds of work that can be saved up
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
        """Seconds of work that may be done now; negative when it is overdrawn."""
        now = self._seconds()
        self._left = min(self._reserve, self._left + max(0.0, now - self._at) * self._share)
        self._at = now
        return self._left

    def spend(self, work: float) -> None:
        """So many seconds of work were done."""
        self._left = self.left - work


class UserQuota:
    """What one user may have of the processor, over all of his connections.

    :param everyone: for costly forms, of all users
    :param seconds: a monotonic clock
    :param worked: seconds of processor time so far
    """

    __slots__ = ("__weakref__", "_everyone", "_forms", "requests", "worked")

    def __init__(self, everyone: Quota, seconds: Callable[[], float], worked: Callable[[], float]) -> None:
        self.worked = worked
        self.requests = Quota(REQUESTS, REQUESTS_RESERVE, seconds)
        self._forms = Quota(FORMS_OF_USER, FORMS_RESERVE, seconds)
        self._everyone = everyone

    @property
    def may_form(self) -> bool:
        """Whether a message may be put in a costly form now."""
        return self._forms.left > 0 and self._everyone.left > 0

    @contextmanager
    def forming(self) -> Iterator[None]:
        """Around the work of putting a message in a costly form."""
        began = self.worked()
        try:
            yield
        finally:
            work = self.worked() - began
            self._forms.spend(work)
            self._everyone.spend(work)


class UserQuotas:
    """The allowances of all users. Each is kept for good: one who comes back has what he has left.

    :param seconds: a monotonic clock
    :param worked: seconds of processor time so far
    """

    def __init__(self, seconds: Callable[[], float], worked: Callable[[], float]) -> None:
        self._seconds = seconds
        self._worked = worked
        self._forms = Quota(FORMS, FORMS_RESERVE, seconds)
        self._of: dict[int, UserQuota] = {}

    def of(self, user: int) -> UserQuota:
        """The allowance of a user, by id."""
        found = self._of.get(user)
        if found is None:
            found = self._of[user] = UserQuota(self._forms, self._seconds, self._worked)
        return found
