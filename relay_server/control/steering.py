"""What the robot has to do with control: it is told of every change, and nobody has control before it has answered."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.clocks import now_ns
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_protocol.rights import Operation
from relay_server.clock import Clock, Timer, cancel
from relay_server.control.detached import detached
from relay_server.control.idling import Idling
from relay_server.control.lease import FREE, Client, Lease, Request, Tenure
from relay_server.control.orders import Orders
from relay_server.control.pushing import Pushing
from relay_server.control.record import Actor, Record
from relay_server.control.stopping import Stopping
from relay_server.control.subsuming import Subsuming
from relay_server.control.terms import ROBOT, ControlRules, Standing, actor_of
from relay_server.registry import Presence


class Steering:
    """The lease of one robot, and the robot's word for it.

    :param changed: called when what the list of robots shows of it is another
    :param wall: Unix time in seconds
    :param clock_ns: the relay's monotonic nanoseconds
    """

    log = Logger()

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
        self._clock = clock
        self.robot = robot
        self._record = record
        self.rules = rules
        self._changed = changed
        self._wall = wall
        self.orders = Orders(clock, robot)
        self.stopping = Stopping(clock, robot, self.orders, record, self._stand, wall, clock_ns)
        self.subsuming = Subsuming(clock, robot, self.orders, record, self._stand)
        self.pushing = Pushing(clock)
        self.standing = Standing(FREE, {}, None)
        self._idling = Idling(clock, rules.idle, self._latest_command, self._idle_over)
        self._moved = -inf
        """The clock's time at which the robot was last known to move, since somebody has control."""
        self._due = 0.0
        """The monotonic moment from which an owner who asks again takes over."""
        self._lapsing: Timer | None = None
        """Ends a request that nobody answers."""
        self._bereft: dict[Client, float] = {}
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

    def _judge(self, client: Client) -> None:
        verdict = client.permit.judge(Operation.CONTROL, ROBOT)
        if not verdict.allowed:
            raise Refused(verdict.reason)
        if self.robot.control is None:
            raise Unavailable(f"robot {self.robot.name} is offline")

    def _lose(self, client: Client, why: str) -> None:
        tenure = self.lease.holder or self.lease.coming
        if self.lease.requested_by(client):
            self._note_lapsed(self.lease.request, why)
            self._become(self.lease.withdrawn())
        elif tenure is not None and tenure.client is client:
            self._note_lost(tenure, why)
            self._let_go(why)
            self._tell_lost(tenure, why)

    def _note_lost(self, tenure: Tenure, why: str) -> None:
        """Somebody has control no more, without having given it back."""
        self._bereft[tenure.client] = self._clock.seconds()
        self._note("control.lost", tenure.client, why, moving=self._driven_by(tenure.client))

    def _driven_by(self, client: Client) -> bool:
        """Whether the robot moves, or did when who drives it was heard last.

        Whom a link swallows is known to be gone seconds after the robot has stopped itself.
        """
        return self.robot.safety.moving or self._moved >= client.heard_driving()

    def _tell_lost(self, tenure: Tenure, why: str) -> None:
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

    def _tell_request(self, request: Request | None, why: str) -> None:
        if request is not None:
            request.client.tell("warning", f"control of {self.robot.name} is free: {why}")

    def _note_lapsed(self, request: Request | None, why: str) -> None:
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
        self, client: Client, why: str, how: str, implicit: bool = False
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

    def _order_control(self, client: Client, why: str) -> Deferred[None]:
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
        now = Standing(lease or before.lease, self.subsuming.sources, self.stopping.stopped)
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

    def _note(self, kind: str, client: Client, why: str, by: Actor | None = None, **data: Any) -> None:
        """Put something on record.

        :param by: who does it, where that is not the client, who is named in the data then
        """
        self._record.note(kind, self.robot, by or actor_of(client), why, **data)


def _unheard(failure: Any) -> None:
    """What was taken back as a precaution need not have been there."""
