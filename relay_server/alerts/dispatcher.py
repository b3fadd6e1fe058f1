"""All rules, and the deliveries of those that send something somewhere."""

from __future__ import annotations

from collections.abc import Iterable

from twisted.internet.defer import DeferredSemaphore

from relay_db.queries import AlertRecord, AlertRuleRecord
from relay_server.alerts import delivery, rules
from relay_server.alerts import types as kinds
from relay_server.alerts.delivery import Delivery, DeliveryContext, DeliveryStatus
from relay_server.alerts.store import AlertChange
from relay_server.alerts.types import AlertEvent

PLACES = 2
"""Messages of one user under way at a time."""


class RuleDispatcher:
    """Rules by user, each with its way out."""

    def __init__(self, office: DeliveryContext) -> None:
        self._office = office
        self._rules: dict[int, AlertRuleRecord] = {}
        self._portal: dict[int, list[AlertRuleRecord]] = {}
        self._deliveries: dict[int, Delivery] = {}
        self._places: dict[int, DeferredSemaphore] = {}
        self._hushed = False

    def take(self, records: Iterable[AlertRuleRecord]) -> None:
        """These are the rules from now on; what waits by those that stay goes on. Once hushed, nothing changes."""
        if self._hushed:
            return
        fresh = {each.id: each for each in records}
        for number in [each for each in self._deliveries if fresh.get(each) != self._rules.get(each)]:
            self._deliveries.pop(number).close()
        self._rules = fresh
        self._portal = {}
        for rule in fresh.values():
            if rule.channel == "portal":
                self._portal.setdefault(rule.user_id, []).append(rule)
            elif rule.id not in self._deliveries:
                self._deliveries[rule.id] = Delivery(self._office, rule, self._places_of(rule.user_id))
        users = {each.user_id for each in fresh.values()}
        self._places = {user: places for user, places in self._places.items() if user in users}

    def offer(self, changes: Iterable[AlertChange]) -> None:
        """There is news."""
        for change in changes:
            for each in self._deliveries.values():
                each.offer(change)

    def status(self, number: int) -> DeliveryStatus:
        """What has become of the messages of a rule."""
        found = self._deliveries.get(number)
        return DeliveryStatus() if found is None else found.status

    async def test(self, rule: AlertRuleRecord) -> str:
        """Send a made-up alert now; why it did not arrive, or nothing."""
        if rule.channel == "portal":
            return ""
        return await delivery.test(self._office, rule, self._places_of(rule.user_id))

    def shown(self, user: int, alert: AlertRecord, now: float) -> bool:
        """Whether a page of this user is to show an alert.

        :param now: Unix seconds
        """
        event = AlertEvent.BEGUN if alert.over is None else AlertEvent.OVER
        mine = self._portal.get(user)
        if mine is None:
            return kinds.severity(alert.level) >= kinds.severity("warning")
        realms = self._office.realms(alert)
        return any(
            rules.wants(each, alert, event, realms) and rules.passes(each, alert, now) for each in mine
        )

    def hush(self) -> None:
        """Send nothing any more; what is offered is remembered."""
        self._hushed = True
        for each in self._deliveries.values():
            each.hush()

    def unheard(self) -> set[str]:
        """Alerts that rules were to tell of, by their ids, and none has."""
        ways = self._deliveries.values()
        return set().union(*(each.owed for each in ways)).difference(*(each.told for each in ways))

    def _places_of(self, user: int) -> DeferredSemaphore:
        return self._places.setdefault(user, DeferredSemaphore(PLACES))
