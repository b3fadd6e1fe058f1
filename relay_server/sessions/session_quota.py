"""What one client's work takes of its user's share of the processor."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from relay_protocol.errors import Refused
from relay_server.common import close_codes
from relay_server.common.cpu_quota import DEBT

if TYPE_CHECKING:
    from relay_server.sessions.session import Session

REFUSAL = 5e-6
"""Seconds it takes to refuse something."""

ROUND_TRIP = 150e-6
"""Seconds it takes to send a question to a robot and to hand on the answer, beside what is timed."""


class SessionQuota:
    """Work for one session, on its user's account.

    :ivar counting: whether what is done now is timed already; what is done within it is counted along
    """

    __slots__ = ("_session", "counting")

    def __init__(self, session: Session) -> None:
        self._session = session
        self.counting = False

    def check(self) -> None:
        """:raises Refused: the user has used up his share of the processor"""
        if self._session.allowance.requests.left <= 0:
            raise Refused(
                "too much at once: your share of the relay's processor is used up; try again in a moment"
            )

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Around work for the client that is done later than its message is handled.

        :raises Refused: the user has used up his share of the processor
        """
        self.check()
        with self.timed():
            yield

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Around work that is done whatever is left of the share."""
        if self.counting:
            yield
            return
        self.counting = True
        worked = self._session.allowance.worked
        began = worked()
        try:
            yield
        finally:
            self.counting = False
            self._spent(worked() - began)

    async def own_turn(self) -> None:
        """Wait for a turn of the reactor in which nobody else's answer is made, unless the message is still handled.

        Many may wait for the same word of a robot; it must not take all of their work at once.
        """
        if not self.counting:
            await self._session.channel.line.turn()

    def took(self, seconds: float) -> None:
        """Work for the client was done by another thread, for so long."""
        self._spent(seconds)

    def refused(self) -> None:
        """Something was refused, which is not timed: that would take longer."""
        self._spent(REFUSAL)

    def asks_robot(self) -> None:
        """A question goes to the robot: what its way there and back takes is counted."""
        self._spent(ROUND_TRIP)

    def _spent(self, work: float) -> None:
        requests = self._session.allowance.requests
        requests.spend(work)
        if requests.left < -DEBT:
            self._session.close(
                close_codes.TOO_MANY_ERRORS,
                "far too much at once: more than the relay can do beside its work",
            )
