"""The motion topics of one daemon: every command judged, every silence answered with zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from twisted.logger import Logger

from relay_protocol.link import MotionPolicy
from robot_client.offset import Offset
from robot_client.platforms.base import Motion, Platform, Sink
from robot_client.reactors import Clock, Timer
from robot_client.safety import DAEMON_SHARE, Freshness, Watchdog, freshness, is_motion

NANO = 1_000_000_000


class GuardFeed(Protocol):
    """Who is told of every motion command, to act when the daemon can't."""

    def topic(self, topic: str, type: str) -> None:
        """Commands may come on this topic."""

    def command(self, topic: str, moving: bool, at: int) -> None:
        """A command went out; ``at`` is the monotonic clock in nanoseconds."""

    def ready(self, topic: str) -> bool:
        """Whether it could stop this topic now."""


class NoGuard:
    """Nobody is told, by choice: motion does not wait for a guard."""

    def topic(self, topic: str, type: str) -> None:
        """Pass over."""

    def command(self, topic: str, moving: bool, at: int) -> None:
        """Pass over."""

    def ready(self, topic: str) -> bool:
        """Nothing to wait for."""
        return True


class _Outlet(NamedTuple):
    topic: str
    type: str
    sink: Sink


class MotionDesk:
    """Passes motion commands on, or not, and stops what is left moving.

    :param now: monotonic clock, nanoseconds
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
        self._timer: Timer | None = None
        self._log = Logger("motion")

    def concerns(self, topic: str, type: str) -> bool:
        """Whether commands on this topic move the robot."""
        return is_motion(self.policy, topic, type)

    def open(self, source: str, topic: str, type: str, sink: Sink) -> None:
        """A client may command a topic now; ``source`` names the publication."""
        self._outlets[source] = _Outlet(topic, type, sink)
        self._guard.topic(topic, type)

    def command(self, source: str, body: bytes, stamp: int, offset: Offset) -> bool:
        """Publish one command if it is fresh and sane; whether it was."""
        outlet = self._outlets[source]
        now = self._now()
        if freshness(stamp, now, offset, self.policy.deadline_ms) is not Freshness.FRESH:
            self.stale_commands += 1
            return False
        verdict = self._platform.judge(outlet.type, body)
        if verdict is Motion.INVALID:
            self.invalid_commands += 1
            return False
        moving = verdict is Motion.MOVING
        if moving and not self._guard.ready(outlet.topic):
            self._hold_back(outlet.topic)
            return False
        # The guard hears of a movement before it begins, and of a stop after it was sent.
        if moving:
            self._guard.command(outlet.topic, True, now)
        outlet.sink.publish(body)
        if not moving:
            self._guard.command(outlet.topic, False, now)
        self._watchdog.command(outlet.topic, source, moving, now)
        self._schedule()
        return True

    def _hold_back(self, topic: str) -> None:
        if not self.unguarded_commands:
            self._log.info(
                "commands to {topic} wait for the motion guard to be able to stop them", topic=topic
            )
        self.unguarded_commands += 1

    def close(self, source: str) -> None:
        """A publication ends; what it left moving is stopped. Its sink may be closed after this."""
        outlet = self._outlets.get(source)
        if outlet is None:
            return
        if self._watchdog.release(outlet.topic, source):
            self._stop([outlet.topic], "its publisher left")
        del self._outlets[source]
        self._schedule()

    def stop_all(self, why: str) -> None:
        """Zero on everything that moves, at once."""
        self._stop(self._watchdog.everything(), why)
        self._schedule()

    def _expire(self) -> None:
        self._timer = None
        topics = self._watchdog.expired(self._now())
        self.watchdog_stops += len(topics)
        self._stop(topics, "no fresh command came")
        self._schedule()

    def _stop(self, topics: list[str], why: str) -> None:
        for topic in topics:
            outlet = next(each for each in self._outlets.values() if each.topic == topic)
            try:
                outlet.sink.publish(self._platform.zero(outlet.type))
            except Exception as error:  # one topic that fails must not keep the next from its stop
                self._log.error(
                    "could not stop {topic} ({why}): {error}", topic=topic, why=why, error=str(error)
                )
                continue  # the guard, not told, will try
            self._guard.command(topic, False, self._now())
            self._log.info("stopped {topic}: {why}", topic=topic, why=why)

    def _schedule(self) -> None:
        due = self._watchdog.due()
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None
        if due is not None:
            self._timer = self._clock.callLater(max(0.0, (due - self._now()) / NANO), self._expire)
