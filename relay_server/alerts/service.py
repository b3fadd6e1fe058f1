"""What people ask about alerts: what there is, who looks after it, by which rules they are told."""

from __future__ import annotations

import math
import re
import secrets
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgspec
from sqlalchemy.orm import Session
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import AlertRecord, AlertRuleRecord
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.rights import Level, Rules
from relay_server.access import Access, Principal
from relay_server.alerts import rules
from relay_server.alerts import types as kinds
from relay_server.alerts.alerts import AlertHub
from relay_server.alerts.message import view
from relay_server.alerts.rules import RuleRequest
from relay_server.alerts.transports import Transports
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import TokenBucket
from relay_server.events.bus import EventBus

_FORM = re.compile(r"([0-9.e+-]{1,32})_([0-9A-Za-z]{1,32})\Z")


class AlertCursor(NamedTuple):
    """An alert, by what lists are sorted by; it need not be there any more.

    :param last: Unix seconds
    """

    last: float
    id: str

    def __str__(self) -> str:
        return f"{self.last!r}_{self.id}"

    @classmethod
    def parse(cls, text: str) -> AlertCursor:
        """Read one again.

        :raises Invalid: it is none
        """
        found = _FORM.match(text)
        try:
            last = math.nan if found is None else float(found[1])
        except ValueError:
            last = math.nan
        if found is None or not math.isfinite(last):
            raise Invalid("'before' is what an earlier answer gave as 'next'")
        return cls(last, found[2])


MOST = 500
"""Alerts one answer holds."""

PAGE = 500
"""Rows that are looked through at once for alerts that somebody may know of."""

REFUSED = 200
"""Parts of robots that the database is told to leave out, because their alerts were seen to be none of his."""

TESTS = (5 / 60, 5.0)
CHANGES = (0.2, 20.0)
"""Tests and changes of rules by one user: a second in the long run, and at once."""

REMEMBERED = 1000
"""Users whose doings are counted, and whose pages' alerts are kept at a time."""

NO_ALERT = "there is no such alert, or none for you"


class TooManyRuleChanges(Unavailable):
    """Somebody does something too often; he may again after ``retry_after`` seconds."""

    code = "too_often"

    def __init__(self, what: str, retry_after: float) -> None:
        super().__init__(f"{what} too often; try again in {int(retry_after) + 1} s")
        self.retry_after = retry_after


