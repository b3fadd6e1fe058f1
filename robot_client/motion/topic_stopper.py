"""Stops a topic that clients command: publishes zero several times, at once or at the end of a ramp.

:mod:`robot_client.motion.motion_control` decides when. The guard does the same when the daemon can't
(:mod:`robot_client.motion.guard`). Topics that other nodes command get zeros from
:mod:`robot_client.motion.graph_zero_publisher`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from twisted.logger import Logger

from relay_protocol.errors import Unavailable
from robot_client.motion.guard_port import GuardPort
from robot_client.motion.motion_topics import MotionTopic
from robot_client.motion.ramp import STEP, Ramp, ramp
from robot_client.motion.typed_topic import TypedTopic
from robot_client.motion.velocity import Velocity, velocity_access
from robot_client.motion.watchdog import STOP_ZERO_EVERY, STOP_ZEROS
from robot_client.platforms.base import Platform
from robot_client.twisted_types import ReactorClock

NANO = 1_000_000_000


class TopicStopper:
    """Publishes zeros and ramps on topics that clients command and that are to stop.

    :param now: nanoseconds of a clock that counts time suspended
    :param guard: notified when a topic is stopped
    :param topics: the motion topics; the caller owns and changes them
    :param ramp_length: nanoseconds a ramp takes; 0: no ramps
    """

    def __init__(
        self,
        platform: Platform,
        clock: ReactorClock,
        now: Callable[[], int],
        guard: GuardPort,
        topics: Mapping[TypedTopic, MotionTopic],
        ramp_length: int,
    ) -> None:
        self.on_zero_published: Callable[[TypedTopic], None] = lambda topic: None
        """Called when zero was published on a topic."""
        self.on_slowed: Callable[[TypedTopic, Velocity], None] = lambda topic, velocity: None
        """Called when a ramp published a speed on a topic."""
        self.on_ramp_ended: Callable[[TypedTopic, bool], None] = lambda topic, stopped: None
        """Called when a ramp has run to its end, with whether zero was published then."""
        self.on_stopped: Callable[[TypedTopic], None] = lambda topic: None
        """Called when the last zero of a topic was published."""
        self._platform = platform
        self._clock = clock
        self._now = now
        self._guard = guard
        self._topics = topics
        self._ramp_length = ramp_length
        self._log = Logger("motion")

    @property
    def has_ramps(self) -> bool:
        """Whether ramps are configured."""
        return self._ramp_length > 0

    @property
    def under_way(self) -> bool:
        """Whether a ramp is under way."""
        return self.has_ramps and any(state.ramp for state in self._topics.values())

    def stop(self, topics: list[TypedTopic], why: str, gently: bool = False) -> list[str]:
        """Stop these topics; return those on which zero could not be published.

        :param why: reason for the log
        :param gently: by a ramp, where ramps are configured and time is left; else at once
        """
        failed = []
        for topic in topics:
            if gently and self._begin_ramp(topic):
                self._log.info("bringing {topic} to a standstill: {why}", topic=topic.name, why=why)
            elif self.stop_at_once(topic, why):
                self._log.info("stopped {topic}: {why}", topic=topic.name, why=why)
            else:
                failed.append(topic.name)
        return failed

    def stop_at_once(self, topic: TypedTopic, why: str) -> bool:
        """Publish zero now, and repeat it; ends a ramp. Return whether it could be published now."""
        self.repeat(topic)
        return self._publish_zero(topic, why)

    def _publish_zero(self, topic: TypedTopic, why: str) -> bool:
        state = self._topics[topic]
        try:
            if state.last_publisher is None:
                raise Unavailable("its publisher is gone")
            state.last_publisher.publish(self._platform.zero_command(topic.type, state.zero_template))
        except Exception as error:  # a failure on one topic must not prevent the stop of the next
            self._log.error(
                "could not stop {topic} ({why}): {error}", topic=topic.name, why=why, error=str(error)
            )
            return False  # the guard was not notified of a stop, so it will try too
        self.on_zero_published(topic)
        return True

    def repeat(self, topic: TypedTopic) -> None:
        """Schedule the repetitions of zero; ends a ramp. A failed repetition does not end the others."""
        state = self._topics[topic]
        state.cancel_timers()
        state.zeros_left = STOP_ZEROS - 1
        state.timer = self._clock.callLater(STOP_ZERO_EVERY / NANO, self._repeat_zero, topic)

    def _repeat_zero(self, topic: TypedTopic) -> None:
        state = self._topics[topic]
        state.zeros_left -= 1
        published = self._publish_zero(topic, "once more")
        if published and not state.zeros_left:
            # Only now: a command line makes the guard end repetitions of its own.
            self._guard.note_command(topic, False, self._now())
        if state.zeros_left:
            state.timer = self._clock.callLater(STOP_ZERO_EVERY / NANO, self._repeat_zero, topic)
        else:
            self.on_stopped(topic)

    # --- ramps ---------------------------------------------------------------------------------------------

    def _begin_ramp(self, topic: TypedTopic) -> bool:
        """Begin a ramp; false where ramps are off, no time is left or the speed is unknown."""
        state, speeds = self._topics[topic], velocity_access(topic.type, self._platform.encoding)
        last = speeds.read(state.last_command) if speeds is not None and state.last_command else None
        if last is None:
            return False
        slope = ramp(last, self._now(), self._ramp_length, state.latest_stop)
        if slope is None:
            return False
        state.cancel_timers()
        state.ramp = slope
        state.timer = self._clock.callLater(STEP / NANO, self._step, topic, slope)
        return True

    def _step(self, topic: TypedTopic, slope: Ramp) -> None:
        """Publish the next command of a ramp, or zero at its end."""
        state, now = self._topics[topic], self._now()
        if self._publish_ramp(topic, slope, now):
            pause = min(STEP, slope.until - now) / NANO
            state.timer = self._clock.callLater(pause, self._step, topic, slope)
            return
        self.on_ramp_ended(topic, self.stop_at_once(topic, "its ramp is over"))

    def _publish_ramp(self, topic: TypedTopic, slope: Ramp, now: int) -> bool:
        """Publish the ramp's speed at this moment; false where it is over or that failed."""
        state, velocity = self._topics[topic], slope.at(now)
        speeds = velocity_access(topic.type, self._platform.encoding)
        if velocity is None or speeds is None or state.last_publisher is None:
            return False
        try:
            state.last_publisher.publish(
                speeds.write(self._platform.zero_command(topic.type, state.zero_template), velocity)
            )
        except Exception as error:  # zero is published instead
            self._log.error("could not slow {topic} down: {error}", topic=topic.name, error=str(error))
            return False
        self.on_slowed(topic, velocity)
        return True
