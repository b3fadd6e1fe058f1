"""The motion topics of one daemon: every command judged, every silence answered with zero."""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol.errors import Refused, Unavailable
from relay_protocol.link import MotionPolicy, QoS
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.authority import GRIPS, Authority, Verdict
from robot_client.motion.governor import Governor, unreadable
from robot_client.motion.guard_port import GuardPort
from robot_client.motion.motion_topics import MotionPublisher, MotionTopic, MotionTopics
from robot_client.motion.rules import MotionRules
from robot_client.motion.safety import (
    DAEMON_SHARE,
    MILLI,
    CommandAge,
    Times,
    Watchdog,
    earliest,
    freshness,
    is_motion,
    void_at,
)
from robot_client.motion.stop_sequence import StopSequence
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import Motion, Platform, PublisherHandle
from robot_client.twisted_types import DelayedCall, ReactorClock

NANO = 1_000_000_000
MAX_SHAPE = 4096
"""Bytes that may be needed to know what zero looks like: of a joystick's axes, of an arm's joints."""
KEPT = 30.0
"""Seconds the guard keeps its publisher after the last client left: whoever comes back need not wait for it."""

MOTION_QOS = QoS(history="keep_last", depth=1, reliability="reliable", durability="volatile")
"""How motion is published: nothing old is kept for a slow or late subscriber, nothing is left to chance."""


