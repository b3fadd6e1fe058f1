"""Goals over HTTP: sent, polled, cancelled, and stored for some minutes after their end."""

from __future__ import annotations

import enum
import secrets
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from fnmatch import fnmatchcase
from typing import NamedTuple, cast

import msgspec
from twisted.internet.defer import Deferred

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.limits import KIB, MIB
from relay_protocol.rights import Operation
from relay_server.access import Principal
from relay_server.channels.goals import GoalStatusCode
from relay_server.channels.names import normal_type, resolve
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.errors import NotDone
from relay_server.common.etags import tag_of
from relay_server.in_process_sessions.in_process_port import GoalListener
from relay_server.in_process_sessions.pool import InProcessSessionPool, PooledSession, RobotCaller
from relay_server.relay_node.visible_graph import visible_graph
from relay_server.resources.page import TypedPageQuery
from relay_server.resources.schemas import GoalPage
from relay_server.resources.service import RobotResourceService, require_online

FEEDBACK_BYTES = 256 * KIB
RESULT_BYTES = MIB
"""Largest stored size, as JSON."""


class GoalState(enum.Enum):
    """The state of a goal."""

    ACTIVE = "active"
    CANCELLING = "cancelling"
    """Cancelling was requested; it has not ended yet."""
    SUCCEEDED = "succeeded"
    CANCELED = "canceled"
    ABORTED = "aborted"
    REFUSED = "refused"
    """It never began."""


_ENDS = {
    GoalStatusCode.NEVER_BEGAN: GoalState.REFUSED,
    GoalStatusCode.SUCCEEDED: GoalState.SUCCEEDED,
    GoalStatusCode.CANCELED: GoalState.CANCELED,
    GoalStatusCode.ABORTED: GoalState.ABORTED,
}

NEXT = {
    GoalState.ACTIVE: {GoalState.CANCELLING, *_ENDS.values()},
    GoalState.CANCELLING: set(_ENDS.values()),
    **{end: set() for end in _ENDS.values()},
}


class GoalOwner(NamedTuple):
    """The owner of a goal: a user, with tokens of the same scope."""

    user: int
    realm: str
    scope: str | None

    @classmethod
    def of(cls, principal: Principal) -> GoalOwner:
        """The owner for a principal."""
        scope = None if principal.scope is None else str(principal.scope)
        return cls(principal.user_id, principal.realm, scope)


class GoalRequest(NamedTuple):
    """A request to execute a goal.

    :param goal: JSON
    :param type: of the action; empty for its known type
    :param poll_timeout: seconds without a poll after which the goal is cancelled
    """

    goal: bytes
    type: str = ""
    poll_timeout: float = 10.0


