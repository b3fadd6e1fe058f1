"""Goal topics: topics on which a single message starts motion, as Nav2's ``goal_pose`` does.

A message on them is checked like a goal or a call that moves the robot. The topic itself has no zero: an empty goal
leads to the origin of the map. A stop cancels the goals of the actions behind the topic instead.

Unlike commands, goals are not repeated. A goal that arrives before the link has proved to work both ways therefore
waits for the proof, as long as its age allows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

from twisted.logger import Logger

from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.authority import Authority, MotionDecision
from robot_client.motion.command_age import CommandAge, earliest_sent_of, expires_at, freshness
from robot_client.motion.motion_control import MotionControl
from robot_client.motion.motion_topics import MotionPublication
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import CommandEffect, Platform, PublisherHandle
from robot_client.twisted_types import DelayedCall, ReactorClock

RETRY_EVERY = 0.01
"""Seconds between checks whether the relay has answered, while a goal waits for that."""


class GoalMessage(NamedTuple):
    """One message that starts motion.

    :ivar stamp: as of :func:`robot_client.motion.command_age.freshness`
    :ivar offset: of the link it came on
    :ivar source: the connection that sent it
    """

    body: bytes
    stamp: int
    offset: ClockOffset
    source: int


class GoalTopics:
    """Publishes goals that are allowed.

    :param patterns: of the topics' names, with shell wildcards
    :param motion: counts stale and invalid goals, and has the link probed while goals may come; its own topics are no
        goal topics
    :param clock: schedules the retries of goals that wait
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
        self._publications: dict[str, MotionPublication] = {}
        self._retry_timers: dict[str, DelayedCall] = {}
        self._ending: set[str] = set()
        """Publications that end once their goal that waits is published or dropped."""
        self._log = Logger("goals")

    def matches(self, topic: TypedTopic) -> bool:
        """Whether a topic is a goal topic; ``topic`` as the platform resolved it."""
        matches = any(fnmatchcase(topic.name, pattern) for pattern in self._patterns)
        return matches and not self._motion.policy.moves_by_topic(topic.name, topic.type)

    def open(self, publication_id: str, topic: TypedTopic, publisher: PublisherHandle) -> None:
        """Let a publication publish goals."""
        if publication_id in self._ending:
            self.close(publication_id)
        self._publications[publication_id] = MotionPublication(topic, publisher)
        self._motion.add_motion_input(publication_id)

    def end(self, publication_id: str) -> None:
        """End a publication behind its last goal: programs unadvertise at once after they have sent one."""
        if publication_id in self._retry_timers:
            self._ending.add(publication_id)
        else:
            self.close(publication_id)

    def close_ending(self, prefix: str) -> None:
        """Close the publications whose last goal still waits.

        :param prefix: of their ids
        """
        for publication_id in [each for each in self._ending if each.startswith(prefix)]:
            self.close(publication_id)

    def close(self, publication_id: str) -> None:
        """End a publication and close its publisher; a goal that waits is dropped."""
        publication = self._publications.pop(publication_id, None)
        self._ending.discard(publication_id)
        self._motion.forget_order(publication_id)
        if publication is None:
            return
        self._drop_waiting(publication_id)
        publication.publisher.close()
        self._motion.remove_motion_input(publication_id)

    def publish(self, publication_id: str, goal: GoalMessage) -> None:
        """Publish a goal if it is allowed, fresh and valid, once the link proved to work both ways; else count it."""
        now = self._now()
        earliest_sent = earliest_sent_of(goal.stamp, now, goal.offset)
        if not self._motion.in_order(publication_id, goal.source, goal.stamp, fresh=True):
            return
        if self._authority.decide_request(goal.source, now, earliest_sent) is MotionDecision.ALLOWED:
            self._publish_if_valid(publication_id, goal, earliest_sent)

    def _retry(self, publication_id: str, goal: GoalMessage, earliest_sent: int) -> None:
        """
        :param earliest_sent: nanoseconds; a stop since then refuses it, even if resumed
        """
        del self._retry_timers[publication_id]
        if self._authority.decide_request(goal.source, self._now(), earliest_sent) is MotionDecision.ALLOWED:
            self._publish_if_valid(publication_id, goal, earliest_sent)
        if publication_id in self._ending and publication_id not in self._retry_timers:
            self.close(publication_id)

    def _publish_if_valid(self, publication_id: str, goal: GoalMessage, earliest_sent: int) -> None:
        topic, publisher = self._publications[publication_id]
        now, deadline = self._now(), self._motion.policy.deadline_ms
        fresh = freshness(goal.stamp, now, goal.offset, deadline) is CommandAge.FRESH
        if not fresh or self._expiry(goal, now, now) <= now:
            self._motion.stale_commands += 1
            self._log.info(
                "a goal on {topic} was too old when it could be published; send it again", topic=topic.name
            )
            return
        if self._platform.classify_command(topic.type, goal.body) is CommandEffect.INVALID:
            self._motion.invalid_commands += 1
            return
        self._drop_waiting(publication_id)
        if self._expiry(goal, now, self._motion.link_proven_at()) <= now:
            self._retry_timers[publication_id] = self._clock.callLater(
                RETRY_EVERY, self._retry, publication_id, goal, earliest_sent
            )
        else:
            self._publish(topic, publisher, goal.body)

    def _drop_waiting(self, publication_id: str) -> None:
        """Drop a goal that waits, and count it as stale."""
        timer = self._retry_timers.pop(publication_id, None)
        if timer is not None:
            timer.cancel()
            self._motion.stale_commands += 1

    def _expiry(self, goal: GoalMessage, now: int, link_proven_at: int) -> int:
        policy = self._motion.policy
        return expires_at(
            goal.stamp, now, goal.offset, link_proven_at, policy.deadline_ms, policy.stop_within_ms
        )

    def _publish(self, topic: TypedTopic, publisher: PublisherHandle, body: bytes) -> None:
        try:
            publisher.publish(body)
        except Exception as error:
            self._log.error("could not publish on {topic}: {error}", topic=topic.name, error=str(error))
