"""Who controls one robot: takes, hands over, loses it; and whose commands pass (SPEC section 1.7)."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred

from relay_protocol.clocks import now_ns
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_protocol.rights import Operation
from relay_server.bucket import Buckets
from relay_server.clock import Clock
from relay_server.control.comeback import Comeback, held_on
from relay_server.control.lease import Client, Request, Tenure, owns
from relay_server.control.record import WHY, Actor, Record
from relay_server.control.steering import Steering
from relay_server.control.terms import (
    DESERTED_SECONDS,
    IMPLICIT,
    LET_GO_SECONDS,
    REST_SECONDS,
    ROBOT,
    TAKES_A_SECOND,
    TAKES_AT_ONCE,
    USERS,
    Answer,
    ControlRules,
)
from relay_server.registry import Presence


class Desk(Steering):
    """Control of one robot.

    :param changed: called when what the list of robots shows of it is another
    :param wall: Unix time in seconds
    :param clock_ns: the relay's monotonic nanoseconds
    """

    def __init__(
        self,
        clock: Clock,
        robot: Presence,
        record: Record,
        rules: ControlRules,
        changed: Callable[[], None],
        wall: Callable[[], float],
        clock_ns: Callable[[], int] = now_ns,
    ) -> None:
        super().__init__(clock, robot, record, rules, changed, wall, clock_ns)
        self._takes = Buckets(TAKES_A_SECOND, TAKES_AT_ONCE, USERS, clock.seconds)
        """By user, how often he may take control still."""
        self._comeback = Comeback(clock)
        self._resting: OrderedDict[int, tuple[int, float]] = OrderedDict()
        """By user, the connection that refused him control the last time, and until when he does not ask it again."""

    # --- commands -----------------------------------------------------------------------------------------

    def passes(self, client: Client, topic: str) -> bool:
        """Whether this client commands that topic now."""
        return self.lease.held_by(client) or client.number in self.standing.suppressed.get(topic, ())

    def claim(self, client: Client) -> bool:
        """Whether a client that commands moves the robot; a free one becomes its own when the robot has agreed.

        :returns: false when that is waited for
        :raises Refused: it has no right to, somebody else moves the robot, or control must be taken first
        """
        lease, name = self.lease, self.robot.name
        if lease.held_by(client):
            return True
        if lease.coming_to(client):
            return False
        self._judge(client)
        tenure = lease.holder or lease.coming
        if tenure is not None and self._deserted(client):
            # A link that swallows all is known to be lost later than its user comes back by another.
            since = tenure.client.commanding_since()
            self._comeback.note(client.user, since, held_on=held_on(tenure.client, since))
        self._see_let_go(client)
        if tenure is not None and (self.rules.explicit or not self._deserted(client)):
            raise self._held_by(tenure)
        if not lease.settled:
            raise Refused(f"control of robot {name} is just being given back; try again in a moment")
        if self.rules.explicit:
            raise Refused(
                f"nobody controls robot {name}: take control first, with /relay/take_control, PUT …/control or the "
                "portal"
            )
        self._count_take(client)
        self._comeback.forget(client.user)
        lost = "the same user commands from another connection"
        self._succeed(client, IMPLICIT, "taken", lost, implicit=True)
        return False

    def zero(self, client: Client) -> None:
        """A zero of a client that does not move the robot: it takes no control, and there is nothing it could stop.

        :raises Refused: somebody else moves the robot
        """
        tenure = self.lease.holder or self.lease.coming
        if tenure is not None:
            raise self._held_by(tenure)

    def _held_by(self, tenure: Tenure) -> Refused:
        return Refused(
            f"robot {self.robot.name} is controlled by {tenure.client.name}; ask for it with /relay/take_control"
        )

    def _count_take(self, client: Client) -> None:
        """Bound how often a user takes control.

        :raises Refused: he has done so too often
        """
        if not self._takes.take(client.user):
            raise Refused(
                f"you take control of robot {self.robot.name} too often: {TAKES_A_SECOND:g} times a second at most; "
                "try again in a moment"
            )

    def _see_let_go(self, client: Client) -> None:
        """Who has lost control in the middle of commanding does not get it back by going on.

        :raises Refused: he has not let go since
        """
        since = self._bereft.pop(client, None)
        if since is None:
            # By another connection he goes on as he did by that which has ended.
            since = self._comeback.silent_since(client)
        if since is None:
            return
        now = self._clock.seconds()
        if now - since < LET_GO_SECONDS:
            self._bereft[client] = now
            raise Refused(
                f"you had no control of robot {self.robot.name} when you began to command: let go for "
                f"{LET_GO_SECONDS:g} s"
            )

    def in_vain(self, client: Client) -> bool:
        """Whether who commands without control holds on by that: somebody else has it, or he has lost it.

        Who commands while nobody has it need not let go of anything (SPEC section 2.5, "Who moves the robot").
        """
        lease = self.lease
        return client in self._bereft or any(
            each is not None and each.client is not client for each in (lease.holder, lease.coming)
        )

    def unheard(self, client: Client) -> None:
        """A client has published to the robot while that is away: it must find no hand on the stick."""
        self._bereft[client] = self._clock.seconds()

    def _succeed(
        self, client: Client, why: str, how: str, lost: str, *, implicit: bool = False
    ) -> Deferred[SwitchboardError | None]:
        """Have the robot obey this client in the place of who has control now, if anybody has.

        :param lost: what that one is told
        :param implicit: whether a command of his takes it
        """
        former = self.lease.holder
        if former is not None:
            self._note_lost(former, lost)
        waiting = self._hand_to(client, why, how, implicit)
        if former is not None:
            self._tell_lost(former, lost)
        return waiting

    def _deserted(self, client: Client) -> bool:
        """Whether who has control is the same user, by a connection that he commands from no more."""
        holder = self.lease.holder
        if holder is None or holder.client.user != client.user or self.robot.safety.moving:
            return False
        return self._clock.seconds() - holder.client.driving_since() >= DESERTED_SECONDS

    async def claimed(self, client: Client) -> None:
        """Wait until a client that commands moves the robot.

        :raises Refused: as :meth:`claim`
        :raises Unavailable: the robot is offline, or does not agree
        """
        if not self.claim(client):
            error = await self._settled()
            if not self.lease.held_by(client):
                raise error or Unavailable(f"you did not get control of {self.robot.name}")

    # --- what clients ask for -----------------------------------------------------------------------------

    async def take(self, client: Client, why: str) -> Answer:
        """Take control of a free robot, or ask who has it for it.

        :raises Refused: the client may not control this robot
        :raises Unavailable: the robot is offline, or does not agree
        """
        self._judge(client)
        if not self.lease.held_by(client):
            self._count_take(client)
        why = why[:WHY]
        while not self.lease.settled:
            mine = self.lease.coming_to(client)
            error = await self._settled()
            if mine and error is not None:
                raise error
        # Rights may have changed while it was waited, and the robot may have gone.
        self._judge(client)
        lease = self.lease
        if lease.held_by(client):
            if lease.holder is not None and lease.holder.implicit:
                self._become(lease.meant())
            return Answer(True, "you have control")
        if lease.holder is not None and not self._may_take_over(client):
            return self._request(client, why)
        # Who goes on as before is held back by his session then.
        self._bereft.pop(client, None)
        self._comeback.forget(client.user)
        how = "taken" if lease.holder is None else "taken over"
        error = await self._succeed(client, why, how, f"{client.name} has taken over")
        if error is not None:
            raise error
        if not self.lease.held_by(client):
            self._judge(client)
            raise Unavailable("control has changed hands again meanwhile")
        return Answer(True, "you have control")

    def _may_take_over(self, client: Client) -> bool:
        holder, lease = self.lease.holder, self.lease
        if holder is not None and holder.client.user == client.user:
            # Nobody asks himself for anything.
            return True
        return lease.requested_by(client) and self._comes_due(client) and self._clock.seconds() >= self._due

    def _comes_due(self, client: Client) -> bool:
        """Whether this client takes over after the grace time: an owner, or anybody from an implicit holder."""
        holder = self.lease.holder
        return owns(client) or (holder is not None and holder.implicit)

    def _see_rested(self, client: Client, holder: Client) -> None:
        """:raises Refused: this holder has just refused control to the same user"""
        refuser, until = self._resting.get(client.user, (0, 0.0))
        left = until - self._clock.seconds()
        if refuser == holder.number and left > 0:
            raise Refused(
                f"{holder.name} has just kept control of {self.robot.name}; ask again in {math.ceil(left)} s"
            )

    def _request(self, client: Client, why: str) -> Answer:
        lease, now = self.lease, self._wall()
        assert lease.holder is not None
        holder, request = lease.holder.client, lease.request
        if request is not None and request.client is client:
            left = max(0.0, self._due - self._clock.seconds())
            after = f"; after {left:.0f} s ask again to take over" if self._comes_due(client) else ""
            return Answer(False, f"{holder.name} has control and was asked for it already{after}")
        if request is not None and (owns(request.client) or not owns(client)):
            return Answer(False, f"{holder.name} has control, and {request.client.name} asks for it already")
        self._see_rested(client, holder)
        self._due = self._clock.seconds() + self.rules.grace
        self._note_lapsed(request, f"{client.name} asks for it before")
        self._become(lease.requested(Request(client, now, now + self.rules.grace, why)))
        self._note("control.requested", client, why, holder=holder.name)
        if request is not None:
            request.client.tell("warning", f"{client.name} asks for control of {self.robot.name} before you")
        said = f": {why}" if why else ""
        holder.tell("warning", f"{client.name} asks for control of {self.robot.name}{said}")
        return Answer(False, f"{holder.name} has control and was asked for it")

    def release(self, client: Client, why: str, by: Actor | None = None) -> Answer:
        """Give control back, or a request for it.

        :param by: who does it, where that is not the client
        """
        why = why[:WHY]
        whose = {} if by is None or by.user == client.user else {"of": client.name}
        if self.lease.requested_by(client):
            self._note("control.withdrawn", client, why, by, **whose)
            self._become(self.lease.withdrawn())
            return Answer(True, "you ask for control no more")
        if not (self.lease.held_by(client) or self.lease.coming_to(client)):
            return Answer(False, "you have no control of this robot")
        self._note("control.released", client, why, by, **whose)
        if by is not None:
            self._bereft[client] = self._clock.seconds()
        self._let_go(f"given back by {client.name if by is None else by.name}")
        return Answer(True, "control is given back")

    def _asked_by(self, client: Client, meant: int) -> Request | Answer:
        """The request that the holder answers, or why he answers none.

        :param meant: the number of the connection whose request he means, 0 for whoever asks
        """
        request = self.lease.request
        if not self.lease.held_by(client):
            return Answer(False, "you have no control of this robot")
        if request is None:
            return Answer(False, "nobody asks for control")
        if meant not in (0, request.client.number):
            return Answer(
                False,
                f"who you mean asks for control no more; {request.client.name} does, and has no answer yet",
            )
        return request

    def grant(self, client: Client, why: str, meant: int = 0) -> Answer:
        """The holder hands control over to who asks for it.

        :param meant: the number of the connection he means, 0 for whoever asks
        """
        request = self._asked_by(client, meant)
        if isinstance(request, Answer):
            return request
        self._note("control.granted", client, why[:WHY], to=request.client.name)
        self._hand_to(request.client, f"granted by {client.name}", "granted")
        return Answer(True, f"{request.client.name} gets control")

    def refuse(self, client: Client, why: str, meant: int = 0) -> Answer:
        """The holder keeps control, and is left alone by who asked for a while.

        :param meant: as for :meth:`grant`
        """
        request, why = self._asked_by(client, meant), why[:WHY]
        if isinstance(request, Answer):
            return request
        self._rests(request.client.user, client)
        self._note("control.refused", client, why, to=request.client.name)
        said = f": {why}" if why else ""
        self._become(self.lease.withdrawn())
        request.client.tell("warning", f"{client.name} keeps control of {self.robot.name}{said}")
        return Answer(True, f"you keep control; {request.client.name} is told")

    def _rests(self, user: int, refuser: Client) -> None:
        self._resting.pop(user, None)
        self._resting[user] = (refuser.number, self._clock.seconds() + REST_SECONDS)
        while len(self._resting) > USERS:
            self._resting.popitem(last=False)

    def may_resume(self, client: Client) -> bool:
        """Whether this client may let a robot that is stopped move again: who has control, and owners."""
        return self.lease.held_by(client) or owns(client)

    # --- what ends it -------------------------------------------------------------------------------------

    def left(self, client: Client, *, orderly: bool = False) -> None:
        """A connection has ended.

        :param orderly: its user has closed it
        """
        self.pushing.forget(client)
        # Not the moment at which the connection ended: who did not command any more has let go.
        since = max(self._bereft.get(client, 0.0), client.commanding_since())
        lost = not orderly and held_on(client, since)
        self._lose(client, "the connection has ended")
        if self._bereft.pop(client, None) is not None:
            self._comeback.note(client.user, since, held_on=lost)
        self.subsuming.ends(client, lambda topic: False)

    def rights_changed(self, client: Client) -> None:
        """Whoever may not control the robot any more does not; with another level other limits count."""
        verdict = client.permit.judge(Operation.CONTROL, ROBOT)
        if not verdict.allowed:
            self._lose(client, verdict.reason)
        elif self.lease.held_by(client) or self.lease.coming_to(client):
            self._order_control(client, "the level has changed").addErrback(self._level_unknown)
        self.subsuming.ends(client, lambda topic: client.permit.judge(Operation.INHIBIT, topic).allowed)
        self.pushing.push()

    def _level_unknown(self, failure: Any) -> None:
        self.log.warn("{robot} has not taken the new level: {why}", robot=self.robot.full, why=failure.value)
