"""Deliveries of rules: each gathers notices, sends them together and tries again, independently of other rules.

Each rule has three bounded queues, which drop the mildest notices first: the *inbox* before the user's rights are
checked, *pending* for the next message, *held* until the end of the quiet hours. The message that is being sent is in
none of them. Only notices that the user may see reach the second and third, and only their drops are counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator
from contextlib import AbstractAsyncContextManager, nullcontext
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

from twisted.internet.defer import CancelledError, Deferred, DeferredSemaphore
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_db.queries import AlertRecord, AlertRuleRecord
from relay_protocol.errors import SwitchboardError
from relay_protocol.realms import full_name
from relay_server.alerts import rules
from relay_server.alerts import types as kinds
from relay_server.alerts.schemas import AlertNotice, NotificationMessage, RuleStatus, Undelivered
from relay_server.alerts.store import AlertChange
from relay_server.alerts.types import AlertEvent
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.token_bucket import TokenBucket

Send = Callable[[AlertRuleRecord, NotificationMessage], Awaitable[None]]
"""Sends a message of a rule. Raises :class:`Undelivered`."""

Slot = Callable[[AlertRuleRecord, bool], AbstractAsyncContextManager[None]]
"""A context that a message waits for, and holds while it is sent. The flag: the rule's last message did not arrive."""

Visible = Callable[[AlertRuleRecord, Collection[AlertRecord]], Awaitable[set[str]]]
"""The ids of the alerts that the rule's user may see. Raises :class:`SwitchboardError`."""


def no_wait(rule: AlertRuleRecord, failing: bool) -> AbstractAsyncContextManager[None]:
    """A slot that is always free."""
    return nullcontext()


@dataclass(frozen=True)
class DeliveryContext:
    """Tools and functions that all deliveries share.

    :param wall: Unix time in seconds
    :param random: 0 to 1
    :param name: makes a new id for a message
    :param is_open: whether the alert of this id is open
    :param realms: the realms of an alert's robot
    """

    clock: Clock
    wall: Callable[[], float]
    random: Callable[[], float]
    name: Callable[[], str]
    send: Send
    visible: Visible
    is_open: Callable[[str], bool]
    realms: Callable[[AlertRecord], Collection[str]]
    slot: Slot = no_wait


Key = tuple[str, str]
"""The alert's id and the event: a queue holds each pair once."""


class QueuedNotification(NamedTuple):
    """A notice in a queue.

    :param since: monotonic seconds at which it first came
    """

    notice: AlertNotice
    since: float


class NotificationQueue:
    """A bounded queue of notices.

    :param most: most notices
    :param fair: drops notices of the robot with the most first, whatever their level
    """

    def __init__(self, most: int, *, fair: bool = False) -> None:
        self._most = most
        self._fair = fair
        self._waiting: dict[Key, QueuedNotification] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def __iter__(self) -> Iterator[QueuedNotification]:
        return iter(list(self._waiting.values()))

    def put(self, notice: AlertNotice, since: float) -> int:
        """Add a notice, or replace the same one; returns how many were dropped."""
        key = _key(notice)
        before = self._waiting.pop(key, None)
        self._waiting[key] = QueuedNotification(notice, since if before is None else before.since)
        if len(self._waiting) <= self._most:
            return 0
        del self._waiting[self._least()]
        return 1

    def drop(self, notice: AlertNotice) -> QueuedNotification | None:
        """Remove a notice; returns its latest version, if there was one."""
        return self._waiting.pop(_key(notice), None)

    def take(self) -> list[AlertNotice]:
        """Remove all, in their order."""
        taken, self._waiting = self._waiting, {}
        return [each.notice for each in taken.values()]

    def clear(self) -> None:
        """Remove all."""
        self._waiting.clear()

    def _least(self) -> Key:
        """The key of the notice to drop: the mildest, of these an end, of these the oldest."""
        most = 0
        robots: Counter[int] = Counter()
        if self._fair:
            robots.update(each.notice.alert.robot_id for each in self._waiting.values())
            most = max(robots.values())
        there = ((key, each.notice) for key, each in self._waiting.items())
        found = ((key, it) for key, it in there if robots[it.alert.robot_id] == most)
        key, _ = min(found, key=lambda each: _weight(each[1]))
        return key


