"""The stop of one robot: sent, stored in the database until the robot confirms it, and in force until a resume.

A stop in the database is still to be sent. It is deleted when the robot has confirmed it, or when a resume has
withdrawn it (SPEC 1.7): :mod:`relay_server.control.stored_stops`.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any, NamedTuple

from msgspec import structs
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db.queries import StopRecord
from relay_protocol import link
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_protocol.limits import REASON_LENGTH
from relay_server.common.clock import Clock
from relay_server.common.concurrency import detached
from relay_server.common.token_bucket import Buckets
from relay_server.control.actor import Actor, local_actor
from relay_server.control.orders import ControlOrders, OrderFailed
from relay_server.control.records import AuditSink
from relay_server.control.stored_stops import PendingStops, StopWriter
from relay_server.robots.registry import RobotState

STOP_SECONDS = 14.0
"""Time for a robot to confirm a stop. A switch in its hardware may take 6 s, and has to be set twice where the stop
arrives during a resume."""

FURTHER_AUDITS_PER_SECOND = 3 / 60
FURTHER_AUDITS_BURST = 3
"""Rate and burst of one user's further stops that are audited. The robot receives all."""

USERS = 256
"""Most users remembered for this rate and for ids of stops; the least recent are forgotten first."""

IDS_PER_USER = 16
"""Most ids of stops remembered for each user while a robot is stopped; the oldest are forgotten first."""

ORDERS_AT_ONCE = 64
"""Most stop orders without an answer. Beyond this, the robot has been sent the stop often enough."""


class FurtherStop(NamedTuple):
    """A stop of a robot that was stopped already, by another request.

    :param since: Unix time, seconds
    """

    by: str
    why: str
    since: float


class StopState(NamedTuple):
    """Why a robot is stopped.

    :param since: Unix time, seconds; of its latest duplicate, if any
    :param confirmed: whether the robot has confirmed it
    :param again: the latest further stop; a resume overrides that one too
    """

    by: str
    why: str
    since: float
    confirmed: bool
    again: FurtherStop | None = None


class StopIncomplete(SwitchboardError):
    """The robot is stopped, but could not do all that belongs to a stop.

    :ivar reason: what failed, in the robot's words
    """

    code = "not_done"

    def __init__(self, robot: str, reason: str) -> None:
        super().__init__(f"robot {robot} is stopped, but a part of the stop failed: {reason}")
        self.reason = reason


class StoppedSince(Refused):
    """The robot may have been stopped after this resume was sent."""

    code = "stopped_since"


class StopIds:
    """Ids of the stops that one robot has received since it could last move, separated by user.

    One id of one user is one stop, by whatever paths it arrives: each later arrival is a duplicate. As ids are
    separated, no user can pass off another's stop as a duplicate of their own. The command line has the same rule for
    what it stores: :func:`relay_db.queries.store_stop_once`. The robot knows no ids: a stop that comes again is done
    again.
    """

    def __init__(self) -> None:
        self._seen: OrderedDict[int | str, deque[str]] = OrderedDict()

    def is_duplicate(self, actor: Actor, stop_id: str) -> bool:
        """Remember an id; return whether this user sent it before. A stop without an id is no duplicate."""
        if not stop_id:
            return False
        user = actor.source if actor.user is None else actor.user
        seen = self._seen.pop(user, None) or deque(maxlen=IDS_PER_USER)
        duplicate = stop_id in seen
        if not duplicate:
            seen.append(stop_id)
        self._seen[user] = seen
        if len(self._seen) > USERS:
            self._seen.popitem(last=False)
        return duplicate

    def clear(self) -> None:
        """Forget all ids, as the robot may move: every later stop is new."""
        self._seen.clear()


