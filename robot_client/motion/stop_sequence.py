"""How a topic comes to a standstill: by zero, said several times, at once or at the end of a ramp."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from twisted.logger import Logger

from relay_protocol.errors import Unavailable
from robot_client.motion.guard_port import GuardPort
from robot_client.motion.motion_topics import MotionTopic
from robot_client.motion.ramp import STEP, Ramp, ramp
from robot_client.motion.safety import REPEAT_EVERY, REPEATS
from robot_client.motion.typed_topic import TypedTopic
from robot_client.motion.velocity import Velocity, form
from robot_client.platforms.base import Platform
from robot_client.twisted_types import ReactorClock

NANO = 1_000_000_000


class StopSequence:
    """Says zero on topics.

    :param now: clock that goes on in suspends, nanoseconds
    :param tracks: those topics, which the owner of this keeps
    :param length: nanoseconds a ramp takes; 0: there are none
    """

    def __init__(
        self,
        platform: Platform,
        clock: ReactorClock,
        now: Callable[[], int],
        guard: GuardPort,
        tracks: Mapping[TypedTopic, MotionTopic],
        length: int,
    ) -> None:
        self.said: Callable[[TypedTopic], None] = lambda on: None
        """Called when zero was said on a topic."""
        self.slowed: Callable[[TypedTopic, Velocity], None] = lambda on, velocity: None
        """Called when a ramp said a speed on a topic."""
        self.over: Callable[[TypedTopic, bool], None] = lambda on, stopped: None
        """Called when a ramp has ended by itself, with whether it ended in zero."""
        self.rested: Callable[[TypedTopic], None] = lambda on: None
        """Called when nothing more is to be said."""
        self._platform = platform
        self._clock = clock
        self._now = now
        self._guard = guard
        self._tracks = tracks
        self._length = length
        self._log = Logger("motion")

    @property
    def ramps(self) -> bool:
        """Whether there are any."""
        return self._length > 0

    @property
    def under_way(self) -> bool:
        """Whether a ramp has not come to its end."""
        return self.ramps and any(track.ramp for track in self._tracks.values())

    def stop(self, topics: list[TypedTopic], why: str, gently: bool = False) -> list[str]:
        """Stop these; the topics on which zero could not be said.

        :param gently: by a ramp, where there are any and time is left; else at once
        """
        failed = []
        for on in topics:
            if gently and self._ease(on):
                self._log.info("bringing {topic} to a standstill: {why}", topic=on.topic, why=why)
            elif self.still(on, why):
                self._log.info("stopped {topic}: {why}", topic=on.topic, why=why)
            else:
                failed.append(on.topic)
        return failed

    def still(self, on: TypedTopic, why: str) -> bool:
        """Say zero now and several times more, whatever was under way; whether it could be said now."""
        self.repeat(on)
        return self._zero(on, why)

    def _zero(self, on: TypedTopic, why: str) -> bool:
        track = self._tracks[on]
        try:
            if track.speaker is None:
                raise Unavailable("its publisher is gone")
            track.speaker.publish(self._platform.zero(on.type, track.rest))
        except Exception as error:  # one topic that fails must not keep the next from its stop
            self._log.error(
                "could not stop {topic} ({why}): {error}", topic=on.topic, why=why, error=str(error)
            )
            return False  # the guard, not told, will try as well
        self.said(on)
        return True

    def repeat(self, on: TypedTopic) -> None:
        """Say it several times more, beginning soon; a ramp is over by that, and what fails is tried again."""
        track = self._tracks[on]
        track.settle()
        track.zeros = REPEATS - 1
        track.timer = self._clock.callLater(REPEAT_EVERY / NANO, self._say_again, on)

    def _say_again(self, on: TypedTopic) -> None:
        track = self._tracks[on]
        track.zeros -= 1
        said = self._zero(on, "once more")
        if said and not track.zeros:
            # Not before: what the guard has begun to repeat goes on until this end is done.
            self._guard.command(on, False, self._now())
        if track.zeros:
            track.timer = self._clock.callLater(REPEAT_EVERY / NANO, self._say_again, on)
        else:
            self.rested(on)

    # --- ramps ---------------------------------------------------------------------------------------------

    def _ease(self, on: TypedTopic) -> bool:
        """Begin a ramp, if there is to be one and time for it."""
        track, speeds = self._tracks[on], form(on.type, self._platform.encoding)
        last = speeds.read(track.body) if speeds is not None and track.body else None
        if last is None:
            return False
        way = ramp(last, self._now(), self._length, track.latest)
        if way is None:
            return False
        track.settle()
        track.ramp = way
        track.timer = self._clock.callLater(STEP / NANO, self._step, on, way)
        return True

    def _step(self, on: TypedTopic, way: Ramp) -> None:
        """The next command of a ramp, and zero at its end."""
        track, now = self._tracks[on], self._now()
        if self._slower(on, way, now):
            pause = min(STEP, way.until - now) / NANO
            track.timer = self._clock.callLater(pause, self._step, on, way)
            return
        self.over(on, self.still(on, "its ramp is over"))

    def _slower(self, on: TypedTopic, way: Ramp, now: int) -> bool:
        """Say the speed of this moment; whether there was one to say."""
        track, speeds, velocity = self._tracks[on], form(on.type, self._platform.encoding), way.at(now)
        if velocity is None or speeds is None or track.speaker is None:
            return False
        try:
            track.speaker.publish(speeds.write(self._platform.zero(on.type, track.rest), velocity))
        except Exception as error:  # then zero is what may still be said
            self._log.error("could not slow {topic} down: {error}", topic=on.topic, error=str(error))
            return False
        self.slowed(on, velocity)
        return True
