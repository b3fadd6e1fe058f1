"""Alerts, and the rules by which people are told of them."""

from __future__ import annotations

import secrets
from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType
from typing import Any

from sqlalchemy import and_, case, delete, func, insert, literal, or_, select, tuple_, update
from sqlalchemy.orm import Session

from relay_db.models import Alert, AlertRule, Realm, Robot, User
from relay_db.names import label, sanitise
from relay_db.queries.records import AlertRecord, AlertRuleRecord
from relay_db.queries.state import bump
from relay_db.queries.users import live_user
from relay_protocol.errors import Invalid, NotFound
from relay_protocol.limits import WORDS

RULES = 32
"""Most rules of one user."""

ALERTS = 100_000
"""Most alerts kept of one realm, whatever their age."""

NUMBERS = 2**31 - 1
"""The greatest number of a rule."""

_RECENT = 1000
"""Most alerts of one robot that are over, of those of late."""

_PAGE = 1000
_BY_ROBOT = 8
"""Of no more robots alerts are looked up by robot."""


def save_alerts(s: Session, records: Iterable[AlertRecord]) -> None:
    """Keep alerts as they are now, new ones and known ones; those of robots that are gone are let go.

    Who looks after one may have been written by somebody else meanwhile, and stays unless there was news since.
    """
    records = list(records)
    asked = {each.robot_id for each in records}
    there = set(s.scalars(select(Robot.id).where(Robot.id.in_(asked)))) if asked else set()
    for each in records:
        if each.robot_id not in there:
            continue
        values = _values(each)
        there_too = s.execute(
            update(Alert)
            .where(Alert.id == each.id)
            .values({**values, **_looked_after(each)})
            .returning(Alert.id)
        )
        if there_too.first() is None:
            s.execute(insert(Alert).values(id=each.id, **values))


def _looked_after(record: AlertRecord) -> dict[str, Any]:
    """What a row that is there says of who looks after it, once the record is written."""
    if record.ack_at is not None:
        return {}
    same = or_(literal(record.over is not None), and_(Alert.over_at.is_(None), Alert.news == record.news))
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
        "text": sanitise(record.text, WORDS),
        "first_at": record.first,
        "last_at": record.last,
        "times": record.times,
        "news": record.news,
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
    kinds_but: Mapping[str, Collection[int]] = MappingProxyType({}),
    but: Collection[tuple[int, str, str]] = (),
) -> list[AlertRecord]:
    """Alerts, the latest first.

    :param robots: of these robots only; ``None`` for all
    :param open: only those that last, or only those that are over
    :param after: only those that come after the one with this ``last`` and ``id``, whether it is there or not
    :param kinds_but: by kind, robots of which none of it is wanted
    :param but: robot, kind and part of those that are not wanted
    """
    query = _alerts().order_by(Alert.last_at.desc(), Alert.id).limit(limit)
    if robots is not None:
        # Of many robots by time: by robot, all they ever told would be sorted for one page.
        of: Any = Alert.robot_id if len(robots) <= _BY_ROBOT else Alert.robot_id + 0
        query = query.where(of.in_(list(robots)))
    if after is not None:
        last, id = after
        # The first condition says nothing new: by it an index is read from there on, which by an 'or' it is not.
        query = query.where(Alert.last_at <= last, or_(Alert.last_at < last, Alert.id > sanitise(id, 32)))
    for kind, of in kinds_but.items():
        query = query.where(or_(Alert.kind != kind, Alert.robot_id.not_in(list(of))))
    if but:
        query = query.where(tuple_(Alert.robot_id, Alert.kind, Alert.about).not_in(list(but)))
    if open is not None:
        query = query.where(Alert.over_at.is_(None) if open else Alert.over_at.is_not(None))
    return [AlertRecord(*row) for row in s.execute(query)]


def recent_alerts(s: Session, since: float) -> list[AlertRecord]:
    """All alerts that last, and of each robot the latest that were over after this moment.

    :param since: Unix seconds
    """
    # By robot: what one tells must not keep another's alerts from being known.
    place = func.row_number().over(partition_by=Alert.robot_id, order_by=(Alert.last_at.desc(), Alert.id))
    late = select(Alert.id, place.label("place")).where(Alert.over_at >= since).subquery()
    chosen = select(late.c.id).where(late.c.place <= _RECENT)
    query = _alerts().where(or_(Alert.over_at.is_(None), Alert.id.in_(chosen)))
    return [AlertRecord(*row) for row in s.execute(query.order_by(Alert.last_at.desc()))]


def get_alert(s: Session, alert_id: str) -> AlertRecord | None:
    """One alert."""
    row = s.execute(_alerts().where(Alert.id == sanitise(alert_id, 32))).one_or_none()
    return None if row is None else AlertRecord(*row)


def acknowledge_alert(s: Session, alert_id: str, by: str, at: float) -> AlertRecord:
    """Somebody looks after an alert; a relay that runs takes it up by the revision. The first who did stays.

    :param at: Unix seconds
    :raises NotFound: no such alert
    :raises Invalid: it is over
    """
    lasts = Alert.over_at.is_(None), Alert.ack_at.is_(None)
    known = update(Alert).where(Alert.id == sanitise(alert_id, 32), *lasts)
    values = known.values(ack_by=sanitise(by), ack_at=at)
    fresh = s.execute(values.returning(Alert.id)).first() is not None
    found = get_alert(s, alert_id)
    if found is None:
        raise NotFound("there is no such alert")
    if found.over is not None:
        raise Invalid("this alert is over already")
    if fresh:
        bump(s)
    return found


