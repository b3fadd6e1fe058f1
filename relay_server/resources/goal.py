"""One goal that was given over HTTP: how far it has come, who looks at it, and how it ended.

Nobody may leave a robot moving by vanishing, and a request says nothing of who sent it once it is answered. So a goal
goes on only as long as somebody looks at it: when nobody has for a time that its asker named, it is cancelled.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

import msgspec
from twisted.internet.defer import Deferred

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import KIB, MIB
from relay_server.access import Principal
from relay_server.channel.goal import Status
from relay_server.clock import Clock, Timer, cancel
from relay_server.control import NotDone
from relay_server.inside import Guest
from relay_server.inside.client import Progress

FEEDBACK_BYTES = 256 * KIB
RESULT_BYTES = MIB
"""Longest that is kept, as JSON."""


class State(enum.Enum):
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
    Status.NEVER_BEGAN: State.REFUSED,
    Status.SUCCEEDED: State.SUCCEEDED,
    Status.CANCELED: State.CANCELED,
    Status.ABORTED: State.ABORTED,
}

NEXT = {
    State.ACTIVE: {State.CANCELLING, *_ENDS.values()},
    State.CANCELLING: set(_ENDS.values()),
    **{end: set() for end in _ENDS.values()},
}


class Owner(NamedTuple):
    """For whom something is kept: a user, by tokens that are for the same."""

    user: int
    realm: str
    scope: str | None

    @classmethod
    def of(cls, principal: Principal) -> Owner:
        """For whom that of a principal is."""
        scope = None if principal.scope is None else str(principal.scope)
        return cls(principal.user_id, principal.realm, scope)


class Ask(NamedTuple):
    """What is asked of an action.

    :param goal: JSON
    :param type: of the action; empty for the one it has
    :param unwatched: seconds for which nobody has to look at it
    """

    goal: bytes
    type: str = ""
    unwatched: float = 10.0


class Goal(Progress):
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
        guest: Guest,
        leave: Callable[[], None],
        *,
        id: str,
        owner: Owner,
        action: str,
        type: str,
        moves: bool,
        unwatched: float,
        on_end: Callable[[Goal], None],
    ) -> None:
        self.id = id
        self.owner = owner
        self.robot = guest.session.robot.name
        self.action = action
        self.type = type
        self.state = State.ACTIVE
        self.feedback_json: bytes | None = None
        self.result_json: bytes | None = None
        self.reason: str | None = None
        self.begun = wall()
        self.ended_at: float | None = None
        self.version = 0
        self._clock = clock
        self._wall = wall
        self._guest: Guest | None = guest
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
        :param since: as for :meth:`relay_server.inside.InsideClient.do`
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
        if self.state is not State.ACTIVE or self._guest is None:
            return
        self._why = why
        self._become(State.CANCELLING)
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
        state = _ENDS.get(Status(status), State.ABORTED)
        if self._guest.client.closed is not None:
            # Whoever has his connection ended has his goals cancelled.
            state = State.CANCELED
        words = None if result else str(jsontext.decode_any(values))
        if state is State.CANCELED and self._why is not None:
            words = self._why
        elif words is None and state in (State.CANCELED, State.ABORTED):
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

    def _become(self, state: State) -> None:
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

    def _explained(self, guest: Guest, state: State) -> str:
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
        return "it was cancelled on the robot" if state is State.CANCELED else "the robot gave it up"

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
