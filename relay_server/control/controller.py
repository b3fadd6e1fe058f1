"""Who controls one robot: takes, hands over, loses it; and whose commands pass (SPEC section 1.7)."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Hashable
from math import inf
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.clocks import now_ns
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_protocol.rights import Operation
from relay_server.common.clock import Clock, Timer, cancel, detached
from relay_server.common.token_bucket import Buckets
from relay_server.control.audit import WHY, Actor, AuditSink
from relay_server.control.commands import RobotCommands
from relay_server.control.lease import FREE, ControlRequest, Holder, Lease, LeaseClient, owns
from relay_server.control.rearm import ReconnectGuard, held_on
from relay_server.control.stopping import StopController
from relay_server.control.suppression import SuppressionService
from relay_server.control.types import (
    DESERTED_SECONDS,
    IMPLICIT,
    LET_GO_SECONDS,
    REST_SECONDS,
    ROBOT,
    TAKES_A_SECOND,
    TAKES_AT_ONCE,
    USERS,
    ControlReply,
    ControlRules,
    ControlSnapshot,
    actor_of,
)
from relay_server.robots.registry import RobotState

INTERVAL = 0.1
"""Least seconds between two tellings; what changes meanwhile is told together."""


class ChangeNotifier:
    """Who wants to hear of changes, and when they did the last time."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._followers: dict[Hashable, Callable[[], None]] = {}
        self._timer: Timer | None = None
        self._told_at = -INTERVAL

    def follow(self, follower: Hashable, tell: Callable[[], None]) -> None:
        """From now on this one is told, by this call."""
        self._followers[follower] = tell

    def forget(self, follower: Hashable) -> None:
        """This one no more."""
        self._followers.pop(follower, None)

    def push(self) -> None:
        """Something is another: tell all when all that changes now has changed."""
        if self._timer is None and self._followers:
            pause = max(0.0, self._told_at + INTERVAL - self._clock.seconds())
            self._timer = self._clock.callLater(pause, self._tell)

    def _tell(self) -> None:
        self._timer = None
        self._told_at = self._clock.seconds()
        for tell in list(self._followers.values()):
            tell()


class IdleTimeout:
    """Watches how long whoever has control has given no command.

    :param seconds: without a command, after which it is over
    :param latest: the clock's time of the latest command
    :param over: called when it is
    """

    def __init__(
        self, clock: Clock, seconds: float, latest: Callable[[], float], over: Callable[[], None]
    ) -> None:
        self._clock = clock
        self._seconds = seconds
        self._latest = latest
        self._over = over
        self._since = 0.0
        self._timer: Timer | None = None

    def begin(self) -> None:
        """Somebody has control now."""
        self.end()
        self._since = self._clock.seconds()
        self._timer = self._clock.callLater(self._seconds, self._look)

    def end(self) -> None:
        """Nobody has it any more."""
        cancel(self._timer)
        self._timer = None

    def _look(self) -> None:
        self._timer = None
        left = max(self._since, self._latest()) + self._seconds - self._clock.seconds()
        # A clock's rounding must not make it look a thousand times.
        if left > 0.001:
            self._timer = self._clock.callLater(left, self._look)
        else:
            self._over()


