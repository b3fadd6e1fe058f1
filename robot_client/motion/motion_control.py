"""Publishes commands on the topics that move the robot, and stops topics whose commands have ended.

Each command is checked before it is published:

1. no newer one has come from its connection,
2. its source may move the robot (:mod:`robot_client.motion.authority`),
3. it is not too old.

A command other than zero also needs:

4. a link that is known to work both ways (:func:`robot_client.motion.command_age.expires_at`),
5. a speed that can be read, where speeds are limited,
6. a guard that is ready, and valid content.

Then it is slowed to the limits.
"""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol.errors import Refused, Unavailable
from relay_protocol.link import MotionPolicy, QoS
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.authority import STREAMS, Authority, MotionDecision
from robot_client.motion.command_age import MILLI, CommandAge, earliest_sent_of, expires_at, freshness
from robot_client.motion.guard_port import GuardPort
from robot_client.motion.motion_topics import MotionPublication, MotionTopic, MotionTopics
from robot_client.motion.rules import MotionRules
from robot_client.motion.speed_limiter import SpeedLimiter, unreadable
from robot_client.motion.topic_stopper import TopicStopper
from robot_client.motion.typed_topic import TypedTopic
from robot_client.motion.watchdog import DAEMON_SHARE, CommandTimes, Watchdog
from robot_client.platforms.base import CommandEffect, Platform, PublisherHandle
from robot_client.twisted_types import DelayedCall, ReactorClock

NANO = 1_000_000_000
MAX_ZERO_TEMPLATE = 4096
"""Most bytes of a zero template, see ``Platform.zero_template``: for example a joystick's axes or an arm's joints."""
IDLE_TOPIC_SECONDS = 30.0
"""Seconds the guard keeps its publisher after the last client left, so that a client that returns need not wait."""

MOTION_QOS = QoS(history="keep_last", depth=1, reliability="reliable", durability="volatile")
"""Reliable, and only the newest: a slow or late subscriber never receives an old command."""


