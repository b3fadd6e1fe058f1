"""The rules of alerts for users: which alerts a user may list and acknowledge, and the user's own rules."""

from __future__ import annotations

import math
import re
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple

import msgspec
from sqlalchemy.orm import Session
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import AlertRecord, AlertRuleRecord
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.limits import HEARTBEATS_MISSED
from relay_protocol.rights import Level, Rules
from relay_server.access import Access, Principal
from relay_server.alerts import rules
from relay_server.alerts import types as kinds
from relay_server.alerts.hub import AlertHub
from relay_server.alerts.monitors import Thresholds
from relay_server.alerts.rules import RuleRequest
from relay_server.alerts.schemas import AlertInfo, RuleInfo, RuleList, RuleTest
from relay_server.alerts.transports import Transports
from relay_server.cluster.leadership import ALERTS
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import TokenBucket
from relay_server.core import Core
from relay_server.events.bus import EventBus

_CURSOR = re.compile(r"([0-9.e+-]{1,32})_([0-9A-Za-z]{1,32})\Z")


class AlertCursor(NamedTuple):
    """A place in the list of alerts, which is sorted by these fields. The alert may be gone.

    :param last: Unix seconds of its latest report
    """

    last: float
    id: str

    def __str__(self) -> str:
        return f"{self.last!r}_{self.id}"

    @classmethod
    def parse(cls, text: str) -> AlertCursor:
        """:raises Invalid: not the text of a cursor"""
        found = _CURSOR.match(text)
        try:
            last = math.nan if found is None else float(found[1])
        except ValueError:
            last = math.nan
        if found is None or not math.isfinite(last):
            raise Invalid("'before' must be the 'next' of an earlier answer")
        return cls(last, found[2])


PAGE = 500
"""Rows that one query reads."""

MAX_EXCLUDED = 200
"""Parts of robots that queries leave out because their alerts are not for the user."""

TESTS = (5 / 60, 5.0)
CHANGES = (0.2, 20.0)
"""Tests and changes of rules by one user: per second in the long run, and at once."""

MAX_USERS = 1000
"""Users whose changes are counted, and whose shown alerts are cached."""

NO_ALERT = "there is no such alert, or you may not see it"


class TooManyRuleChanges(Unavailable):
    """A user changes or tests rules too often.

    :ivar retry_after: seconds until the next is accepted
    """

    code = "too_often"

    def __init__(self, action: str, retry_after: float) -> None:
        super().__init__(f"{action} too often; try again in {int(retry_after) + 1} s")
        self.retry_after = retry_after


