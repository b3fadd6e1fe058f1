"""All open alerts and those that ended recently; repeated reports join the alert that is there.

Pure: no clock, no database. Callers pass the time, and take the changed records to write them. Users see times of the
wall clock, which may be set; durations are measured by the monotonic clock.
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
"""Kind and part (``about``), by which two alerts of a robot are the same."""

MAX_OVER = 1000
"""Most ended alerts of a robot in memory."""


class Moment(NamedTuple):
    """A point in time.

    :param wall: Unix seconds
    :param tick: seconds of the monotonic clock
    """

    wall: float
    tick: float

    def ago(self, wall: float) -> float:
        """The monotonic time of a wall time; a future time counts as now.

        :param wall: Unix seconds, of an earlier relay
        """
        return self.tick - max(0.0, self.wall - wall)


class AlertChange(NamedTuple):
    """A change that users are notified of."""

    alert: AlertRecord
    event: AlertEvent


@dataclass
class _Marks:
    """State of an alert beside its record; times by the monotonic clock.

    :param since: of the last report, or of the end
    :param notified: of the last notification that it began or became worse
    :param severity: of its level then
    :param announced: users know that it lasts
    :param own: this relay has announced it last
    """

    since: float
    notified: float = -inf
    severity: int = -1
    announced: bool = False
    own: bool = False


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
    """Alerts over the limits since the flood began."""


class AlertStore:
    """Alerts by robot.

    :param new_id: makes a new id
    """

    def __init__(self, new_id: Callable[[], str]) -> None:
        self.states = 0
        """Counts each beginning, end, worsening and acknowledgement, with or without a notification."""
        self._new_id = new_id
        self._robots: dict[int, _Robot] = {}
        self._changed: dict[str, AlertRecord] = {}

    def __iter__(self) -> Iterator[AlertRecord]:
        """All alerts in memory."""
        for robot in self._robots.values():
            yield from robot.open.values()
            yield from robot.over.values()

    def load(self, records: list[AlertRecord], now: Moment) -> None:
        """Load stored alerts. Of two that are the same the open one counts.

        No user was notified of an alert with ``notification_count`` 0. It is announced when it is reported again or
        stays open (:meth:`sweep`).
        """
        for each in sorted(records, key=lambda record: (record.over is None, record.last)):
            robot = self._robots.setdefault(each.robot_id, _Robot(filled=now.tick))
            key = (each.kind, each.about)
            (robot.open if each.over is None else robot.over)[key] = each
            robot.marks[key] = _marks(each, now)
            if each.over is None:
                robot.over.pop(key, None)

    def mirror(self, record: AlertRecord, now: Moment) -> bool:
        """Take over what another relay of the cluster has written, if it is newer; no user is notified again.

        If both have raised the same alert, before they knew of each other's, the one that began first stays.

        :returns: whether it was taken over
        """
        robot = self._robots.setdefault(record.robot_id, _Robot(filled=now.tick))
        key = (record.kind, record.about)
        lasts, over = robot.open.get(key), robot.over.get(key)
        mine = lasts if lasts is not None and lasts.id == record.id else over
        if lasts is not None and lasts is mine and not record.notification_count and not robot.marks[key].own:
            # That relay has stopped before it could notify a user.
            robot.marks[key] = _Marks(robot.marks[key].since)
            robot.open[key] = unreported = lasts._replace(notification_count=0)
            if record.id in self._changed:
                self._changed[record.id] = unreported
            return False
        if mine is not None and mine.id == record.id:
            if _age(record) <= _age(mine):
                return False
        elif over is not None and record.over is not None and record.first < over.first:
            return False
        if lasts is not None and lasts.id != record.id:
            if record.over is not None:
                return False
            kept, other = sorted((lasts, record), key=lambda each: (each.first, each.id))
            self._changed[other.id] = other._replace(over=now.wall)
            self.states += 1
            if kept is lasts:
                return False
        self.states += 1
        robot.open.pop(key, None)
        robot.over.pop(key, None)
        (robot.open if record.over is None else robot.over)[key] = record
        robot.marks[key] = _marks(record, now)
        self._changed.pop(record.id, None)
        while len(robot.over) > MAX_OVER:
            _forget(robot, next(iter(robot.over)))
        return True

    def take_changed(self) -> list[AlertRecord]:
        """The records to write, each once."""
        changed, self._changed = self._changed, {}
        return list(changed.values())

    def put_back(self, records: list[AlertRecord]) -> None:
        """Take back records that could not be written; newer changes win."""
        self._changed = {each.id: each for each in records} | self._changed

    def open_of(self, robot_id: int) -> list[AlertRecord]:
        """The open alerts of a robot."""
        robot = self._robots.get(robot_id)
        return [] if robot is None else list(robot.open.values())

    def find_open(self, robot_id: int, kind: str, about: str = "") -> AlertRecord | None:
        """An alert, if it is open."""
        robot = self._robots.get(robot_id)
        return None if robot is None else robot.open.get((kind, about))

    def find_over(self, robot_id: int, kind: str, about: str = "") -> AlertRecord | None:
        """An alert, if it has ended recently and is not open."""
        robot, key = self._robots.get(robot_id), (kind, about)
        return None if robot is None or key in robot.open else robot.over.get(key)

    def find(self, alert_id: str) -> AlertRecord | None:
        """An alert by its id."""
        return next((each for each in self if each.id == alert_id), None)

    def mark_unreported(self, alert_ids: Collection[str]) -> None:
        """Reset these alerts, if open: their notifications have reached no user."""
        for robot in self._robots.values():
            for key, each in robot.open.items():
                if each.id in alert_ids:
                    robot.marks[key] = _Marks(robot.marks[key].since)
                    self._put(robot, each._replace(notification_count=0))

    def forget_robot(self, robot_id: int) -> None:
        """Drop the alerts of a robot that was removed."""
        robot = self._robots.pop(robot_id, None)
        if robot is not None:
            for each in (*robot.open.values(), *robot.over.values()):
                self._changed.pop(each.id, None)

    # --- what happens -------------------------------------------------------------------------------------

    def report(
        self, robot_id: int, name: str, realm: str, kind: str, about: str, level: str, text: str, now: Moment
    ) -> list[AlertChange]:
        """Report an alert: it joins the open or recent one of the same key, or is a new one.

        :param name: of the robot, in its realm
        """
        robot = self._robots.setdefault(robot_id, _Robot(filled=now.tick))
        key, text = (kind, about), text[: kinds.MAX_TEXT]
        before = robot.open.get(key)
        if before is not None:
            return self._repeat(robot, before, level, text, now)
        back = robot.over.get(key)
        if back is not None and now.tick - robot.marks[key].since < kinds.REJOIN_SECONDS:
            return self._reopen(robot, back, level, text, now)
        if kind != kinds.FLOOD and not _is_reserved(robot, key) and not self._take_token(robot, now):
            robot.full += 1
            # Without their texts, which readers of this may have no right to see; but with the worst level.
            words = f"{robot.full} more alerts of {name} are not listed one by one"
            worst = max(level, "warning", key=kinds.severity)
            return self.report(robot_id, name, realm, kinds.FLOOD, "", worst, words, now)
        made = AlertRecord(
            id=self._new_id(),
            robot_id=robot_id,
            robot=name,
            realm=realm,
            kind=kind,
            about=about,
            level=level,
            text=text,
            first=now.wall,
            last=now.wall,
            report_count=1,
            notification_count=1,
            over=None,
            ack_by=None,
            ack_at=None,
        )
        robot.over.pop(key, None)
        robot.marks[key] = _Marks(now.tick)
        return [self._announce(robot, made, AlertEvent.BEGUN, now)]

    def end(self, robot_id: int, kind: str, about: str, now: Moment) -> list[AlertChange]:
        """End an alert."""
        robot = self._robots.get(robot_id)
        lasts = None if robot is None else robot.open.get((kind, about))
        return [] if robot is None or lasts is None else self._end(robot, lasts, now)

    def acknowledge(
        self, alert_id: str, by: str, at: float, now: Moment
    ) -> tuple[AlertRecord | None, list[AlertChange]]:
        """Acknowledge an alert; returns it, if there is one, and the changes.

        Kinds without an end of their own end by it, also if it was written while no relay ran.

        :param at: of the acknowledgement, Unix seconds
        """
        found = self.find(alert_id)
        if found is None or found.over is not None:
            return found, []
        robot = self._robots[found.robot_id]
        if found.ack_at is None:
            found = self._put(robot, found._replace(ack_by=by, ack_at=at))
            self.states += 1
        changes = self._end(robot, found, now) if kinds.endless(found.kind) else []
        return self.find(alert_id), changes

    def sweep(self, now: Moment, owned: Callable[[int], bool] = lambda robot_id: True) -> list[AlertChange]:
        """Announce alerts that came back and stayed, end those without an end of their own, drop old ones.

        :param owned: whether the alerts of a robot are this relay's; only these change
        """
        changes: list[AlertChange] = []
        for robot_id, robot in list(self._robots.items()):
            for key, each in list(robot.open.items()) if owned(robot_id) else ():
                marks = robot.marks[key]
                # An acknowledgement may have been written while no relay owned it.
                acknowledged = kinds.endless(each.kind) and each.ack_at is not None
                if acknowledged or now.tick - marks.since >= _timeout(each.kind):
                    changes += self._end(robot, each, now)
                elif not marks.announced:
                    changes += self._announce_return(robot, each, now)
            _forget_old(robot, now)
            if not robot.open and not robot.over and now.tick - robot.filled > kinds.BURST / kinds.RATE:
                del self._robots[robot_id]
        return changes

    # --- how ----------------------------------------------------------------------------------------------

    def _repeat(
        self, robot: _Robot, before: AlertRecord, level: str, text: str, now: Moment
    ) -> list[AlertChange]:
        marks = robot.marks[before.kind, before.about]
        marks.since = now.tick
        worse = kinds.severity(level) > kinds.severity(before.level)
        now_it_is = before._replace(
            text=text,
            level=level if worse else before.level,
            last=now.wall,
            report_count=before.report_count + 1,
        )
        if not worse:
            same = self._put(robot, now_it_is)
            return [] if marks.announced else self._announce_return(robot, same, now)
        self.states += 1
        fresh = self._put(robot, now_it_is._replace(ack_by=None, ack_at=None))
        if not marks.announced:
            return self._announce_return(robot, fresh, now)
        return [
            self._announce(
                robot, fresh._replace(notification_count=before.notification_count + 1), AlertEvent.WORSE, now
            )
        ]

    def _reopen(
        self, robot: _Robot, before: AlertRecord, level: str, text: str, now: Moment
    ) -> list[AlertChange]:
        del robot.over[before.kind, before.about]
        robot.marks[before.kind, before.about].since = now.tick
        back = before._replace(
            level=level,
            text=text,
            last=now.wall,
            report_count=before.report_count + 1,
            over=None,
            ack_by=None,
            ack_at=None,
        )
        self.states += 1
        return self._announce_return(robot, self._put(robot, back), now)

    def _announce_return(self, robot: _Robot, back: AlertRecord, now: Moment) -> list[AlertChange]:
        """Announce an alert, unless it was announced recently with the same or a worse level."""
        marks = robot.marks[back.kind, back.about]
        event = AlertEvent.BEGUN
        if now.tick - marks.notified < kinds.NEWS_SECONDS:
            if kinds.severity(back.level) <= marks.severity:
                return []
            event = AlertEvent.WORSE
        return [
            self._announce(robot, back._replace(notification_count=back.notification_count + 1), event, now)
        ]

    def _end(self, robot: _Robot, lasts: AlertRecord, now: Moment) -> list[AlertChange]:
        key = (lasts.kind, lasts.about)
        del robot.open[key]
        if lasts.kind == kinds.FLOOD:
            robot.full = 0
        marks = robot.marks[key]
        announced, marks.announced, marks.since = marks.announced, False, now.tick
        robot.over[key] = over = lasts._replace(
            over=now.wall, notification_count=lasts.notification_count + announced
        )
        self._changed[over.id] = over
        self.states += 1
        while len(robot.over) > MAX_OVER:
            _forget(robot, next(iter(robot.over)))
        # The end of an announced alert is announced, however soon it comes.
        return [AlertChange(over, AlertEvent.OVER)] if announced else []

    def _announce(self, robot: _Robot, alert: AlertRecord, event: AlertEvent, now: Moment) -> AlertChange:
        self.states += 1
        marks = robot.marks[alert.kind, alert.about]
        marks.notified, marks.severity, marks.announced = now.tick, kinds.severity(alert.level), True
        marks.own = True
        return AlertChange(self._put(robot, alert), event)

    def _put(self, robot: _Robot, alert: AlertRecord) -> AlertRecord:
        robot.open[alert.kind, alert.about] = alert
        self._changed[alert.id] = alert
        return alert

    @staticmethod
    def _take_token(robot: _Robot, now: Moment) -> bool:
        robot.tokens = min(kinds.BURST, robot.tokens + (now.tick - robot.filled) * kinds.RATE)
        robot.filled = now.tick
        if len(robot.open) >= kinds.MAX_OPEN or robot.tokens < 1:
            return False
        robot.tokens -= 1
        return True


def _marks(record: AlertRecord, now: Moment) -> _Marks:
    """The marks of an alert that this relay has not raised itself, or has not since its start."""
    marks = _Marks(now.ago(record.last if record.over is None else record.over))
    if record.notification_count:
        marks.notified, marks.severity = now.ago(record.last), kinds.severity(record.level)
        marks.announced = record.over is None
    return marks


def _age(record: AlertRecord) -> tuple[float, int, bool, int, float]:
    """Greater for a later state of the same alert."""
    latest, over = max(record.last, record.over or 0.0), record.over is not None
    return latest, record.report_count, over, record.notification_count, record.ack_at or 0.0


def _is_reserved(robot: _Robot, key: Key) -> bool:
    """Whether the limits do not apply to an alert. Recent ended ones count, as parts could be endless."""
    kind = key[0]
    if kind not in kinds.RESERVED:
        return kind in kinds.SINGLE
    return sum(each[0] == kind and each != key for each in (*robot.open, *robot.over)) < kinds.RESERVE


def _timeout(kind: str) -> float:
    """Seconds without a report after which an alert ends."""
    if kind == kinds.FLOOD:
        return kinds.FLOOD_SECONDS
    return kinds.ENDLESS_SECONDS if kinds.endless(kind) else float("inf")


def _forget_old(robot: _Robot, now: Moment) -> None:
    for key in list(robot.over):
        if now.tick - robot.marks[key].since > kinds.SHOWN_SECONDS:
            _forget(robot, key)


def _forget(robot: _Robot, key: Key) -> None:
    del robot.over[key]
    if key not in robot.open:
        del robot.marks[key]
