"""The way out of one rule: what is to be told waits, goes together, is tried again, and hurts nobody else's.

Three heaps: *pending* goes with the next message, *held* waits for the end of the quiet hours, and what is in the
message under way is in none of them. All are bounded; the oldest give way and are counted.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection
from dataclasses import dataclass

from twisted.internet.defer import CancelledError, Deferred, DeferredSemaphore
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_db.queries import AlertRecord, AlertRuleRecord
from relay_protocol.errors import SwitchboardError
from relay_server.alerts import rules
from relay_server.alerts.book import Change
from relay_server.alerts.kinds import Event
from relay_server.alerts.message import Message, Notice, Undelivered
from relay_server.clock import Clock, Timer, cancel

MOST = 200
"""Notices that wait for one rule, and again those that wait for the end of quiet hours."""

TOLD = 1000
"""Alerts of which one rule remembers that they were told, so that their end is told too."""

GATHER_SECONDS = 0.2
"""What comes within this time of the first goes with it."""

RETRY_SECONDS = (2.0, 10.0, 30.0, 120.0, 420.0)
"""Pauses before a message is tried again; each is shortened at random by up to a fifth."""

LONGEST_REST = 3600.0
"""Wall clocks are set: nobody sleeps longer on the word of one."""

Send = Callable[[AlertRuleRecord, Message, bool], Awaitable[None]]
"""Sends a message by a rule's way. The last says whether the one before has failed. Raises :class:`Undelivered`."""

Known = Callable[[AlertRuleRecord, Collection[AlertRecord]], Awaitable[set[str]]]
"""Which of these alerts the rule's user may still know of, by their ids. Raises :class:`SwitchboardError`."""


@dataclass
class Status:
    """What has become of the messages of a rule.

    :param last: Unix time of the latest that arrived
    """

    sent: int = 0
    failed: int = 0
    reason: str = ""
    last: float | None = None


@dataclass(frozen=True)
class Office:
    """What all deliveries share.

    :param wall: Unix time in seconds
    :param random: 0 to 1
    :param name: makes a fresh name for a message
    :param lasts: whether the alert of this id is not over
    """

    clock: Clock
    wall: Callable[[], float]
    random: Callable[[], float]
    name: Callable[[], str]
    send: Send
    known: Known
    lasts: Callable[[str], bool]


