"""Alerts, and the rules by which users are notified of them."""

from __future__ import annotations

import secrets
from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType
from typing import Any

from sqlalchemy import and_, case, delete, func, insert, literal, or_, select, tuple_, update
from sqlalchemy.orm import Session

from relay_db.models import Alert, AlertRule, Realm, Robot, User
from relay_db.names import checked_label, sanitise
from relay_db.queries.records import AlertRecord, AlertRuleRecord, fetch_all, fetch_one, record_of
from relay_db.queries.revision import bump
from relay_db.queries.users import live_user
from relay_protocol.errors import Invalid, NotFound
from relay_protocol.limits import TEXT_LENGTH

MAX_RULES = 32
"""Most rules of one user."""

MAX_ALERTS = 100_000
"""Most alerts of one realm, whatever their age."""

MAX_RULE_NUMBER = 2**31 - 1
"""Highest number of a rule."""

_MAX_RECENT = 1000
"""Most ended alerts of one robot that :func:`recent_alerts` returns."""

_PAGE = 1000
_MAX_BY_ROBOT = 8
"""Most robots for which the index on the robot is used. For more the index on the time is used."""


def save_alerts(s: Session, records: Iterable[AlertRecord]) -> None:
    """Write new and changed alerts. Alerts of removed robots are skipped.

    Another process may have written an acknowledgement meanwhile: it stays unless the alert became worse since.
    """
    records = list(records)
    robot_ids = {each.robot_id for each in records}
    existing = set(s.scalars(select(Robot.id).where(Robot.id.in_(robot_ids)))) if robot_ids else set()
    for each in records:
        if each.robot_id not in existing:
            continue
        values = _values(each)
        updated = s.execute(
            update(Alert)
            .where(Alert.id == each.id)
            .values({**values, **_acknowledgement(each)})
            .returning(Alert.id)
        )
        if updated.first() is None:
            s.execute(insert(Alert).values(id=each.id, **values))


def _acknowledgement(record: AlertRecord) -> dict[str, Any]:
    """The acknowledgement of an existing row after a record without one is written."""
    if record.ack_at is not None:
        return {}
    same = or_(
        literal(record.over is not None),
        and_(Alert.over_at.is_(None), Alert.notification_count == record.notification_count),
    )
    return {
        "ack_by": case((same, Alert.ack_by), else_=None),
        "ack_at": case((same, Alert.ack_at), else_=None),
    }


def _values(record: AlertRecord) -> dict[str, Any]:
    return {
        "robot_id": record.robot_id,
        "kind": sanitise(record.kind, 63),
        "about": sanitise(record.about),
        "level": record.level,
        "text": sanitise(record.text, TEXT_LENGTH),
        "first_at": record.first,
        "last_at": record.last,
        "report_count": record.report_count,
        "notification_count": record.notification_count,
        "over_at": record.over,
        "ack_by": record.ack_by,
        "ack_at": record.ack_at,
    }


def list_alerts(
    s: Session,
    robots: Collection[int] | None = None,
    *,
    open: bool | None = None,
    limit: int = 100,
    after: tuple[float, str] | None = None,
    except_kinds: Mapping[str, Collection[int]] = MappingProxyType({}),
    except_alerts: Collection[tuple[int, str, str]] = (),
) -> list[AlertRecord]:
    """Alerts, the latest first.

    :param robots: only of the robots with these numbers; ``None`` for all
    :param open: only open ones, or only ended ones
    :param after: ``last`` and ``id`` of the alert before the first
    :param except_kinds: numbers of robots whose alerts of a kind are left out, by kind
    :param except_alerts: number of the robot, kind and ``about`` of alerts that are left out
    """
    query = _alerts().order_by(Alert.last_at.desc(), Alert.id).limit(limit)
    if robots is not None:
        # For many robots by time: by robot, all their alerts would be sorted for one page.
        of: Any = Alert.robot_id if len(robots) <= _MAX_BY_ROBOT else Alert.robot_id + 0
        query = query.where(of.in_(list(robots)))
    if after is not None:
        last, id = after
        # The first condition is implied by the second. Only the first lets the index start at that position.
        query = query.where(Alert.last_at <= last, or_(Alert.last_at < last, Alert.id > sanitise(id, 32)))
    for kind, of in except_kinds.items():
        query = query.where(or_(Alert.kind != kind, Alert.robot_id.not_in(list(of))))
    if except_alerts:
        query = query.where(tuple_(Alert.robot_id, Alert.kind, Alert.about).not_in(list(except_alerts)))
    if open is not None:
        query = query.where(Alert.over_at.is_(None) if open else Alert.over_at.is_not(None))
    return fetch_all(s, AlertRecord, query)