class HttpGoal(GoalListener):
    """A goal given by HTTP; it is cancelled unless its owner keeps polling.

    :param wall: Unix time in seconds
    :param pooled: session of the goal, kept until the goal has ended or is no longer polled
    :param leave: gives the session back
    :param moves: whether the robot counts the goal as motion
    :param poll_timeout: seconds without a poll after which the goal is cancelled
    :param on_end: called once, when the goal has ended
    :ivar version: grows with each change
    """

    def __init__(
        self,
        clock: Clock,
        wall: Callable[[], float],
        pooled: PooledSession,
        leave: Callable[[], None],
        *,
        id: str,
        owner: GoalOwner,
        action: str,
        type: str,
        moves: bool,
        poll_timeout: float,
        on_end: Callable[[HttpGoal], None],
    ) -> None:
        self.id = id
        self.owner = owner
        self.robot = pooled.client.robot.name
        self.action = action
        self.type = type
        self.state = GoalState.ACTIVE
        self.feedback_json: bytes | None = None
        self.result_json: bytes | None = None
        self.reason: str | None = None
        self.begun = wall()
        self.ended_at: float | None = None
        self.version = 0
        self._clock = clock
        self._wall = wall
        self._pooled: PooledSession | None = pooled
        self._leave: Callable[[], None] | None = leave
        self._moves = moves
        self._poll_timeout = poll_timeout
        self._on_end = on_end
        self._operation = pooled.port.new_id()
        self._why: str | None = None
        """The reason of a cancellation over HTTP."""
        self._polls = 0
        self._poll_timer: Timer | None = None
        self._waiting: list[Deferred[None]] = []

    @property
    def over(self) -> bool:
        """Whether it has ended."""
        return not NEXT[self.state]

    @property
    def size(self) -> int:
        """Bytes of its stored feedback and result."""
        return len(self.feedback_json or b"") + len(self.result_json or b"")

    # --- its life -----------------------------------------------------------------------------------------

    def begin(self, args: bytes, earliest_sent: int | None) -> Deferred[None]:
        """Send the goal; fires when it was handed on to its executor, or has ended.

        :param args: JSON
        :param earliest_sent: as for :meth:`relay_server.in_process_sessions.in_process_port.InProcessPort.perform`
        :raises SwitchboardError: it is refused, or cannot begin
        """
        assert self._pooled is not None
        operation = rosbridge.SendActionGoal(
            id=self._operation,
            action=self.action,
            action_type=self.type,
            args=msgspec.Raw(args),
            feedback=True,
        )
        try:
            self._pooled.port.send_goal(operation, self, earliest_sent)
        except SwitchboardError as error:
            if self.over:
                # It was accepted, but could not begin.
                raise NotDone(self.reason or str(error)) from None
            raise
        self._watch()
        return self._pooled.session.goals.begun(self._operation)

    def cancel(self, why: str) -> None:
        """Request its cancellation; its end is reported as usual.

        :param why: the reason
        """
        if self.state is not GoalState.ACTIVE or self._pooled is None:
            return
        self._why = why
        self._become(GoalState.CANCELLING)
        with suppress(SwitchboardError):
            self._pooled.port.perform(rosbridge.CancelActionGoal(id=self._operation, action=self.action))

    def feedback(self, values: bytes) -> None:
        """Store feedback, JSON."""
        if self.over:
            return
        fits = len(values) <= FEEDBACK_BYTES
        self.feedback_json = values if fits else None
        self.reason = None if fits else _too_long("feedback", values, FEEDBACK_BYTES)
        self._become(self.state)

    def ended(self, status: int, result: bool, values: bytes) -> None:
        """Store the end of the goal."""
        if self.over or self._pooled is None:
            return
        state = _ENDS.get(GoalStatusCode(status), GoalState.ABORTED)
        if self._pooled.port.closed is not None:
            # The goals of a closed session are cancelled.
            state = GoalState.CANCELED
        words = None if result else str(jsontext.decode_any(values))
        if state is GoalState.CANCELED and self._why is not None:
            words = self._why
        elif words is None and state in (GoalState.CANCELED, GoalState.ABORTED):
            words = self._explained(self._pooled, state)
        if result and len(values) <= RESULT_BYTES:
            self.result_json = values
        elif result:
            words = "; ".join(filter(None, (words, _too_long("its result", values, RESULT_BYTES))))
        self.reason = words
        self.ended_at = self._wall()
        self._become(state)
        self._give_back()
        self._on_end(self)

    def _become(self, state: GoalState) -> None:
        self.state = state
        self.version += 1
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.callback(None)

    def _give_back(self) -> None:
        """Give the session back."""
        cancel(self._poll_timer)
        self._poll_timer = None
        leave, self._leave = self._leave, None
        if leave is not None:
            leave()
        if self.over:
            self._pooled = None

    def _explained(self, pooled: PooledSession, state: GoalState) -> str:
        """The reason of its end, if the executor gave none."""
        client = pooled.client
        robot, standing = client.robot.name, client.controller.snapshot
        if standing.stopped is not None:
            why = f": {standing.stopped.why}" if standing.stopped.why else ""
            return f"robot {robot} was stopped by {standing.stopped.by}{why}"
        if self._moves and not standing.lease.held_by(client):
            holder = standing.lease.holder or standing.lease.pending_holder
            now = f"; {holder.client.name} has control" if holder is not None else ""
            return f"control of robot {robot} was lost or released{now}"
        return "it was cancelled on the robot" if state is GoalState.CANCELED else "the robot aborted it"

    # --- polling ------------------------------------------------------------------------------------------

    @contextmanager
    def polled(self) -> Iterator[None]:
        """Count as polled while the block runs."""
        self._polls += 1
        cancel(self._poll_timer)
        try:
            yield
        finally:
            self._polls -= 1
            self._watch()

    async def changed(self, version: int, seconds: float) -> None:
        """Wait for another version, for so many seconds at most."""
        if self.version != version or seconds <= 0:
            return
        waiting: Deferred[None] = Deferred(self._waiting.remove)
        self._waiting.append(waiting)
        timer = self._clock.callLater(seconds, self._too_late, waiting)
        try:
            await waiting
        finally:
            cancel(timer)

    async def end_within(self, seconds: float) -> None:
        """Wait for its end, for so many seconds at most."""
        until = self._clock.seconds() + seconds
        while not self.over and (left := until - self._clock.seconds()) > 0:
            await self.changed(self.version, left)

    def _too_late(self, waiting: Deferred[None]) -> None:
        if waiting in self._waiting:
            self._waiting.remove(waiting)
            waiting.callback(None)

    def _watch(self) -> None:
        """Start the timer that cancels the goal unless it is polled."""
        if self._polls or self._leave is None:
            return
        cancel(self._poll_timer)
        self._poll_timer = self._clock.callLater(self._poll_timeout, self._on_poll_timeout)

    def _on_poll_timeout(self) -> None:
        self._poll_timer = None
        self.cancel(f"its status was not requested for {self._poll_timeout:g} s")
        self._give_back()

    # --- status -------------------------------------------------------------------------------------------

    def summary(self) -> dict[str, object]:
        """Its status without feedback and result."""
        ended = self.ended_at
        return {
            "id": self.id,
            "action": self.action,
            "type": self.type,
            "state": self.state.value,
            "reason": self.reason,
            "begun": round(self.begun, 3),
            "ended": None if ended is None else round(ended, 3),
        }

    def json(self, whole: bool = True) -> bytes:
        """The status resource.

        :param whole: whether to include feedback and result
        """
        hidden = None, None
        feedback, result = (self.feedback_json, self.result_json) if whole else hidden
        values = {"feedback": feedback, "result": result}
        status = {name: None if each is None else msgspec.Raw(each) for name, each in values.items()}
        return jsontext.encode({**self.summary(), **status})


