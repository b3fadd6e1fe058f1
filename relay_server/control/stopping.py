"""Stopping one robot, and letting it move again; a robot that is away is stopped first thing when it comes back."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from msgspec import structs
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db.queries import StopRecord
from relay_protocol import link
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_server.common.clock import Clock, detached, sleep
from relay_server.common.token_bucket import Buckets
from relay_server.control.audit import WHY, Actor, AuditSink
from relay_server.control.commands import NotDone, RobotCommands
from relay_server.robots.registry import RobotState

STOP_SECONDS = 14.0
"""A robot has so long to confirm that it stands: a switch in its hardware may take 6 s, and has to be thrown once more
where the stop came in the middle of a resume."""

KEEPING = 8
"""Orders to stop one robot that are being written at a time: who stops it again and again must not fill the database's
queue. The robot is told all the same; where it can't be, whoever comes then is told that his order is not kept."""

KNOWN = 256
"""Orders to stop one robot that are remembered: a slow database may still tell of them."""

PUT_AWAY_SECONDS = 10.0
"""From one attempt to take out of the database what is over to the next."""

AGAIN_A_SECOND = 3 / 60
AGAIN_AT_ONCE = 3
"""Of the stops of a robot that is stopped already, how many of one user are in the audit log. The robot gets all."""

AGAIN_USERS = 256
"""Users remembered for that; the longest quiet are forgotten first."""

SAME_SECONDS = 2.0
"""Who stops a robot once more for the same reason within so long has pressed once: a page sends that two ways."""

AT_ONCE = 64
"""Orders to stop one robot that are under way at a time; whoever comes then is stopping it already."""


class RepeatedStop(NamedTuple):
    """That a stopped robot was stopped once more.

    :param since: Unix time, seconds
    """

    by: str
    why: str
    since: float


class StopState(NamedTuple):
    """That a robot is stopped.

    :param since: Unix time, seconds; of what comes by two ways the later
    :param told: whether the robot has confirmed it
    :param again: the latest of those who have stopped it since: whoever lets it move goes over his head too
    """

    by: str
    why: str
    since: float
    told: bool
    again: RepeatedStop | None = None


class StopId(NamedTuple):
    """What stopped a robot that could move.

    :param at: the clock's seconds
    """

    who: int | str
    why: str
    at: float


class StoppedSince(Refused):
    """Somebody may have stopped the robot after it was asked for that it may move again."""

    code = "stopped_since"