def recent_alerts(s: Session, since: float) -> list[AlertRecord]:
    """All open alerts, and of each robot the latest that ended after a time.

    :param since: Unix seconds
    """
    # The limit is for each robot, so that one with many alerts displaces no others.
    place = func.row_number().over(partition_by=Alert.robot_id, order_by=(Alert.last_at.desc(), Alert.id))
    late = select(Alert.id, place.label("place")).where(Alert.over_at >= since).subquery()
    chosen = select(late.c.id).where(late.c.place <= _MAX_RECENT)
    query = _alerts().where(or_(Alert.over_at.is_(None), Alert.id.in_(chosen)))
    return fetch_all(s, AlertRecord, query.order_by(Alert.last_at.desc()))


def get_alert(s: Session, alert_id: str) -> AlertRecord | None:
    return fetch_one(s, AlertRecord, _alerts().where(Alert.id == sanitise(alert_id, 32)))


def acknowledge_alert(s: Session, alert_id: str, by: str, at: float) -> AlertRecord:
    """Acknowledge an open alert. An earlier acknowledgement stays. A running relay is notified by the revision.

    :param at: Unix seconds
    :raises NotFound: no such alert
    :raises Invalid: it is over
    """
    unacknowledged = Alert.over_at.is_(None), Alert.ack_at.is_(None)
    change = (
        update(Alert)
        .where(Alert.id == sanitise(alert_id, 32), *unacknowledged)
        .values(ack_by=sanitise(by), ack_at=at)
    )
    changed = s.execute(change.returning(Alert.id)).first() is not None
    found = get_alert(s, alert_id)
    if found is None:
        raise NotFound("there is no such alert")
    if found.over is not None:
        raise Invalid("this alert is over already")
    if changed:
        bump(s)
    return found


def acknowledgements(s: Session) -> dict[str, tuple[str, float]]:
    """User and time (Unix seconds) of the acknowledgements of open alerts, by the id of the alert."""
    query = select(Alert.id, Alert.ack_by, Alert.ack_at).where(
        Alert.over_at.is_(None), Alert.ack_at.is_not(None)
    )
    return {row.id: (row.ack_by or "", row.ack_at) for row in s.execute(query)}


def purge_alerts(s: Session, before: float, max_alerts: int = MAX_ALERTS, batch: int = _PAGE) -> int:
    """Delete a batch of ended alerts that are too old or too many; returns how many. Call it until it returns 0.

    :param before: Unix seconds; ended alerts with an earlier last report are deleted
    :param max_alerts: most alerts of a realm, whatever their age
    :param batch: most alerts that are deleted at once, of each realm
    """
    over = Alert.over_at.is_not(None)
    old = select(Alert.id).where(over, Alert.last_at < before).limit(batch)
    deleted = len(s.scalars(delete(Alert).where(Alert.id.in_(old)).returning(Alert.id)).all())
    if deleted:
        return deleted
    count = func.count()
    full = select(Robot.realm_id, count).join(Alert, Alert.robot_id == Robot.id).group_by(Robot.realm_id)
    for realm, rows in s.execute(full.having(count > max_alerts)).all():
        in_realm = Alert.robot_id.in_(select(Robot.id).where(Robot.realm_id == realm))
        oldest = (
            select(Alert.id)
            .where(over, in_realm)
            .order_by(Alert.last_at)
            .limit(min(batch, rows - max_alerts))
        )
        deleted += len(s.scalars(delete(Alert).where(Alert.id.in_(oldest)).returning(Alert.id)).all())
    return deleted