class MotionControl:
    """Publishes motion commands that are allowed, and stops topics whose commands have ended.

    :param now: nanoseconds of a clock that counts time suspended
    :param clock: schedules the watchdog
    :param guard: is notified of every command, and stops the robot when the daemon can't
    :param authority: decides which connections may move the robot
    :param rules: limits, ramps and times of single topics; default: none
    """

    def __init__(
        self,
        policy: MotionPolicy,
        platform: Platform,
        clock: ReactorClock,
        now: Callable[[], int],
        guard: GuardPort,
        authority: Authority,
        rules: MotionRules | None = None,
    ) -> None:
        self.policy = policy
        self.moving = False
        """Whether commands keep the robot moving."""
        self.on_moving: Callable[[], None] = lambda: None
        """Called when :attr:`moving` changes."""
        self.on_motion_inputs_changed: Callable[[bool], None] = lambda any_left: None
        """Called with whether there is an input that may move the robot, when that may have changed."""
        self.on_unreadable: Callable[[TypedTopic, str], None] = lambda topic, level: None
        """Called with a topic and a level whose command was refused because its speed can't be read."""
        self.link_proven_at: Callable[[], int] = now
        """Returns when the latest ping that the relay has answered was sent, nanoseconds of ``now``."""
        self.stale_commands = 0
        self._newest_stamps: dict[str, dict[int, int]] = {}
        """By publication and connection, stamp of the newest fresh command; the latest sender is last."""
        self.invalid_commands = 0
        self.watchdog_stops = 0
        self.unguarded_commands = 0
        self._platform = platform
        self._clock = clock
        self._now = now
        self._guard = guard
        self._authority = authority
        self._rules = rules or MotionRules()
        self._speed_limiter = SpeedLimiter(self._rules.limits, platform.encoding, self._rules.unlimited)
        self._watchdog = Watchdog(policy.stop_within_ms, DAEMON_SHARE, self._rules.ramp_ms)
        for name, times in self._rules.topics.items():
            self._watchdog.set_time_to_stop(name, times.stop_within_ms)
        self._publications: dict[str, MotionPublication] = {}
        self._motion_inputs: set[str] = set()
        self._topics = MotionTopics(guard, self._watchdog.moves)
        self._topics.on_forgotten = self._speed_limiter.forget
        self._stopper = self._build_stopper(self._rules.ramp_ms * MILLI)
        self._timer: DelayedCall | None = None
        self._zero_waiters: list[Deferred[None]] = []
        self._ramp_waiters: list[Deferred[list[str]]] = []
        self._failed_ramps: list[str] = []
        """Topics whose ramp could not end in zero, since the waiters of ramps were last notified."""
        self._log = Logger("motion")

    @property
    def limited_commands(self) -> int:
        """Number of commands that were slowed to the limits."""
        return self._speed_limiter.limited

    def open(self, publication_id: str, topic: TypedTopic, publisher: PublisherHandle) -> None:
        """Let a publication command a topic.

        Another topic may evict it from the guarded topics later; the next command adds it again.

        :param publication_id: id of the publication
        :param topic: as the platform resolved it
        :raises Unavailable: too many topics move
        :raises Refused: speed is limited at every level, and that of the topic's commands can't be read
        """
        if self._speed_limiter.refuses_every_level(topic):
            raise Refused(unreadable(topic))
        state = self._acquire_topic(topic)
        if state.is_idle:
            state.cancel_timers()
        state.publication_ids.add(publication_id)
        self._publications[publication_id] = MotionPublication(topic, publisher)
        self.add_motion_input(publication_id)

    def add_motion_input(self, name: str) -> None:
        """Note an input that may move the robot: a publication, or goals under way.

        :param name: names the input
        """
        self._motion_inputs.add(name)
        self.on_motion_inputs_changed(True)

    def remove_motion_input(self, name: str) -> None:
        """Undo :meth:`add_motion_input`."""
        self._motion_inputs.discard(name)
        if not self._motion_inputs:
            self.on_motion_inputs_changed(False)

    @property
    def is_still(self) -> bool:
        """Whether no topic moves the robot or is being stopped."""
        return not any(
            self._watchdog.moves(topic) or state.is_stopping for topic, state in self._topics.items()
        )

    def may_be_commanded(self, topic: str) -> bool:
        """Whether a client's publication may command a topic."""
        return any(each.topic.name == topic for each in self._publications.values())

    def refuse_sample(self) -> None:
        """Count a message to a motion topic that names no connection; such a message is never published."""
        self._authority.refused += 1

    def command(self, publication_id: str, body: bytes, stamp: int, offset: ClockOffset, source: int) -> bool:
        """Publish one command if it is allowed, fresh and valid; return whether it was published.

        :param publication_id: id of the publication it came on
        :param stamp: as of :func:`robot_client.motion.command_age.freshness`
        :param offset: of the link it came on
        :param source: the connection that sent it
        """
        topic = self._publications[publication_id].topic
        now = self._now()
        fresh = freshness(stamp, now, offset, self._times(topic).deadline_ms) is CommandAge.FRESH
        if not self.in_order(publication_id, source, stamp, fresh):
            return False
        effect = self._platform.classify_command(topic.type, body)
        # A zero that is too old does not show what its source commands now. It is judged as one that moves, so that it
        # releases nothing.
        moving = effect is not CommandEffect.STILL or not fresh
        earliest_sent = earliest_sent_of(stamp, now, offset)
        if (
            self._authority.decide(source, topic.name, moving, now, earliest_sent)
            is not MotionDecision.ALLOWED
        ):
            return False
        if not fresh:
            self.stale_commands += 1
            return False
        expiry = self._expiry(topic, stamp, now, offset)
        guarded = self._ensure_guarded(topic, now)
        if effect is CommandEffect.STILL and guarded:
            self._publish_zero(publication_id, body, now)
        elif effect is CommandEffect.STILL:
            self._publications[publication_id].publisher.publish(body)
        elif expiry <= now:
            self.stale_commands += 1
            return False
        elif effect is CommandEffect.MOVING and not self._speed_limiter.allows(
            topic, self._authority.level_of(source)
        ):
            self._authority.refused += 1
            self.on_unreadable(topic, self._authority.level_of(source))
            return False
        elif effect is CommandEffect.MOVING and not (guarded and self._guard.ready(topic)):
            self._count_unguarded(topic)
            return False
        else:
            limited = None if effect is CommandEffect.INVALID else self._limit_speed(topic, body, source, now)
            if limited is None:
                self.invalid_commands += 1
                return False
            self._topics[topic].moved_by = source
            self._publish_motion(publication_id, limited, now, expiry)
        self._schedule()
        return True

    def close(self, publication_id: str) -> None:
        """End a publication: a topic it left moving is stopped, and its publisher closes after the last zero."""
        publication = self._publications.pop(publication_id, None)
        self.forget_order(publication_id)
        if publication is None:
            return
        self.remove_motion_input(publication_id)
        state = self._topics.get(publication.topic)
        if state is None:
            publication.publisher.close()
            return
        state.publication_ids.discard(publication_id)
        state.ended_publishers.append(publication.publisher)
        if self._watchdog.remove_publication(publication.topic, publication_id):
            self._stopper.stop([publication.topic], "its publication has ended", gently=True)
        if not state.is_stopping:
            self._close_ended_publishers(publication.topic)
        self._schedule()

    def stop_moving_topics(self, why: str, gently: bool = False) -> list[str]:
        """Stop every topic that moves; return the names of topics on which zero could not be published.

        :param gently: by a ramp, where ramps are configured; else at once
        """
        failed = self._stopper.stop(self._watchdog.take_all(), why, gently)
        self._schedule()
        return failed

    def ramps_ended(self) -> Deferred[list[str]]:
        """Fires when no ramp is under way, with the topics whose ramp could not end in zero."""
        done: Deferred[list[str]] = Deferred()
        self._ramp_waiters.append(done)
        self._notify_waiters()
        return done

    def zero_commanded_topics(self, why: str) -> list[str]:
        """Publish zero on every topic that clients may command, moving or not; return those on which that failed."""
        moving = set(self._watchdog.take_all())
        failed = []
        for topic, state in self._topics.items():
            if topic not in moving and not state.publication_ids and state.ramp is None:
                continue
            if state.last_publisher is None:
                state.last_publisher = next(
                    (each.publisher for each in self._publications.values() if each.topic == topic), None
                )
            if not self._stopper.stop_at_once(topic, why):
                failed.append(topic.name)
        self._log.info("stopped all topics: {why}", why=why)
        self._notify_waiters()
        self._schedule()
        return failed

    def stop_unless_allowed(self, name: str, why: str) -> None:
        """Stop a topic if the connection that moves it may no longer command it, as another has acquired it.

        :param name: of the topic, as the platform resolved it
        """
        now = self._now()
        topics = [
            topic
            for topic, state in self._topics.items()
            if topic.name == name
            and (self._watchdog.moves(topic) or state.ramp is not None)
            and not self._authority.may_command(state.moved_by, name, now)
        ]
        for topic in topics:
            self._watchdog.note_command(topic, "", False, now)
        self._stopper.stop(topics, why)
        self._notify_waiters()
        self._schedule()

    def all_zeros_published(self) -> Deferred[None]:
        """Fires when no ramp is under way and every zero has been published."""
        done: Deferred[None] = Deferred()
        self._zero_waiters.append(done)
        self._notify_waiters()
        return done

    def in_order(self, publication_id: str, source: int, stamp: int, fresh: bool) -> bool:
        """Whether this connection has sent no newer command on this publication; else the command counts as stale.

        :param stamp: of the command, the relay's monotonic nanoseconds
        :param fresh: whether later commands are compared with it; a stamp from the future would refuse them all
        """
        stamps = self._newest_stamps.setdefault(publication_id, {})
        newest = stamps.get(source, stamp)
        if fresh:
            stamps.pop(source, None)
            stamps[source] = max(newest, stamp)
            if len(stamps) > STREAMS:
                del stamps[next(iter(stamps))]
        if stamp < newest:
            self.stale_commands += 1
        return stamp >= newest

    def forget_order(self, publication_id: str) -> None:
        """Undo what :meth:`in_order` keeps of a publication."""
        self._newest_stamps.pop(publication_id, None)

    # --- one command ---------------------------------------------------------------------------------------

    def _acquire_topic(self, topic: TypedTopic) -> MotionTopic:
        return self._topics.acquire(
            topic, (id for id, each in self._publications.items() if each.topic == topic)
        )

    def _ensure_guarded(self, topic: TypedTopic, now: int) -> bool:
        """Add a topic to the guarded ones, and note that an allowed connection commands it; false: too many move."""
        try:
            self._acquire_topic(topic).used_at = now
        except Unavailable:
            return False
        return True

    def _times(self, topic: TypedTopic) -> CommandTimes:
        own = self._rules.topics.get(topic.name)
        return CommandTimes(self.policy.stop_within_ms, self.policy.deadline_ms) if own is None else own

    def _limit_speed(self, topic: TypedTopic, body: bytes, source: int, now: int) -> bytes | None:
        """Return the command within the limits, its zero template noted; ``None`` where it must not be published."""
        zero_template = self._platform.zero_template(topic.type, body)
        if len(zero_template) > MAX_ZERO_TEMPLATE:
            return None
        limited = self._speed_limiter.limit(topic, body, self._authority.level_of(source), now)
        state = self._topics[topic]
        if limited is not None and zero_template != state.zero_template:
            state.zero_template = zero_template
            self._guard.set_zero_template(topic, zero_template)
        return limited

    def _expiry(self, topic: TypedTopic, stamp: int, now: int, offset: ClockOffset) -> int:
        stop_within, deadline = self._times(topic)
        return expires_at(stamp, now, offset, self.link_proven_at(), deadline, stop_within)

    def _publish_motion(self, publication_id: str, body: bytes, now: int, expiry: int) -> None:
        topic, publisher = self._publications[publication_id]
        # The guard is notified of a movement before it begins, and of a stop after it was sent.
        self._guard.note_command(topic, True, now)
        publisher.publish(body)
        self._watchdog.note_command(topic, publication_id, True, now, expiry)
        state = self._topics[topic]
        state.last_publisher = publisher
        state.latest_stop = min(expiry, self._watchdog.latest_stop(topic, now))
        state.last_command = body if self._stopper.has_ramps else b""
        if state.is_stopping:
            state.cancel_timers()
            self._close_ended_publishers(topic)

    def _publish_zero(self, publication_id: str, body: bytes, now: int) -> None:
        topic, publisher = self._publications[publication_id]
        state = self._topics[topic]
        was_moving = self._watchdog.moves(topic) or state.ramp is not None
        self._watchdog.note_command(topic, publication_id, False, now)
        state.last_publisher = publisher
        if was_moving:
            self._stopper.repeat(topic)  # before publishing: if that fails, the repetition tries again
            self._schedule()
        publisher.publish(body)
        self._speed_limiter.zero_published(topic, now)
        if was_moving:
            self._notify_waiters()
        elif not state.zeros_left:
            self._guard.note_command(topic, False, now)

    def _count_unguarded(self, topic: TypedTopic) -> None:
        if not self.unguarded_commands:
            self._log.info(
                "commands to {topic} wait for the motion guard to be able to stop them", topic=str(topic)
            )
        self.unguarded_commands += 1

    # --- stopping ------------------------------------------------------------------------------------------

    def _expire(self) -> None:
        self._timer = None
        topics = self._watchdog.take_expired(self._now())
        self.watchdog_stops += len(topics)
        self._stopper.stop(topics, "no fresh command came", gently=True)
        self._schedule()

    def _build_stopper(self, ramp: int) -> TopicStopper:
        stopper = TopicStopper(self._platform, self._clock, self._now, self._guard, self._topics, ramp)
        stopper.on_zero_published = lambda topic: self._speed_limiter.zero_published(topic, self._now())
        stopper.on_slowed = lambda topic, velocity: self._speed_limiter.slowed(topic, velocity, self._now())
        stopper.on_ramp_ended = self._ramp_ended
        stopper.on_stopped = self._close_ended_publishers
        return stopper

    def _ramp_ended(self, topic: TypedTopic, stopped: bool) -> None:
        if not stopped:
            self._failed_ramps.append(topic.name)
        self._notify_waiters()
        self._schedule()

    # --- after the last zero ------------------------------------------------------------------------------------

    def _close_ended_publishers(self, topic: TypedTopic) -> None:
        """No zero is pending: close the publishers of publications that have ended."""
        state = self._topics[topic]
        ended, state.ended_publishers = state.ended_publishers, []
        for publisher in ended:
            if publisher is state.last_publisher:
                state.last_publisher = None
            publisher.close()
        if state.is_idle:
            state.cancel_timers()
            state.timer = self._clock.callLater(IDLE_TOPIC_SECONDS, self._topics.forget, topic)
        self._notify_waiters()

    def _notify_waiters(self) -> None:
        if self._stopper.under_way:
            return
        ramp_waiters, self._ramp_waiters = self._ramp_waiters, []
        failed, self._failed_ramps = self._failed_ramps, []
        for each in ramp_waiters:
            each.callback(failed)
        if any(state.zeros_left for state in self._topics.values()):
            return
        zero_waiters, self._zero_waiters = self._zero_waiters, []
        for done in zero_waiters:
            done.callback(None)

    def _schedule(self) -> None:
        due = self._watchdog.due()
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None
        if due is not None:
            self._timer = self._clock.callLater(max(0.0, (due - self._now()) / NANO), self._expire)
        moving = due is not None or self._stopper.under_way
        if self.moving != moving:
            self.moving = moving
            self.on_moving()
