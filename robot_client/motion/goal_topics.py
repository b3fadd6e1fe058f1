"""Topics on which a single message sends the robot off, as Nav2's ``goal_pose`` does.

What comes on them is judged like a goal or a call that moves the robot. There is nothing to stop it by on the topic
itself: an empty goal is one to the origin of the map. A stop cancels what the actions behind it pursue.

There is no stream of goals either, in which the next could stand for one that came too early: one that finds the link
not known to work both ways waits for that, as long as its age allows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

from twisted.logger import Logger

from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.authority import Authority, Verdict
from robot_client.motion.motion import MotionControl
from robot_client.motion.motion_topics import MotionPublisher
from robot_client.motion.safety import CommandAge, earliest, freshness, void_at
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import Motion, Platform, PublisherHandle
from robot_client.twisted_types import DelayedCall, ReactorClock

LOOK_EVERY = 0.01
"""Seconds between looks whether the relay has answered, for a goal that waits for that."""


class GoalMessage(NamedTuple):
    """One message that sends the robot off.

    :ivar stamp: as of :func:`robot_client.motion.safety.freshness`
    :ivar offset: of the link it came by
    :ivar by: the connection that gave it
    """

    body: bytes
    stamp: int
    offset: ClockOffset
    by: int


class GoalTopics:
    """Publishes what may be published there.

    :param patterns: of their names, with shell wildcards
    :param motion: counts what is too old or makes no sense, and has the link prove itself while goals may come; what it
        takes for its own is no goal topic
    :param clock: for what waits
    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds
    """

    def __init__(
        self,
        patterns: Sequence[str],
        platform: Platform,
        authority: Authority,
        motion: MotionControl,
        clock: ReactorClock,
        now: Callable[[], int],
    ) -> None:
        self._patterns = patterns
        self._platform = platform
        self._authority = authority
        self._motion = motion
        self._clock = clock
        self._now = now
        self._open: dict[str, MotionPublisher] = {}
        self._waiting: dict[str, DelayedCall] = {}
        self._log = Logger("goals")

    def concern(self, on: TypedTopic) -> bool:
        """Whether a topic is one; ``on`` as the platform resolved it."""
        named = any(fnmatchcase(on.topic, pattern) for pattern in self._patterns)
        return named and not self._motion.concerns(on)

    def open(self, source: str, on: TypedTopic, sink: PublisherHandle) -> None:
        """A client may publish goals now; ``source`` names the publication."""
        self._open[source] = MotionPublisher(on, sink)
        self._motion.attend(source)

    def close(self, source: str) -> None:
        """A publication ends, and its sink is closed; a goal that waits is dropped."""
        outlet = self._open.pop(source, None)
        self._motion.forget_order(source)
        if outlet is None:
            return
        self._supersede(source)
        outlet.sink.close()
        self._motion.leave(source)

    def take(self, source: str, goal: GoalMessage) -> None:
        """Publish a goal if it is allowed, fresh and sane, as soon as the link has proved itself; else count it."""
        now = self._now()
        sent = earliest(goal.stamp, now, goal.offset)
        if not self._motion.in_order(source, goal.by, goal.stamp, fresh=True):
            return
        if self._authority.judge_request(goal.by, now, sent) is Verdict.ALLOWED:
            self._judge(source, goal, sent)

    def _again(self, source: str, goal: GoalMessage, sent: int) -> None:
        """
        :param sent: before when it can't have been sent, nanoseconds: a stop since then counts though it is over
        """
        del self._waiting[source]
        if self._authority.judge_request(goal.by, self._now(), sent) is Verdict.ALLOWED:
            self._judge(source, goal, sent)

    def _judge(self, source: str, goal: GoalMessage, sent: int) -> None:
        on, sink = self._open[source]
        now, deadline = self._now(), self._motion.policy.deadline_ms
        fresh = freshness(goal.stamp, now, goal.offset, deadline) is CommandAge.FRESH
        if not fresh or self._void(goal, now, now) <= now:
            self._motion.stale_commands += 1
            self._log.info("a goal on {topic} came too late, or in vain", topic=on.topic)
            return
        if self._platform.judge(on.type, goal.body) is Motion.INVALID:
            self._motion.invalid_commands += 1
            return
        self._supersede(source)
        if self._void(goal, now, self._motion.proof()) <= now:
            self._waiting[source] = self._clock.callLater(LOOK_EVERY, self._again, source, goal, sent)
        else:
            self._publish(on, sink, goal.body)

    def _supersede(self, source: str) -> None:
        """Drop what waits."""
        timer = self._waiting.pop(source, None)
        if timer is not None:
            timer.cancel()
            self._motion.stale_commands += 1

    def _void(self, goal: GoalMessage, now: int, proof: int) -> int:
        policy = self._motion.policy
        return void_at(goal.stamp, now, goal.offset, proof, policy.deadline_ms, policy.stop_within_ms)

    def _publish(self, on: TypedTopic, sink: PublisherHandle, body: bytes) -> None:
        try:
            sink.publish(body)
        except Exception as error:
            self._log.error("could not publish on {topic}: {error}", topic=on.topic, error=str(error))