def add_alert_rule(
    s: Session,
    user_id: int,
    *,
    label: str = "",
    robots: str = "*",
    kinds: Collection[str] = (),
    level: str,
    channel: str,
    url: str = "",
    secret: str = "",
    notify_end: bool = True,
    group_s: float,
    quiet: Mapping[str, str] | None = None,
    created: float,
) -> AlertRuleRecord:
    """Add a rule, which the caller has checked.

    :param label: for display
    :param created: Unix seconds
    :raises Invalid: the user has too many rules, or the label is not valid
    :raises NotFound: no such user
    """
    if s.scalar(select(User.id).where(User.id == user_id).with_for_update()) is None:
        raise NotFound("there is no such user")
    count = s.scalar(select(func.count()).select_from(AlertRule).where(AlertRule.user_id == user_id)) or 0
    if count >= MAX_RULES:
        raise Invalid(f"a user has at most {MAX_RULES} rules for alerts; delete one first")
    bump(s)
    number = _unused_number(s)
    values = {
        "id": number,
        "user_id": user_id,
        "label": checked_label(label, "label of a rule"),
        "robots": robots,
        "kinds": list(kinds),
        "level": level,
        "channel": channel,
        "url": url,
        "secret": secret,
        "notify_end": notify_end,
        "group_s": group_s,
        "quiet": None if quiet is None else dict(quiet),
        "created": created,
    }
    s.execute(insert(AlertRule).values(**values))
    return next(each for each in list_alert_rules(s, user_id) if each.id == number)


def _unused_number(s: Session) -> int:
    """A random number that no rule has. Counted numbers would show users how many rules others add."""
    while True:
        number = secrets.randbelow(MAX_RULE_NUMBER) + 1
        if s.scalar(select(AlertRule.id).where(AlertRule.id == number)) is None:
            return number


def list_alert_rules(s: Session, user_id: int | None = None) -> list[AlertRuleRecord]:
    """The rules of one user, or of all users that are not disabled, oldest first."""
    query: Any = (
        select(
            AlertRule.id,
            AlertRule.user_id,
            User.name.label("user"),
            Realm.name.label("realm"),
            AlertRule.label,
            AlertRule.robots,
            AlertRule.kinds,
            AlertRule.level,
            AlertRule.channel,
            AlertRule.url,
            AlertRule.secret,
            AlertRule.notify_end,
            AlertRule.group_s,
            AlertRule.quiet,
            AlertRule.created,
        )
        .join(User, User.id == AlertRule.user_id)
        .join(Realm, Realm.id == User.realm_id)
        .order_by(AlertRule.created, AlertRule.id)
    )
    query = query.where(live_user() if user_id is None else User.id == user_id)
    return [record_of(AlertRuleRecord, row, kinds=tuple(row.kinds)) for row in s.execute(query)]


def remove_alert_rule(s: Session, rule_id: int, user_id: int | None = None) -> bool:
    """Remove a rule; false if there is none of this number.

    :param user_id: only if the rule belongs to this user
    """
    statement = delete(AlertRule).where(AlertRule.id == rule_id)
    if user_id is not None:
        statement = statement.where(AlertRule.user_id == user_id)
    found = s.scalar(statement.returning(AlertRule.id)) is not None
    if found:
        bump(s)
    return found


def _alerts() -> Any:
    query: Any = select(
        Alert.id,
        Alert.robot_id,
        Robot.name.label("robot"),
        Realm.name.label("realm"),
        Alert.kind,
        Alert.about,
        Alert.level,
        Alert.text,
        Alert.first_at.label("first"),
        Alert.last_at.label("last"),
        Alert.report_count,
        Alert.notification_count,
        Alert.over_at.label("over"),
        Alert.ack_by,
        Alert.ack_at,
    ).join(Robot, Robot.id == Alert.robot_id)
    return query.join(Realm, Realm.id == Robot.realm_id)
