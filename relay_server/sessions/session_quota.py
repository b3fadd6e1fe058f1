"""Counts the processor time of a session towards its user's quota (:mod:`relay_server.common.cpu_quota`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from relay_protocol.errors import Refused
from relay_server.common import close_codes
from relay_server.common.concurrency import FairQueue
from relay_server.common.cpu_quota import DEBT, UserQuota

REFUSAL = 5e-6
"""Seconds of processor time that a refusal takes."""

ROUND_TRIP = 150e-6
"""Seconds of processor time to send a request to a robot and to pass on the answer, beside what is timed."""


class SessionQuota:
    """Counts processor time spent for one session towards its user's quota.

    :param user: the quota of its user, over all connections
    :param fair_queue: of all sessions of the robot that wait for its answer
    :param close: closes the connection with a code and a reason; the session replaces it
    :ivar being_timed: whether the work done now is timed already; work nested in it is not timed again
    """

    __slots__ = ("_fair_queue", "being_timed", "close", "user")

    def __init__(self, user: UserQuota, fair_queue: FairQueue, close: Callable[[int, str], None]) -> None:
        self.user = user
        self._fair_queue = fair_queue
        self.close = close
        self.being_timed = False

    def check(self) -> None:
        """:raises Refused: the user's CPU quota is used up"""
        if self.user.requests.left <= 0:
            raise Refused(
                "too much at once: your share of the relay's processor is used up; try again in a moment"
            )

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Around work that is done for the client after its message was handled.

        :raises Refused: the user's CPU quota is used up
        """
        self.check()
        with self.timed():
            yield

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Around work that is done whether the quota is used up or not."""
        if self.being_timed:
            yield
            return
        self.being_timed = True
        worked = self.user.worked
        began = worked()
        try:
            yield
        finally:
            self.being_timed = False
            self._spent(worked() - began)

    async def wait_for_turn(self) -> None:
        """Wait for a reactor turn in which no other answer is made, unless the message is still being handled.

        Many clients may wait for the same answer of a robot; their work must not be done all at once.
        """
        if not self.being_timed:
            await self._fair_queue.wait()

    def count_elsewhere(self, seconds: float) -> None:
        """Count work that another thread did for the client."""
        self._spent(seconds)

    def count_refusal(self) -> None:
        """Count a refusal, which is not timed, as timing it would take longer."""
        self._spent(REFUSAL)

    def count_robot_request(self) -> None:
        """Count a request to the robot: the work to send it and to pass on its answer."""
        self._spent(ROUND_TRIP)

    def _spent(self, work: float) -> None:
        requests = self.user.requests
        requests.spend(work)
        if requests.left < -DEBT:
            self.close(
                close_codes.TOO_MANY_ERRORS,
                "far too much at once: more than the relay can do beside its work",
            )