def _too_long(part: str, values: bytes, most: int) -> str:
    return (
        f"{part} has {len(values)} bytes, more than the {most} that are stored; use rosbridge to receive it"
    )


KEPT_SECONDS = 600.0
"""Seconds for which an ended goal can be read."""

KEPT = 64
KEPT_BYTES = 4 * MIB
"""Ended goals of one user on all robots: the oldest are dropped first, the newest stays."""

UNDER_WAY = 64
"""Most active goals of one user on all robots."""


class GoalReply(NamedTuple):
    """A status resource.

    :param body: JSON
    :param known: whether the client has it already
    """

    body: bytes
    over: bool
    known: bool = False

    @property
    def etag(self) -> str:
        """The same for the same body."""
        return tag_of(self.body)


class GoalStore:
    """All goals whose status can still be read."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._of: dict[int, dict[str, HttpGoal]] = {}
        """By user and id, the oldest first."""
        self._ended: dict[int, dict[HttpGoal, Timer]] = {}
        """Those that are over, in the order of their ends, and when they are forgotten."""

    def of(self, owner: GoalOwner, robot: str) -> dict[str, HttpGoal]:
        """Those of an owner at a robot, by id."""
        mine = self._of.get(owner.user, {})
        return {id: goal for id, goal in mine.items() if (goal.owner, goal.robot) == (owner, robot)}

    def check_room(self, user: int) -> None:
        """:raises Unavailable: the user has too many under way"""
        if sum(not goal.over for goal in self._of.get(user, {}).values()) >= UNDER_WAY:
            raise Unavailable(f"{UNDER_WAY} goals of yours are under way already, the most one user may have")

    def add(self, goal: HttpGoal) -> None:
        """One more."""
        self._of.setdefault(goal.owner.user, {})[goal.id] = goal

    def ended(self, goal: HttpGoal) -> None:
        """One is over."""
        ended = self._ended.setdefault(goal.owner.user, {})
        ended[goal] = self._clock.callLater(KEPT_SECONDS, self.remove, goal)
        size = sum(each.size for each in ended)
        while len(ended) > 1 and (len(ended) > KEPT or size > KEPT_BYTES):
            oldest = next(iter(ended))
            size -= oldest.size
            self.remove(oldest)

    def remove(self, goal: HttpGoal) -> None:
        """It can't be read any more."""
        user = goal.owner.user
        mine, ended = self._of.get(user, {}), self._ended.get(user, {})
        mine.pop(goal.id, None)
        cancel(ended.pop(goal, None))
        if not mine:
            self._of.pop(user, None)
        if not ended:
            self._ended.pop(user, None)