class StopController:
    """The stop of one robot.

    :param changed: called when it is another
    :param wall: Unix time in seconds
    :param clock_ns: the relay's monotonic nanoseconds
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        robot: RobotState,
        orders: RobotCommands,
        record: AuditSink,
        changed: Callable[[], None],
        wall: Callable[[], float],
        clock_ns: Callable[[], int],
    ) -> None:
        self._clock = clock
        self._robot = robot
        self._orders = orders
        self._record = record
        self._changed = changed
        self._wall = wall
        self._clock_ns = clock_ns
        self._latest = 0
        """When the robot was stopped the last time, as far as this relay knows; its monotonic nanoseconds."""
        self._repeats = Buckets(AGAIN_A_SECOND, AGAIN_AT_ONCE, AGAIN_USERS, clock.seconds)
        self._again: RepeatedStop | None = None
        """Who stopped it last while it was stopped."""
        self._press: StopId | None = None
        self._same: float | None = None
        """When what is one press with that came last; Unix time, seconds."""
        self._pending: StopRecord | None = None
        self._known: deque[float] = deque(maxlen=KNOWN)
        """The moments that name the orders seen here, whatever has become of them. They are compared for being the
        same only: clocks are set back."""
        self._unsure: StopRecord | None = None
        """An order that the robot has, but could not do all of: it may have forgotten it when it comes back."""
        self._look = False
        """Whether what the robot says next of itself shows if it still stands."""
        self._under_way = 0
        self._keeping: list[StopRecord] = []
        """Orders that are being written."""
        self._left: deque[float] = deque(maxlen=KNOWN)
        """The moments of orders that are over, and may still be in the database."""
        self._clearing = False

    @property
    def stopped(self) -> StopState | None:
        """By whom and why the robot is stopped, as it says itself, or is going to be; ``None`` when it may move."""
        told, pending, again = self._robot.safety.stopped, self._pending, self._again
        if told is not None:
            since = told.since if self._same is None else self._same
            return StopState(told.by, told.why, since, True, again)
        if pending is None:
            return None
        # What the robot was not told of gives way to the latest order, which is not told twice.
        if again is not None and again.since == pending.at:
            again = None
        return StopState(pending.by, pending.why, max(pending.at, self._same or 0.0), False, again)

    def stop(self, actor: Actor, why: str) -> Deferred[bool]:
        """Stop the robot, and keep it stopped. The order is on its way when this returns.

        What comes back fires with true when the robot has done it, with false when it will as soon as it is back. It
        fails with :class:`NotDone` when the robot is stopped but could not do all that belongs to it, and with
        :class:`Unavailable` when the order could neither be given nor be kept.
        """
        order = StopRecord(self._robot.robot_id, actor.name, why[:WHY], self._wall())
        self._known.append(order.at)
        first = self.stopped is None
        self._latest = self._clock_ns()
        self._count(order, actor, first)
        audit = first or self._repeats.take(actor.source)
        if self._pending is None or len(self._keeping) < KEEPING:
            # Else those stand that are being written.
            self._pending = order
        self._changed()
        return detached(self._stop(order, actor, audit))

    def _count(self, order: StopRecord, actor: Actor, first: bool) -> None:
        """See what whoever would let the robot move is told of an order.

        :param first: whether the robot was not stopped before
        """
        who = actor.source if actor.user is None else actor.user
        press, before = StopId(who, order.why, self._clock.seconds()), self._press
        if first:
            self._unpress()
            self._press = press
        elif before is not None and before[:2] == press[:2] and press.at - before.at <= SAME_SECONDS:
            # It is told by another moment: that ends a press to resume.
            self._same = order.at
        else:
            self._again = RepeatedStop(order.by, order.why, order.at)

    async def _stop(self, order: StopRecord, actor: Actor, audit: bool) -> bool:
        # Before anything is written: nothing is as urgent.
        given = self._tell(order)
        keeping = detached(self._keep(order, actor, audit))
        outcome = await _outcome(given)
        # Whoever asked is not kept waiting by a database that hangs.
        if outcome is None:
            self._has(order)
            keeping.addErrback(self._failed)
            return True
        if isinstance(outcome, NotDone):
            self._unsure = order
            keeping.addErrback(self._failed)
            raise outcome
        kept = await _outcome(keeping)
        if kept is not None:
            raise Unavailable(f"{outcome}; and the order can't be kept for when it is back: {kept}")
        return False

    async def _keep(self, order: StopRecord, actor: Actor, audit: bool) -> None:
        if len(self._keeping) >= KEEPING:
            self._record.note("robot.stopped", self._robot, actor, order.why, audit=audit)
            raise Unavailable(f"{KEEPING} orders to stop {self._robot.name} are being written already")
        self._keeping.append(order)
        try:
            await self._record.ordered(self._robot, order, actor, audit=audit)
        finally:
            self._keeping.remove(order)
        if self._pending is None:
            self._put_away(order)

    def _has(self, order: StopRecord) -> None:
        """The robot has it: nobody need tell it again."""
        self._believe(link.Stopped(by=order.by, why=order.why, since=order.at))
        self._over(order)
        self._put_away(order)

    def _believe(self, stopped: link.Stopped | None) -> None:
        """The robot has done as it was told; how it says so of itself may come a moment later."""
        safety = self._robot.safety
        if (safety.stopped is None) is not (stopped is None):
            self._robot.safety = structs.replace(safety, stopped=stopped)
            self._changed()

    def _over(self, order: StopRecord) -> None:
        # One that was given meanwhile stands.
        if self._pending is order:
            self._pending = None
            self._changed()

    def _put_away(self, order: StopRecord) -> None:
        """Have the database tell nobody of an order that is over, a later relay neither; nobody waits for that."""
        # What is being written is put away when it is there.
        if order not in self._keeping and order.at not in self._left:
            self._left.append(order.at)
            if not self._clearing:
                self._clearing = True
                detached(self._clear()).addErrback(self._failed)

    async def _clear(self) -> None:
        try:
            while self._left:
                at = self._left[0]
                try:
                    await self._record.told(self._robot, at)
                except SwitchboardError as error:
                    robot, reason = self._robot.name, str(error)
                    self.log.warn(
                        "a stop of {robot} is over and still kept: {reason}", robot=robot, reason=reason
                    )
                    await sleep(self._clock, PUT_AWAY_SECONDS)
                else:
                    # It is not there where so many were over meanwhile that the oldest went.
                    if at in self._left:
                        self._left.remove(at)
        finally:
            self._clearing = False

    def _failed(self, failure: Any) -> None:
        """A robot that is told to stop again stands all the same."""
        robot = self._robot.name
        self.log.error("the stop of {robot} is not well kept: {reason}", robot=robot, reason=failure.value)

    def _tell(self, order: StopRecord) -> Deferred[None]:
        if self._under_way >= AT_ONCE:
            given: Deferred[None] = Deferred()
            given.errback(Unavailable(f"robot {self._robot.name} has been told to stop, and does not answer"))
            return given
        self._under_way += 1
        given = self._orders.give(
            lambda id: link.Stop(id=id, by=order.by[:255], why=order.why, at=order.at),
            seconds=STOP_SECONDS,
            always=True,
        )
        return given.addBoth(self._answered)

    def _answered(self, result: Any) -> Any:
        self._under_way -= 1
        return result

    def anew(self) -> None:
        """The robot is stopped now: nothing that was asked for before lets it move again."""
        self._latest = self._clock_ns()
        self._unpress()

    def _unpress(self) -> None:
        """Forget who has stopped it."""
        self._again = self._press = self._same = None

    def resume(self, actor: Actor, why: str, sent: int) -> Deferred[None]:
        """Let the robot move again. A stop it was not told of is taken back.

        What comes back fails with :class:`StoppedSince` when it can have been asked for before the robot was last
        stopped, with :class:`NotDone` or :class:`Unavailable` when the robot has not done it. One that is
        offline keeps what it was told, also where this relay has not seen it since it began.

        :param sent: a moment before which it can't have been asked for, the relay's monotonic nanoseconds
        """
        return detached(self._resume(actor, why[:WHY], self._pending, sent))

    async def _resume(self, actor: Actor, why: str, pending: StopRecord | None, sent: int) -> None:
        robot = self._robot
        if sent < self._latest:
            raise StoppedSince(
                f"robot {robot.name} was stopped, or may have been, after you asked for this: see why it stands, and "
                "resume it once more"
            )
        told = robot.control is not None
        if told:
            await self._orders.give(
                lambda id: link.Resume(id=id, by=actor.name[:255], why=why), seconds=STOP_SECONDS, always=True
            )
        elif robot.safety.stopped is not None:
            raise Unavailable(
                f"robot {robot.name} is offline, and stopped: it can be resumed when it is back"
            )
        elif pending is None or pending is self._unsure:
            raise Unavailable(
                f"robot {robot.name} is offline, and may be stopped: it can be resumed when it is back"
            )
        else:
            await self._record.told(robot, pending.at)
        if told:
            # What the robot has done is done, whatever the database says.
            self._unpress()
            self._believe(None)
        if pending is not None:
            self._over(pending)
        self._record.note("robot.resumed", robot, actor, why)
        if told and pending is not None:
            self._put_away(pending)

    # --- the robot ----------------------------------------------------------------------------------------

    def expect(self, order: StopRecord | None, seen: int) -> bool:
        """What the database says is still to be told; whether that is new.

        :param seen: when it was first read there, the relay's monotonic nanoseconds
        """
        if order is None:
            return False
        if order.at in self._known:
            if self._pending is None:
                self._put_away(order)
            return False
        self._known.append(order.at)
        self._latest = max(self._latest, seen)
        self._pending = order
        self._changed()
        return True

    def came(self) -> None:
        """The robot is there: what it was not told yet it is told now."""
        pending = self._pending
        self._look = pending is not None and pending is self._unsure
        if not self._look:
            self._tell_pending()

    def heard(self) -> None:
        """The robot has said of itself whether it stands: one that has forgotten its stop is told again."""
        if self._look:
            self._look = False
            if self._robot.safety.stopped is None:
                self._tell_pending()

    def _tell_pending(self) -> None:
        if self._pending is not None:
            detached(self._catch_up(self._pending)).addErrback(self._failed)

    async def _catch_up(self, order: StopRecord) -> None:
        outcome = await _outcome(self._tell(order))
        if outcome is not None:
            robot = self._robot.name
            self.log.error("robot {robot} was to be stopped: {reason}", robot=robot, reason=str(outcome))
        if outcome is None:
            self._has(order)
        elif isinstance(outcome, NotDone):
            self._unsure = order


async def _outcome(work: Any) -> SwitchboardError | None:
    """What went wrong, if anything did."""
    try:
        await work
    except SwitchboardError as error:
        return error
    return None
