"""The way out of one rule: what is to be told waits, goes together, is tried again, and hurts nobody else's.

Three heaps: in the *inbox* is what nobody has judged yet, *pending* goes with the next message, *held* waits for the
end of the quiet hours; what is in the message under way is in none of them. All are bounded; the mildest give way. Only
what the user may know of gets to the second and third, and only of that it is counted what gave way.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterator
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
from relay_server.alerts.message import AlertNotice, NotificationMessage, Undelivered
from relay_server.alerts.store import AlertChange
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.token_bucket import TokenBucket

Send = Callable[[AlertRuleRecord, NotificationMessage], Awaitable[None]]
"""Sends a message by a rule's way. Raises :class:`Undelivered`."""

Room = Callable[[AlertRuleRecord, bool], AbstractAsyncContextManager[None]]
"""What a message has to wait for, and keeps while it is sent. The last says whether the one before has failed."""

Known = Callable[[AlertRuleRecord, Collection[AlertRecord]], Awaitable[set[str]]]
"""Which of these alerts the rule's user may still know of, by their ids. Raises :class:`SwitchboardError`."""


def at_once(rule: AlertRuleRecord, doubtful: bool) -> AbstractAsyncContextManager[None]:
    """The room of a way on which no message waits."""
    return nullcontext()


@dataclass(frozen=True)
class DeliveryContext:
    """What all deliveries share.

    :param wall: Unix time in seconds
    :param random: 0 to 1
    :param name: makes a fresh name for a message
    :param lasts: whether the alert of this id is not over
    :param realms: those that the robot of an alert is of
    """

    clock: Clock
    wall: Callable[[], float]
    random: Callable[[], float]
    name: Callable[[], str]
    send: Send
    known: Known
    lasts: Callable[[str], bool]
    realms: Callable[[AlertRecord], Collection[str]]
    room: Room = at_once


Key = tuple[str, str]
"""The alert's id and the event: the same news waits once."""


class QueuedNotification(NamedTuple):
    """A notice that waits.

    :param since: when it came first, monotonic seconds
    """

    notice: AlertNotice
    since: float


class NotificationQueue:
    """So many notices at most.

    :param most: places
    :param fair: one robot's many give way before another's few, whatever they tell
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
        """Put a notice where its place in time is; how many gave way."""
        key = _key(notice)
        before = self._waiting.pop(key, None)
        self._waiting[key] = QueuedNotification(notice, since if before is None else before.since)
        if len(self._waiting) <= self._most:
            return 0
        del self._waiting[self._least()]
        return 1

    def drop(self, notice: AlertNotice) -> QueuedNotification | None:
        """It waits no more; the latest of the same news, if there was any."""
        return self._waiting.pop(_key(notice), None)

    def take(self) -> list[AlertNotice]:
        """All, in their order; none is left."""
        taken, self._waiting = self._waiting, {}
        return [each.notice for each in taken.values()]

    def clear(self) -> None:
        """None is left."""
        self._waiting.clear()

    def _least(self) -> Key:
        """Which one matters least: the mildest, among those an end, among those the oldest."""
        crowd = 0
        robots: Counter[int] = Counter()
        if self._fair:
            robots.update(each.notice.alert.robot_id for each in self._waiting.values())
            crowd = max(robots.values())
        there = ((key, each.notice) for key, each in self._waiting.items())
        found = ((key, it) for key, it in there if robots[it.alert.robot_id] == crowd)
        key, _ = min(found, key=lambda each: _weight(each[1]))
        return key


def _key(notice: AlertNotice) -> Key:
    return notice.alert.id, notice.event


def _weight(notice: AlertNotice) -> tuple[int, bool]:
    return kinds.severity(notice.alert.level), not notice.ends


MOST = 200
"""Notices that wait for one rule, and again those that wait for the end of quiet hours."""

UNJUDGED = 2000
"""Notices that wait to be judged while the database does not answer."""

TOLD = 1000
"""Alerts of which one rule remembers that they were told, so that their end is told too."""

GATHER_SECONDS = 0.2
"""What comes within this time of the first goes with it."""

URGENT_BURST = 3.0
URGENT_SECONDS = 10.0
"""Messages that do not wait for a rule's pause: so many at once, and one in so long after that."""