def _key(notice: AlertNotice) -> Key:
    return notice.alert.id, notice.event


def _weight(notice: AlertNotice) -> tuple[int, bool]:
    return kinds.severity(notice.alert.level), not notice.ends


MAX_QUEUED = 200
"""Most pending notices of a rule, and most held ones."""

MAX_UNFILTERED = 2000
"""Most notices in the inbox, while the database does not answer."""

MAX_DELIVERED = 1000
"""Most delivered alerts that a rule remembers, to send their ends too."""

GATHER_SECONDS = 0.2
"""Notices that come within this time of the first go with it."""

URGENT_BURST = 3.0
URGENT_SECONDS = 10.0
"""Urgent messages do not wait for the rule's pause: so many at once, and one in so long after that."""

RETRY_SECONDS = (2.0, 10.0, 30.0, 120.0, 420.0)
"""Pauses before a message is tried again; each is shortened at random by up to a fifth."""

URGENT_RETRY_SECONDS = 30.0
"""Longest pause between tries while an error waits behind the message."""

FILTER_RETRY_SECONDS = 2.0
"""Pause before rights are checked again when the database did not answer."""

MAX_SLEEP = 3600.0
"""Longest sleep until a time of the wall clock, which may be set meanwhile."""


class Delivery:
    """Delivers the alerts of one rule.

    :param slots: of the rule's user, bound the messages that are sent at a time
    """

    log = Logger()

    def __init__(self, context: DeliveryContext, rule: AlertRuleRecord, slots: DeferredSemaphore) -> None:
        self.rule = rule
        self.status = RuleStatus()
        self._context = context
        self._slots = slots
        self._inbox = NotificationQueue(MAX_UNFILTERED, fair=True)
        self._pending = NotificationQueue(MAX_QUEUED)
        self._held = NotificationQueue(MAX_QUEUED)
        self._delivered: dict[str, None] = {}
        """Ids of alerts whose beginning was delivered and whose end was not."""
        self._never_delivered: dict[str, None] = {}
        """Ids of alerts whose beginning was held and has not been delivered."""
        self._left_out = 0
        self._next = 0.0
        self._worst = -1
        """The worst severity in the latest message."""
        self._extra = TokenBucket(1 / URGENT_SECONDS, URGENT_BURST, context.clock.seconds)
        self._under_way: list[AlertNotice] = []
        """Notices of the message that is being sent or tried again."""
        self._muted = False
        self._failing = False
        self._filtering: Deferred[None] | None = None
        self._working: Deferred[None] | None = None
        self._wake: Deferred[None] | None = None

    @property
    def waiting(self) -> int:
        """Notices in the queues."""
        return len(self._inbox) + len(self._pending) + len(self._held)

    def offer(self, change: AlertChange) -> None:
        """Queue a change, if the rule wants it and its user may see it."""
        if not rules.wants(self.rule, change.alert, change.event, self._context.realms(change.alert)):
            return
        # Drops here are not counted: the user might have no right to know their number.
        self._inbox.put(AlertNotice(change.alert, change.event.value), self._context.clock.seconds())
        if self._filtering is None and not self._muted:
            # The coroutine mostly ends before this returns.
            self._filtering = filtering = Deferred.fromCoroutine(self._filter())
            filtering.addErrback(self._failed)
            filtering.addBoth(self._filter_done)

    @property
    def undelivered(self) -> set[str]:
        """Ids of alerts whose beginning or worsening is not delivered yet, the message that is being sent included."""
        queues = self._inbox, self._pending, self._held
        waiting = [*self._under_way, *(each.notice for queue in queues for each in queue)]
        return {each.alert.id for each in waiting if not each.ends}

    @property
    def delivered(self) -> set[str]:
        """Ids of alerts whose beginning was delivered; the latest :data:`MAX_DELIVERED`."""
        return set(self._delivered)

    def close(self) -> None:
        """Send nothing any more, and drop what waits."""
        self.mute()
        for queue in (self._inbox, self._pending, self._held):
            queue.clear()

    def mute(self) -> None:
        """Send nothing any more; what waits and what is offered later stays :attr:`undelivered`."""
        self._muted = True
        for each in (self._filtering, self._working):
            if each is not None:
                each.cancel()

    def _failed(self, failure: Failure) -> None:
        if not failure.check(CancelledError):
            self.log.failure("sending alerts of rule {rule} failed", failure, rule=self.rule.id)

    # --- the rights of the user ---------------------------------------------------------------------------

    async def _filter(self) -> None:
        """Move the notices that the user may see from the inbox to pending."""
        while self._inbox:
            notices = [each.notice for each in self._inbox]
            try:
                known = await self._context.visible(self.rule, [each.alert for each in notices])
            except SwitchboardError:
                await self._sleep(FILTER_RETRY_SECONDS)
                continue
            for each in notices:
                latest = self._inbox.drop(each)
                if latest is not None and each.alert.id in known:
                    self._left_out += self._pending.put(*latest)
            self._begin()

    def _filter_done(self, _: object) -> None:
        self._filtering = None

    def _begin(self) -> None:
        if not self._pending:
            return
        if self._working is not None:
            self._wake_up()
            return
        self._working = working = Deferred.fromCoroutine(self._work())
        working.addErrback(self._failed)
        working.addBoth(self._work_done)

    def _work_done(self, _: object) -> None:
        self._working = None

    # --- when ---------------------------------------------------------------------------------------------

    async def _work(self) -> None:
        """Send messages until the queues are empty."""
        while self._pending or self._held:
            pause = self._pause()
            if pause > 0:
                await self._rest(min(pause, MAX_SLEEP))
                continue
            self._apply_quiet_hours()
            if self._pending:
                if self._context.clock.seconds() < self._next:
                    self._extra.take()
                left_out, self._left_out = self._left_out, 0
                self._under_way = self._pending.take()
                await self._deliver(self._under_way, left_out)
                self._under_way = []

    def _pause(self) -> float:
        """Seconds until the next message or the end of the quiet hours."""
        now = self._context.clock.seconds()
        if self._pending:
            regular = max(min(each.since for each in self._pending) + GATHER_SECONDS, self._next)
            urgent = min((each.since for each in self._pending if self._urgent(each.notice)), default=inf)
            return min(regular, max(urgent + GATHER_SECONDS, now + self._extra.wait)) - now
        wall = self._context.wall()
        end = rules.quiet_until(self.rule, wall)
        return 0.0 if end is None else end - wall

    def _urgent(self, notice: AlertNotice) -> bool:
        """Whether a notice must not wait: an error, or one worse than all of the latest message."""
        return notice.alarms or (not notice.ends and kinds.severity(notice.alert.level) > self._worst)

    async def _rest(self, seconds: float) -> None:
        self._wake = Deferred()
        timer: Timer = self._context.clock.callLater(seconds, self._wake_up)
        try:
            await self._wake
        finally:
            cancel(timer)
            self._wake = None

    async def _sleep(self, seconds: float) -> None:
        slept: Deferred[None] = Deferred()
        timer: Timer = self._context.clock.callLater(seconds, slept.callback, None)
        try:
            await slept
        finally:
            cancel(timer)

    def _wake_up(self) -> None:
        wake, self._wake = self._wake, None
        if wake is not None:
            wake.callback(None)

    def _apply_quiet_hours(self) -> None:
        """Hold notices in quiet hours; after these move those that are still true back to pending."""
        now = self._context.wall()
        if rules.quiet_until(self.rule, now) is None:
            held = [each for each in self._held if self._still_true(each.notice)]
            fresh = list(self._pending)
            self._held.clear()
            self._pending.clear()
            for each in (*held, *fresh):
                self._left_out += self._pending.put(*each)
        else:
            for each in self._pending:
                if not rules.passes(self.rule, each.notice.alert, now):
                    self._hold(each)
        self._drop_ends()

    def _hold(self, waiting: QueuedNotification) -> None:
        alert = waiting.notice.alert
        self._pending.drop(waiting.notice)
        self._left_out += self._held.put(*waiting)
        if not waiting.notice.ends and alert.id not in self._delivered:
            _add_latest(self._never_delivered, alert.id)

    def _still_true(self, notice: AlertNotice) -> bool:
        """Whether a held notice still says what is true of its alert."""
        return self._context.is_open(notice.alert.id) != notice.ends

    def _drop_ends(self) -> None:
        """Drop ends of alerts whose beginning was never delivered."""
        begun = {each.notice.alert.id for each in self._pending if not each.notice.ends}
        for notice, _ in self._pending:
            if notice.ends and notice.alert.id in self._never_delivered and notice.alert.id not in begun:
                self._pending.drop(notice)
                del self._never_delivered[notice.alert.id]

    # --- sending ------------------------------------------------------------------------------------------

    async def _deliver(self, batch: list[AlertNotice], left_out: int) -> None:
        """Try until the message has arrived, or cannot arrive any more."""
        name, pauses, due = self._context.name(), iter(RETRY_SECONDS), 0.0
        while True:
            try:
                if await self._try(name, batch, left_out):
                    self._arrived()
                return
            except SwitchboardError as error:
                self._failing = True
                self.status.reason = str(error)
                hopeless = not getattr(error, "again", True)
            now = self._context.clock.seconds()
            if not hopeless and now >= due:
                pause = next(pauses, None)
                hopeless = pause is None
                due = now + (pause or 0.0) * (1 - 0.2 * self._context.random())
            if hopeless:
                self._give_up(len(batch))
                return
            while (left := self._next_try(now, due) - self._context.clock.seconds()) > 0:
                await self._rest(left)

    def _next_try(self, tried: float, due: float) -> float:
        """The monotonic time of the next try: earlier than due while an error waits behind the message."""
        pressed = any(each.notice.alarms for each in self._pending)
        return min(due, tried + URGENT_RETRY_SECONDS) if pressed else due

    async def _try(self, name: str, batch: list[AlertNotice], left_out: int) -> bool:
        """Send the notices that the user may see now; returns whether there were any."""
        async with self._slots, self._context.slot(self.rule, self._failing):
            # Rights are checked after every long wait: they may have been revoked meanwhile.
            known = await self._context.visible(self.rule, [each.alert for each in batch])
            notices = [each for each in batch if each.alert.id in known]
            if not notices:
                return False
            await self._context.send(self.rule, NotificationMessage(name, notices, left_out))
        self._remember(notices)
        return True

    def _remember(self, notices: list[AlertNotice]) -> None:
        self._worst = max(kinds.severity(each.alert.level) for each in notices)
        for each in notices:
            self._never_delivered.pop(each.alert.id, None)
            if each.ends:
                self._delivered.pop(each.alert.id, None)
            else:
                _add_latest(self._delivered, each.alert.id)

    def _arrived(self) -> None:
        self._failing = False
        self.status.sent += 1
        self.status.last = self._context.wall()
        self._next = self._context.clock.seconds() + self.rule.group_s

    def _give_up(self, count: int) -> None:
        self.status.failed += 1
        self._next = self._context.clock.seconds() + self.rule.group_s
        self.log.warn(
            "{count} alerts could not be sent by rule {rule} of {user}: {reason}",
            count=count,
            rule=self.rule.id,
            user=full_name(self.rule.user, self.rule.realm),
            reason=self.status.reason,
        )