class AlertService:
    """Serves the HTTP API.

    :param seconds: a monotonic clock
    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(
        self,
        alerts: AlertHub,
        ways: Transports,
        store: AsyncDatabase,
        access: Access,
        journal: EventBus,
        seconds: Callable[[], float],
        wall: Callable[[], float],
    ) -> None:
        self._alerts = alerts
        self._ways = ways
        self._store = store
        self._access = access
        self._journal = journal
        self._seconds = seconds
        self._wall = wall
        self._buckets: OrderedDict[tuple[str, int], TokenBucket] = OrderedDict()
        self._pages: OrderedDict[int, tuple[int, object, list[dict[str, Any]]]] = OrderedDict()

    # --- alerts -------------------------------------------------------------------------------------------

    async def all(
        self,
        principal: Principal,
        robot: str = "",
        open: bool | None = None,
        limit: int = 100,
        before: AlertCursor | None = None,
    ) -> list[dict[str, Any]]:
        """Alerts the principal may know of, the latest first.

        :param robot: of this robot only
        :param open: only those that last, or only those that are over
        :param before: only those that come after this one in the list
        """
        rights = await self._rights(principal)
        asked = [number for number, (name, _) in rights.items() if not robot or name == robot]
        await self._alerts.flush()
        deaf = [each for each in asked if not rules.visible(rights[each][1], kinds.DIAGNOSTICS, "")]
        found: list[dict[str, Any]] = []
        refused: set[tuple[int, str, str]] = set()
        after: tuple[float, str] | None = before
        while True:
            rows: list[AlertRecord] = await self._store.read(
                queries.list_alerts,
                asked,
                open=open,
                limit=PAGE,
                after=after,
                kinds_but={kinds.DIAGNOSTICS: deaf},
                but=refused,
            )
            for each in rows:
                if rules.visible(rights[each.robot_id][1], each.kind, each.about):
                    found.append(self._view(principal, each, rights[each.robot_id][1]))
                elif len(refused) < REFUSED:
                    refused.add((each.robot_id, each.kind, each.about))
            if len(rows) < PAGE or len(found) >= limit:
                return found[:limit]
            after = rows[-1].last, rows[-1].id

    async def shown(self, principal: Principal) -> list[dict[str, Any]]:
        """What a page of the principal shows now; the same list as long as it is the same."""
        known = await self._access.robots(principal)
        version = self._alerts.version
        kept = self._pages.get(principal.user_id)
        if kept is not None and kept[0] == version and kept[1] is known:
            return kept[2]
        rights = {record.id: each for record, each in known}
        found = [
            each
            for each in self._alerts.book
            if each.robot_id in rights and rules.visible(rights[each.robot_id], each.kind, each.about)
        ]
        lasting = [each for each in found if each.over is None]
        over = [each for each in found if each.over is not None]
        over.sort(key=lambda each: each.over or 0.0, reverse=True)
        over = over[: max(kinds.SHOWN_OVER, kinds.SHOWN - len(lasting))]
        lasting.sort(key=lambda each: each.last, reverse=True)
        chosen = sorted(over + lasting[: kinds.SHOWN - len(over)], key=lambda each: each.last, reverse=True)
        shown = [self._view(principal, each, rights[each.robot_id]) for each in chosen]
        if kept is not None and kept[2] == shown:
            shown = kept[2]
        self._pages[principal.user_id] = (version, known, shown)
        self._pages.move_to_end(principal.user_id)
        while len(self._pages) > REMEMBERED:
            self._pages.popitem(last=False)
        return shown

    async def acknowledge(self, principal: Principal, alert_id: str) -> dict[str, Any]:
        """The principal looks after it.

        :raises NotFound: no such alert, or none the principal may know of
        :raises Refused: only operators and owners may
        """
        rights = await self._rights(principal)
        found = self._alerts.book.find(alert_id)
        if not _concerns(found, rights):
            # Also one of the book: how long it takes does not tell who has no right on its robot that it is there.
            found = await self._store.read(queries.get_alert, alert_id)
        if found is None or not _concerns(found, rights):
            raise NotFound(NO_ALERT)
        mine = rights[found.robot_id][1]
        if not _operates(mine):
            raise Refused(f"to acknowledge alerts of {found.robot} takes the level operator")
        fresh = found.over is None and found.ack_at is None
        name = self._alerts.name_of(principal, found)
        found = self._alerts.acknowledge(alert_id, name, self._wall()) or found
        if fresh:
            await self._alerts.flush()
            self._journal.event(
                "alert.acknowledged",
                f"user:{name}",
                cause=f"user:{principal.full}",
                robot_id=found.robot_id,
                user_id=principal.user_id,
                alert=found.id,
                alert_kind=found.kind,
            )
        return self._view(principal, found, mine)

    async def _rights(self, principal: Principal) -> dict[int, tuple[str, Rules]]:
        return {record.id: (record.name, each) for record, each in await self._access.robots(principal)}

    def _view(self, principal: Principal, alert: AlertRecord, rights: Rules) -> dict[str, Any]:
        told = view(alert._replace(ack_by=_elsewhere(alert, principal.realm)))
        return {
            **told,
            "may_acknowledge": alert.over is None and alert.ack_at is None and _operates(rights),
            "news": alert.news,
            "notify": self._alerts.tellers.shown(principal.user_id, alert, self._wall()),
        }

    # --- rules --------------------------------------------------------------------------------------------

    async def rules(self, principal: Principal) -> dict[str, Any]:
        """The principal's rules, and what a rule may say here."""
        principal.needs_whole()
        found = await self._store.read(queries.list_alert_rules, principal.user_id)
        return {
            "rules": [self._rule(each) for each in found],
            "kinds": list(kinds.KINDS),
            "levels": list(kinds.LEVELS),
            "channels": list(self._ways.channels),
            "schemes": self._ways.schemes,
        }

    async def add_rule(self, principal: Principal, ask: RuleRequest, address: str) -> dict[str, Any]:
        """Tell the principal of alerts from now on; the rule, with the secret if the relay made one.

        :param address: from where this is asked
        :raises Invalid: the rule makes no sense, or there are too many
        :raises TooOften: so many changes in so short a time
        """
        principal.needs_whole()
        self._count("change", principal, CHANGES, "you change rules")
        rules.check(ask, self._ways.channels)
        await self._ways.check(ask.channel, ask.url)
        made = ask.channel == "webhook" and not ask.secret
        if made:
            ask = msgspec.structs.replace(ask, secret=secrets.token_urlsafe(32))
        record = await self._store.write(_add, principal, ask, address, self._wall())
        await self._take_up()
        return {**self._rule(record), **({"secret": ask.secret} if made else {})}

    async def remove_rule(self, principal: Principal, number: int, address: str) -> None:
        """Tell nobody by this rule any more.

        :raises NotFound: the principal has none of this number
        """
        principal.needs_whole()
        self._count("change", principal, CHANGES, "you change rules")
        await self._store.write(_remove, principal, number, address, self._wall())
        await self._take_up()

    async def test_rule(self, principal: Principal, number: int) -> dict[str, Any]:
        """Send a made-up alert now: whether it arrived, and why not.

        :raises NotFound: the principal has no rule of this number
        """
        principal.needs_whole()
        self._count("test", principal, TESTS, "you test rules")
        mine = await self._store.read(queries.list_alert_rules, principal.user_id)
        rule = next((each for each in mine if each.id == number), None)
        if rule is None:
            raise NotFound(_no_rule(number))
        reason = await self._alerts.tellers.test(rule)
        return {"ok": not reason, "reason": reason}

    async def _take_up(self) -> None:
        """Have what was written count now. It was written: where that fails, the relay's next look does it."""
        try:
            await self._alerts.refresh()
        except SwitchboardError as error:
            self.log.warn("a change of rules for alerts counts later: {reason}", reason=str(error))

    def _count(self, what: str, principal: Principal, most: tuple[float, float], words: str) -> None:
        bucket = self._buckets.setdefault(
            (what, principal.user_id), TokenBucket(most[0], most[1], self._seconds)
        )
        self._buckets.move_to_end((what, principal.user_id))
        while len(self._buckets) > REMEMBERED:
            self._buckets.popitem(last=False)
        if not bucket.take():
            raise TooManyRuleChanges(words, bucket.wait)

    def _rule(self, record: AlertRuleRecord) -> dict[str, Any]:
        status = self._alerts.tellers.status(record.id)
        return {
            "id": record.id,
            "label": record.label,
            "robots": record.robots,
            "kinds": list(record.kinds),
            "level": record.level,
            "channel": record.channel,
            "url": rules.shown_url(record),
            "over": record.over,
            "group_s": record.group_s,
            "quiet": record.quiet,
            "status": {
                "sent": status.sent,
                "failed": status.failed,
                "reason": status.reason,
                "last": status.last,
            },
        }