class Delivery:
    """What is to be told by one rule.

    :param places: of the rule's user: how many messages he has under way at a time
    """

    log = Logger()

    def __init__(self, office: Office, rule: AlertRuleRecord, places: DeferredSemaphore) -> None:
        self.rule = rule
        self.status = Status()
        self._office = office
        self._places = places
        self._pending: dict[tuple[str, str], Notice] = {}
        self._held: dict[tuple[str, str], Notice] = {}
        self._told: dict[str, None] = {}
        """Alerts of which their user knows that they have begun, and not that they are over."""
        self._left_out = 0
        self._since = self._next = 0.0
        self._failing = False
        self._working: Deferred[None] | None = None
        self._wake: Deferred[None] | None = None

    @property
    def waiting(self) -> int:
        """Notices that wait."""
        return len(self._pending) + len(self._held)

    def offer(self, change: Change) -> None:
        """There is news; if the rule wants it, it goes with the next message."""
        if not rules.wants(self.rule, change.alert, change.event):
            return
        if not self._pending:
            self._since = self._office.clock.seconds()
        self._left_out += _put(self._pending, Notice(change.alert, change.event.value))
        if self._working is None:
            self._working = Deferred.fromCoroutine(self._work())
            self._working.addErrback(self._broken)
        else:
            self._awake()

    def close(self) -> None:
        """Tell nothing any more."""
        self._pending.clear()
        self._held.clear()
        if self._working is not None:
            self._working.cancel()

    def _broken(self, failure: Failure) -> None:
        self._working = None
        if not failure.check(CancelledError):
            self.log.failure("telling alerts by rule {rule} failed", failure, rule=self.rule.id)

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
                batch, self._pending = list(self._pending.values()), {}
                left_out, self._left_out = self._left_out, 0
                await self._deliver(batch, left_out)
        self._working = None

    def _pause(self) -> float:
        """Seconds until there is something to do."""
        now = self._office.clock.seconds()
        if self._pending:
            return max(self._since + GATHER_SECONDS, self._next) - now
        wall = self._office.wall()
        end = rules.quiet_until(self.rule, wall)
        return 0.0 if end is None else end - wall

    async def _rest(self, seconds: float) -> None:
        self._wake = Deferred()
        timer: Timer = self._office.clock.callLater(seconds, self._awake)
        try:
            await self._wake
        finally:
            cancel(timer)
            self._wake = None

    def _awake(self) -> None:
        wake, self._wake = self._wake, None
        if wake is not None:
            wake.callback(None)

    def _sort(self) -> None:
        """Put aside what is not for quiet hours; after them, take up what still counts."""
        now = self._office.wall()
        if rules.quiet_until(self.rule, now) is None:
            held, self._held = self._held, {}
            for key, notice in held.items():
                if self._still(notice, held):
                    self._pending.setdefault(key, notice)
            return
        for key, notice in list(self._pending.items()):
            if not rules.passes(self.rule, notice.alert, now):
                self._left_out += _put(self._held, self._pending.pop(key))

    def _still(self, notice: Notice, held: Collection[tuple[str, str]]) -> bool:
        """Whether what was held is worth telling: what lasts, and the end of what was told before."""
        if notice.event != Event.OVER.value:
            return self._office.lasts(notice.alert.id)
        if self._office.lasts(notice.alert.id):
            return False
        return notice.alert.id in self._told or (notice.alert.id, Event.BEGUN.value) not in held

    # --- sending ------------------------------------------------------------------------------------------

    async def _deliver(self, batch: list[Notice], left_out: int) -> None:
        """Try until it has arrived, or there is no hope."""
        name = self._office.name()
        for pause in (*RETRY_SECONDS, None):
            try:
                if not await self._try(name, batch, left_out):
                    return
            except SwitchboardError as error:
                self._failing = True
                self.status.reason = str(error)
                if pause is None or not getattr(error, "again", True):
                    self._give_up(len(batch))
                    return
            else:
                self._arrived()
                return
            until = self._office.clock.seconds() + pause * (1 - 0.2 * self._office.random())
            while (left := until - self._office.clock.seconds()) > 0:
                await self._rest(left)

    async def _try(self, name: str, batch: list[Notice], left_out: int) -> bool:
        """Send what the user may still know of; whether there was anything."""
        known = await self._office.known(self.rule, [each.alert for each in batch])
        notices = [each for each in batch if each.alert.id in known]
        if not notices:
            return False
        await self._places.acquire()
        try:
            await self._office.send(self.rule, Message(name, notices, left_out), self._failing)
        finally:
            self._places.release()
        self._remember(notices)
        return True

    def _remember(self, notices: list[Notice]) -> None:
        for alert, event in notices:
            self._told.pop(alert.id, None)
            if event != Event.OVER.value:
                self._told[alert.id] = None
        while len(self._told) > TOLD:
            del self._told[next(iter(self._told))]

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
            user=self.rule.user,
            reason=self.status.reason,
        )


def _put(heap: dict[tuple[str, str], Notice], notice: Notice) -> int:
    """Put a notice where its place in time is; how many gave way."""
    key = (notice.alert.id, notice.event)
    heap.pop(key, None)
    heap[key] = notice
    if len(heap) <= MOST:
        return 0
    del heap[next(iter(heap))]
    return 1


async def test(office: Office, rule: AlertRuleRecord, places: DeferredSemaphore) -> str:
    """Send a made-up alert now; why it did not arrive, or nothing."""
    now = office.wall()
    text = "This is a test: alerts of your robots arrive like this."
    alert = AlertRecord("test", 0, "test", "robot", "", "info", text, now, now, 1, 1, None, None, None)
    await places.acquire()
    try:
        await office.send(rule, Message(office.name(), [Notice(alert, "test")]), False)
    except Undelivered as error:
        return str(error)
    finally:
        places.release()
    return ""