RETRY_SECONDS = (2.0, 10.0, 30.0, 120.0, 420.0)
"""Pauses before a message is tried again; each is shortened at random by up to a fifth."""

PRESSED_SECONDS = 30.0
"""While an error waits behind a message, that is tried this often."""

JUDGE_SECONDS = 2.0
"""The database is asked again after so long who may know of what."""

LONGEST_REST = 3600.0
"""Wall clocks are set: nobody sleeps longer on the word of one."""


@dataclass
class DeliveryStatus:
    """What has become of the messages of a rule.

    :param last: Unix time of the latest that arrived
    """

    sent: int = 0
    failed: int = 0
    reason: str = ""
    last: float | None = None


class Delivery:
    """What is to be told by one rule.

    :param places: of the rule's user: how many messages he has under way at a time
    """

    log = Logger()

    def __init__(self, office: DeliveryContext, rule: AlertRuleRecord, places: DeferredSemaphore) -> None:
        self.rule = rule
        self.status = DeliveryStatus()
        self._office = office
        self._places = places
        self._inbox = NotificationQueue(UNJUDGED, fair=True)
        self._pending = NotificationQueue(MOST)
        self._held = NotificationQueue(MOST)
        self._told: dict[str, None] = {}
        """Alerts of which their user knows that they have begun, and not that they are over."""
        self._unheard: dict[str, None] = {}
        """Alerts whose beginning was put aside, and was not told since."""
        self._left_out = 0
        self._next = 0.0
        self._worst = -1
        """How bad the worst was that the latest message told."""
        self._extra = TokenBucket(1 / URGENT_SECONDS, URGENT_BURST, office.clock.seconds)
        self._under_way: list[AlertNotice] = []
        """The message that is being sent, or tried again."""
        self._hushed = False
        self._failing = False
        self._judging: Deferred[None] | None = None
        self._working: Deferred[None] | None = None
        self._wake: Deferred[None] | None = None

    @property
    def waiting(self) -> int:
        """Notices that wait."""
        return len(self._inbox) + len(self._pending) + len(self._held)

    def offer(self, change: AlertChange) -> None:
        """There is news; if the rule wants it and its user may know of it, it goes with the next message."""
        if not rules.wants(self.rule, change.alert, change.event, self._office.realms(change.alert)):
            return
        # What gives way here is not counted: nobody knows whether its number may be told.
        self._inbox.put(AlertNotice(change.alert, change.event.value), self._office.clock.seconds())
        if self._judging is None and not self._hushed:
            # Judged when a coroutine can be: mostly before this returns.
            self._judging = judging = Deferred.fromCoroutine(self._judge())
            judging.addErrback(self._broken)
            judging.addBoth(self._judged)

    @property
    def owed(self) -> set[str]:
        """Alerts that have begun or become worse and of which this has yet to tell, by their ids.

        Also by the message under way: whether it arrives nobody knows before there is an answer.
        """
        heaps = self._inbox, self._pending, self._held
        waiting = [*self._under_way, *(each.notice for heap in heaps for each in heap)]
        return {each.alert.id for each in waiting if not each.ends}

    @property
    def told(self) -> set[str]:
        """Alerts of which their user knows that they have begun, by their ids; the latest."""
        return set(self._told)

    def close(self) -> None:
        """Tell nothing any more, and forget what waits."""
        self.hush()
        for heap in (self._inbox, self._pending, self._held):
            heap.clear()

    def hush(self) -> None:
        """Send nothing any more: what waits, and what is offered from now on, stays :attr:`owed`."""
        self._hushed = True
        for each in (self._judging, self._working):
            if each is not None:
                each.cancel()

    def _broken(self, failure: Failure) -> None:
        if not failure.check(CancelledError):
            self.log.failure("telling alerts by rule {rule} failed", failure, rule=self.rule.id)

    # --- who may know -------------------------------------------------------------------------------------

    async def _judge(self) -> None:
        """Let what the user may know of take a place."""
        while self._inbox:
            asked = [each.notice for each in self._inbox]
            try:
                known = await self._office.known(self.rule, [each.alert for each in asked])
            except SwitchboardError:
                await self._sleep(JUDGE_SECONDS)
                continue
            for each in asked:
                latest = self._inbox.drop(each)
                if latest is not None and each.alert.id in known:
                    self._left_out += self._pending.put(*latest)
            self._begin()

    def _judged(self, _: object) -> None:
        self._judging = None

    def _begin(self) -> None:
        if not self._pending:
            return
        if self._working is not None:
            self._awake()
            return
        self._working = working = Deferred.fromCoroutine(self._work())
        working.addErrback(self._broken)
        working.addBoth(self._worked)

    def _worked(self, _: object) -> None:
        self._working = None

    # --- when ---------------------------------------------------------------------------------------------

    async def _work(self) -> None:
        """Until nothing waits."""
        while self._pending or self._held:
            pause = self._pause()
            if pause > 0:
                await self._rest(min(pause, LONGEST_REST))
                continue
            self._sort()
            if self._pending:
                if self._office.clock.seconds() < self._next:
                    self._extra.take()
                left_out, self._left_out = self._left_out, 0
                self._under_way = self._pending.take()
                await self._deliver(self._under_way, left_out)
                self._under_way = []

    def _pause(self) -> float:
        """Seconds until there is something to do."""
        now = self._office.clock.seconds()
        if self._pending:
            regular = max(min(each.since for each in self._pending) + GATHER_SECONDS, self._next)
            urgent = min((each.since for each in self._pending if self._urgent(each.notice)), default=inf)
            return min(regular, max(urgent + GATHER_SECONDS, now + self._extra.wait)) - now
        wall = self._office.wall()
        end = rules.quiet_until(self.rule, wall)
        return 0.0 if end is None else end - wall

    def _urgent(self, notice: AlertNotice) -> bool:
        """Whether it must not wait for others: an error, and what is worse than all that was told last."""
        return notice.alarms or (not notice.ends and kinds.severity(notice.alert.level) > self._worst)

    async def _rest(self, seconds: float) -> None:
        self._wake = Deferred()
        timer: Timer = self._office.clock.callLater(seconds, self._awake)
        try:
            await self._wake
        finally:
            cancel(timer)
            self._wake = None

    async def _sleep(self, seconds: float) -> None:
        slept: Deferred[None] = Deferred()
        timer: Timer = self._office.clock.callLater(seconds, slept.callback, None)
        try:
            await slept
        finally:
            cancel(timer)

    def _awake(self) -> None:
        wake, self._wake = self._wake, None
        if wake is not None:
            wake.callback(None)

    def _sort(self) -> None:
        """Put aside what is not for quiet hours; after them, take up what still counts."""
        now = self._office.wall()
        if rules.quiet_until(self.rule, now) is None:
            held = [each for each in self._held if self._still(each.notice)]
            fresh = list(self._pending)
            self._held.clear()
            self._pending.clear()
            for each in (*held, *fresh):
                self._left_out += self._pending.put(*each)
        else:
            for each in self._pending:
                if not rules.passes(self.rule, each.notice.alert, now):
                    self._put_aside(each)
        self._drop_ends()

    def _put_aside(self, waiting: QueuedNotification) -> None:
        alert = waiting.notice.alert
        self._pending.drop(waiting.notice)
        self._left_out += self._held.put(*waiting)
        if not waiting.notice.ends and alert.id not in self._told:
            _keep(self._unheard, alert.id)

    def _still(self, notice: AlertNotice) -> bool:
        """Whether what was held is worth telling: that something lasts which does, and is over which is."""
        return self._office.lasts(notice.alert.id) != notice.ends

    def _drop_ends(self) -> None:
        """Who never heard that something began is not told that it is over."""
        heard = {each.notice.alert.id for each in self._pending if not each.notice.ends}
        for notice, _ in self._pending:
            if notice.ends and notice.alert.id in self._unheard and notice.alert.id not in heard:
                self._pending.drop(notice)
                del self._unheard[notice.alert.id]

    # --- sending ------------------------------------------------------------------------------------------

    async def _deliver(self, batch: list[AlertNotice], left_out: int) -> None:
        """Try until it has arrived, or there is no hope."""
        name, pauses, due = self._office.name(), iter(RETRY_SECONDS), 0.0
        while True:
            try:
                if await self._try(name, batch, left_out):
                    self._arrived()
                return
            except SwitchboardError as error:
                self._failing = True
                self.status.reason = str(error)
                hopeless = not getattr(error, "again", True)
            now = self._office.clock.seconds()
            if not hopeless and now >= due:
                pause = next(pauses, None)
                hopeless = pause is None
                due = now + (pause or 0.0) * (1 - 0.2 * self._office.random())
            if hopeless:
                self._give_up(len(batch))
                return
            while (left := self._next_try(now, due) - self._office.clock.seconds()) > 0:
                await self._rest(left)

    def _next_try(self, tried: float, due: float) -> float:
        """When a message is tried again, monotonic seconds: sooner than it is due while an error waits behind it."""
        pressed = any(each.notice.alarms for each in self._pending)
        return min(due, tried + PRESSED_SECONDS) if pressed else due

    async def _try(self, name: str, batch: list[AlertNotice], left_out: int) -> bool:
        """Send what the user may still know of; whether there was anything."""
        async with self._places, self._office.room(self.rule, self._failing):
            # Judged after every long wait: meanwhile the right may be gone.
            known = await self._office.known(self.rule, [each.alert for each in batch])
            notices = [each for each in batch if each.alert.id in known]
            if not notices:
                return False
            await self._office.send(self.rule, NotificationMessage(name, notices, left_out))
        self._remember(notices)
        return True

    def _remember(self, notices: list[AlertNotice]) -> None:
        self._worst = max(kinds.severity(each.alert.level) for each in notices)
        for each in notices:
            self._unheard.pop(each.alert.id, None)
            if each.ends:
                self._told.pop(each.alert.id, None)
            else:
                _keep(self._told, each.alert.id)

    def _arrived(self) -> None:
        self._failing = False
        self.status.sent += 1
        self.status.last = self._office.wall()
        self._next = self._office.clock.seconds() + self.rule.group_s

    def _give_up(self, count: int) -> None:
        self.status.failed += 1
        self._next = self._office.clock.seconds() + self.rule.group_s
        self.log.warn(
            "{count} alerts were not told by rule {rule} of {user}: {reason}",
            count=count,
            rule=self.rule.id,
            user=full_name(self.rule.user, self.rule.realm),
            reason=self.status.reason,
        )


def _keep(heap: dict[str, None], alert_id: str) -> None:
    """Remember an alert as the latest of at most :data:`TOLD`."""
    heap.pop(alert_id, None)
    heap[alert_id] = None
    if len(heap) > TOLD:
        del heap[next(iter(heap))]


async def test(office: DeliveryContext, rule: AlertRuleRecord, places: DeferredSemaphore) -> str:
    """Send a made-up alert now; why it did not arrive, or nothing."""
    now = office.wall()
    text = "This is a test: alerts of your robots arrive like this."
    alert = AlertRecord(
        "test", 0, "test", rule.realm, "robot", "", "info", text, now, now, 1, 1, None, None, None
    )
    try:
        async with places, office.room(rule, False):
            await office.send(rule, NotificationMessage(office.name(), [AlertNotice(alert, "test")]))
    except Undelivered as error:
        return str(error)
    return ""
