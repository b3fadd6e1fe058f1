"""Control of one robot: how clients acquire, request, hand over, release and lose it (SPEC 1.7)."""

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
from relay_protocol.limits import REASON_LENGTH
from relay_protocol.release_rule import HELD_NS, RELEASE_NS, CommandStreams, ReconnectGuard, is_released
from relay_protocol.rights import Operation
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.concurrency import detached
from relay_server.common.token_bucket import Buckets
from relay_server.control.actor import Actor, actor_of
from relay_server.control.lease import FREE, ControlRequest, Holder, Lease, LeaseClient, owns
from relay_server.control.orders import ControlOrders
from relay_server.control.records import AuditSink
from relay_server.control.stopping import StopController
from relay_server.control.stored_stops import PendingStops
from relay_server.control.suppression import SuppressionService
from relay_server.control.types import (
    DESERTED_SECONDS,
    IMPLICIT,
    REFUSED_SECONDS,
    ROBOT,
    TAKES_A_SECOND,
    TAKES_AT_ONCE,
    USERS,
    ControlReply,
    ControlRules,
    ControlSnapshot,
)
from relay_server.robots.registry import RobotState

INTERVAL = 0.1
"""Least seconds between two notifications; changes in between share one."""


class ChangeNotifier:
    """Notifies followers of changes, at most every :data:`INTERVAL`."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._followers: dict[Hashable, Callable[[], None]] = {}
        self._timer: Timer | None = None
        self._notified_at = -INTERVAL

    def follow(self, follower: Hashable, notify: Callable[[], None]) -> None:
        """Notify a follower of every change from now on."""
        self._followers[follower] = notify

    def forget(self, follower: Hashable) -> None:
        """Stop notifying a follower."""
        self._followers.pop(follower, None)

    def changed(self) -> None:
        """Schedule a notification of all followers; changes of the same reactor turn share it."""
        if self._timer is None and self._followers:
            pause = max(0.0, self._notified_at + INTERVAL - self._clock.seconds())
            self._timer = self._clock.callLater(pause, self._notify)

    def _notify(self) -> None:
        self._timer = None
        self._notified_at = self._clock.seconds()
        for notify in list(self._followers.values()):
            notify()


class IdleTimeout:
    """Ends control when its holder sends no moving command for a time.

    :param seconds: longest time without a moving command
    :param latest: returns the clock's time of the latest moving command
    :param expired: called when control is to end
    """

    def __init__(
        self, clock: Clock, seconds: float, latest: Callable[[], float], expired: Callable[[], None]
    ) -> None:
        self._clock = clock
        self._seconds = seconds
        self._last_motion_at = latest
        self._expired = expired
        self._since = 0.0
        self._timer: Timer | None = None

    def start(self) -> None:
        """Begin to count, as a client has control now."""
        self.stop()
        self._since = self._clock.seconds()
        self._timer = self._clock.callLater(self._seconds, self._check)

    def stop(self) -> None:
        """Stop counting, as no client has control."""
        cancel(self._timer)
        self._timer = None

    def _check(self) -> None:
        self._timer = None
        left = max(self._since, self._last_motion_at()) + self._seconds - self._clock.seconds()
        # Rounding of the clock must not cause a thousand checks.
        if left > 0.001:
            self._timer = self._clock.callLater(left, self._check)
        else:
            self._expired()


class RobotController:
    """Control of one robot: its lease, which the robot has to confirm, and the rules for acquiring it.

    :param changed: called when an entry of the list of robots has changed
    :param wall: Unix time in seconds
    :param clock_ns: the relay's monotonic nanoseconds
    """

    log = Logger()

    def __init__(
        self,
        *,
        clock: Clock,
        robot: RobotState,
        record: AuditSink,
        stop_store: PendingStops,
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
        self.orders = ControlOrders(clock, robot)
        self.stopping = StopController(
            clock,
            robot,
            self.orders,
            record=record,
            store=stop_store,
            changed=self._update,
            wall=wall,
            clock_ns=clock_ns,
        )
        self.suppression = SuppressionService(clock, robot, self.orders, record, self._update)
        self.changes = ChangeNotifier(clock)
        self.snapshot = ControlSnapshot(FREE, {}, None)
        self._idle_timeout = IdleTimeout(clock, rules.idle, self._latest_motion, self._idle_expired)
        self._last_moving_at = -inf
        """The clock's time at which the robot was last reported moving; -inf: not since a client has control."""
        self._takeover_at = 0.0
        """The clock's time from which an owner takes over by asking again."""
        self._request_timer: Timer | None = None
        """Ends an unanswered request."""
        self._unreleased: CommandStreams[LeaseClient] = CommandStreams()
        """Clients that can't acquire control by a command before they release the controls."""
        self._awaiting_robot: list[Deferred[SwitchboardError | None]] = []
        self._take_limits = Buckets(TAKES_A_SECOND, TAKES_AT_ONCE, USERS, clock.seconds)
        """Requests for control that each user may still make."""
        self._reconnects = ReconnectGuard(USERS)
        self._refused_recently: OrderedDict[int, tuple[int, float]] = OrderedDict()
        """By user, the connection that last refused them control, and the time until which it is not asked again."""
        # Before the channel and the streams, so that the first command a robot receives is the stop.
        robot.observers.insert(0, self)

    @property
    def lease(self) -> Lease:
        """Which client has control, or is about to."""
        return self.snapshot.lease

    # --- the robot ----------------------------------------------------------------------------------------

    def message_received(self, message: link.MotionState | link.OrderResult) -> None:
        """Handle a robot's report of its state, or the result of an order."""
        if isinstance(message, link.OrderResult):
            self.orders.result_received(message)
            return
        if message.stopped is not None and self.stopping.stopped is None:
            # The relay did not send this stop.
            self.stopping.stopped_elsewhere()
        if self.robot.motion_state.moving:
            self._last_moving_at = self._clock.seconds()
        self.robot.motion_state = message
        self.stopping.state_received()
        self._update()
        self.changes.changed()

    def robot_online(self) -> None:
        """Handle that the robot has registered, for the first time or again."""
        self.stopping.robot_online()
        self.suppression.robot_online()
        self.changes.changed()

    def robot_offline(self) -> None:
        """End control, as the control link is lost; clients have to acquire it again."""
        why = "the robot's link was lost"
        holder, request = self.lease.holder or self.lease.pending_holder, self.lease.request
        if holder is not None:
            self._note_lost(holder, why)
        self._note_lapsed(request, why)
        # Its reported state no longer holds, except the stop, which the robot keeps. At another relay it may resume.
        stopped = None if self.robot.elsewhere else self.robot.motion_state.stopped
        self.robot.motion_state = link.MotionState(stopped=stopped)
        self._set_lease(self.lease.lost())
        self.suppression.link_lost()
        self.orders.link_lost()
        if holder is not None:
            self._notify_lost(holder, why)
        self._notify_request(request, why)

    def robot_moved(self) -> None:
        """Forget a stop that the robot reported here: it is connected to another relay, and may resume there."""
        if self.robot.control_link is None and self.robot.motion_state.stopped is not None:
            self.robot.motion_state = link.MotionState()
            self._update()

    def graph_changed(self) -> None:
        """Do nothing: control does not depend on the graph."""

    def described(self) -> None:
        """Do nothing: each command reads the description when it is needed."""

    # --- the lease ----------------------------------------------------------------------------------------

    def _check_right(self, client: LeaseClient) -> None:
        decision = client.permit.decide(Operation.CONTROL, ROBOT)
        if not decision.allowed:
            raise Refused(decision.reason)
        if self.robot.control_link is None:
            raise Unavailable(f"robot {self.robot.name} is offline")

    def _end_control(self, client: LeaseClient, why: str) -> None:
        holder = self.lease.holder or self.lease.pending_holder
        if self.lease.requested_by(client):
            self._note_lapsed(self.lease.request, why)
            self._set_lease(self.lease.withdrawn())
        elif holder is not None and holder.client is client:
            self._note_lost(holder, why)
            self._free_control(why)
            self._notify_lost(holder, why)

    def _note_lost(self, holder: Holder, why: str) -> None:
        """Record that a client has lost control without releasing it."""
        self._unreleased.refused(holder.client, self._now_ns())
        self._record_event("control.lost", holder.client, why, moving=self._driven_by(holder.client))

    def _driven_by(self, client: LeaseClient) -> bool:
        """Whether the robot moves, or moved when its driver was last known to be alive.

        The loss of a connection may be detected only seconds after the robot has stopped itself.
        """
        return self.robot.motion_state.moving or self._last_moving_at >= client.last_alive_while_driving()

    def _notify_lost(self, holder: Holder, why: str) -> None:
        """Notify a client that has lost control.

        To be called after all state has changed: notifying a slow reader may close its connection.
        """
        holder.client.notify("warning", f"you have lost control of {self.robot.name}: {why}")

    def _free_control(self, why: str) -> None:
        """End control: the robot stops what moves before another client gets it."""
        request = self.lease.request
        self._note_lapsed(request, why)
        lease = self.lease.free()
        self._set_lease(lease)
        if self.lease is lease:
            sent = self.orders.send(lambda id: link.ControlGrant(id=id, why=why), always=True)
            detached(self._await_confirmation(lease, sent))
        self._notify_request(request, why)

    def _notify_request(self, request: ControlRequest | None, why: str) -> None:
        if request is not None:
            request.client.notify("warning", f"control of {self.robot.name} is free: {why}")

    def _note_lapsed(self, request: ControlRequest | None, why: str) -> None:
        """Record a request that ended without being withdrawn or answered."""
        if request is not None:
            self._record_event("control.lapsed", request.client, why)

    def _request_expired(self) -> None:
        holder, request = self.lease.holder, self.lease.request
        assert holder is not None and request is not None
        why = f"no answer within {self.rules.request:g} s"
        self._note_lapsed(request, why)
        self._set_lease(self.lease.withdrawn())
        robot = self.robot.name
        request.client.notify(
            "warning", f"your request for control of {robot} has ended: {why}; request it again"
        )
        holder.client.notify(
            "warning", f"the request of {request.client.name} for control of {robot} has ended: {why}"
        )

    def _latest_motion(self) -> float:
        holder = self.lease.holder
        if holder is None or self.robot.motion_state.moving:
            return self._clock.seconds()
        return holder.client.last_motion_at()

    def _idle_expired(self) -> None:
        if self.lease.holder is not None:
            self._end_control(self.lease.holder.client, f"no moving command for {self.rules.idle:g} s")

    def _give_control(
        self, client: LeaseClient, why: str, how: str, implicit: bool = False
    ) -> Deferred[SwitchboardError | None]:
        """Give a client control, which the robot has to confirm; returns as :meth:`_wait_settled`.

        :param implicit: whether a command of the client acquires it
        """
        request = self.lease.request
        superseded = request if request is not None and request.client is not client else None
        why_superseded = f"{client.name} gets it"
        self._note_lapsed(superseded, why_superseded)
        lease = self.lease.give(client, self._wall(), implicit)
        self._set_lease(lease)
        waiting = self._wait_settled()
        if superseded is not None:
            superseded.client.notify(
                "warning", f"your request for control of {self.robot.name} has ended: {why_superseded}"
            )
        # The notification may have closed a client.
        if self.lease is lease:
            detached(self._await_confirmation(lease, self._send_grant(client, why), why, how))
        return waiting

    def _send_grant(self, client: LeaseClient, why: str) -> Deferred[None]:
        level = str(client.permit.rules.level or "")
        return self.orders.send(
            lambda id: link.ControlGrant(id=id, holder=client.number, user=client.name, level=level, why=why)
        )

    async def _await_confirmation(
        self, lease: Lease, sent: Deferred[None], why: str = "", how: str = ""
    ) -> None:
        """Wait for the robot to confirm this lease."""
        error: SwitchboardError | None = None
        try:
            await sent
        except SwitchboardError as failure:
            error = failure
        if self.lease is not lease:
            # In the meantime the client or the robot has left.
            return
        if error is not None:
            self._not_confirmed(error, lease)
            return
        self._set_lease(lease.done(self._wall()))
        if lease.pending_holder is not None:
            self._record_event("control.taken", lease.pending_holder.client, why, how=how)

    def _not_confirmed(self, error: SwitchboardError, lease: Lease) -> None:
        """Free control, as the robot has not confirmed the holder."""
        self.log.warn("control of {robot} is free: {why}", robot=self.robot.full, why=str(error))
        client = None if lease.pending_holder is None else lease.pending_holder.client
        if client is not None:
            # It may still have received the grant. Revoke it before a waiting client gets control below.
            sent = self.orders.send(lambda id: link.ControlGrant(id=id, why=str(error)), always=True)
            sent.addErrback(_ignore_failure)
            self._record_event("control.lost", client, str(error), moving=self.robot.motion_state.moving)
        self._set_lease(lease.failed(), error)
        if client is not None:
            client.notify("error", f"you did not get control of {self.robot.name}: {error}")

    def _set_lease(self, lease: Lease, error: SwitchboardError | None = None) -> None:
        before = self.lease
        self._update(lease)
        if before.holder is None and lease.holder is not None:
            self._idle_timeout.start()
        elif lease.holder is None:
            self._idle_timeout.stop()
            self._last_moving_at = -inf
        if lease.request is not before.request:
            cancel(self._request_timer)
            self._request_timer = None
            if lease.request is not None:
                self._request_timer = self._clock.callLater(self.rules.request, self._request_expired)
        for holder in (before.pending_holder, before.holder):
            if holder is not None:
                holder.client.control_changed()
        if lease.settled:
            waiting, self._awaiting_robot = self._awaiting_robot, []
            for each in waiting:
                each.callback(error)

    def _update(self, lease: Lease | None = None) -> None:
        """Replace the snapshot if anything that decides about commands has changed."""
        before = self.snapshot
        now = ControlSnapshot(lease or before.lease, self.suppression.sources, self.stopping.stopped)
        if now == before and lease is None:
            return
        self.snapshot = now
        self._changed()
        if lease is None or lease.settled:
            # Otherwise followers are notified with the robot's answer, which is due soon.
            self.changes.changed()

    def _wait_settled(self) -> Deferred[SwitchboardError | None]:
        """Fires when the robot has answered, with the error or ``None``."""
        waiting: Deferred[SwitchboardError | None] = Deferred(self._awaiting_robot.remove)
        if self.lease.settled:
            waiting.callback(None)
        else:
            self._awaiting_robot.append(waiting)
        return waiting

    def _record_event(
        self, kind: str, client: LeaseClient, why: str, by: Actor | None = None, **data: Any
    ) -> None:
        """Record an event.

        :param by: the originator, where that is not the client; ``data`` then name the client
        """
        self._record.note(kind, self.robot, by or actor_of(client), why, **data)

    def _now_ns(self) -> int:
        return _ns(self._clock.seconds())

    # --- commands -----------------------------------------------------------------------------------------

    def may_command(self, client: LeaseClient, topic: str) -> bool:
        """Whether commands of this client to this topic are sent to the robot now."""
        return self.lease.held_by(client) or client.number in self.snapshot.suppressing.get(topic, ())

    def acquire_by_command(self, client: LeaseClient) -> bool:
        """Acquire control for a client that commands a free robot.

        :returns: whether it has control; false until the robot has confirmed
        :raises Refused: no right to control, another client has it, or control must be taken explicitly
        """
        lease, name = self.lease, self.robot.name
        if lease.held_by(client):
            return True
        if lease.pending_for(client):
            return False
        self._check_right(client)
        holder = lease.holder or lease.pending_holder
        if holder is not None and self._holder_inactive(client):
            # A user may return by another connection before the loss of the first is detected.
            self._note_reconnect(holder.client, _ns(holder.client.last_command_at()))
        self._check_released(client)
        if holder is not None and (self.rules.explicit or not self._holder_inactive(client)):
            raise self._controlled_by(holder)
        if not lease.settled:
            raise Refused(f"control of robot {name} is just being released; try again in a moment")
        if self.rules.explicit:
            raise Refused(
                f"no client controls robot {name}: take control first, with /relay/take_control, PUT …/control or "
                "the portal"
            )
        self._count_take(client)
        self._reconnects.forget(client.user)
        lost = "the same user commands from another connection"
        self._replace_holder(client, IMPLICIT, "taken", lost, implicit=True)
        return False

    def check_zero_command(self, client: LeaseClient) -> None:
        """Check a zero command of a client without control; it acquires no control.

        :raises Refused: another client has control
        """
        holder = self.lease.holder or self.lease.pending_holder
        if holder is not None:
            raise self._controlled_by(holder)

    def _controlled_by(self, holder: Holder) -> Refused:
        return Refused(
            f"robot {self.robot.name} is controlled by {holder.client.name}; ask for it with /relay/take_control"
        )

    def _count_take(self, client: LeaseClient) -> None:
        """:raises Refused: the user takes control too often"""
        if not self._take_limits.take(client.user):
            raise Refused(
                f"you take control of robot {self.robot.name} too often: {TAKES_A_SECOND:g} times a second at most; "
                "try again in a moment"
            )

    def _check_released(self, client: LeaseClient) -> None:
        """Check that a client that lost control while it commanded has released the controls since.

        :raises Refused: it has not
        """
        now, since = self._now_ns(), self._unreleased.pop(client)
        if since is None:
            # A new connection of a user counts as the continuation of one that has ended.
            opened = _ns(client.opened)
            if self._reconnects.may_be_queued(client.user, opened, now):
                raise Refused(
                    "your connection was lost while you drove, and the first commands of a new one may have waited "
                    "for it: send again"
                )
            since = self._reconnects.silent_since(client.user, opened)
        if since is None or is_released(since, now):
            return
        self._unreleased.refused(client, now)
        raise Refused(
            f"you had no control of robot {self.robot.name} when you began to command: release the controls for "
            f"{RELEASE_NS / 1e9:g} s"
        )

    def _note_reconnect(self, client: LeaseClient, commanded: int) -> None:
        """Note that a user commands by another connection, as the first may have ended undetected.

        :param commanded: when the first sent its latest command, nanoseconds
        """
        released = _released(client, commanded)
        self._reconnects.connection_ended(client.user, commanded, self._now_ns(), released=released)

    def commands_without_control(self, client: LeaseClient) -> bool:
        """Whether a client that commands now must release later, as another has control or it has lost control.

        While no client has control, it need not release (SPEC 2.5-45).
        """
        lease = self.lease
        return client in self._unreleased or any(
            each is not None and each.client is not client for each in (lease.holder, lease.pending_holder)
        )

    def published_while_offline(self, client: LeaseClient) -> None:
        """Note that a client has published to an offline robot: it must release before the robot returns."""
        self._unreleased.refused(client, self._now_ns())

    def _replace_holder(
        self, client: LeaseClient, why: str, how: str, lost: str, *, implicit: bool = False
    ) -> Deferred[SwitchboardError | None]:
        """Give a client control in place of the present holder, if there is one.

        :param lost: the reason that the present holder is notified of
        :param implicit: whether a command of the client acquires control
        """
        former = self.lease.holder
        if former is not None:
            self._note_lost(former, lost)
        waiting = self._give_control(client, why, how, implicit)
        if former is not None:
            self._notify_lost(former, lost)
        return waiting

    def _holder_inactive(self, client: LeaseClient) -> bool:
        """Whether the holder is another connection of the same user that has stopped sending commands."""
        holder = self.lease.holder
        if holder is None or holder.client.user != client.user or self.robot.motion_state.moving:
            return False
        return self._clock.seconds() - holder.client.last_motion_at() >= DESERTED_SECONDS

    async def wait_for_control(self, client: LeaseClient) -> None:
        """Wait until a client that commands has acquired control.

        :raises Refused: as of :meth:`acquire_by_command`
        :raises Unavailable: the robot is offline, or does not confirm
        """
        if not self.acquire_by_command(client):
            error = await self._wait_settled()
            if not self.lease.held_by(client):
                raise error or Unavailable(f"you did not get control of {self.robot.name}")

    # --- requests -----------------------------------------------------------------------------------------

    async def take(self, client: LeaseClient, why: str) -> ControlReply:
        """Take control of a free robot, or request it from its holder.

        :raises Refused: no right to control, or too many requests
        :raises Unavailable: the robot is offline, or does not confirm
        """
        self._check_right(client)
        if not self.lease.held_by(client):
            self._count_take(client)
        why = why[:REASON_LENGTH]
        while not self.lease.settled:
            was_pending = self.lease.pending_for(client)
            error = await self._wait_settled()
            if was_pending and error is not None:
                raise error
        # Rights may have changed during the wait, and the robot may have gone offline.
        self._check_right(client)
        lease = self.lease
        if lease.held_by(client):
            if lease.holder is not None and lease.holder.implicit:
                self._set_lease(lease.made_explicit())
            return ControlReply(True, "you have control")
        if lease.holder is not None and not self._may_take_over(client):
            return self._request(client, why)
        # Its session refuses commands that continue without a release.
        self._unreleased.zero(client)
        self._reconnects.forget(client.user)
        how = "taken" if lease.holder is None else "taken over"
        error = await self._replace_holder(client, why, how, f"{client.name} has taken over")
        if error is not None:
            raise error
        if not self.lease.held_by(client):
            self._check_right(client)
            raise Unavailable("control has changed again meanwhile")
        return ControlReply(True, "you have control")

    def _may_take_over(self, client: LeaseClient) -> bool:
        holder, lease = self.lease.holder, self.lease
        if holder is not None and holder.client.user == client.user:
            # A user needs no grant from their own connection.
            return True
        grace_over = self._clock.seconds() >= self._takeover_at
        return lease.requested_by(client) and self._takes_over_later(client) and grace_over

    def _takes_over_later(self, client: LeaseClient) -> bool:
        """Whether this client may take over after the grace time: an owner, or any client from an implicit holder."""
        holder = self.lease.holder
        return owns(client) or (holder is not None and holder.implicit)

    def _check_refused_recently(self, client: LeaseClient, holder: LeaseClient) -> None:
        """:raises Refused: this holder has just refused control to the same user"""
        refuser, until = self._refused_recently.get(client.user, (0, 0.0))
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
            left = max(0.0, self._takeover_at - self._clock.seconds())
            after = f"; after {left:.0f} s ask again to take over" if self._takes_over_later(client) else ""
            return ControlReply(False, f"{holder.name} has control and was asked for it already{after}")
        if request is not None and (owns(request.client) or not owns(client)):
            return ControlReply(
                False, f"{holder.name} has control, and {request.client.name} asks for it already"
            )
        self._check_refused_recently(client, holder)
        self._takeover_at = self._clock.seconds() + self.rules.grace
        self._note_lapsed(request, f"{client.name} asks for it before")
        self._set_lease(lease.requested(ControlRequest(client, now, now + self.rules.grace, why)))
        self._record_event("control.requested", client, why, holder=holder.name)
        if request is not None:
            request.client.notify(
                "warning", f"{client.name} asks for control of {self.robot.name} before you"
            )
        reason = f": {why}" if why else ""
        holder.notify("warning", f"{client.name} asks for control of {self.robot.name}{reason}")
        return ControlReply(False, f"{holder.name} has control and was asked for it")

    def release(self, client: LeaseClient, why: str, by: Actor | None = None) -> ControlReply:
        """Release control, or withdraw a request.

        :param by: the originator, where that is not the client
        """
        why = why[:REASON_LENGTH]
        details = {} if by is None or by.user == client.user else {"of": client.name}
        if self.lease.requested_by(client):
            self._record_event("control.withdrawn", client, why, by, **details)
            self._set_lease(self.lease.withdrawn())
            return ControlReply(True, "your request for control is withdrawn")
        if not (self.lease.held_by(client) or self.lease.pending_for(client)):
            return ControlReply(False, "you have no control of this robot")
        self._record_event("control.released", client, why, by, **details)
        if by is not None:
            self._unreleased.refused(client, self._now_ns())
        self._free_control(f"released by {client.name if by is None else by.name}")
        return ControlReply(True, "control is released")

    def _request_for(self, client: LeaseClient, requester: int) -> ControlRequest | ControlReply:
        """The request that the holder answers, or a reply that says why there is none.

        :param requester: number of the connection whose request is meant, 0 for any
        """
        request = self.lease.request
        if not self.lease.held_by(client):
            return ControlReply(False, "you have no control of this robot")
        if request is None:
            return ControlReply(False, "there is no request for control")
        if requester not in (0, request.client.number):
            return ControlReply(
                False,
                f"that request has ended; {request.client.name} requests control now, and has no answer yet",
            )
        return request

    def grant(self, client: LeaseClient, why: str, requester: int = 0) -> ControlReply:
        """Hand control over, as its holder.

        :param requester: number of the connection that is meant, 0 for any
        """
        request = self._request_for(client, requester)
        if isinstance(request, ControlReply):
            return request
        self._record_event("control.granted", client, why[:REASON_LENGTH], to=request.client.name)
        self._give_control(request.client, f"granted by {client.name}", "granted")
        return ControlReply(True, f"{request.client.name} gets control")

    def refuse(self, client: LeaseClient, why: str, requester: int = 0) -> ControlReply:
        """Keep control, as its holder; the same user can't ask it again for :data:`REFUSED_SECONDS`.

        :param requester: as for :meth:`grant`
        """
        request, why = self._request_for(client, requester), why[:REASON_LENGTH]
        if isinstance(request, ControlReply):
            return request
        self._note_refused(request.client.user, client)
        self._record_event("control.refused", client, why, to=request.client.name)
        reason = f": {why}" if why else ""
        self._set_lease(self.lease.withdrawn())
        request.client.notify("warning", f"{client.name} keeps control of {self.robot.name}{reason}")
        return ControlReply(True, f"you keep control; {request.client.name} is notified")

    def _note_refused(self, user: int, refuser: LeaseClient) -> None:
        self._refused_recently.pop(user, None)
        self._refused_recently[user] = (refuser.number, self._clock.seconds() + REFUSED_SECONDS)
        while len(self._refused_recently) > USERS:
            self._refused_recently.popitem(last=False)

    # --- clients that leave, and changed rights -----------------------------------------------------------

    def client_left(self, client: LeaseClient, *, orderly: bool = False) -> None:
        """End control of a connection that has ended.

        :param orderly: whether its user has closed it
        """
        self.changes.forget(client)
        # The time of the command, not of the end: a client that had stopped commanding has released.
        commanded = max(self._unreleased.last(client) or 0, _ns(client.last_command_at()))
        released = orderly or _released(client, commanded)
        self._end_control(client, "the connection has ended")
        if self._unreleased.pop(client) is not None:
            self._reconnects.connection_ended(client.user, commanded, self._now_ns(), released=released)
        self.suppression.end_of(client, lambda topic: False)

    def rights_changed(self, client: LeaseClient) -> None:
        """Apply changed rights: control ends without the right to it; a new level has other speed limits."""
        decision = client.permit.decide(Operation.CONTROL, ROBOT)
        if not decision.allowed:
            self._end_control(client, decision.reason)
        elif self.lease.held_by(client) or self.lease.pending_for(client):
            self._send_grant(client, "the level has changed").addErrback(self._level_not_confirmed)
        self.suppression.end_of(client, lambda topic: client.permit.decide(Operation.INHIBIT, topic).allowed)
        self.changes.changed()

    def _level_not_confirmed(self, failure: Any) -> None:
        self.log.warn(
            "{robot} has not confirmed the new level: {why}", robot=self.robot.full, why=failure.value
        )


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


def _released(client: LeaseClient, commanded: int) -> bool:
    """Whether a client that has left is known to have released the controls.

    :param commanded: when it sent its latest command, nanoseconds
    """
    alive = client.last_alive_while_driving()
    return alive == inf or _ns(alive) - commanded >= HELD_NS


def _ignore_failure(failure: Any) -> None:
    """Ignore that a revocation sent as a precaution did not arrive."""
