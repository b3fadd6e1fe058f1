"""Which of the robot's services and actions move it, which connections may use them, and how old a request may be.

No client may use the service that is the robot's hardware switch: a stop sets it, and only a resume releases it.

SPEC 2.5-38, 2.5-43 and 2.5-31.
"""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol.errors import Refused
from relay_protocol.link.motion import SEND_GOAL, MotionPolicy
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.authority import Authority, MotionDecision
from robot_client.motion.command_age import MILLI, earliest_sent_of
from robot_client.platforms.base import Check, Platform


class MotionRequestGate:
    """Asks the authority about calls and goals, by the names the platform resolves, and checks their age.

    :param now: nanoseconds of a clock that counts time suspended
    :param switch: service that the daemon calls at a stop and at a resume, and no client may call; empty for none
    """

    def __init__(
        self,
        policy: MotionPolicy,
        platform: Platform,
        authority: Authority,
        now: Callable[[], int],
        switch: str = "",
    ) -> None:
        self.stale = 0
        """How many calls and goals were refused for their age."""
        self._policy = policy
        self._platform = platform
        self._authority = authority
        self._now = now
        self._switch = switch

    def check_call(self, service: str, source: int, stamp: int | None, offset: ClockOffset) -> Check:
        """Check that a connection may call a service.

        :param source: the connection
        :param stamp: the relay's monotonic nanoseconds before which the call can't have been sent; ``None``: unknown
        :param offset: of the relay's clock, by the link on which the call came
        :return: repeats the check; run it just before the call, as finding the service takes time
        :raises Refused: it moves the robot and the connection may not, or it may be too old; or it is the switch
        :raises Invalid: the name is not valid
        """
        if not (self._policy.services or self._policy.actions or self._switch):
            return _always_allowed
        full = self._platform.full_name(service, "service")
        self._refuse_switch(full, "call")
        moves = self._policy.moves_by_service(full)
        return self._check_now(f"a call of {full}", source, stamp, offset) if moves else _always_allowed

    def check_goal(self, action: str, source: int, stamp: int | None, offset: ClockOffset) -> bool:
        """Check that a connection may have a goal executed; return whether the goal moves the robot.

        :param stamp: as of :meth:`check_call`, like ``source`` and ``offset``
        :raises Refused: it moves the robot and the connection may not, or it may be too old; or the switch is a
            service of the action
        :raises Invalid: the name is not valid
        """
        if not (self._policy.actions or self._switch):
            return False
        full = self._platform.full_name(action, "action")
        self._refuse_switch(full + SEND_GOAL, "call")
        moves = self._policy.moves_by_action(full)
        if moves:
            self._check_now(f"a goal for {full}", source, stamp, offset)
        return moves

    def check_advertise(self, service: str) -> None:
        """Check that a client may advertise a service.

        :raises Refused: it is the switch
        :raises Invalid: the name is not valid
        """
        if self._switch:
            self._refuse_switch(self._platform.full_name(service, "service"), "advertise")

    def _refuse_switch(self, full: str, what: str) -> None:
        """Check that a service is not the switch.

        :param what: the verb of the refused request, for the message
        """
        if self._switch and full == self._platform.full_name(self._switch, "service"):
            raise Refused(
                f"{full} is the robot's hardware switch, which no client may {what}: "
                "call /relay/stop to stop the robot, /relay/resume to resume it"
            )

    def _check_now(self, what: str, source: int, stamp: int | None, offset: ClockOffset) -> Check:
        """Check a request now; return a function that repeats the check.

        :param what: the request, for the message
        """
        received = self._now()
        earliest_sent = received if stamp is None else earliest_sent_of(stamp, received, offset)

        def check() -> None:
            now, deadline = self._now(), self._policy.deadline_ms
            decision = self._authority.decide_request(source, now, earliest_sent)
            if decision is not MotionDecision.ALLOWED:
                raise Refused(f"{what} moves the robot: {decision.value}")
            oldest = now - received if stamp is None else offset.max_age(stamp, now)
            if oldest is None or not 0 <= oldest <= deadline * MILLI:
                self.stale += 1
                raise Refused(
                    f"{what} moves the robot: {_age_problem(oldest)}; none older than {deadline} ms is obeyed"
                )

        check()
        return check


def _always_allowed() -> None:
    """Allow a request that moves nothing."""


def _age_problem(oldest: int | None) -> str:
    """Describe what is wrong with an age.

    :param oldest: the greatest age it can have, nanoseconds; ``None``: unknown
    """
    if oldest is None:
        return "its age is not known yet"
    if oldest < 0:
        return "its stamp is in the future"
    return f"it may be {oldest / MILLI:.0f} ms old"