def acknowledgements(s: Session) -> dict[str, tuple[str, float]]:
    """Who looks after which of the alerts that last, and since when."""
    query = select(Alert.id, Alert.ack_by, Alert.ack_at).where(
        Alert.over_at.is_(None), Alert.ack_at.is_not(None)
    )
    return {row.id: (row.ack_by or "", row.ack_at) for row in s.execute(query)}


def purge_alerts(s: Session, before: float, most: int = ALERTS, batch: int = _PAGE) -> int:
    """Forget a batch of what is over and too old, or too much for its realm; how many. Call again until it is 0.

    :param before: Unix seconds; what was told last before that goes
    :param most: rows of a realm that may stay, whatever their age
    :param batch: most that go at once, of each realm
    """
    over = Alert.over_at.is_not(None)
    old = select(Alert.id).where(over, Alert.last_at < before).limit(batch)
    gone = len(s.scalars(delete(Alert).where(Alert.id.in_(old)).returning(Alert.id)).all())
    if gone:
        return gone
    count = func.count()
    full = select(Robot.realm_id, count).join(Alert, Alert.robot_id == Robot.id).group_by(Robot.realm_id)
    for realm, rows in s.execute(full.having(count > most)).all():
        theirs = Alert.robot_id.in_(select(Robot.id).where(Robot.realm_id == realm))
        oldest = select(Alert.id).where(over, theirs).order_by(Alert.last_at).limit(min(batch, rows - most))
        gone += len(s.scalars(delete(Alert).where(Alert.id.in_(oldest)).returning(Alert.id)).all())
    return gone


def add_alert_rule(
    s: Session,
    user_id: int,
    *,
    name: str = "",
    robots: str = "*",
    kinds: Collection[str] = (),
    level: str,
    channel: str,
    url: str = "",
    secret: str = "",
    over: bool = True,
    group_s: float,
    quiet: Mapping[str, str] | None = None,
    created: float,
) -> AlertRuleRecord:
    """Tell a user of alerts from now on. What the words mean the relay judges before.

    :param name: for people
    :param created: Unix seconds
    :raises Invalid: the user has too many rules, or the name is no line of text
    :raises NotFound: no such user
    """
    if s.scalar(select(User.id).where(User.id == user_id).with_for_update()) is None:
        raise NotFound("there is no such user")
    mine = s.scalar(select(func.count()).select_from(AlertRule).where(AlertRule.user_id == user_id)) or 0
    if mine >= RULES:
        raise Invalid(f"a user has at most {RULES} rules for alerts; delete one first")
    bump(s)
    number = _fresh_number(s)
    values = {
        "id": number,
        "user_id": user_id,
        "label": label(name, "label of a rule"),
        "robots": robots,
        "kinds": list(kinds),
        "level": level,
        "channel": channel,
        "url": url,
        "secret": secret,
        "over": over,
        "group_s": group_s,
        "quiet": None if quiet is None else dict(quiet),
        "created": created,
    }
    s.execute(insert(AlertRule).values(**values))
    return next(each for each in list_alert_rules(s, user_id) if each.id == number)


def _fresh_number(s: Session) -> int:
    """A number that no rule has. Drawn: who sees his own must not learn how many others are made."""
    while True:
        number = secrets.randbelow(NUMBERS) + 1
        if s.scalar(select(AlertRule.id).where(AlertRule.id == number)) is None:
            return number


def list_alert_rules(s: Session, user_id: int | None = None) -> list[AlertRuleRecord]:
    """The rules of a user, or of all who are not disabled, oldest first."""
    query: Any = (
        select(
            AlertRule.id,
            User.id,
            User.name,
            Realm.name,
            AlertRule.label,
            AlertRule.robots,
            AlertRule.kinds,
            AlertRule.level,
            AlertRule.channel,
            AlertRule.url,
            AlertRule.secret,
            AlertRule.over,
            AlertRule.group_s,
            AlertRule.quiet,
            AlertRule.created,
        )
        .join(User, User.id == AlertRule.user_id)
        .join(Realm, Realm.id == User.realm_id)
        .order_by(AlertRule.created, AlertRule.id)
    )
    query = query.where(live_user() if user_id is None else User.id == user_id)
    rows = (AlertRuleRecord(*row) for row in s.execute(query))
    return [row._replace(kinds=tuple(row.kinds)) for row in rows]


def remove_alert_rule(s: Session, rule_id: int, user_id: int | None = None) -> bool:
    """Tell nobody by this rule any more; false if there is none of that number.

    :param user_id: only if it is this user's
    """
    gone = delete(AlertRule).where(AlertRule.id == rule_id)
    if user_id is not None:
        gone = gone.where(AlertRule.user_id == user_id)
    found = s.scalar(gone.returning(AlertRule.id)) is not None
    if found:
        bump(s)
    return found


def _alerts() -> Any:
    query: Any = select(
        Alert.id,
        Alert.robot_id,
        Robot.name,
        Realm.name,
        Alert.kind,
        Alert.about,
        Alert.level,
        Alert.text,
        Alert.first_at,
        Alert.last_at,
        Alert.times,
        Alert.news,
        Alert.over_at,
        Alert.ack_by,
        Alert.ack_at,
    ).join(Robot, Robot.id == Alert.robot_id)
    return query.join(Realm, Realm.id == Robot.realm_id)
