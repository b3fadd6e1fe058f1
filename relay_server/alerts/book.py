"""All alerts that last, and those that were over a moment ago: what is told again joins what is there.

Pure: no clock, no database. Who calls says what time it is, and takes what has changed to be written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from relay_db.queries import AlertRecord
from relay_server.alerts import kinds
from relay_server.alerts.kinds import Event

Key = tuple[str, str]
"""Kind and part: what makes two alerts of one robot the same."""

KEPT = 1000
"""Most alerts of one robot that are remembered after they were over."""


class Change(NamedTuple):
    """Something worth telling."""

    alert: AlertRecord
    event: Event


@dataclass
class _Robot:
    """The alerts of one robot."""

    open: dict[Key, AlertRecord] = field(default_factory=dict)
    over: dict[Key, AlertRecord] = field(default_factory=dict)
    news: dict[Key, float] = field(default_factory=dict)
    """When there was news of each, Unix seconds."""
    told: set[Key] = field(default_factory=set)
    """Of which people were told that they last."""
    tokens: float = kinds.BURST
    filled: float = 0.0
    full: int = 0
    """Alerts that found no room since the flood began."""


class Book:
    """Alerts by robot.

    :param new_id: makes a fresh name for an alert
    """

    def __init__(self, new_id: Callable[[], str]) -> None:
        self.states = 0
        """Another number whenever an alert begins, ends, becomes worse or is looked after, worth telling or not."""
        self._new_id = new_id
        self._robots: dict[int, _Robot] = {}
        self._changed: dict[str, AlertRecord] = {}

    def __iter__(self) -> Iterator[AlertRecord]:
        """All that are remembered."""
        for robot in self._robots.values():
            yield from robot.open.values()
            yield from robot.over.values()

    def load(self, records: list[AlertRecord]) -> None:
        """Take up what an earlier relay kept."""
        for each in sorted(records, key=lambda record: record.last):
            robot = self._robots.setdefault(each.robot_id, _Robot())
            (robot.open if each.over is None else robot.over)[each.kind, each.about] = each
            robot.news[each.kind, each.about] = each.last
            if each.over is None:
                robot.told.add((each.kind, each.about))

    def take_changed(self) -> list[AlertRecord]:
        """What is to be written, each once."""
        changed, self._changed = self._changed, {}
        return list(changed.values())

    def put_back(self, records: list[AlertRecord]) -> None:
        """It could not be written; what has changed since counts."""
        self._changed = {each.id: each for each in records} | self._changed

    def open_of(self, robot_id: int) -> list[AlertRecord]:
        """Those of a robot that last."""
        robot = self._robots.get(robot_id)
        return [] if robot is None else list(robot.open.values())

    def lasts(self, robot_id: int, kind: str, about: str = "") -> AlertRecord | None:
        """This alert, if it lasts."""
        robot = self._robots.get(robot_id)
        return None if robot is None else robot.open.get((kind, about))

    def find(self, alert_id: str) -> AlertRecord | None:
        """An alert by its name."""
        return next((each for each in self if each.id == alert_id), None)

    def forget(self, robot_id: int) -> None:
        """The robot was removed."""
        robot = self._robots.pop(robot_id, None)
        if robot is not None:
            for each in (*robot.open.values(), *robot.over.values()):
                self._changed.pop(each.id, None)

    # --- what happens -------------------------------------------------------------------------------------

    def tell(
        self, robot_id: int, name: str, kind: str, about: str, level: str, text: str, now: float
    ) -> list[Change]:
        """Something is wrong: it joins what is known of the same, or is a new alert.

        :param name: of the robot
        :param now: Unix seconds
        """
        robot = self._robots.setdefault(robot_id, _Robot(filled=now))
        key, text = (kind, about), text[: kinds.TEXT]
        before = robot.open.get(key)
        if before is not None:
            return self._again(robot, before, level, text, now)
        back = robot.over.get(key)
        if back is not None and back.over is not None and now - back.over < kinds.REJOIN_SECONDS:
            return self._back(robot, back, level, text, now)
        if kind != kinds.FLOOD and kind not in kinds.SINGLE and not self._room(robot, now):
            robot.full += 1
            # Not what they say: whoever sees this may have no right to see them.
            words = f"{robot.full} more alerts of {name} are not kept one by one"
            return self.tell(robot_id, name, kinds.FLOOD, "", "warning", words, now)
        made = AlertRecord(
            self._new_id(), robot_id, name, kind, about, level, text, now, now, 1, 1, None, None, None
        )
        robot.over.pop(key, None)
        return [self._news(robot, made, Event.BEGUN, now)]

    def over(self, robot_id: int, kind: str, about: str, now: float) -> list[Change]:
        """It is well again."""
        robot = self._robots.get(robot_id)
        lasts = None if robot is None else robot.open.get((kind, about))
        return [] if robot is None or lasts is None else self._end(robot, lasts, now)

    def acknowledge(self, alert_id: str, by: str, now: float) -> tuple[AlertRecord | None, list[Change]]:
        """Somebody looks after it; the alert, if there is one, and what that changes.

        What nobody will tell the end of is over by it.
        """
        found = self.find(alert_id)
        if found is None or found.over is not None or found.ack_at is not None:
            return found, []
        robot = self._robots[found.robot_id]
        found = self._keep(robot, found._replace(ack_by=by, ack_at=now))
        self.states += 1
        changes = self._end(robot, found, now) if kinds.endless(found.kind) else []
        return self.find(alert_id), changes

    def sweep(self, now: float) -> list[Change]:
        """Tell what came back and stayed; end what nobody tells the end of; forget what was over long ago."""
        changes: list[Change] = []
        for robot_id, robot in list(self._robots.items()):
            for each in list(robot.open.values()):
                if now - each.last >= _patience(each.kind):
                    changes += self._end(robot, each, now)
                elif (each.kind, each.about) not in robot.told:
                    changes += self._come_back(robot, each, now)
            _forget_old(robot, now)
            if not robot.open and not robot.over and now - robot.filled > kinds.BURST / kinds.RATE:
                del self._robots[robot_id]
        return changes

    # --- how ----------------------------------------------------------------------------------------------

    def _again(self, robot: _Robot, before: AlertRecord, level: str, text: str, now: float) -> list[Change]:
        worse = kinds.severity(level) > kinds.severity(before.level)
        now_it_is = before._replace(
            text=text, level=level if worse else before.level, last=now, times=before.times + 1
        )
        if not worse:
            self._keep(robot, now_it_is)
            return []
        fresh = now_it_is._replace(ack_by=None, ack_at=None, news=before.news + 1)
        return [self._news(robot, fresh, Event.WORSE, now)]

    def _back(self, robot: _Robot, before: AlertRecord, level: str, text: str, now: float) -> list[Change]:
        del robot.over[before.kind, before.about]
        back = before._replace(
            level=level, text=text, last=now, times=before.times + 1, over=None, ack_by=None, ack_at=None
        )
        self.states += 1
        return self._come_back(robot, self._keep(robot, back), now)

    def _come_back(self, robot: _Robot, back: AlertRecord, now: float) -> list[Change]:
        """Tell of it, unless there was news of it a moment ago."""
        if now - robot.news.get((back.kind, back.about), -kinds.NEWS_SECONDS) < kinds.NEWS_SECONDS:
            return []
        return [self._news(robot, back._replace(news=back.news + 1), Event.BEGUN, now)]

    def _end(self, robot: _Robot, lasts: AlertRecord, now: float) -> list[Change]:
        key = (lasts.kind, lasts.about)
        del robot.open[key]
        if lasts.kind == kinds.FLOOD:
            robot.full = 0
        told = key in robot.told
        robot.told.discard(key)
        robot.over[key] = over = lasts._replace(over=now, news=lasts.news + told)
        self._changed[over.id] = over
        self.states += 1
        while len(robot.over) > KEPT:
            oldest = next(iter(robot.over))
            del robot.over[oldest]
            robot.news.pop(oldest, None)
        # The end of what was told is told, however soon it came: nobody shall go on worrying.
        return [Change(over, Event.OVER)] if told else []

    def _news(self, robot: _Robot, alert: AlertRecord, event: Event, now: float) -> Change:
        self.states += 1
        robot.news[alert.kind, alert.about] = now
        robot.told.add((alert.kind, alert.about))
        return Change(self._keep(robot, alert), event)

    def _keep(self, robot: _Robot, alert: AlertRecord) -> AlertRecord:
        robot.open[alert.kind, alert.about] = alert
        self._changed[alert.id] = alert
        return alert

    @staticmethod
    def _room(robot: _Robot, now: float) -> bool:
        robot.tokens = min(kinds.BURST, robot.tokens + max(0.0, now - robot.filled) * kinds.RATE)
        robot.filled = now
        if len(robot.open) >= kinds.OPEN or robot.tokens < 1:
            return False
        robot.tokens -= 1
        return True


def _patience(kind: str) -> float:
    """Seconds after which an alert that was not told again is over."""
    if kind == kinds.FLOOD:
        return kinds.FLOOD_SECONDS
    return kinds.ENDLESS_SECONDS if kinds.endless(kind) else float("inf")


def _forget_old(robot: _Robot, now: float) -> None:
    for key, each in list(robot.over.items()):
        if each.over is not None and now - each.over > kinds.SHOWN_SECONDS:
            del robot.over[key]
            robot.news.pop(key, None)
