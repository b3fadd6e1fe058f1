"""Alerts that the relay raises itself: offline robots, low batteries, stops, and topics that have ceased.

Robots are polled, so that no lasting state is missed by a lost event.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from relay_server.alerts import types as kinds
from relay_server.channels.channel import Channel, Channels
from relay_server.control.controllers import Controllers
from relay_server.robots.registry import RobotRegistry, RobotState

REGULAR_SECONDS = 10.0
"""A topic is watched after so long without a gap."""

MIN_SAMPLES = 5
"""Fewest samples from which a period is known."""

MAX_PERIOD = 1.0
"""Longest period of watched topics, in seconds; slower topics may pause on purpose."""

GAP_SECONDS = 2.5
"""Longest pause that is no gap; checks are a second apart."""

STALE_PERIODS = 5.0
STALE_SECONDS = 3.0
"""A topic has ceased when no sample came for this many of its periods, and for this time."""


class TopicWatch:
    """One subscription of a topic.

    :param now: seconds of any clock
    :param count: samples that have come so far
    """

    __slots__ = ("_base", "_count", "_grown", "_since", "stale")

    def __init__(self, now: float, count: int) -> None:
        self.stale = False
        self._count = self._base = count
        self._since = self._grown = now

    @property
    def has_samples(self) -> bool:
        """Whether samples have come since this began."""
        return self._count > self._base

    def has_new(self, count: int) -> bool:
        """Whether samples have come since the last check.

        :param count: samples that have come so far
        """
        return count != self._count

    @property
    def period(self) -> float | None:
        """The period in seconds, if it is known and regular."""
        lasted, samples = self._grown - self._since, self._count - self._base
        if lasted < REGULAR_SECONDS or samples < MIN_SAMPLES or lasted > samples * MAX_PERIOD:
            return None
        return lasted / samples

    def excuse(self, now: float) -> None:
        """Leave out the time since the last check, in which no sample could come.

        :param now: not before the last check
        """
        if not self.stale:
            self._since += now - self._grown
            self._grown = now

    def update(self, now: float, count: int) -> bool:
        """Count samples; returns whether the topic is stale.

        :param now: not before the last check
        """
        if count != self._count:
            if self.stale or now - self._grown > GAP_SECONDS:
                self._since, self._base = now, self._count
            self._count, self._grown, self.stale = count, now, False
        elif not self.stale:
            period = self.period
            self.stale = period is not None and now - self._grown > max(STALE_SECONDS, STALE_PERIODS * period)
        return self.stale


CHECK_SECONDS = 0.25
"""Pause between two checks of robots."""

STALL_SECONDS = 1.5
"""After so long without a check the relay itself stood still, and has not read yet what arrived meanwhile."""

CLOCKS_SECONDS = 1.0
"""Largest difference between the two clocks of one duration."""

BATTERY_STEP = 0.05
"""The alert ends when the charge is so much above the threshold."""

MAYBE_OFFLINE = 2 / 3
"""After this part of the silence that makes a robot offline, pauses of its topics do not count."""

SETTLED_SECONDS = 5.0
"""Time for a robot to report its state after it came online."""

UNWATCHED = ("/rosout", "/parameter_events")
"""Topics without a regular rate."""

_ACTION = "/_action/"


class AlertSink(Protocol):
    """Takes the alerts."""

    def raise_alert(self, robot: RobotState, kind: str, about: str, level: str, text: str) -> None:
        """Raise an alert, or repeat it."""

    def end(self, robot: RobotState, kind: str, about: str = "") -> None:
        """End an alert."""

    def level_of(self, robot: RobotState, kind: str, about: str = "") -> str | None:
        """The level of an open alert; ``None`` if it is not open."""

    def ended_since(self, robot: RobotState, kind: str, at: float) -> bool:
        """Whether an alert has ended after a time, Unix seconds, and is not open."""

    def parts_of(self, robot: RobotState, kind: str) -> list[str]:
        """The parts of the open alerts of a kind."""


@dataclass(frozen=True)
class Thresholds:
    """Limits for alerts.

    :param silent: seconds without a message after which a robot is offline
    :param battery_low: charge, 0 to 1; 0 is never, critical or not
    :param battery_critical: charge at which it is worse
    """

    silent: float
    battery_low: float
    battery_critical: float


class Monitors:
    """Checks all robots.

    :param controllers: know the stops that robots have not confirmed yet
    :param sink: takes the alerts
    :param leads: whether this relay raises the alerts about robots that are connected to no relay of the cluster
    """

    def __init__(
        self,
        registry: RobotRegistry,
        channels: Channels,
        controllers: Controllers,
        thresholds: Thresholds,
        sink: AlertSink,
        leads: Callable[[], bool] = lambda: True,
    ) -> None:
        self._registry = registry
        self._channels = channels
        self._controllers = controllers
        self._thresholds = thresholds
        self._sink = sink
        self._leads = leads
        self._online: dict[int, tuple[str | None, float]] = {}
        """Session of each online robot, and the monotonic time of its beginning."""
        self._last_seen: dict[int, tuple[float | None, float]] = {}
        """When each robot was seen, by the wall clock, and when that was first noticed, by the monotonic one."""
        self._checked_at: float | None = None
        """The monotonic time of the last check."""
        self._waiting_stops: set[int] = set()
        """Robots that are away, and for which a stop has waited. Another relay may withdraw it."""
        self._maybe_offline: set[int] = set()
        """Robots that may be offline."""
        self._watches: dict[tuple[int, str, int], TopicWatch] = {}

    def check(self, now: float, wall: float) -> None:
        """Check links, batteries and stops.

        :param now: monotonic seconds
        :param wall: Unix time, seconds
        """
        if self._checked_at is not None and now - self._checked_at >= STALL_SECONDS:
            self._excuse_stall(now)
        self._checked_at = now
        for robot in self._registry:
            if robot.elsewhere and robot.control_link is None:
                # The relay that it is connected to checks it.
                self._leave(robot, wall)
                continue
            # Once more when its link has ended: the last that it reported may be an empty battery.
            here = robot.control_link is not None or robot.robot_id in self._online
            self._presence(robot, now, wall)
            if here:
                self._battery(robot)
            if robot.control_link is not None or self._leads():
                self._stop(robot, now)

    def check_topics(self, now: float) -> None:
        """Check which topics have ceased; to be called about once a second."""
        watches: dict[tuple[int, str, int], TopicWatch] = {}
        for channel in self._channels:
            watches.update(self._topics(channel, now))
        self._watches = watches
        for robot in self._registry:
            self._end_stale(robot)

    # --- links, batteries, stops --------------------------------------------------------------------------

    def _excuse_stall(self, now: float) -> None:
        """After the relay stood still: robots that had a link count as just seen, and topics have not ceased."""
        for robot_id in self._online:
            self._last_seen[robot_id] = (self._last_seen.get(robot_id, (None, 0.0))[0], now)
        for watch in self._watches.values():
            watch.excuse(now)

    def _presence(self, robot: RobotState, now: float, wall: float) -> None:
        if robot.control_link is None:
            self._online.pop(robot.robot_id, None)
        elif self._online.get(robot.robot_id, (None, now))[0] != robot.session:
            self._online[robot.robot_id] = (robot.session, now)
        silence = self._silence(robot, now, wall)
        silent = silence >= self._thresholds.silent
        if silence >= MAYBE_OFFLINE * self._thresholds.silent:
            self._maybe_offline.add(robot.robot_id)
        else:
            self._maybe_offline.discard(robot.robot_id)
        if robot.control_link is not None and not silent:
            self._sink.end(robot, kinds.OFFLINE)
        elif not silent or robot.last_seen is None or not (self._leads() or robot.control_link is not None):
            return
        elif self._sink.level_of(robot, kinds.OFFLINE) is None:
            self._sink.raise_alert(
                robot, kinds.OFFLINE, "", "error", "the robot is offline: no messages come from it"
            )

    def _leave(self, robot: RobotState, wall: float) -> None:
        self._online.pop(robot.robot_id, None)
        self._maybe_offline.discard(robot.robot_id)
        self._waiting_stops.discard(robot.robot_id)
        robot.last_seen = wall

    def _silence(self, robot: RobotState, now: float, wall: float) -> float:
        """Seconds since the robot was seen; by the monotonic clock alone if the wall clock was set meanwhile."""
        seen = robot.last_seen
        if self._last_seen.get(robot.robot_id, (None, 0.0))[0] != seen or seen is None:
            self._last_seen[robot.robot_id] = (seen, now)
        elapsed = now - self._last_seen[robot.robot_id][1]
        by_wall_clock = elapsed if seen is None else wall - seen
        return by_wall_clock if abs(by_wall_clock - elapsed) <= CLOCKS_SECONDS else elapsed

    def _battery(self, robot: RobotState) -> None:
        charge, at = robot.health.battery, self._thresholds
        if not at.battery_low:
            return
        lasts = self._sink.level_of(robot, kinds.BATTERY)
        if robot.impossible_charge is not None and lasts is None:
            said = f"the robot reports a charge of {robot.impossible_charge:g}, which is not from 0 to 1"
            self._sink.raise_alert(robot, kinds.BATTERY, "", "warning", f"{said}; it counts as unknown")
        if charge is None:
            return
        level = "error" if charge <= at.battery_critical else "warning" if charge <= at.battery_low else ""
        if level and (lasts is None or kinds.severity(level) > kinds.severity(lasts)):
            self._sink.raise_alert(robot, kinds.BATTERY, "", level, f"the battery is at {charge:.0%}")
        elif lasts is not None and charge >= max(at.battery_low, at.battery_critical) + BATTERY_STEP:
            self._sink.end(robot, kinds.BATTERY)

    def _stop(self, robot: RobotState, now: float) -> None:
        stopped = robot.motion_state.stopped or self._controllers.snapshot(robot.robot_id).stopped
        if stopped is not None:
            waits = robot.control_link is None and robot.motion_state.stopped is None
            if waits:
                self._waiting_stops.add(robot.robot_id)
            # That one has ended at another relay may not have been read yet.
            known = waits and self._sink.ended_since(robot, kinds.STOP, stopped.since)
            if self._sink.level_of(robot, kinds.STOP) is None and not known:
                self._sink.raise_alert(robot, kinds.STOP, "", "warning", stopped_by(stopped.by, stopped.why))
        elif (
            robot.robot_id in self._waiting_stops
            or now - self._online.get(robot.robot_id, ("", now))[1] > SETTLED_SECONDS
        ):
            self._waiting_stops.discard(robot.robot_id)
            self._sink.end(robot, kinds.STOP)

    # --- topics -------------------------------------------------------------------------------------------

    def _topics(self, channel: Channel, now: float) -> Iterable[tuple[tuple[int, str, int], TopicWatch]]:
        robot = channel.robot
        silent = {each.resource for each in robot.motion_state.inhibited}
        silent.update(topic for topic, _ in channel.publications.active())
        for each in channel.subscriptions.topic_rates():
            if not each.regular or each.topic in silent or _may_pause(robot, each.topic, each.type):
                continue
            key = (robot.robot_id, each.topic, each.number)
            watch = self._watches.get(key) or TopicWatch(now, each.received)
            was = watch.stale
            if robot.robot_id in self._maybe_offline and not watch.has_new(each.received):
                watch.excuse(now)
            elif watch.update(now, each.received) and not was:
                text = f"{each.topic} came regularly and has stopped"
                self._sink.raise_alert(robot, kinds.STALE, each.topic, "warning", text)
            yield key, watch

    def _end_stale(self, robot: RobotState) -> None:
        """End alerts of topics that come again or have no subscription; an offline robot's alerts stay."""
        about = self._sink.parts_of(robot, kinds.STALE) if robot.control_link is not None else []
        if not about:
            return
        channel = self._channels.find(robot)
        numbers = (
            {}
            if channel is None
            else {each.topic: each.number for each in channel.subscriptions.topic_rates()}
        )
        for topic in about:
            watch = self._watches.get((robot.robot_id, topic, numbers.get(topic, 0)))
            if topic not in numbers or (watch is not None and watch.has_samples and not watch.stale):
                self._sink.end(robot, kinds.STALE, topic)


def _may_pause(robot: RobotState, topic: str, type_name: str) -> bool:
    """Whether a topic has no regular rate: commands, logs, topics of actions."""
    return topic in UNWATCHED or _ACTION in topic or robot.is_motion(topic, type_name)


def stopped_by(user: str, why: str) -> str:
    """The text of an alert about a stop."""
    return f"stopped by {user}" + (f": {why}" if why else "")
