"""All alerts that last, and those that were over a moment ago: what is told again joins what is there.

Pure: no clock, no database. Who calls says what time it is, and takes what has changed to be written. What is shown
to people has the wall clock's time, which may be set; how long something lasts is measured by the monotonic one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from math import inf
from typing import NamedTuple

from relay_db.queries import AlertRecord
from relay_server.alerts import types as kinds
from relay_server.alerts.types import AlertEvent

Key = tuple[str, str]
"""Kind and part: what makes two alerts of one robot the same."""

KEPT = 1000
"""Most alerts of one robot that are remembered after they were over."""


class Moment(NamedTuple):
    """A point in time.

    :param wall: Unix seconds
    :param tick: seconds of the monotonic clock
    """

    wall: float
    tick: float

    def ago(self, wall: float) -> float:
        """When something was, by the monotonic clock; what seems to lie ahead is now.

        :param wall: Unix seconds, of an earlier relay
        """
        return self.tick - max(0.0, self.wall - wall)


class AlertChange(NamedTuple):
    """Something worth telling."""

    alert: AlertRecord
    event: AlertEvent


@dataclass
class _Marks:
    """What is remembered of an alert beside its record; times by the monotonic clock.

    :param since: it was told last, or it is over
    :param news: people were told that it began or became worse
    :param severity: how bad it was then
    :param told: people know that it lasts
    """

    since: float
    news: float = -inf
    severity: int = -1
    told: bool = False


@dataclass
class _Robot:
    """The alerts of one robot.

    :param filled: monotonic seconds
    """

    open: dict[Key, AlertRecord] = field(default_factory=dict)
    over: dict[Key, AlertRecord] = field(default_factory=dict)
    marks: dict[Key, _Marks] = field(default_factory=dict)
    tokens: float = kinds.BURST
    filled: float = 0.0
    full: int = 0
    """Alerts that found no room since the flood began."""


class AlertStore:
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

    def load(self, records: list[AlertRecord], now: Moment) -> None:
        """Take up what an earlier relay kept. Of what is the same that which lasts counts, as when it was told.

        What is without news nobody was told of: it is told when it is told here again, or stays (:meth:`sweep`).
        """
        for each in sorted(records, key=lambda record: (record.over is None, record.last)):
            robot = self._robots.setdefault(each.robot_id, _Robot(filled=now.tick))
            key = (each.kind, each.about)
            (robot.open if each.over is None else robot.over)[key] = each
            marks = robot.marks[key] = _Marks(now.ago(each.last if each.over is None else each.over))
            if each.news:
                marks.news, marks.severity = now.ago(each.last), kinds.severity(each.level)
                marks.told = each.over is None
            if each.over is None:
                robot.over.pop(key, None)

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

    def untell(self, alert_ids: Collection[str]) -> None:
        """Nobody has heard of these after all: those that last are kept without news."""
        for robot in self._robots.values():
            for key, each in robot.open.items():
                if each.id in alert_ids:
                    robot.marks[key] = _Marks(robot.marks[key].since)
                    self._keep(robot, each._replace(news=0))

    def forget(self, robot_id: int) -> None:
        """The robot was removed."""
        robot = self._robots.pop(robot_id, None)
        if robot is not None:
            for each in (*robot.open.values(), *robot.over.values()):
                self._changed.pop(each.id, None)

    # --- what happens -------------------------------------------------------------------------------------

    def tell(
        self, robot_id: int, name: str, realm: str, kind: str, about: str, level: str, text: str, now: Moment
    ) -> list[AlertChange]:
        """Something is wrong: it joins what is known of the same, or is a new alert.

        :param name: of the robot, in its realm
        """
        robot = self._robots.setdefault(robot_id, _Robot(filled=now.tick))
        key, text = (kind, about), text[: kinds.TEXT]
        before = robot.open.get(key)
        if before is not None:
            return self._again(robot, before, level, text, now)
        back = robot.over.get(key)
        if back is not None and now.tick - robot.marks[key].since < kinds.REJOIN_SECONDS:
            return self._back(robot, back, level, text, now)
        if kind != kinds.FLOOD and not _has_place(robot, key) and not self._room(robot, now):
            robot.full += 1
            # Not what they say: whoever sees this may have no right to see them. But how bad it is.
            words = f"{robot.full} more alerts of {name} are not kept one by one"
            worst = max(level, "warning", key=kinds.severity)
            return self.tell(robot_id, name, realm, kinds.FLOOD, "", worst, words, now)
        made = AlertRecord(
            self._new_id(),
            robot_id,
            name,
            realm,
            kind,
            about,
            level,
            text,
            now.wall,
            now.wall,
            1,
            1,
            None,
            None,
            None,
        )
        robot.over.pop(key, None)
        robot.marks[key] = _Marks(now.tick)
        return [self._news(robot, made, AlertEvent.BEGUN, now)]

    def over(self, robot_id: int, kind: str, about: str, now: Moment) -> list[AlertChange]:
        """It is well again."""
        robot = self._robots.get(robot_id)
        lasts = None if robot is None else robot.open.get((kind, about))
        return [] if robot is None or lasts is None else self._end(robot, lasts, now)

    def acknowledge(
        self, alert_id: str, by: str, at: float, now: Moment
    ) -> tuple[AlertRecord | None, list[AlertChange]]:
        """Somebody looks after it; the alert, if there is one, and what that changes.

        What nobody will tell the end of is over by it, also where that was kept while no relay ran.

        :param at: since when, Unix seconds
        """
        found = self.find(alert_id)
        if found is None or found.over is not None:
            return found, []
        robot = self._robots[found.robot_id]
        if found.ack_at is None:
            found = self._keep(robot, found._replace(ack_by=by, ack_at=at))
            self.states += 1
        changes = self._end(robot, found, now) if kinds.endless(found.kind) else []
        return self.find(alert_id), changes

    def sweep(self, now: Moment) -> list[AlertChange]:
        """Tell what came back and stayed; end what nobody tells the end of; forget what was over long ago."""
        changes: list[AlertChange] = []
        for robot_id, robot in list(self._robots.items()):
            for key, each in list(robot.open.items()):
                marks = robot.marks[key]
                if now.tick - marks.since >= _patience(each.kind):
                    changes += self._end(robot, each, now)
                elif not marks.told:
                    changes += self._come_back(robot, each, now)
            _forget_old(robot, now)
            if not robot.open and not robot.over and now.tick - robot.filled > kinds.BURST / kinds.RATE:
                del self._robots[robot_id]
        return changes

    # --- how ----------------------------------------------------------------------------------------------

    def _again(
        self, robot: _Robot, before: AlertRecord, level: str, text: str, now: Moment
    ) -> list[AlertChange]:
        marks = robot.marks[before.kind, before.about]
        marks.since = now.tick
        worse = kinds.severity(level) > kinds.severity(before.level)
        now_it_is = before._replace(
            text=text, level=level if worse else before.level, last=now.wall, times=before.times + 1
        )
        if not worse:
            same = self._keep(robot, now_it_is)
            return [] if marks.told else self._come_back(robot, same, now)
        self.states += 1
        fresh = self._keep(robot, now_it_is._replace(ack_by=None, ack_at=None))
        if not marks.told:
            return self._come_back(robot, fresh, now)
        return [self._news(robot, fresh._replace(news=before.news + 1), AlertEvent.WORSE, now)]

    def _back(
        self, robot: _Robot, before: AlertRecord, level: str, text: str, now: Moment
    ) -> list[AlertChange]:
        del robot.over[before.kind, before.about]
        robot.marks[before.kind, before.about].since = now.tick
        back = before._replace(
            level=level, text=text, last=now.wall, times=before.times + 1, over=None, ack_by=None, ack_at=None
        )
        self.states += 1
        return self._come_back(robot, self._keep(robot, back), now)

    def _come_back(self, robot: _Robot, back: AlertRecord, now: Moment) -> list[AlertChange]:
        """Tell of it, unless people were told of it a moment ago, and as bad."""
        marks = robot.marks[back.kind, back.about]
        event = AlertEvent.BEGUN
        if now.tick - marks.news < kinds.NEWS_SECONDS:
            if kinds.severity(back.level) <= marks.severity:
                return []
            event = AlertEvent.WORSE
        return [self._news(robot, back._replace(news=back.news + 1), event, now)]

    def _end(self, robot: _Robot, lasts: AlertRecord, now: Moment) -> list[AlertChange]:
        key = (lasts.kind, lasts.about)
        del robot.open[key]
        if lasts.kind == kinds.FLOOD:
            robot.full = 0
        marks = robot.marks[key]
        told, marks.told, marks.since = marks.told, False, now.tick
        robot.over[key] = over = lasts._replace(over=now.wall, news=lasts.news + told)
        self._changed[over.id] = over
        self.states += 1
        while len(robot.over) > KEPT:
            _forget(robot, next(iter(robot.over)))
        # The end of what was told is told, however soon it came: nobody shall go on worrying.
        return [AlertChange(over, AlertEvent.OVER)] if told else []

    def _news(self, robot: _Robot, alert: AlertRecord, event: AlertEvent, now: Moment) -> AlertChange:
        self.states += 1
        marks = robot.marks[alert.kind, alert.about]
        marks.news, marks.severity, marks.told = now.tick, kinds.severity(alert.level), True
        return AlertChange(self._keep(robot, alert), event)

    def _keep(self, robot: _Robot, alert: AlertRecord) -> AlertRecord:
        robot.open[alert.kind, alert.about] = alert
        self._changed[alert.id] = alert
        return alert

    @staticmethod
    def _room(robot: _Robot, now: Moment) -> bool:
        robot.tokens = min(kinds.BURST, robot.tokens + (now.tick - robot.filled) * kinds.RATE)
        robot.filled = now.tick
        if len(robot.open) >= kinds.OPEN or robot.tokens < 1:
            return False
        robot.tokens -= 1
        return True


def _has_place(robot: _Robot, key: Key) -> bool:
    """Whether an alert needs no room among the others. What was over of late counts as well: else parts without end."""
    kind = key[0]
    if kind not in kinds.RESERVED:
        return kind in kinds.SINGLE
    return sum(each[0] == kind and each != key for each in (*robot.open, *robot.over)) < kinds.RESERVE


def _patience(kind: str) -> float:
    """Seconds after which an alert that was not told again is over."""
    if kind == kinds.FLOOD:
        return kinds.FLOOD_SECONDS
    return kinds.ENDLESS_SECONDS if kinds.endless(kind) else float("inf")


def _forget_old(robot: _Robot, now: Moment) -> None:
    for key in list(robot.over):
        if now.tick - robot.marks[key].since > kinds.SHOWN_SECONDS:
            _forget(robot, key)


def _forget(robot: _Robot, key: Key) -> None:
    """What was over is remembered no more; what is known of the same while it lasts stays."""
    del robot.over[key]
    if key not in robot.open:
        del robot.marks[key]