class ControlHandshake:
    """The lease of one robot, and the robot's word for it.

    :param changed: called when what the list of robots shows of it is another
    :param wall: Unix time in seconds
    :param clock_ns: the relay's monotonic nanoseconds
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        robot: RobotState,
        record: AuditSink,
        rules: ControlRules,
        changed: Callable[[], None],
        wall: Callable[[], float],
        clock_ns: Callable[[], int] = now_ns,
    ) -> None:
        self._clock = clock
        self.robot = robot
        self._record = record
        self.rules = rules
        self._changed = changed
        self._wall = wall
        self.orders = RobotCommands(clock, robot)
        self.stopping = StopController(clock, robot, self.orders, record, self._stand, wall, clock_ns)
        self.subsuming = SuppressionService(clock, robot, self.orders, record, self._stand)
        self.pushing = ChangeNotifier(clock)
        self.standing = ControlSnapshot(FREE, {}, None)
        self._idling = IdleTimeout(clock, rules.idle, self._latest_command, self._idle_over)
        self._moved = -inf
        """The clock's time at which the robot was last known to move, since somebody has control."""
        self._due = 0.0
        """The monotonic moment from which an owner who asks again takes over."""
        self._lapsing: Timer | None = None
        """Ends a request that nobody answers."""
        self._bereft: dict[LeaseClient, float] = {}
        """Who may not get control by a command before he has let go, and the moment of his latest one."""
        self._settling: list[Deferred[SwitchboardError | None]] = []
        # Before its channel and its streams: what the robot is told first is to stop.
        robot.watchers.insert(0, self)

    @property
    def lease(self) -> Lease:
        """Who has control now."""
        return self.standing.lease

    # --- the robot ----------------------------------------------------------------------------------------

    def told(self, message: link.Safety | link.Done) -> None:
        """The robot has carried out an order, or tells who moves it."""
        if isinstance(message, link.Done):
            self.orders.done(message)
            return
        if message.stopped is not None and self.stopping.stopped is None:
            # Of what comes from here it has been told, and that is known.
            self.stopping.anew()
        if self.robot.safety.moving:
            self._moved = self._clock.seconds()
        self.robot.safety = message
        self.stopping.heard()
        self._stand()
        self.pushing.push()

    def robot_online(self) -> None:
        """The robot has registered (again)."""
        self.stopping.came()
        self.subsuming.came()
        self.pushing.push()

    def robot_offline(self) -> None:
        """The control link is gone, and with it control: it is taken anew."""
        why = "the robot's link was lost"
        tenure = self.lease.holder or self.lease.coming
        request = self.lease.request
        if tenure is not None:
            self._note_lost(tenure, why)
        self._note_lapsed(request, why)
        # What it said of itself is over, but for the stop, which it keeps.
        self.robot.safety = link.Safety(stopped=self.robot.safety.stopped)
        self._become(self.lease.lost())
        self.subsuming.lost()
        self.orders.lost()
        if tenure is not None:
            self._tell_lost(tenure, why)
        self._tell_request(request, why)

    def graph_changed(self) -> None:
        """What moves the robot is no question of its graph."""

    def described(self) -> None:
        """Nor of this: who commands looks it up."""

    # --- for the desk -------------------------------------------------------------------------------------

    def _judge(self, client: LeaseClient) -> None:
        verdict = client.permit.judge(Operation.CONTROL, ROBOT)
        if not verdict.allowed:
            raise Refused(verdict.reason)
        if self.robot.control is None:
            raise Unavailable(f"robot {self.robot.name} is offline")

    def _lose(self, client: LeaseClient, why: str) -> None:
        tenure = self.lease.holder or self.lease.coming
        if self.lease.requested_by(client):
            self._note_lapsed(self.lease.request, why)
            self._become(self.lease.withdrawn())
        elif tenure is not None and tenure.client is client:
            self._note_lost(tenure, why)
            self._let_go(why)
            self._tell_lost(tenure, why)

    def _note_lost(self, tenure: Holder, why: str) -> None:
        """Somebody has control no more, without having given it back."""
        self._bereft[tenure.client] = self._clock.seconds()
        self._note("control.lost", tenure.client, why, moving=self._driven_by(tenure.client))

    def _driven_by(self, client: LeaseClient) -> bool:
        """Whether the robot moves, or did when who drives it was heard last.

        Whom a link swallows is known to be gone seconds after the robot has stopped itself.
        """
        return self.robot.safety.moving or self._moved >= client.heard_driving()

    def _tell_lost(self, tenure: Holder, why: str) -> None:
        """Tell him, once all has changed: whoever is told may be cut for reading too slowly, and leave by that."""
        tenure.client.tell("warning", f"you have lost control of {self.robot.name}: {why}")

    def _let_go(self, why: str) -> None:
        """Nobody is to have control: the robot stops what moves before anybody else gets it."""
        request = self.lease.request
        self._note_lapsed(request, why)
        lease = self.lease.free()
        self._become(lease)
        if self.lease is lease:
            given = self.orders.give(lambda id: link.Control(id=id, why=why), always=True)
            detached(self._settle(lease, given))
        self._tell_request(request, why)

    def _tell_request(self, request: ControlRequest | None, why: str) -> None:
        if request is not None:
            request.client.tell("warning", f"control of {self.robot.name} is free: {why}")

    def _note_lapsed(self, request: ControlRequest | None, why: str) -> None:
        """Somebody asks for control no more, without having taken that back or having been answered."""
        if request is not None:
            self._note("control.lapsed", request.client, why)

    def _unanswered(self) -> None:
        """The holder has not answered a request in time: others may ask now."""
        holder, request = self.lease.holder, self.lease.request
        assert holder is not None and request is not None
        why = f"no answer within {self.rules.request:g} s"
        self._note_lapsed(request, why)
        self._become(self.lease.withdrawn())
        robot = self.robot.name
        request.client.tell("warning", f"you ask for control of {robot} no more: {why}; ask again to go on")
        holder.client.tell("warning", f"{request.client.name} asks for control of {robot} no more: {why}")

    def _latest_command(self) -> float:
        holder = self.lease.holder
        if holder is None or self.robot.safety.moving:
            return self._clock.seconds()
        return holder.client.driving_since()

    def _idle_over(self) -> None:
        if self.lease.holder is not None:
            self._lose(self.lease.holder.client, f"no command for {self.rules.idle:g} s")

    def _hand_to(
        self, client: LeaseClient, why: str, how: str, implicit: bool = False
    ) -> Deferred[SwitchboardError | None]:
        """Have the robot obey this client and nobody else; what comes back is that of :meth:`_settled`.

        :param implicit: whether a command of his takes it
        """
        request = self.lease.request
        ousted = request if request is not None and request.client is not client else None
        gone = f"{client.name} gets it"
        self._note_lapsed(ousted, gone)
        lease = self.lease.give(client, self._wall(), implicit)
        self._become(lease)
        waiting = self._settled()
        if ousted is not None:
            ousted.client.tell("warning", f"you ask for control of {self.robot.name} no more: {gone}")
        # Whoever was told of it may have left by that.
        if self.lease is lease:
            detached(self._settle(lease, self._order_control(client, why), why, how))
        return waiting

    def _order_control(self, client: LeaseClient, why: str) -> Deferred[None]:
        level = str(client.permit.rules.level or "")
        return self.orders.give(
            lambda id: link.Control(id=id, holder=client.number, user=client.name, level=level, why=why)
        )

    async def _settle(self, asked: Lease, given: Deferred[None], why: str = "", how: str = "") -> None:
        """Wait for the robot's word about this lease."""
        error: SwitchboardError | None = None
        try:
            await given
        except SwitchboardError as failure:
            error = failure
        if self.lease is not asked:
            # Whoever was to have it has left, or the robot has.
            return
        if error is not None:
            self._not_settled(error, asked)
            return
        self._become(asked.done(self._wall()))
        if asked.coming is not None:
            self._note("control.taken", asked.coming.client, why, how=how)

    def _not_settled(self, error: SwitchboardError, asked: Lease) -> None:
        """The robot has not said that it obeys: nobody has control."""
        self.log.warn("control of {robot} is free: {why}", robot=self.robot.full, why=str(error))
        client = None if asked.coming is None else asked.coming.client
        if client is not None:
            # It may have heard us all the same. First: whoever waits for a free robot is given it by what follows.
            given = self.orders.give(lambda id: link.Control(id=id, why=str(error)), always=True)
            given.addErrback(_unheard)
            self._note("control.lost", client, str(error), moving=self.robot.safety.moving)
        self._become(asked.failed(), error)
        if client is not None:
            client.tell("error", f"you did not get control of {self.robot.name}: {error}")

    def _become(self, lease: Lease, error: SwitchboardError | None = None) -> None:
        before = self.lease
        self._stand(lease)
        if before.holder is None and lease.holder is not None:
            self._idling.begin()
        elif lease.holder is None:
            self._idling.end()
            self._moved = -inf
        if lease.request is not before.request:
            cancel(self._lapsing)
            asked = lease.request is not None
            self._lapsing = self._clock.callLater(self.rules.request, self._unanswered) if asked else None
        for tenure in (before.coming, before.holder):
            if tenure is not None:
                tenure.client.control_changed()
        if lease.settled:
            self._report(error)

    def _stand(self, lease: Lease | None = None) -> None:
        """What decides over commands is another."""
        before = self.standing
        now = ControlSnapshot(lease or before.lease, self.subsuming.sources, self.stopping.stopped)
        if now == before and lease is None:
            return
        self.standing = now
        self._changed()
        if lease is None or lease.settled:
            # Else the robot's answer is a moment away, and tells more.
            self.pushing.push()

    def _report(self, error: SwitchboardError | None) -> None:
        """Tell those who wait for the robot's word."""
        waiting, self._settling = self._settling, []
        for each in waiting:
            each.callback(error)

    def _settled(self) -> Deferred[SwitchboardError | None]:
        """Fires when the robot has answered; with what went wrong, if anything did."""
        waiting: Deferred[SwitchboardError | None] = Deferred(self._settling.remove)
        if self.lease.settled:
            waiting.callback(None)
        else:
            self._settling.append(waiting)
        return waiting

    def _note(self, kind: str, client: LeaseClient, why: str, by: Actor | None = None, **data: Any) -> None:
        """Put something on record.

        :param by: who does it, where that is not the client, who is named in the data then
        """
        self._record.note(kind, self.robot, by or actor_of(client), why, **data)