class MotionControl:
    """Passes motion commands on, or not, and stops what is left moving.

    :param now: clock that goes on in suspends, nanoseconds
    :param clock: schedules the watchdog
    :param authority: knows who may move the robot
    :param rules: what else holds for commands and stops
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
        """Called when that changes."""
        self.on_commanded: Callable[[bool], None] = lambda commanded: None
        """Called when somebody may command the robot, and when nobody may any more."""
        self.on_unread: Callable[[TypedTopic, str], None] = lambda on, level: None
        """Called when a command of that level was refused because its speed can't be read."""
        self.proof: Callable[[], int] = now
        """When the latest ping that the relay has answered was sent."""
        self.stale_commands = 0
        self._stamps: dict[str, dict[int, int]] = {}
        """By publication, the stamp of each connection's newest fresh command, the latest last."""
        self.invalid_commands = 0
        self.watchdog_stops = 0
        self.unguarded_commands = 0
        self._platform = platform
        self._clock = clock
        self._now = now
        self._guard = guard
        self._authority = authority
        self._rules = rules or MotionRules()
        self._governor = Governor(self._rules.limits, platform.encoding, self._rules.unlimited)
        self._watchdog = Watchdog(policy.stop_within_ms, DAEMON_SHARE, self._rules.ramp_ms)
        for topic, times in self._rules.topics.items():
            self._watchdog.within(topic, times.stop_within_ms)
        self._outlets: dict[str, MotionPublisher] = {}
        self._attended: set[str] = set()
        self._tracks = MotionTopics(guard, self._watchdog.moves)
        self._tracks.forgotten = self._governor.forget
        self._stilling = self._make_stilling(self._rules.ramp_ms * MILLI)
        self._timer: DelayedCall | None = None
        self._finishing: list[Deferred[None]] = []
        self._standing: list[Deferred[list[str]]] = []
        self._unstopped: list[str] = []
        """Topics whose ramp could not end in zero, since somebody wanted to know."""
        self._log = Logger("motion")

    @property
    def limited_commands(self) -> int:
        """Commands made slower."""
        return self._governor.limited

    def concerns(self, on: TypedTopic) -> bool:
        """Whether commands on this topic move the robot; ``on`` as the platform resolved it."""
        return is_motion(self.policy, on)

    def open(self, source: str, on: TypedTopic, sink: PublisherHandle) -> None:
        """A client may command a topic now; ``source`` names the publication.

        It may give its place to another later; a command takes one again.

        :raises Unavailable: too many topics move
        :raises Refused: nobody may command it, as all speed is limited and that of its commands can't be read
        """
        if self._governor.closed(on):
            raise Refused(unreadable(on))
        track = self._place(on)
        if track.idle:
            track.settle()
        track.sources.add(source)
        self._outlets[source] = MotionPublisher(on, sink)
        self.attend(source)

    def attend(self, source: str) -> None:
        """Somebody may move the robot by a publication, here or elsewhere."""
        self._attended.add(source)
        self.on_commanded(True)

    def leave(self, source: str) -> None:
        """Nobody may by this one any more."""
        self._attended.discard(source)
        if not self._attended:
            self.on_commanded(False)

    def commanded(self, topic: str) -> bool:
        """Whether clients may command a topic."""
        return any(outlet.on.topic == topic for outlet in self._outlets.values())

    def refuse(self) -> None:
        """Count a message to what moves the robot that came without its source, which is never obeyed."""
        self._authority.refused += 1

    def command(self, source: str, body: bytes, stamp: int, offset: ClockOffset, by: int) -> bool:
        """Publish one command if it is allowed, fresh and sane; whether it was.

        :param source: the publication it came on
        :param by: the connection that gave it
        """
        on = self._outlets[source].on
        now = self._now()
        fresh = freshness(stamp, now, offset, self._times(on).deadline_ms) is CommandAge.FRESH
        if not self.in_order(source, by, stamp, fresh):
            return False
        verdict = self._platform.judge(on.type, body)
        # Zero that is too old tells nothing of what its source does now: it is no letting go.
        moving = verdict is not Motion.STILL or not fresh
        sent = earliest(stamp, now, offset)
        if self._authority.judge(by, on.topic, moving, now, sent) is not Verdict.ALLOWED:
            return False
        if not fresh:
            self.stale_commands += 1
            return False
        void = self._void(on, stamp, now, offset)
        placed = self._use(on, now)
        if verdict is Motion.STILL and placed:
            self._stand(source, body, now)
        elif verdict is Motion.STILL:
            self._outlets[source].sink.publish(body)
        elif void <= now:
            self.stale_commands += 1
            return False
        elif verdict is Motion.MOVING and not self._governor.covers(on, self._authority.level_of(by)):
            self._authority.refused += 1
            self.on_unread(on, self._authority.level_of(by))
            return False
        elif verdict is Motion.MOVING and not (placed and self._guard.ready(on)):
            self._hold_back(on)
            return False
        else:
            tamed = None if verdict is Motion.INVALID else self._tame(on, body, by, now)
            if tamed is None:
                self.invalid_commands += 1
                return False
            self._tracks[on].mover = by
            self._move(source, tamed, now, void)
        self._schedule()
        return True

    def close(self, source: str) -> None:
        """A publication ends; what it left moving is stopped, and its sink closed when that is said."""
        outlet = self._outlets.pop(source, None)
        self.forget_order(source)
        if outlet is None:
            return
        self.leave(source)
        track = self._tracks.get(outlet.on)
        if track is None:
            outlet.sink.close()
            return
        track.sources.discard(source)
        track.leaving.append(outlet.sink)
        if self._watchdog.release(outlet.on, source):
            self._stilling.stop([outlet.on], "its publisher left", gently=True)
        if not track.busy:
            self._settle(outlet.on)
        self._schedule()

    def stop_all(self, why: str, gently: bool = False) -> list[str]:
        """Zero on everything that moves; the topics on which it could not be said.

        :param gently: by a ramp, where there are any; else at once
        """
        failed = self._stilling.stop(self._watchdog.everything(), why, gently)
        self._schedule()
        return failed

    def standing(self) -> Deferred[list[str]]:
        """Fires when no ramp is under way any more; with the topics on which zero could not be said at its end."""
        done: Deferred[list[str]] = Deferred()
        self._standing.append(done)
        self._tell_finished()
        return done

    def halt(self, why: str) -> list[str]:
        """Zero on every topic that clients may command, moving or not; those on which it could not be said."""
        moving = set(self._watchdog.everything())
        failed = []
        for on, track in self._tracks.items():
            if on not in moving and not track.sources and track.ramp is None:
                continue
            if track.speaker is None:
                track.speaker = next((each.sink for each in self._outlets.values() if each.on == on), None)
            if not self._stilling.still(on, why):
                failed.append(on.topic)
        self._log.info("stopped everything: {why}", why=why)
        self._tell_finished()
        self._schedule()
        return failed

    def yield_topic(self, topic: str, why: str) -> None:
        """Others command a topic now: stop what those move who don't."""
        now = self._now()
        others = [
            on
            for on, track in self._tracks.items()
            if on.topic == topic
            and (self._watchdog.moves(on) or track.ramp is not None)
            and not self._authority.commands(track.mover, topic, now)
        ]
        for on in others:
            self._watchdog.command(on, "", False, now)
        self._stilling.stop(others, why)
        self._tell_finished()
        self._schedule()

    def finish(self) -> Deferred[None]:
        """Fires when every zero is said."""
        done: Deferred[None] = Deferred()
        self._finishing.append(done)
        self._tell_finished()
        return done

    def in_order(self, source: str, by: int, stamp: int, fresh: bool) -> bool:
        """Whether no newer command of this connection came on this publication before; else it counts as too old.

        :param stamp: of the command, the relay's monotonic nanoseconds
        :param fresh: whether later commands are compared with it; a stamp of the future would shut them out
        """
        stamps = self._stamps.setdefault(source, {})
        newest = stamps.get(by, stamp)
        if fresh:
            stamps.pop(by, None)
            stamps[by] = max(newest, stamp)
            if len(stamps) > GRIPS:
                del stamps[next(iter(stamps))]
        if stamp < newest:
            self.stale_commands += 1
        return stamp >= newest

    def forget_order(self, source: str) -> None:
        """A publication has ended."""
        self._stamps.pop(source, None)

    # --- one command ---------------------------------------------------------------------------------------

    def _place(self, on: TypedTopic) -> MotionTopic:
        return self._tracks.take(on, (name for name, each in self._outlets.items() if each.on == on))

    def _use(self, on: TypedTopic, now: int) -> bool:
        """A topic is commanded by who may; whether there is a place for it."""
        try:
            self._place(on).used = now
        except Unavailable:
            return False
        return True

    def _times(self, on: TypedTopic) -> Times:
        own = self._rules.topics.get(on.topic)
        return Times(self.policy.stop_within_ms, self.policy.deadline_ms) if own is None else own

    def _tame(self, on: TypedTopic, body: bytes, by: int, now: int) -> bytes | None:
        """The command as it may be followed, its zero known; ``None`` where it must not be."""
        rest = self._platform.resting(on.type, body)
        if len(rest) > MAX_SHAPE:
            return None
        tamed = self._governor.tame(on, body, self._authority.level_of(by), now)
        track = self._tracks[on]
        if tamed is not None and rest != track.rest:
            track.rest = rest
            self._guard.shape(on, rest)
        return tamed

    def _void(self, on: TypedTopic, stamp: int, now: int, offset: ClockOffset) -> int:
        within, deadline = self._times(on)
        return void_at(stamp, now, offset, self.proof(), deadline, within)

    def _move(self, source: str, body: bytes, now: int, void: int) -> None:
        on, sink = self._outlets[source]
        # The guard hears of a movement before it begins, and of a stop after it was sent.
        self._guard.command(on, True, now)
        sink.publish(body)
        self._watchdog.command(on, source, True, now, void)
        track = self._tracks[on]
        track.speaker = sink
        track.latest = min(void, self._watchdog.latest(on, now))
        track.body = body if self._stilling.ramps else b""
        if track.busy:
            track.settle()
            self._settle(on)

    def _stand(self, source: str, body: bytes, now: int) -> None:
        on, sink = self._outlets[source]
        track = self._tracks[on]
        moved = self._watchdog.moves(on) or track.ramp is not None
        self._watchdog.command(on, source, False, now)
        track.speaker = sink
        if moved:
            self._stilling.repeat(on)  # before it is published: where that fails it is tried again
            self._schedule()
        sink.publish(body)
        self._governor.stood(on, now)
        if moved:
            self._tell_finished()
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
        self._stilling.stop(topics, "no fresh command came", gently=True)
        self._schedule()

    def _make_stilling(self, ramp: int) -> StopSequence:
        made = StopSequence(self._platform, self._clock, self._now, self._guard, self._tracks, ramp)
        made.said = lambda on: self._governor.stood(on, self._now())
        made.slowed = lambda on, velocity: self._governor.slowed(on, velocity, self._now())
        made.over = self._ramp_over
        made.rested = self._settle
        return made

    def _ramp_over(self, on: TypedTopic, stopped: bool) -> None:
        if not stopped:
            self._unstopped.append(on.topic)
        self._tell_finished()
        self._schedule()

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
            track.settle()
            track.timer = self._clock.callLater(KEPT, self._tracks.forget, on)
        self._tell_finished()

    def _tell_finished(self) -> None:
        if self._stilling.under_way:
            return
        standing, self._standing = self._standing, []
        unstopped, self._unstopped = self._unstopped, []
        for each in standing:
            each.callback(unstopped)
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
        moving = due is not None or self._stilling.under_way
        if self.moving != moving:
            self.moving = moving
            self.on_moving()