class GoalService:
    """Goals that are given over HTTP.

    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        clock: Clock,
        pool: InProcessSessionPool,
        resources: RobotResourceService,
        wall: Callable[[], float],
    ) -> None:
        self._clock = clock
        self._pool = pool
        self._resources = resources
        self._wall = wall
        self._store = GoalStore(clock)

    async def give(
        self, caller: RobotCaller, name: str, request: GoalRequest, earliest_sent: int | None
    ) -> HttpGoal:
        """Begin a goal; it is active when this returns.

        :param earliest_sent: earliest time of the request, the relay's monotonic nanoseconds
        :raises FreshnessTokenRequired: it moves the robot, and the request has no freshness token
        :raises FreshnessTokenExpired: it moves the robot, and the request may be too old
        :raises NotDone: it cannot begin, with the reason
        :raises SwitchboardError: it is refused
        """
        action = resolve(name)
        type_name = normal_type(request.type, "action")
        pooled, leave = await self._pool.keep(caller)
        with ExitStack() as undone:
            undone.callback(leave)
            goal, begins = self._begin(caller, pooled, leave, action, type_name, request, earliest_sent)
            undone.pop_all()
        with goal.polled():
            await begins
        if goal.state is GoalState.REFUSED:
            self._store.remove(goal)
            raise NotDone(goal.reason or "the goal could not begin")
        return goal

    def _begin(
        self,
        caller: RobotCaller,
        pooled: PooledSession,
        leave: Callable[[], None],
        action: str,
        type_name: str,
        request: GoalRequest,
        earliest_sent: int | None,
    ) -> tuple[HttpGoal, Deferred[None]]:
        client, owner = pooled.client, GoalOwner.of(caller.principal)
        client.require(Operation.CALL, action)
        require_online(client)
        known = visible_graph(client).actions.get(action)
        if not type_name and known is None:
            raise NotFound(f"there is no action {action} on robot {client.robot.name}")
        moves = client.robot.description.motion.moves_by_action(action)
        checked = self._resources.check_freshness(pooled, earliest_sent) if moves else None
        self._store.check_room(owner.user)
        goal = HttpGoal(
            self._clock,
            self._wall,
            pooled,
            leave,
            # Sorted by time, and not guessable.
            id=f"{round(self._wall() * 1000):012x}{secrets.token_hex(16)}",
            owner=owner,
            action=action,
            type=known.types[0] if known is not None and known.types else type_name,
            moves=moves,
            poll_timeout=request.poll_timeout,
            on_end=self._store.ended,
        )
        self._store.add(goal)
        try:
            return goal, goal.begin(request.goal, checked)
        except SwitchboardError:
            self._store.remove(goal)
            raise

    async def members(self, caller: RobotCaller, listing: TypedPageQuery) -> GoalPage:
        """A page of the client's own goals, oldest first, without feedback and results.

        :param listing: names and types are those of actions
        :raises NotFound: no such robot, or no right on it
        """
        mine = self._store.of(GoalOwner.of(caller.principal), caller.robot)
        if not mine:
            async with self._pool.admitted(caller):
                pass
        matching = {id: goal for id, goal in mine.items() if fnmatchcase(goal.action, listing.name)}
        page, after = msgspec.structs.replace(listing, name="*").page(matching, lambda goal: [goal.type])
        return cast(GoalPage, {"goals": [goal.summary() for _, goal in page], "next": after})

    def find(self, caller: RobotCaller, id: str) -> HttpGoal:
        """One of the client's own goals.

        :raises NotFound: there is none
        """
        goal = self._store.of(GoalOwner.of(caller.principal), caller.robot).get(id)
        if goal is None:
            raise NotFound("you have no such goal, or it is no longer stored")
        return goal

    async def status(self, caller: RobotCaller, goal: HttpGoal) -> GoalReply:
        """The status of a goal, without feedback and result if the client lost the right to the action."""
        # An active goal ends with the right.
        whole = not goal.over or await self._may(caller, goal)
        return GoalReply(goal.json(whole), goal.over)

    async def state(self, caller: RobotCaller, id: str, wait: float, unlike: frozenset[str]) -> GoalReply:
        """The status of a goal; this counts as polling.

        :param wait: seconds to wait for another status than those in ``unlike``
        :param unlike: entity tags of the statuses that the client has
        :raises NotFound: there is no such goal
        """
        goal = self.find(caller, id)
        until = self._clock.seconds() + wait
        with goal.polled():
            while True:
                version = goal.version
                status = await self.status(caller, goal)
                if status.etag not in unlike:
                    return status
                left = until - self._clock.seconds()
                if left <= 0 or status.over:
                    return status._replace(known=True)
                await goal.changed(version, left)

    async def awaited(self, caller: RobotCaller, id: str, wait: float) -> GoalReply | None:
        """The status at its end, or after so many seconds; ``None`` if it is no longer stored."""
        try:
            goal = self.find(caller, id)
        except NotFound:
            return None
        with goal.polled():
            await goal.end_within(wait)
        return await self.status(caller, goal)

    def cancel(self, caller: RobotCaller, id: str) -> HttpGoal | None:
        """Cancel a goal; ``None`` if it has already ended.

        :raises NotFound: there is no such goal
        """
        goal = self.find(caller, id)
        if goal.over:
            return None
        with goal.polled():
            goal.cancel("its owner cancelled it")
        return goal

    async def result(
        self, caller: RobotCaller, name: str, args: bytes, seconds: float, earliest_sent: int | None
    ) -> bytes:
        """Have a goal executed, and wait for it: its result, JSON. One that has not ended in time is cancelled.

        :param args: of the goal, JSON
        :raises NotDone: it did not succeed in time, with the reason
        :raises SwitchboardError: as :meth:`give`
        """
        goal = await self.give(caller, name, GoalRequest(args), earliest_sent)
        try:
            with goal.polled():
                await goal.end_within(seconds)
        finally:
            # Also when the client disconnects.
            if not goal.over:
                goal.cancel(f"it had not ended within {seconds:g} s")
        if goal.state is not GoalState.SUCCEEDED or goal.result_json is None:
            raise NotDone(
                goal.reason or f"the goal is {goal.state.value}: it had not ended within {seconds:g} s"
            )
        return goal.result_json

    def cancel_all(self, caller: RobotCaller, name: str) -> None:
        """Cancel all goals of the caller for an action."""
        action = resolve(name)
        for goal in self._store.of(GoalOwner.of(caller.principal), caller.robot).values():
            if goal.action == action and not goal.over:
                goal.cancel("its owner cancelled it")

    async def _may(self, caller: RobotCaller, goal: HttpGoal) -> bool:
        try:
            await self._resources.may(caller, Operation.CALL, goal.action)
        except (NotFound, Refused):
            return False
        return True