class StopController:
    """The stop of one robot.

    :param changed: called when :attr:`stopped` has changed
    :param wall: Unix time in seconds
    :param clock_ns: the relay's monotonic nanoseconds
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        robot: RobotState,
        orders: ControlOrders,
        *,
        record: AuditSink,
        store: PendingStops,
        changed: Callable[[], None],
        wall: Callable[[], float],
        clock_ns: Callable[[], int],
    ) -> None:
        self._clock = clock
        self._robot = robot
        self._orders = orders
        self._record = record
        self._writer = StopWriter(clock, robot, store)
        self._changed = changed
        self._wall = wall
        self._clock_ns = clock_ns
        self._last_stopped_at = 0
        """When the robot was last stopped, as far as this relay knows; the relay's monotonic nanoseconds."""
        self._further_audits = Buckets(FURTHER_AUDITS_PER_SECOND, FURTHER_AUDITS_BURST, USERS, clock.seconds)
        self._ids = StopIds()
        self._latest_further: FurtherStop | None = None
        self._duplicate_at: float | None = None
        """When a duplicate last arrived; Unix time, seconds."""
        self._pending: StopRecord | None = None
        """A stop that the robot has not confirmed."""
        self._stored_since: int | None = None
        """Since when the pending stop has been in the database, the relay's monotonic nanoseconds; ``None``: it may not
        be stored yet."""
        self._incomplete: StopRecord | None = None
        """A stop that the robot received but could not carry out completely. It may be without it when it returns."""
        self._check_state = False
        """Whether the next state from the robot shows if it is still stopped."""
        self._unanswered_orders = 0

    @property
    def stopped(self) -> StopState | None:
        """Why the robot is stopped, by its own report or by a stop that it has not confirmed; ``None``: it may move."""
        confirmed, pending, again = self._robot.motion_state.stopped, self._pending, self._latest_further
        if confirmed is not None:
            since = confirmed.since if self._duplicate_at is None else self._duplicate_at
            return StopState(confirmed.by, confirmed.why, since, True, again)
        if pending is None:
            return None
        # While the robot is offline, the latest stop replaces the first; do not show it twice.
        if again is not None and again.since == pending.at:
            again = None
        return StopState(pending.by, pending.why, max(pending.at, self._duplicate_at or 0.0), False, again)

    def stop(self, actor: Actor, why: str, stop_id: str = "") -> Deferred[bool]:
        """Stop the robot, and keep it stopped. The order is sent when this returns.

        :param stop_id: made by the client, see :class:`StopIds`. A duplicate is sent as every stop is, but not
            recorded
        :returns: fires with true when the robot has confirmed, with false when it will be stopped once it returns.
            Fails with :class:`StopIncomplete` when the robot is stopped but could not do everything, and with
            :class:`Unavailable` when the stop could neither be sent nor be stored
        """
        stop = StopRecord(self._robot.robot_id, actor.name, why[:REASON_LENGTH], self._wall(), stop_id)
        self._writer.note(stop)
        first = self.stopped is None
        self._last_stopped_at = self._clock_ns()
        duplicate = self._identify(stop, actor, stop_id, first)
        audit = first or self._further_audits.take(actor.source)
        if self._pending is None or not self._writer.full:
            # When the writer is full, the pending stop is being written, and a further one is only sent.
            self._pending, self._stored_since = stop, None
        self._changed()
        return detached(self._stop(stop, None if duplicate else actor, audit))

    def _identify(self, stop: StopRecord, actor: Actor, stop_id: str, first: bool) -> bool:
        """Return whether this stop is a duplicate, and update the stop that is shown.

        :param first: whether the robot was not stopped before
        """
        if first:
            self._forget_requests()
        duplicate = self._ids.is_duplicate(actor, stop_id)
        if duplicate:
            # Shown with a new time, which ends a pending press to resume.
            self._duplicate_at = stop.at
        elif not first:
            self._latest_further = FurtherStop(stop.by, stop.why, stop.at)
        return duplicate

    async def _stop(self, stop: StopRecord, actor: Actor | None, audit: bool) -> bool:
        # Before anything is written, as the robot must stop at once.
        sent = self._send(stop)
        saving = detached(self._save(stop, actor, audit))
        error = await _error_of(sent)
        # The caller does not wait for a database that hangs.
        if error is None:
            self._set_confirmed(stop)
            saving.addErrback(self._log_failure)
            return True
        if isinstance(error, OrderFailed):
            self._incomplete = stop
            saving.addErrback(self._log_failure)
            raise StopIncomplete(self._robot.name, error.reason)
        not_saved = await _error_of(saving)
        if not_saved is not None:
            raise Unavailable(f"{error}; and the stop cannot be stored for its return: {not_saved}")
        return False

    async def _save(self, stop: StopRecord, actor: Actor | None, audit: bool) -> None:
        """Record a stop, and store it in the database until it is confirmed.

        :param actor: ``None`` for a duplicate, which is recorded already
        :param audit: whether to write an audit entry
        """
        if actor is not None:
            self._record.note("robot.stopped", self._robot, actor, stop.why, audit=audit)
        await self._writer.save(stop)
        if self._pending is None:
            self._writer.delete(stop)
        elif self._pending is stop:
            self._stored_since = self._clock_ns()

    def _set_confirmed(self, stop: StopRecord) -> None:
        """The robot has the stop: show it as confirmed, and send it no more."""
        self._set_reported_stop(link.Stopped(by=stop.by, why=stop.why, since=stop.at))
        self._clear_pending(stop)
        self._writer.delete(stop)

    def _set_reported_stop(self, stopped: link.Stopped | None) -> None:
        """Apply a confirmation of the robot before its own state report arrives."""
        state = self._robot.motion_state
        if (state.stopped is None) is not (stopped is None):
            self._robot.motion_state = structs.replace(state, stopped=stopped)
            self._changed()

    def _clear_pending(self, stop: StopRecord) -> None:
        # A later stop stays pending.
        if self._pending is stop:
            self._pending = None
            self._changed()

    def _log_failure(self, failure: Any) -> None:
        """Log a failed write; the robot is stopped regardless."""
        robot = self._robot.name
        self.log.error(
            "the stop of {robot} could not be stored or delivered: {reason}",
            robot=robot,
            reason=failure.value,
        )

    def _send(self, stop: StopRecord) -> Deferred[None]:
        if self._unanswered_orders >= ORDERS_AT_ONCE:
            sent: Deferred[None] = Deferred()
            sent.errback(Unavailable(f"robot {self._robot.name} was sent the stop, and does not answer"))
            return sent
        self._unanswered_orders += 1
        sent = self._orders.send(
            lambda id: link.Stop(id=id, by=stop.by[:255], why=stop.why, at=stop.at),
            seconds=STOP_SECONDS,
            always=True,
        )
        return sent.addBoth(self._order_ended)

    def _order_ended(self, result: Any) -> Any:
        self._unanswered_orders -= 1
        return result

    def stopped_elsewhere(self) -> None:
        """Note a stop that this relay did not send: resumes sent before it are refused."""
        self._last_stopped_at = self._clock_ns()
        self._forget_requests()

    def _forget_requests(self) -> None:
        self._ids.clear()
        self._latest_further = self._duplicate_at = None

    def resume(self, actor: Actor, why: str, earliest_sent: int) -> Deferred[None]:
        """Let the robot move again. A stop that the robot has not received is withdrawn.

        An offline robot keeps a stop that it has received, even one from before this relay started.

        :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`
        :returns: fails with :class:`StoppedSince` when the robot may have been stopped after that, with
            :class:`OrderFailed` or :class:`Unavailable` when the robot has not resumed
        """
        return detached(self._resume(actor, why[:REASON_LENGTH], self._pending, earliest_sent))

    async def _resume(self, actor: Actor, why: str, pending: StopRecord | None, earliest_sent: int) -> None:
        robot = self._robot
        if earliest_sent < self._last_stopped_at:
            raise StoppedSince(
                f"robot {robot.name} was stopped, or may have been, after you sent this: check why it is stopped, then "
                "resume it again"
            )
        online = robot.control_link is not None
        if online:
            await self._orders.send(
                lambda id: link.Resume(id=id, by=actor.name[:255], why=why), seconds=STOP_SECONDS, always=True
            )
        elif robot.elsewhere:
            raise Unavailable(
                f"robot {robot.name} is connected to another relay, which needs the age of a resume: resume it by "
                f"'switchboard robot resume {robot.name}', in the portal or over HTTP"
            )
        elif robot.motion_state.stopped is not None:
            raise Unavailable(f"robot {robot.name} is offline, and stopped: resume it when it is back")
        elif pending is None or pending is self._incomplete:
            raise Unavailable(f"robot {robot.name} is offline, and may be stopped: resume it when it is back")
        else:
            await self._writer.delete_now(pending)
        if online:
            # The robot may move, even if the database fails.
            self._forget_requests()
            self._set_reported_stop(None)
        if pending is not None:
            self._clear_pending(pending)
        self._record.note("robot.resumed", robot, actor, why)
        if online and pending is not None:
            self._writer.delete(pending)

    # --- the robot ----------------------------------------------------------------------------------------

    def add_stored(self, stop: StopRecord | None, seen: int, read_at: int) -> bool:
        """Add a stop stored in the database; return whether it is new. The caller sends it.

        Every relay reads the stops again whenever the database has changed, so most are known already.

        :param stop: ``None``: none is stored for this robot
        :param seen: when it was first read from there, the relay's monotonic nanoseconds
        :param read_at: when the present reading began, as ``seen``
        """
        if stop is None:
            self._check_ended_elsewhere(read_at)
            return False
        if self._writer.is_known(stop):
            if self._pending is None:
                self._writer.delete(stop)
            return False
        self._writer.note(stop, read=True)
        if self.stopped is None:
            self._forget_requests()
        # The command line has stored it if no relay answered. It may have arrived here all the same, or still arrive.
        if self._ids.is_duplicate(local_actor(stop.by), stop.stop_id):
            if self._is_confirmed:
                self._writer.delete(stop)
                return False
            self._duplicate_at = stop.at
        self._last_stopped_at = max(self._last_stopped_at, seen)
        self._pending, self._stored_since = stop, seen
        self._changed()
        return True

    @property
    def _is_confirmed(self) -> bool:
        """Whether the robot is online, and has confirmed all its stops."""
        robot = self._robot
        return (
            robot.control_link is not None
            and robot.motion_state.stopped is not None
            and self._pending is None
        )

    @property
    def waits_in_database(self) -> bool:
        """Whether a stop is stored that another relay of a cluster may have confirmed, as the robot is not here."""
        return self._pending is not None and self._robot.control_link is None

    def _check_ended_elsewhere(self, read_at: int) -> None:
        """Forget a pending stop that is stored no longer: the relay with the robot had it confirmed, or withdrawn.

        :param read_at: when the reading began that has not found it
        """
        stored, offline = self._stored_since, self._robot.control_link is None
        if self._pending is not None and offline and stored is not None and stored < read_at:
            self._clear_pending(self._pending)

    def robot_online(self) -> None:
        """Send the robot a stop that it has not confirmed.

        A robot that has carried out a part of it is asked again only if its next state shows no stop.
        """
        if self._pending is not None and self._pending is self._incomplete:
            self._check_state = True
        else:
            self.send_pending()

    def state_received(self) -> None:
        """Handle a state report: send the stop again to a robot that has lost it."""
        if self._check_state:
            self._check_state = False
            if self._robot.motion_state.stopped is None:
                self.send_pending()

    def send_pending(self) -> None:
        """Send the robot a stop that it has not confirmed, if there is one."""
        self._check_state = False
        if self._pending is not None:
            detached(self._deliver(self._pending)).addErrback(self._log_failure)

    async def _deliver(self, stop: StopRecord) -> None:
        error = await _error_of(self._send(stop))
        if error is None:
            self._set_confirmed(stop)
            return
        if isinstance(error, OrderFailed):
            self._incomplete = stop
            error = StopIncomplete(self._robot.name, error.reason)
        self.log.error(
            "the stop of {robot} is not confirmed: {reason}", robot=self._robot.name, reason=str(error)
        )


async def _error_of(work: Any) -> SwitchboardError | None:
    try:
        await work
    except SwitchboardError as error:
        return error
    return None
