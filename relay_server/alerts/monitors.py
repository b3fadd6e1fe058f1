"""What the relay sees for itself: who is away, whose battery is low, who is stopped, which topics have ceased.

It looks again and again instead of counting on events: a state that lasts can't be missed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from relay_server.alerts import types as kinds
from relay_server.channels.channel import Channel
from relay_server.channels.channels import Channels
from relay_server.control.controllers import Controllers
from relay_server.robots.registry import RobotRegistry, RobotState

REGULAR_SECONDS = 10.0
"""What has come for so long without a gap is expected to go on."""

SAMPLES = 5
"""Fewest samples from which the usual period is known."""

PERIOD = 1.0
"""Longest usual period of what is watched, seconds: what comes more seldom may be meant to."""

GAP_SECONDS = 2.5
"""A pause that is no gap yet: looks are a second apart."""

PERIODS = 5.0
LEAST_SECONDS = 3.0
"""A topic has ceased when for so many of its periods, and for so long, nothing came."""


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
    def came(self) -> bool:
        """Whether anything has come since this began."""
        return self._count > self._base

    def grows(self, count: int) -> bool:
        """Whether something has come since the last look.

        :param count: samples that have come so far
        """
        return count != self._count

    @property
    def period(self) -> float | None:
        """Seconds from one sample to the next, where that is known and regular."""
        lasted, samples = self._grown - self._since, self._count - self._base
        if lasted < REGULAR_SECONDS or samples < SAMPLES or lasted > samples * PERIOD:
            return None
        return lasted / samples

    def excuse(self, now: float) -> None:
        """Nothing could have come since the last look: that time does not count.

        :param now: not before the last look
        """
        if not self.stale:
            self._since += now - self._grown
            self._grown = now

    def look(self, now: float, count: int) -> bool:
        """See how many samples have come; whether the topic is stale.

        :param now: not before the last look
        """
        if count != self._count:
            if self.stale or now - self._grown > GAP_SECONDS:
                self._since, self._base = now, self._count
            self._count, self._grown, self.stale = count, now, False
        elif not self.stale:
            period = self.period
            self.stale = period is not None and now - self._grown > max(LEAST_SECONDS, PERIODS * period)
        return self.stale


LOOK_SECONDS = 0.25
"""How often robots are looked at."""

STALL_SECONDS = 1.5
"""After so long without a look the relay itself stood still: what came meanwhile is not read yet."""

CLOCKS_SECONDS = 1.0
"""How far two clocks may be apart that tell the same."""

BATTERY_STEP = 0.05
"""The charge has to be so much above the threshold for a low battery to be over."""

UNSURE = 2 / 3
"""A robot that was silent for this part of what makes it offline may be away: its topics' pauses don't count then."""

SETTLED_SECONDS = 5.0
"""What a robot has not said of itself for so long after it came, it does not say."""

UNWATCHED = ("/rosout", "/parameter_events")
"""Topics that come as there is something to say."""

_ACTION = "/_action/"


class AlertSink(Protocol):
    """Where it is told."""

    def tell(self, robot: RobotState, kind: str, about: str, level: str, text: str) -> None:
        """Something is wrong."""

    def over(self, robot: RobotState, kind: str, about: str = "") -> None:
        """It is well again."""

    def lasts(self, robot: RobotState, kind: str, about: str = "") -> str | None:
        """The level of this alert while it lasts."""

    def lasting(self, robot: RobotState, kind: str) -> list[str]:
        """What those of a kind that last are about."""


@dataclass(frozen=True)
class Thresholds:
    """When something is wrong.

    :param silent: seconds without a sign of life after which a robot is offline
    :param battery_low: charge, 0 to 1; 0 is never, critical or not
    :param battery_critical: charge at which it is worse
    """

    silent: float
    battery_low: float
    battery_critical: float


class Monitors:
    """Looks at all robots.

    :param desks: know of orders to stop that robots have not confirmed yet
    :param voice: is told what lasts and what is over
    """

    def __init__(
        self,
        registry: RobotRegistry,
        channels: Channels,
        desks: Controllers,
        thresholds: Thresholds,
        voice: AlertSink,
    ) -> None:
        self._registry = registry
        self._channels = channels
        self._desks = desks
        self._thresholds = thresholds
        self._voice = voice
        self._online: dict[int, tuple[str | None, float]] = {}
        """Since when each robot has its registration, seconds of the monotonic clock."""
        self._heard: dict[int, tuple[float | None, float]] = {}
        """When each was seen, by the wall's clock, and when that was looked at first, by the monotonic one."""
        self._looked: float | None = None
        """When robots were looked at last, by the monotonic clock."""
        self._unsure: set[int] = set()
        """Robots that may be away."""
        self._flows: dict[tuple[int, str, int], TopicWatch] = {}

    def look(self, now: float, wall: float) -> None:
        """Look at links, batteries and stops.

        :param now: monotonic seconds
        :param wall: Unix time, seconds
        """
        if self._looked is not None and now - self._looked >= STALL_SECONDS:
            self._forgive(now)
        self._looked = now
        for robot in self._registry:
            self._presence(robot, now, wall)
            self._battery(robot)
            self._stop(robot, now)

    def look_at_topics(self, now: float) -> None:
        """See which topics have ceased; about once a second."""
        flows: dict[tuple[int, str, int], TopicWatch] = {}
        for channel in self._channels:
            flows.update(self._topics(channel, now))
        self._flows = flows
        for robot in self._registry:
            self._end_stale(robot)

    # --- links, batteries, stops --------------------------------------------------------------------------

    def _forgive(self, now: float) -> None:
        """Robots that had a link before the relay stood still count as just heard, also if it was cut for that;
        and what did not come meanwhile did not cease."""
        for robot_id in self._online:
            self._heard[robot_id] = (self._heard.get(robot_id, (None, 0.0))[0], now)
        for flow in self._flows.values():
            flow.excuse(now)

    def _presence(self, robot: RobotState, now: float, wall: float) -> None:
        if robot.control is None:
            self._online.pop(robot.robot_id, None)
        elif self._online.get(robot.robot_id, (None, now))[0] != robot.session:
            self._online[robot.robot_id] = (robot.session, now)
        silence = self._silence(robot, now, wall)
        silent = silence >= self._thresholds.silent
        if silence >= UNSURE * self._thresholds.silent:
            self._unsure.add(robot.robot_id)
        else:
            self._unsure.discard(robot.robot_id)
        if robot.control is not None and not silent:
            self._voice.over(robot, kinds.OFFLINE)
        elif silent and robot.last_seen is not None and self._voice.lasts(robot, kinds.OFFLINE) is None:
            self._voice.tell(robot, kinds.OFFLINE, "", "error", "the robot is offline: nothing comes from it")

    def _silence(self, robot: RobotState, now: float, wall: float) -> float:
        """Seconds since the robot was heard; by the monotonic clock alone where the wall's was set meanwhile."""
        seen = robot.last_seen
        if self._heard.get(robot.robot_id, (None, 0.0))[0] != seen or seen is None:
            self._heard[robot.robot_id] = (seen, now)
        looked = now - self._heard[robot.robot_id][1]
        exactly = looked if seen is None else wall - seen
        return exactly if abs(exactly - looked) <= CLOCKS_SECONDS else looked

    def _battery(self, robot: RobotState) -> None:
        charge, at = robot.health.battery, self._thresholds
        if charge is None or not at.battery_low:
            return
        level = "error" if charge <= at.battery_critical else "warning" if charge <= at.battery_low else ""
        lasts = self._voice.lasts(robot, kinds.BATTERY)
        if level and (lasts is None or kinds.severity(level) > kinds.severity(lasts)):
            self._voice.tell(robot, kinds.BATTERY, "", level, f"the battery is at {charge:.0%}")
        elif lasts is not None and charge >= max(at.battery_low, at.battery_critical) + BATTERY_STEP:
            self._voice.over(robot, kinds.BATTERY)

    def _stop(self, robot: RobotState, now: float) -> None:
        stopped = robot.safety.stopped or self._desks.standing(robot.robot_id).stopped
        if stopped is not None:
            if self._voice.lasts(robot, kinds.STOP) is None:
                self._voice.tell(robot, kinds.STOP, "", "warning", stopped_by(stopped.by, stopped.why))
        elif now - self._online.get(robot.robot_id, ("", now))[1] > SETTLED_SECONDS:
            self._voice.over(robot, kinds.STOP)

    # --- topics -------------------------------------------------------------------------------------------

    def _topics(self, channel: Channel, now: float) -> Iterable[tuple[tuple[int, str, int], TopicWatch]]:
        robot = channel.robot
        silent = {each.resource for each in robot.safety.inhibited}
        silent.update(topic for topic, _ in channel.publications.active())
        for each in channel.subscriptions.flows():
            if not each.regular or each.topic in silent or _may_pause(robot, each.topic, each.type):
                continue
            key = (robot.robot_id, each.topic, each.number)
            flow = self._flows.get(key) or TopicWatch(now, each.taken)
            was = flow.stale
            if robot.robot_id in self._unsure and not flow.grows(each.taken):
                flow.excuse(now)
            elif flow.look(now, each.taken) and not was:
                text = f"{each.topic} has come regularly, and comes no more"
                self._voice.tell(robot, kinds.STALE, each.topic, "warning", text)
            yield key, flow

    def _end_stale(self, robot: RobotState) -> None:
        """Those are over that come again, and those nobody listens to; of a robot that is away nothing can be said."""
        about = self._voice.lasting(robot, kinds.STALE) if robot.control is not None else []
        if not about:
            return
        channel = self._channels.find(robot)
        numbers = (
            {} if channel is None else {each.topic: each.number for each in channel.subscriptions.flows()}
        )
        for topic in about:
            flow = self._flows.get((robot.robot_id, topic, numbers.get(topic, 0)))
            if topic not in numbers or (flow is not None and flow.came and not flow.stale):
                self._voice.over(robot, kinds.STALE, topic)


def _may_pause(robot: RobotState, topic: str, type_name: str) -> bool:
    """Whether a topic comes as somebody does something: commands, logs, the insides of actions."""
    return topic in UNWATCHED or _ACTION in topic or robot.is_motion(topic, type_name)


def stopped_by(who: str, why: str) -> str:
    """In words for people."""
    return f"stopped by {who}" + (f": {why}" if why else "")