def _concerns(alert: AlertRecord | None, rights: Mapping[int, tuple[str, Rules]]) -> bool:
    """Whether there is an alert that somebody with these rights may know of."""
    mine = None if alert is None else rights.get(alert.robot_id)
    return alert is not None and mine is not None and rules.visible(mine[1], alert.kind, alert.about)


def _operates(rights: Rules) -> bool:
    return rights.level in (Level.OPERATOR, Level.OWNER)


def _no_rule(number: int) -> str:
    return f"you have no rule {number}"


def keep(s: Session, user_id: int, ask: RuleRequest, now: float) -> AlertRuleRecord:
    """Write a rule that was checked.

    :param now: Unix seconds
    :raises Invalid: the user has too many
    """
    return queries.add_alert_rule(
        s,
        user_id,
        name=ask.label,
        robots=ask.robots,
        kinds=ask.kinds,
        level=ask.level,
        channel=ask.channel,
        url=ask.url,
        secret=ask.secret,
        over=ask.over,
        group_s=ask.group_s,
        quiet=None if ask.quiet is None else msgspec.to_builtins(ask.quiet),
        created=now,
    )


def _add(s: Session, principal: Principal, ask: RuleRequest, address: str, now: float) -> AlertRuleRecord:
    record = keep(s, principal.user_id, ask, now)
    _audit(s, "alert_rule.add", principal, record, address, now)
    return record


def _remove(s: Session, principal: Principal, number: int, address: str, now: float) -> None:
    mine = {each.id: each for each in queries.list_alert_rules(s, principal.user_id)}
    if number not in mine or not queries.remove_alert_rule(s, number, principal.user_id):
        raise NotFound(_no_rule(number))
    _audit(s, "alert_rule.remove", principal, mine[number], address, now)


def _audit(
    s: Session, action: str, principal: Principal, record: AlertRuleRecord, address: str, now: float
) -> None:
    queries.append_audit(
        s,
        at=now,
        actor=f"user:{principal.full}",
        action=action,
        target=str(record.id),
        origin=address,
        data={"channel": record.channel, "url": rules.shown_url(record), "robots": record.robots},
    )


def _elsewhere(alert: AlertRecord, realm: str) -> str | None:
    """Who looks after an alert, as a realm is told: it may be from before the robot was shared with that."""
    by = alert.ack_by
    return by if by is None or "@" in by or realm == alert.realm else f"{by}@{alert.realm}"
