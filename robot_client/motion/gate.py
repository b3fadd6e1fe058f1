"""Which of the robot's services and actions move it, who may use those, and how old what he asks may be.

The switch in its hardware is nobody's: a stop throws it, and only a resume lets go of it.

SPEC 2.5: "Who moves the robot", 1 and 3, and "Clocks and deadline", 9.
"""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol.errors import Refused
from relay_protocol.link import MotionPolicy
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.authority import Authority, Verdict
from robot_client.motion.safety import MILLI, earliest
from robot_client.platforms.base import Check, Platform

HIDDEN = "/_action/"
"""What the names of an action's own services have between the action's and theirs."""

GOAL = HIDDEN + "send_goal"
"""What the service is called that takes an action's goals."""


class MotionGate:
    """Asks the authority about calls and goals, by the names the platform uses in the end, and judges their age.

    :param now: clock that goes on in suspends, nanoseconds
    :param switch: service that is called at a stop and at a resume, and by no client; empty for none
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
        """Calls and goals that were refused for their age."""
        self._policy = policy
        self._platform = platform
        self._authority = authority
        self._now = now
        self._switch = switch

    def call(self, service: str, source: int, stamp: int | None, offset: ClockOffset) -> Check:
        """See that a source may call a service.

        :param stamp: the relay's monotonic nanoseconds before which the call can't have been sent, if it says so
        :param offset: of the relay's clock, by the link on which the call came
        :return: sees to it once more, for when the call is made: much may change while its service is looked for
        :raises Refused: it moves the robot, and this source may not, or it may be too old; or it is the switch
        :raises Invalid: it is no name
        """
        if not (self._policy.services or self._policy.actions or self._switch):
            return _nothing
        full = self._platform.full_name(service, "service")
        self._spare(full, "call")
        moves = self._policy.moves_by_service(full)
        if full.endswith(GOAL):
            moves = moves or self._policy.moves_by_action(full[: -len(GOAL)])
        return self._judge(f"a call of {full}", source, stamp, offset) if moves else _nothing

    def goal(self, action: str, source: int, stamp: int | None, offset: ClockOffset) -> bool:
        """See that a source may have a goal pursued; whether that moves the robot.

        :param stamp: as of :meth:`call`, like ``offset``
        :raises Refused: it does, and this source may not, or it may be too old; or the switch is a part of the action
        :raises Invalid: it is no name
        """
        if not (self._policy.actions or self._switch):
            return False
        full = self._platform.full_name(action, "action")
        self._spare(full + GOAL, "call")
        moves = self._policy.moves_by_action(full)
        if moves:
            self._judge(f"a goal for {full}", source, stamp, offset)
        return moves

    def offer(self, service: str) -> None:
        """See that a client may offer a service.

        :raises Refused: it is the switch
        :raises Invalid: it is no name
        """
        if self._switch:
            self._spare(self._platform.full_name(service, "service"), "offer")

    def _spare(self, full: str, what: str) -> None:
        """See that a service is not the switch.

        :param what: is asked for
        """
        if self._switch and full == self._platform.full_name(self._switch, "service"):
            raise Refused(
                f"{full} is the switch in the robot's hardware, which no client may {what}: "
                "call /relay/stop to stop the robot, /relay/resume to let it go"
            )

    def _judge(self, what: str, source: int, stamp: int | None, offset: ClockOffset) -> Check:
        """Judge it now; what does so again."""
        came = self._now()
        sent = came if stamp is None else earliest(stamp, came, offset)

        def judge() -> None:
            now, deadline = self._now(), self._policy.deadline_ms
            verdict = self._authority.judge_request(source, now, sent)
            if verdict is not Verdict.ALLOWED:
                raise Refused(f"{what} moves the robot: {verdict.value}")
            oldest = now - came if stamp is None else offset.oldest(stamp, now)
            if oldest is None or not 0 <= oldest <= deadline * MILLI:
                self.stale += 1
                raise Refused(
                    f"{what} moves the robot: {_age(oldest)}; none older than {deadline} ms is obeyed"
                )

        judge()
        return judge


def _nothing() -> None:
    """What moves nothing may always be done."""


def _age(oldest: int | None) -> str:
    """In words, what is wrong with the age of something; the greatest it can have, nanoseconds."""
    if oldest is None:
        return "how old it is can't be told yet"
    if oldest < 0:
        return "by its stamp it comes from the future"
    return f"it may be {oldest / MILLI:.0f} ms old"
