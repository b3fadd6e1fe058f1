"""The motion topics of one daemon: every command judged, every silence answered with zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol.errors import Unavailable
from relay_protocol.link import MotionPolicy, QoS
from robot_client.offset import Offset
from robot_client.platforms.base import Motion, Platform, Sink
from robot_client.reactors import Clock, Timer
from robot_client.safety import (
    DAEMON_SHARE,
    REPEAT_EVERY,
    REPEATS,
    Freshness,
    Watchdog,
    freshness,
    is_motion,
)
from robot_client.topics import TypedTopic

NANO = 1_000_000_000
MAX_TOPICS = 64
KEPT = 30.0
"""Seconds the guard keeps its publisher after the last client left: whoever comes back need not wait for it."""

MOTION_QOS = QoS(history="keep_last", depth=1, reliability="reliable", durability="volatile")
"""How motion is published: nothing old is kept for a slow or late subscriber, nothing is left to chance."""


class GuardFeed(Protocol):
    """Who is told of every motion command, to act when the daemon can't."""

    def topic(self, on: TypedTopic) -> None:
        """Commands may come on this topic."""

    def forget(self, on: TypedTopic) -> None:
        """No more commands will come on this topic."""

    def command(self, on: TypedTopic, moving: bool, at: int) -> None:
        """A command went out; ``at`` is the clock in nanoseconds."""

    def ready(self, on: TypedTopic) -> bool:
        """Whether it could stop this topic now."""


class NoGuard:
    """Nobody is told, by choice: motion does not wait for a guard."""

    def topic(self, on: TypedTopic) -> None:
        """Pass over."""

    def forget(self, on: TypedTopic) -> None:
        """Pass over."""

    def command(self, on: TypedTopic, moving: bool, at: int) -> None:
        """Pass over."""

    def ready(self, on: TypedTopic) -> bool:
        """Nothing to wait for."""
        return True


class _Outlet(NamedTuple):
    on: TypedTopic
    sink: Sink


class _Track:
    """One motion topic.

    :attr sources: publications that may command it
    :attr leaving: sinks to close when the last zero is said
    :attr speaker: sink of the last command; what it says arrives after that command, what another says may not
    :attr zeros: how often zero is still to be said
    :attr timer: for the next zero; without sources and zeros, for being forgotten
    """

    def __init__(self) -> None:
        self.sources: set[str] = set()
        self.leaving: list[Sink] = []
        self.speaker: Sink | None = None
        self.zeros = 0
        self.timer: Timer | None = None

    @property
    def idle(self) -> bool:
        """Whether nobody needs it."""
        return not self.sources and not self.zeros

    def rest(self) -> None:
        """Nothing is to come."""
        self.zeros = 0
        if self.timer is not None and self.timer.active():
            self.timer.cancel()
        self.timer = None


