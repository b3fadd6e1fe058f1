"""Goals over HTTP: given, told of, cancelled, and remembered for some minutes when they are over."""

from __future__ import annotations

import enum
import secrets
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import msgspec
from twisted.internet.defer import Deferred

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.limits import KIB, MIB
from relay_protocol.rights import Operation
from relay_server.access import Principal
from relay_server.channels.goals import GoalStatusCode
from relay_server.channels.robot_link import resolve
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.control.commands import NotDone
from relay_server.http_sessions.loopback_client import GoalListener
from relay_server.http_sessions.pool import PooledSession, SessionPool
from relay_server.relay_node.view import view
from relay_server.resources.etags import tag_of
from relay_server.resources.page import PageQuery
from relay_server.resources.service import RequestOrigin, RobotResourceService, see_online
from relay_server.sessions.type_names import normal_type

FEEDBACK_BYTES = 256 * KIB
RESULT_BYTES = MIB
"""Longest that is kept, as JSON."""


class GoalState(enum.Enum):
    """How far a goal has come."""

    ACTIVE = "active"
    CANCELLING = "cancelling"
    """It is to end, and has not yet."""
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
    """For whom something is kept: a user, by tokens that are for the same."""

    user: int
    realm: str
    scope: str | None

    @classmethod
    def of(cls, principal: Principal) -> GoalOwner:
        """For whom that of a principal is."""
        scope = None if principal.scope is None else str(principal.scope)
        return cls(principal.user_id, principal.realm, scope)


class GoalRequest(NamedTuple):
    """What is asked of an action.

    :param goal: JSON
    :param type: of the action; empty for the one it has
    :param unwatched: seconds for which nobody has to look at it
    """

    goal: bytes
    type: str = ""
    unwatched: float = 10.0