def _add_latest(queue: dict[str, None], alert_id: str) -> None:
    """Add an id as the latest of at most :data:`MAX_DELIVERED`."""
    queue.pop(alert_id, None)
    queue[alert_id] = None
    if len(queue) > MAX_DELIVERED:
        del queue[next(iter(queue))]


async def send_test(context: DeliveryContext, rule: AlertRuleRecord, slots: DeferredSemaphore) -> str:
    """Send a test alert now; returns why it did not arrive, or an empty text."""
    now = context.wall()
    text = "This is a test: alerts of your robots arrive like this."
    alert = AlertRecord(
        id="test",
        robot_id=0,
        robot="test",
        realm=rule.realm,
        kind="robot",
        about="",
        level="info",
        text=text,
        first=now,
        last=now,
        report_count=1,
        notification_count=1,
        over=None,
        ack_by=None,
        ack_at=None,
    )
    try:
        async with slots, context.slot(rule, False):
            await context.send(rule, NotificationMessage(context.name(), [AlertNotice(alert, "test")]))
    except Undelivered as error:
        return str(error)
    return ""


MESSAGES_PER_USER = 2
"""Messages of one user that are sent at a time."""


class RuleDispatcher:
    """Passes alerts to the deliveries of rules, and decides what pages show."""

    def __init__(self, context: DeliveryContext) -> None:
        self._context = context
        self._rules: dict[int, AlertRuleRecord] = {}
        self._portal: dict[int, list[AlertRuleRecord]] = {}
        self._deliveries: dict[int, Delivery] = {}
        self._slots: dict[int, DeferredSemaphore] = {}
        self._muted = False

    def set_rules(self, records: Iterable[AlertRuleRecord]) -> None:
        """Replace the rules; deliveries of unchanged ones go on. After :meth:`mute` this does nothing."""
        if self._muted:
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
                self._deliveries[rule.id] = Delivery(self._context, rule, self._slots_of(rule.user_id))
        users = {each.user_id for each in fresh.values()}
        self._slots = {user: slots for user, slots in self._slots.items() if user in users}

    def offer(self, changes: Iterable[AlertChange]) -> None:
        """Offer changes to all rules."""
        for change in changes:
            for each in self._deliveries.values():
                each.offer(change)

    def status(self, number: int) -> RuleStatus:
        """Counts of the messages of a rule."""
        found = self._deliveries.get(number)
        return RuleStatus() if found is None else found.status

    async def test(self, rule: AlertRuleRecord) -> str:
        """Send a test alert now; returns why it did not arrive, or an empty text."""
        if rule.channel == "portal":
            return ""
        return await send_test(self._context, rule, self._slots_of(rule.user_id))

    def is_shown(self, user: int, alert: AlertRecord, now: float) -> bool:
        """Whether pages of this user show an alert.

        :param now: Unix seconds
        """
        event = AlertEvent.BEGUN if alert.over is None else AlertEvent.OVER
        portal_rules = self._portal.get(user)
        if portal_rules is None:
            return kinds.severity(alert.level) >= kinds.severity("warning")
        realms = self._context.realms(alert)
        return any(
            rules.wants(each, alert, event, realms) and rules.passes(each, alert, now)
            for each in portal_rules
        )

    def mute(self) -> None:
        """Send nothing any more; changes that are offered later count as undelivered."""
        self._muted = True
        for each in self._deliveries.values():
            each.mute()

    def undelivered(self) -> set[str]:
        """Ids of alerts that some rule should have sent and none has."""
        deliveries = self._deliveries.values()
        waiting = set().union(*(each.undelivered for each in deliveries))
        return waiting.difference(*(each.delivered for each in deliveries))

    def _slots_of(self, user: int) -> DeferredSemaphore:
        return self._slots.setdefault(user, DeferredSemaphore(MESSAGES_PER_USER))