class MotionDesk:
    """Passes motion commands on, or not, and stops what is left moving.

    :param now: clock that goes on in suspends, nanoseconds
    :param clock: schedules the watchdog
    """

    def __init__(
        self,
        policy: MotionPolicy,
        platform: Platform,
        clock: Clock,
        now: Callable[[], int],
        guard: GuardFeed,
    ) -> None:
        self.policy = policy
        self.stale_commands = 0
        self.invalid_commands = 0
        self.watchdog_stops = 0
        self.unguarded_commands = 0
        self._platform = platform
        self._clock = clock
        self._now = now
        self._guard = guard
        self._watchdog = Watchdog(policy.stop_within_ms, DAEMON_SHARE)
        self._outlets: dict[str, _Outlet] = {}
        self._tracks: dict[TypedTopic, _Track] = {}
        self._timer: Timer | None = None
        self._finishing: list[Deferred[None]] = []
        self._log = Logger("motion")

    def concerns(self, on: TypedTopic) -> bool:
        """Whether commands on this topic move the robot; ``on`` as the platform resolved it."""
        return is_motion(self.policy, on)

    def open(self, source: str, on: TypedTopic, sink: Sink) -> None:
        """A client may command a topic now; ``source`` names the publication.

        :raises Unavailable: too many topics are commanded
        """
        for other, track in list(self._tracks.items()):
            if other.topic == on.topic and other.type != on.type and track.idle:
                self._forget(other)  # some middleware allows one type of a topic in a process
        if on not in self._tracks:
            self._make_room()
            self._tracks[on] = _Track()
        track = self._tracks[on]
        if track.idle:
            track.rest()
        track.sources.add(source)
        self._outlets[source] = _Outlet(on, sink)
        self._guard.topic(on)

    def command(self, source: str, body: bytes, stamp: int, offset: Offset) -> bool:
        """Publish one command if it is fresh and sane; whether it was."""
        on = self._outlets[source].on
        now = self._now()
        if freshness(stamp, now, offset, self.policy.deadline_ms) is not Freshness.FRESH:
            self.stale_commands += 1
            return False
        verdict = self._platform.judge(on.type, body)
        if verdict is Motion.INVALID:
            self.invalid_commands += 1
            return False
        if verdict is Motion.STILL:
            self._stand(source, body, now)
        elif self._guard.ready(on):
            self._move(source, body, now)
        else:
            self._hold_back(on)
            return False
        self._schedule()
        return True

    def close(self, source: str) -> None:
        """A publication ends; what it left moving is stopped, and its sink closed when that is said."""
        outlet = self._outlets.pop(source, None)
        if outlet is None:
            return
        track = self._tracks[outlet.on]
        track.sources.discard(source)
        track.leaving.append(outlet.sink)
        if self._watchdog.release(outlet.on, source):
            self._stop([outlet.on], "its publisher left")
        if not track.zeros:
            self._settle(outlet.on)
        self._schedule()

    def stop_all(self, why: str) -> None:
        """Zero on everything that moves, at once."""
        self._stop(self._watchdog.everything(), why)
        self._schedule()

    def finish(self) -> Deferred[None]:
        """Fires when every zero is said."""
        done: Deferred[None] = Deferred()
        self._finishing.append(done)
        self._tell_finished()
        return done

    # --- one command ---------------------------------------------------------------------------------------

    def _move(self, source: str, body: bytes, now: int) -> None:
        on, sink = self._outlets[source]
        # The guard hears of a movement before it begins, and of a stop after it was sent.
        self._guard.command(on, True, now)
        sink.publish(body)
        self._watchdog.command(on, source, True, now)
        track = self._tracks[on]
        track.speaker = sink
        if track.zeros:
            track.rest()
            self._settle(on)

    def _stand(self, source: str, body: bytes, now: int) -> None:
        on, sink = self._outlets[source]
        sink.publish(body)
        moved = self._watchdog.moves(on)
        self._watchdog.command(on, source, False, now)
        track = self._tracks[on]
        track.speaker = sink
        if moved:
            self._repeat(on)
        elif not track.zeros:
            self._guard.command(on, False, now)

    def _hold_back(self, on: TypedTopic) -> None:
        if not self.unguarded_commands:
            self._log.info("commands to {on} wait for the motion guard to be able to stop them", on=str(on))
        self.unguarded_commands += 1

    # --- stopping ------------------------------------------------------------------------------------------

    def _expire(self) -> None:
        self._timer = None
        topics = self._watchdog.expired(self._now())
        self.watchdog_stops += len(topics)
        self._stop(topics, "no fresh command came")
        self._schedule()

    def _stop(self, topics: list[TypedTopic], why: str) -> None:
        for on in topics:
            if self._zero(on, why):
                self._log.info("stopped {topic}: {why}", topic=on.topic, why=why)
                self._repeat(on)

    def _zero(self, on: TypedTopic, why: str) -> bool:
        speaker = self._tracks[on].speaker
        try:
            if speaker is None:
                raise Unavailable("its publisher is gone")
            speaker.publish(self._platform.zero(on.type))
        except Exception as error:  # one topic that fails must not keep the next from its stop
            self._log.error(
                "could not stop {topic} ({why}): {error}", topic=on.topic, why=why, error=str(error)
            )
            return False  # the guard, not told, will try
        return True

    def _repeat(self, on: TypedTopic) -> None:
        track = self._tracks[on]
        track.rest()
        track.zeros = REPEATS - 1
        track.timer = self._clock.callLater(REPEAT_EVERY / NANO, self._say_again, on)

    def _say_again(self, on: TypedTopic) -> None:
        track = self._tracks[on]
        track.zeros -= 1
        if not self._zero(on, "once more"):
            track.zeros = 0
        elif not track.zeros:
            # Not before: what the guard has begun to repeat goes on until this end is done.
            self._guard.command(on, False, self._now())
        if track.zeros:
            track.timer = self._clock.callLater(REPEAT_EVERY / NANO, self._say_again, on)
        else:
            self._settle(on)

    # --- coming to rest ------------------------------------------------------------------------------------

    def _settle(self, on: TypedTopic) -> None:
        """No zero is to come: let go who left."""
        track = self._tracks[on]
        leaving, track.leaving = track.leaving, []
        for sink in leaving:
            if sink is track.speaker:
                track.speaker = None
            sink.close()
        if track.idle:
            track.rest()
            track.timer = self._clock.callLater(KEPT, self._forget, on)
        self._tell_finished()

    def _forget(self, on: TypedTopic) -> None:
        self._tracks.pop(on).rest()
        self._guard.forget(on)

    def _make_room(self) -> None:
        if len(self._tracks) < MAX_TOPICS:
            return
        idle = next((on for on, track in self._tracks.items() if track.idle), None)
        if idle is None:
            raise Unavailable(f"{MAX_TOPICS} topics that move the robot are in use; unadvertise one first")
        self._forget(idle)

    def _tell_finished(self) -> None:
        if any(track.zeros for track in self._tracks.values()):
            return
        finishing, self._finishing = self._finishing, []
        for done in finishing:
            done.callback(None)

    def _schedule(self) -> None:
        due = self._watchdog.due()
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None
        if due is not None:
            self._timer = self._clock.callLater(max(0.0, (due - self._now()) / NANO), self._expire)