class HttpGoal(GoalListener):
    """See the module's text.

    :param wall: Unix time in seconds
    :param guest: gives it, and is kept until it is over, or nobody looks at it
    :param leave: ends that
    :param moves: whether the robot counts it as motion
    :param unwatched: seconds
    :param on_end: called once, when it is over
    :ivar version: grows with each change
    """

    def __init__(
        self,
        clock: Clock,
        wall: Callable[[], float],
        guest: PooledSession,
        leave: Callable[[], None],
        *,
        id: str,
        owner: GoalOwner,
        action: str,
        type: str,
        moves: bool,
        unwatched: float,
        on_end: Callable[[HttpGoal], None],
    ) -> None:
        self.id = id
        self.owner = owner
        self.robot = guest.session.robot.name
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
        self._guest: PooledSession | None = guest
        self._leave: Callable[[], None] | None = leave
        self._moves = moves
        self._unwatched = unwatched
        self._on_end = on_end
        self._operation = guest.client.new_id()
        self._why: str | None = None
        """Why it was to end, where that was said here."""
        self._looking = 0
        self._deserting: Timer | None = None
        self._waiting: list[Deferred[None]] = []

    @property
    def over(self) -> bool:
        """Whether it has ended."""
        return not NEXT[self.state]

    @property
    def size(self) -> int:
        """Bytes that are kept of it."""
        return len(self.feedback_json or b"") + len(self.result_json or b"")

    # --- its life -----------------------------------------------------------------------------------------

    def begin(self, args: bytes, since: int | None) -> Deferred[None]:
        """Have it pursued; fires when it was handed on to who pursues it, or is over.

        :param args: JSON
        :param since: as for :meth:`relay_server.http_sessions.loopback_client.LoopbackClient.do`
        :raises SwitchboardError: it is refused, or can't be begun
        """
        assert self._guest is not None
        session = self._guest.session
        ask = rosbridge.SendActionGoal(
            id=self._operation,
            action=self.action,
            action_type=self.type,
            args=msgspec.Raw(args),
            feedback=True,
        )
        try:
            self._guest.client.pursue(ask, self, since)
        except SwitchboardError as error:
            if self.over:
                # It was taken, and could not be begun.
                raise NotDone(self.reason or str(error)) from None
            raise
        self._mind()
        return session.pursuing.beginning(self._operation)

    def cancel(self, why: str) -> None:
        """It is not wanted any more; its end still comes.

        :param why: in words
        """
        if self.state is not GoalState.ACTIVE or self._guest is None:
            return
        self._why = why
        self._become(GoalState.CANCELLING)
        with suppress(SwitchboardError):
            self._guest.client.do(rosbridge.CancelActionGoal(id=self._operation, action=self.action))

    def feedback(self, values: bytes) -> None:
        """It has come so far."""
        if self.over:
            return
        fits = len(values) <= FEEDBACK_BYTES
        self.feedback_json = values if fits else None
        self.reason = None if fits else _too_long("feedback", values, FEEDBACK_BYTES)
        self._become(self.state)

    def ended(self, status: int, result: bool, values: bytes) -> None:
        """It is over."""
        if self.over or self._guest is None:
            return
        state = _ENDS.get(GoalStatusCode(status), GoalState.ABORTED)
        if self._guest.client.closed is not None:
            # Whoever has his connection ended has his goals cancelled.
            state = GoalState.CANCELED
        words = None if result else str(jsontext.decode_any(values))
        if state is GoalState.CANCELED and self._why is not None:
            words = self._why
        elif words is None and state in (GoalState.CANCELED, GoalState.ABORTED):
            words = self._explained(self._guest, state)
        if result and len(values) <= RESULT_BYTES:
            self.result_json = values
        elif result:
            words = "; ".join(filter(None, (words, _too_long("its result", values, RESULT_BYTES))))
        self.reason = words
        self.ended_at = self._wall()
        self._become(state)
        self._let_go()
        self._on_end(self)

    def _become(self, state: GoalState) -> None:
        self.state = state
        self.version += 1
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.callback(None)

    def _let_go(self) -> None:
        """The connection need not be kept for this."""
        cancel(self._deserting)
        self._deserting = None
        leave, self._leave = self._leave, None
        if leave is not None:
            leave()
        if self.over:
            self._guest = None

    def _explained(self, guest: PooledSession, state: GoalState) -> str:
        """Why it ended, where nobody has said so."""
        session = guest.session
        robot, standing = session.robot.name, session.desk.standing
        if standing.stopped is not None:
            why = f": {standing.stopped.why}" if standing.stopped.why else ""
            return f"robot {robot} was stopped by {standing.stopped.by}{why}"
        if self._moves and not standing.lease.held_by(session):
            holder = standing.lease.holder or standing.lease.coming
            now = f"; {holder.client.name} has it" if holder is not None else ""
            return f"control of robot {robot} was lost or given back{now}"
        return "it was cancelled on the robot" if state is GoalState.CANCELED else "the robot gave it up"

    # --- who looks at it ----------------------------------------------------------------------------------

    @contextmanager
    def looked_at(self) -> Iterator[None]:
        """Somebody looks at it, as long as the block lasts."""
        self._looking += 1
        cancel(self._deserting)
        try:
            yield
        finally:
            self._looking -= 1
            self._mind()

    async def changed(self, version: int, seconds: float) -> None:
        """Wait until it is another than it was, or so long."""
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
        """Wait until it is over, or so long."""
        until = self._clock.seconds() + seconds
        while not self.over and (left := until - self._clock.seconds()) > 0:
            await self.changed(self.version, left)

    def _too_late(self, waiting: Deferred[None]) -> None:
        if waiting in self._waiting:
            self._waiting.remove(waiting)
            waiting.callback(None)

    def _mind(self) -> None:
        """End it when nobody looks at it for too long."""
        if self._looking or self._leave is None:
            return
        cancel(self._deserting)
        self._deserting = self._clock.callLater(self._unwatched, self._deserted)

    def _deserted(self) -> None:
        self._deserting = None
        self.cancel(f"nobody has looked at it for {self._unwatched:g} s")
        self._let_go()

    # --- how it is told -----------------------------------------------------------------------------------

    def summary(self) -> dict[str, object]:
        """All but how far it came and what came of it."""
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

        :param whole: with feedback and result
        """
        hidden = None, None
        feedback, result = (self.feedback_json, self.result_json) if whole else hidden
        values = {"feedback": feedback, "result": result}
        told = {name: None if each is None else msgspec.Raw(each) for name, each in values.items()}
        return jsontext.encode({**self.summary(), **told})


def _too_long(what: str, values: bytes, most: int) -> str:
    return f"{what} has {len(values)} bytes, and no more than {most} are kept; follow it by rosbridge"


KEPT_SECONDS = 600.0
"""Goals that are over can be read for so long."""

KEPT = 64
KEPT_BYTES = 4 * MIB
"""Of one user, over all robots: the oldest go first, the newest stays."""

UNDER_WAY = 64
"""Goals of one user that may be, over all robots."""


class GoalReply(NamedTuple):
    """A status resource.

    :param body: JSON
    :param known: whether the asker has it already
    """

    body: bytes
    over: bool
    known: bool = False

    @property
    def etag(self) -> str:
        """The same for the same body."""
        return tag_of(self.body)


class GoalStore:
    """All goals that were given and can be read still."""

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
    """Goals of those who come by HTTP.

    :param wall: Unix time in seconds
    """

    def __init__(
        self, clock: Clock, guests: SessionPool, resources: RobotResourceService, wall: Callable[[], float]
    ) -> None:
        self._clock = clock
        self._guests = guests
        self._resources = resources
        self._wall = wall
        self._book = GoalStore(clock)

    async def give(self, asker: RequestOrigin, name: str, ask: GoalRequest, moment: int | None) -> HttpGoal:
        """Have a goal pursued; it is under way then.

        :param moment: the relay's monotonic nanoseconds before which it can't have been asked for
        :raises MomentNeeded: it moves the robot, and no moment is named
        :raises TooOld: it moves the robot, and may be too old
        :raises NotDone: it can't begin, with the reason
        :raises SwitchboardError: it is refused
        """
        action = resolve(name)
        type_name = normal_type(ask.type, "action")
        guest, leave = await self._guests.keep(*asker)
        with ExitStack() as undone:
            undone.callback(leave)
            goal, begins = self._begin(asker, guest, leave, action, type_name, ask, moment)
            undone.pop_all()
        with goal.looked_at():
            await begins
        if goal.state is GoalState.REFUSED:
            self._book.remove(goal)
            raise NotDone(goal.reason or "the goal could not begin")
        return goal

    def _begin(
        self,
        asker: RequestOrigin,
        guest: PooledSession,
        leave: Callable[[], None],
        action: str,
        type_name: str,
        ask: GoalRequest,
        moment: int | None,
    ) -> tuple[HttpGoal, Deferred[None]]:
        session, owner = guest.session, GoalOwner.of(asker.principal)
        session.judge(Operation.CALL, action)
        see_online(session)
        known = view(session).actions.get(action)
        if not type_name and known is None:
            raise NotFound(f"there is no action {action} on robot {session.robot.name}")
        moves = session.robot.description.motion.moves_by_action(action)
        since = self._resources.dated(guest, moment) if moves else None
        self._book.check_room(owner.user)
        goal = HttpGoal(
            self._clock,
            self._wall,
            guest,
            leave,
            # In the order in which they are given, and nobody guesses one.
            id=f"{round(self._wall() * 1000):012x}{secrets.token_hex(16)}",
            owner=owner,
            action=action,
            type=known.types[0] if known is not None and known.types else type_name,
            moves=moves,
            unwatched=ask.unwatched,
            on_end=self._book.ended,
        )
        self._book.add(goal)
        try:
            return goal, goal.begin(ask.goal, since)
        except SwitchboardError:
            self._book.remove(goal)
            raise

    async def members(self, asker: RequestOrigin, listing: PageQuery) -> dict[str, Any]:
        """A page of the asker's own, in the order in which they were given, without feedback and results.

        :param listing: names and types are those of actions
        :raises NotFound: no such robot, or no right on it
        """
        mine = self._book.of(GoalOwner.of(asker.principal), asker.robot)
        if not mine:
            async with self._guests.permit(*asker):
                pass
        meant = {id: goal for id, goal in mine.items() if fnmatchcase(goal.action, listing.name)}
        page, after = listing._replace(name="*").page(meant, lambda goal: [goal.type])
        return {"goals": [goal.summary() for _, goal in page], "next": after}

    def find(self, asker: RequestOrigin, id: str) -> HttpGoal:
        """One of the asker's own.

        :raises NotFound: there is none
        """
        goal = self._book.of(GoalOwner.of(asker.principal), asker.robot).get(id)
        if goal is None:
            raise NotFound("there is no such goal of yours, or none any more")
        return goal

    async def told(self, asker: RequestOrigin, goal: HttpGoal) -> GoalReply:
        """Its status; without feedback and result where the asker may not use the action any more."""
        # While it is under way it ends with the right.
        whole = not goal.over or await self._may(asker, goal)
        return GoalReply(goal.json(whole), goal.over)

    async def state(self, asker: RequestOrigin, id: str, wait: float, unlike: frozenset[str]) -> GoalReply:
        """Its status, which counts as a look at it.

        :param wait: seconds for which another may be waited for than those that are known
        :param unlike: entity tags of these
        :raises NotFound: there is no such goal
        """
        goal = self.find(asker, id)
        until = self._clock.seconds() + wait
        with goal.looked_at():
            while True:
                version = goal.version
                told = await self.told(asker, goal)
                if told.etag not in unlike:
                    return told
                left = until - self._clock.seconds()
                if left <= 0 or told.over:
                    return told._replace(known=True)
                await goal.changed(version, left)

    async def awaited(self, asker: RequestOrigin, id: str, wait: float) -> GoalReply | None:
        """Its status when it is over, or after so many seconds; ``None`` when it can't be read any more."""
        try:
            goal = self.find(asker, id)
        except NotFound:
            return None
        with goal.looked_at():
            await goal.end_within(wait)
        return await self.told(asker, goal)

    def cancel(self, asker: RequestOrigin, id: str) -> HttpGoal | None:
        """Have one end; ``None`` when it is over already.

        :raises NotFound: there is no such goal
        """
        goal = self.find(asker, id)
        if goal.over:
            return None
        with goal.looked_at():
            goal.cancel("it was cancelled by who gave it")
        return goal

    async def _may(self, asker: RequestOrigin, goal: HttpGoal) -> bool:
        try:
            await self._resources.may(asker, Operation.CALL, goal.action)
        except (NotFound, Refused):
            return False
        return True