class AlertService:
    """Alerts and rules for users.

    :param seconds: a monotonic clock
    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(
        self,
        alerts: AlertHub,
        transports: Transports,
        store: AsyncDatabase,
        access: Access,
        bus: EventBus,
        seconds: Callable[[], float],
        wall: Callable[[], float],
    ) -> None:
        self._alerts = alerts
        self._transports = transports
        self._store = store
        self._access = access
        self._bus = bus
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
    ) -> list[AlertInfo]:
        """Alerts that the principal may see, the latest first.

        :param robot: only of the robot of this name
        :param open: only open ones, or only ended ones
        :param before: only those behind this place of the list
        """
        rights = await self._rights(principal)
        robots = [number for number, (name, _) in rights.items() if not robot or name == robot]
        await self._alerts.flush()
        without_diagnostics = [
            each for each in robots if not rules.visible(rights[each][1], kinds.DIAGNOSTICS, "")
        ]
        found: list[AlertInfo] = []
        excluded: set[tuple[int, str, str]] = set()
        after: tuple[float, str] | None = before
        while True:
            rows: list[AlertRecord] = await self._store.read(
                queries.list_alerts,
                robots,
                open=open,
                limit=PAGE,
                after=after,
                except_kinds={kinds.DIAGNOSTICS: without_diagnostics},
                except_alerts=excluded,
            )
            for each in rows:
                if rules.visible(rights[each.robot_id][1], each.kind, each.about):
                    found.append(self._info(principal, each, rights[each.robot_id][1]))
                elif len(excluded) < MAX_EXCLUDED:
                    excluded.add((each.robot_id, each.kind, each.about))
            if len(rows) < PAGE or len(found) >= limit:
                return found[:limit]
            after = rows[-1].last, rows[-1].id

    async def shown(self, principal: Principal) -> list[dict[str, Any]]:
        """The alerts that pages of the principal show now, as JSON objects; the same list while nothing changes."""
        known = await self._access.robots(principal)
        version = self._alerts.version
        cached = self._pages.get(principal.user_id)
        if cached is not None and cached[0] == version and cached[1] is known:
            return cached[2]
        rights = {record.id: each for record, each in known}
        found = [
            each
            for each in self._alerts.store
            if each.robot_id in rights and rules.visible(rights[each.robot_id], each.kind, each.about)
        ]
        shown: list[dict[str, Any]] = [
            msgspec.to_builtins(self._info(principal, each, rights[each.robot_id])) for each in _chosen(found)
        ]
        if cached is not None and cached[2] == shown:
            shown = cached[2]
        self._pages[principal.user_id] = (version, known, shown)
        self._pages.move_to_end(principal.user_id)
        while len(self._pages) > MAX_USERS:
            self._pages.popitem(last=False)
        return shown

    async def acknowledge(self, principal: Principal, alert_id: str) -> AlertInfo:
        """Acknowledge an alert: the principal looks after it.

        :raises NotFound: no such alert, or the principal may not see it
        :raises Refused: the principal is neither operator nor owner
        """
        rights = await self._rights(principal)
        found = self._alerts.store.find(alert_id)
        if not _is_visible(found, rights):
            # Also if it is in memory: the time of the answer must not show a user without a right that it exists.
            found = await self._store.read(queries.get_alert, alert_id)
        if found is None or not _is_visible(found, rights):
            raise NotFound(NO_ALERT)
        mine = rights[found.robot_id][1]
        if not _may_acknowledge(mine):
            raise Refused(f"acknowledging alerts of {found.robot} needs the level operator")
        fresh = found.over is None and found.ack_at is None
        name = self._alerts.name_of(principal, found)
        if fresh and not self._alerts.owns(found.robot_id):
            # Only that, so that nothing is written over what the relay of the robot knows of it.
            try:
                found = await self._store.write(queries.acknowledge_alert, alert_id, name, self._wall())
            except Invalid:
                # It has ended there meanwhile.
                found = await self._store.read(queries.get_alert, alert_id) or found
            self._alerts.mirror([found])
        else:
            found = self._alerts.acknowledge(alert_id, name, self._wall()) or found
        if fresh:
            await self._alerts.flush()
            self._bus.publish(
                "alert.acknowledged",
                found.robot_id,
                f"user:{name}",
                alert=found.id,
                alert_kind=found.kind,
            )
        return self._info(principal, found, mine)

    async def _rights(self, principal: Principal) -> dict[int, tuple[str, Rules]]:
        return {record.id: (record.name, each) for record, each in await self._access.robots(principal)}

    def _info(self, principal: Principal, alert: AlertRecord, rights: Rules) -> AlertInfo:
        return AlertInfo.of(
            alert._replace(ack_by=_acknowledged_by(alert, principal.realm)),
            may_acknowledge=alert.over is None and alert.ack_at is None and _may_acknowledge(rights),
            notification_count=alert.notification_count,
            notify=self._alerts.dispatcher.is_shown(principal.user_id, alert, self._wall()),
        )

    # --- rules --------------------------------------------------------------------------------------------

    async def rules(self, principal: Principal) -> RuleList:
        """The principal's rules, and the values that a rule may have here."""
        principal.require_full_scope()
        found = await self._store.read(queries.list_alert_rules, principal.user_id)
        return RuleList(
            rules=[self._rule(each) for each in found],
            kinds=list(kinds.KINDS),
            levels=list(kinds.LEVELS),
            channels=list(self._transports.channels),
            schemes=self._transports.schemes,
        )

    async def add_rule(self, principal: Principal, request: RuleRequest, address: str) -> RuleInfo:
        """Add a rule for the principal. The result has the secret if the relay made it.

        :param address: the client's network address
        :raises Invalid: the rule is not valid, or the principal has too many
        :raises TooManyRuleChanges: the user changes rules too often
        """
        principal.require_full_scope()
        self._count("change", principal, CHANGES, "you change rules")
        rules.check(request, self._transports.channels)
        await self._transports.check(request.channel, request.url)
        made = request.channel == "webhook" and not request.secret
        if made:
            request = msgspec.structs.replace(request, secret=secrets.token_urlsafe(32))
        record = await self._store.write(_add, principal, request, address, self._wall())
        await self._refresh()
        rule = self._rule(record)
        if made:
            rule.secret = request.secret
        return rule

    async def remove_rule(self, principal: Principal, number: int, address: str) -> None:
        """Remove a rule.

        :raises NotFound: the principal has no rule of this number
        """
        principal.require_full_scope()
        self._count("change", principal, CHANGES, "you change rules")
        await self._store.write(_remove, principal, number, address, self._wall())
        await self._refresh()

    async def test_rule(self, principal: Principal, number: int) -> RuleTest:
        """Send a test alert now.

        :raises NotFound: the principal has no rule of this number
        """
        principal.require_full_scope()
        self._count("test", principal, TESTS, "you test rules")
        mine = await self._store.read(queries.list_alert_rules, principal.user_id)
        rule = next((each for each in mine if each.id == number), None)
        if rule is None:
            raise NotFound(_no_rule(number))
        reason = await self._alerts.dispatcher.test(rule)
        return RuleTest(ok=not reason, reason=reason)

    async def _refresh(self) -> None:
        """Apply a change that was written. If this fails, the relay applies it at its next look at the database."""
        try:
            await self._alerts.refresh()
        except SwitchboardError as error:
            self.log.warn("a change of alert rules takes effect later: {reason}", reason=str(error))

    def _count(self, what: str, principal: Principal, rate: tuple[float, float], action: str) -> None:
        bucket = self._buckets.setdefault(
            (what, principal.user_id), TokenBucket(rate[0], rate[1], self._seconds)
        )
        self._buckets.move_to_end((what, principal.user_id))
        while len(self._buckets) > MAX_USERS:
            self._buckets.popitem(last=False)
        if not bucket.take():
            raise TooManyRuleChanges(action, bucket.wait)

    def _rule(self, record: AlertRuleRecord) -> RuleInfo:
        return RuleInfo(
            id=record.id,
            label=record.label,
            robots=record.robots,
            kinds=list(record.kinds),
            level=record.level,
            channel=record.channel,
            url=rules.shown_url(record),
            notify_end=record.notify_end,
            group_s=record.group_s,
            quiet=rules.quiet_hours(record),
            status=self._alerts.dispatcher.status(record.id),
        )


