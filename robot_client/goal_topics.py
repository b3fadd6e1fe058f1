"""Topics on which a single message sends the robot off, as Nav2's ``goal_pose`` does.

What comes on them is judged like a goal or a call that moves the robot. There is nothing to stop it by on the topic
itself: an empty goal is one to the origin of the map. A stop cancels what the actions behind it pursue.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase

from robot_client.authority import Authority, Verdict
from robot_client.motion import MotionDesk
from robot_client.offset import Offset
from robot_client.platforms.base import Motion, Platform
from robot_client.safety import Freshness, freshness, void_at
from robot_client.topics import TypedTopic


class GoalTopics:
    """Judges what is published there.

    :param patterns: of their names, with shell wildcards
    :param motion: counts what is too old or makes no sense; what it takes for its own is no goal topic
    :param now: clock of :mod:`robot_client.clocks`, nanoseconds
    """

    def __init__(
        self,
        patterns: Sequence[str],
        platform: Platform,
        authority: Authority,
        motion: MotionDesk,
        now: Callable[[], int],
    ) -> None:
        self._patterns = patterns
        self._platform = platform
        self._authority = authority
        self._motion = motion
        self._now = now

    def concern(self, on: TypedTopic) -> bool:
        """Whether a topic is one; ``on`` as the platform resolved it."""
        named = any(fnmatchcase(on.topic, pattern) for pattern in self._patterns)
        return named and not self._motion.concerns(on)

    def allow(self, on: TypedTopic, body: bytes, stamp: int, offset: Offset, by: int) -> bool:
        """Whether a message may be published; one that may not is counted.

        :param stamp: as of :func:`robot_client.safety.freshness`
        :param offset: of the link it came by
        :param by: the connection that gave it
        """
        if self._authority.judge_request(by) is not Verdict.ALLOWED:
            return False
        policy, now = self._motion.policy, self._now()
        deadline, within = policy.deadline_ms, policy.stop_within_ms
        if (
            freshness(stamp, now, offset, deadline) is not Freshness.FRESH
            or void_at(stamp, now, offset, self._motion.proof(), deadline, within) <= now
        ):
            self._motion.stale_commands += 1
            return False
        if self._platform.judge(on.type, body) is Motion.INVALID:
            self._motion.invalid_commands += 1
            return False
        return True