def _unheard(failure: Any) -> None:
    """What was taken back as a precaution need not have been there."""


class RobotController(ControlHandshake):
    """Control of one robot.

    :param changed: called when what the list of robots shows of it is another
    :param wall: Unix time in seconds
    :param clock_ns: the relay's monotonic nanoseconds
    """

    def __init__(
        self,
        clock: Clock,
        robot: RobotState,
        record: AuditSink,
        rules: ControlRules,
        changed: Callable[[], None],
        wall: Callable[[], float],
        clock_ns: Callable[[], int] = now_ns,
    ) -> None:
        super().__init__(clock, robot, record, rules, changed, wall, clock_ns)
        self._takes = Buckets(TAKES_A_SECOND, TAKES_AT_ONCE, USERS, clock.seconds)
        """By user, how often he may take control still."""
        self._comeback = ReconnectGuard(clock)
        self._resting: OrderedDict[int, tuple[int, float]] = OrderedDict()
        """By user, the connection that refused him control the last time, and until when he does not ask it again."""

    # --- commands -----------------------------------------------------------------------------------------

    def passes(self, client: LeaseClient, topic: str) -> bool:
        """Whether this client commands that topic now."""
        return self.lease.held_by(client) or client.number in self.standing.suppressed.get(topic, ())

    def claim(self, client: LeaseClient) -> bool:
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

    def zero(self, client: LeaseClient) -> None:
        """A zero of a client that does not move the robot: it takes no control, and there is nothing it could stop.

        :raises Refused: somebody else moves the robot
        """
        tenure = self.lease.holder or self.lease.coming
        if tenure is not None:
            raise self._held_by(tenure)

    def _held_by(self, tenure: Holder) -> Refused:
        return Refused(
            f"robot {self.robot.name} is controlled by {tenure.client.name}; ask for it with /relay/take_control"
        )

    def _count_take(self, client: LeaseClient) -> None:
        """Bound how often a user takes control.

        :raises Refused: he has done so too often
        """
        if not self._takes.take(client.user):
            raise Refused(
                f"you take control of robot {self.robot.name} too often: {TAKES_A_SECOND:g} times a second at most; "
                "try again in a moment"
            )

    def _see_let_go(self, client: LeaseClient) -> None:
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

    def in_vain(self, client: LeaseClient) -> bool:
        """Whether who commands without control holds on by that: somebody else has it, or he has lost it.

        Who commands while nobody has it need not let go of anything (SPEC section 2.5, "Who moves the robot").
        """
        lease = self.lease
        return client in self._bereft or any(
            each is not None and each.client is not client for each in (lease.holder, lease.coming)
        )

    def unheard(self, client: LeaseClient) -> None:
        """A client has published to the robot while that is away: it must find no hand on the stick."""
        self._bereft[client] = self._clock.seconds()

    def _succeed(
        self, client: LeaseClient, why: str, how: str, lost: str, *, implicit: bool = False
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

    def _deserted(self, client: LeaseClient) -> bool:
        """Whether who has control is the same user, by a connection that he commands from no more."""
        holder = self.lease.holder
        if holder is None or holder.client.user != client.user or self.robot.safety.moving:
            return False
        return self._clock.seconds() - holder.client.driving_since() >= DESERTED_SECONDS

    async def claimed(self, client: LeaseClient) -> None:
        """Wait until a client that commands moves the robot.

        :raises Refused: as :meth:`claim`
        :raises Unavailable: the robot is offline, or does not agree
        """
        if not self.claim(client):
            error = await self._settled()
            if not self.lease.held_by(client):
                raise error or Unavailable(f"you did not get control of {self.robot.name}")

    # --- what clients ask for -----------------------------------------------------------------------------

    async def take(self, client: LeaseClient, why: str) -> ControlReply:
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
            return ControlReply(True, "you have control")
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
        return ControlReply(True, "you have control")

    def _may_take_over(self, client: LeaseClient) -> bool:
        holder, lease = self.lease.holder, self.lease
        if holder is not None and holder.client.user == client.user:
            # Nobody asks himself for anything.
            return True
        return lease.requested_by(client) and self._comes_due(client) and self._clock.seconds() >= self._due

    def _comes_due(self, client: LeaseClient) -> bool:
        """Whether this client takes over after the grace time: an owner, or anybody from an implicit holder."""
        holder = self.lease.holder
        return owns(client) or (holder is not None and holder.implicit)

    def _see_rested(self, client: LeaseClient, holder: LeaseClient) -> None:
        """:raises Refused: this holder has just refused control to the same user"""
        refuser, until = self._resting.get(client.user, (0, 0.0))
        left = until - self._clock.seconds()
        if refuser == holder.number and left > 0:
            raise Refused(
                f"{holder.name} has just kept control of {self.robot.name}; ask again in {math.ceil(left)} s"
            )

    def _request(self, client: LeaseClient, why: str) -> ControlReply:
        lease, now = self.lease, self._wall()
        assert lease.holder is not None
        holder, request = lease.holder.client, lease.request
        if request is not None and request.client is client:
            left = max(0.0, self._due - self._clock.seconds())
            after = f"; after {left:.0f} s ask again to take over" if self._comes_due(client) else ""
            return ControlReply(False, f"{holder.name} has control and was asked for it already{after}")
        if request is not None and (owns(request.client) or not owns(client)):
            return ControlReply(
                False, f"{holder.name} has control, and {request.client.name} asks for it already"
            )
        self._see_rested(client, holder)
        self._due = self._clock.seconds() + self.rules.grace
        self._note_lapsed(request, f"{client.name} asks for it before")
        self._become(lease.requested(ControlRequest(client, now, now + self.rules.grace, why)))
        self._note("control.requested", client, why, holder=holder.name)
        if request is not None:
            request.client.tell("warning", f"{client.name} asks for control of {self.robot.name} before you")
        said = f": {why}" if why else ""
        holder.tell("warning", f"{client.name} asks for control of {self.robot.name}{said}")
        return ControlReply(False, f"{holder.name} has control and was asked for it")

    def release(self, client: LeaseClient, why: str, by: Actor | None = None) -> ControlReply:
        """Give control back, or a request for it.

        :param by: who does it, where that is not the client
        """
        why = why[:WHY]
        whose = {} if by is None or by.user == client.user else {"of": client.name}
        if self.lease.requested_by(client):
            self._note("control.withdrawn", client, why, by, **whose)
            self._become(self.lease.withdrawn())
            return ControlReply(True, "you ask for control no more")
        if not (self.lease.held_by(client) or self.lease.coming_to(client)):
            return ControlReply(False, "you have no control of this robot")
        self._note("control.released", client, why, by, **whose)
        if by is not None:
            self._bereft[client] = self._clock.seconds()
        self._let_go(f"given back by {client.name if by is None else by.name}")
        return ControlReply(True, "control is given back")

    def _asked_by(self, client: LeaseClient, meant: int) -> ControlRequest | ControlReply:
        """The request that the holder answers, or why he answers none.

        :param meant: the number of the connection whose request he means, 0 for whoever asks
        """
        request = self.lease.request
        if not self.lease.held_by(client):
            return ControlReply(False, "you have no control of this robot")
        if request is None:
            return ControlReply(False, "nobody asks for control")
        if meant not in (0, request.client.number):
            return ControlReply(
                False,
                f"who you mean asks for control no more; {request.client.name} does, and has no answer yet",
            )
        return request

    def grant(self, client: LeaseClient, why: str, meant: int = 0) -> ControlReply:
        """The holder hands control over to who asks for it.

        :param meant: the number of the connection he means, 0 for whoever asks
        """
        request = self._asked_by(client, meant)
        if isinstance(request, ControlReply):
            return request
        self._note("control.granted", client, why[:WHY], to=request.client.name)
        self._hand_to(request.client, f"granted by {client.name}", "granted")
        return ControlReply(True, f"{request.client.name} gets control")

    def refuse(self, client: LeaseClient, why: str, meant: int = 0) -> ControlReply:
        """The holder keeps control, and is left alone by who asked for a while.

        :param meant: as for :meth:`grant`
        """
        request, why = self._asked_by(client, meant), why[:WHY]
        if isinstance(request, ControlReply):
            return request
        self._rests(request.client.user, client)
        self._note("control.refused", client, why, to=request.client.name)
        said = f": {why}" if why else ""
        self._become(self.lease.withdrawn())
        request.client.tell("warning", f"{client.name} keeps control of {self.robot.name}{said}")
        return ControlReply(True, f"you keep control; {request.client.name} is told")

    def _rests(self, user: int, refuser: LeaseClient) -> None:
        self._resting.pop(user, None)
        self._resting[user] = (refuser.number, self._clock.seconds() + REST_SECONDS)
        while len(self._resting) > USERS:
            self._resting.popitem(last=False)

    def may_resume(self, client: LeaseClient) -> bool:
        """Whether this client may let a robot that is stopped move again: who has control, and owners."""
        return self.lease.held_by(client) or owns(client)

    # --- what ends it -------------------------------------------------------------------------------------

    def left(self, client: LeaseClient, *, orderly: bool = False) -> None:
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

    def rights_changed(self, client: LeaseClient) -> None:
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