class Alerts:
    """The alerts of a relay: the hub with its transports, and the rules for users.

    :ivar service: the rules for users
    :raises Invalid: a network or scheme of the settings is not valid
    """

    def __init__(self, core: Core) -> None:
        settings, own = core.settings, core.settings.alerts
        self._transports = Transports(
            core.reactor, time.time, own.webhook_networks, own.apprise_schemes, own.webhook_deny
        )
        self.hub = AlertHub(
            core.reactor,
            time.time,
            core.database,
            core.access,
            core.robots,
            core.channels,
            core.controllers,
            core.bus,
            Thresholds(HEARTBEATS_MISSED * settings.heartbeat, own.battery_low, own.battery_critical),
            self._transports.send,
            self._transports.slot,
            partial(core.leads, ALERTS),
        )
        self.service = AlertService(
            self.hub, self._transports, core.database, core.access, core.bus, core.reactor.seconds, time.time
        )

    async def start(self, relay: str) -> None:
        """Load the stored alerts, and check robots from now on.

        :param relay: the relay's name, for messages
        """
        self._transports.start(relay)
        await self.hub.start()

    def mute(self, reason: str) -> None:
        """Send nothing more: robots go offline because the relay stops."""
        self.hub.mute()

    async def save(self) -> None:
        """Write the alerts, if the database takes them soon."""
        await self.hub.save()

    def join(self) -> None:
        """End the threads; blocks until they have ended."""
        self._transports.stop()


def _is_visible(alert: AlertRecord | None, rights: Mapping[int, tuple[str, Rules]]) -> bool:
    """Whether there is an alert, and a user with these rights may see it."""
    mine = None if alert is None else rights.get(alert.robot_id)
    return alert is not None and mine is not None and rules.visible(mine[1], alert.kind, alert.about)


def _may_acknowledge(rights: Rules) -> bool:
    return rights.level in (Level.OPERATOR, Level.OWNER)


def _no_rule(number: int) -> str:
    return f"you have no rule {number}"


def insert_rule(s: Session, user_id: int, request: RuleRequest, now: float) -> AlertRuleRecord:
    """Write a rule that was checked.

    :param now: Unix seconds
    :raises Invalid: the user has too many
    """
    return queries.add_alert_rule(
        s,
        user_id,
        label=request.label,
        robots=request.robots,
        kinds=request.kinds,
        level=request.level,
        channel=request.channel,
        url=request.url,
        secret=request.secret,
        notify_end=request.notify_end,
        group_s=request.group_s,
        quiet=None if request.quiet is None else msgspec.to_builtins(request.quiet),
        created=now,
    )


def _add(s: Session, principal: Principal, request: RuleRequest, address: str, now: float) -> AlertRuleRecord:
    record = insert_rule(s, principal.user_id, request, now)
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


def _acknowledged_by(alert: AlertRecord, realm: str) -> str | None:
    """The user who acknowledged an alert, as users of a realm see the name: with its realm if that is another one.

    The name may be stored without a realm, from before the robot was shared.
    """
    by = alert.ack_by
    return by if by is None or "@" in by or realm == alert.realm else f"{by}@{alert.realm}"


def _chosen(alerts: Iterable[AlertRecord]) -> list[AlertRecord]:
    """The alerts that pages show, the latest first."""
    found = list(alerts)
    lasting = sorted((each for each in found if each.over is None), key=lambda each: -each.last)
    ended = sorted((each for each in found if each.over is not None), key=lambda each: -(each.over or 0.0))
    ended = ended[: max(kinds.MAX_SHOWN_OVER, kinds.MAX_SHOWN - len(lasting))]
    return sorted(ended + lasting[: kinds.MAX_SHOWN - len(ended)], key=lambda each: -each.last)
