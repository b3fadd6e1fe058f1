"""Which desk of a session does what a client asks for, what of it is bounded, and what has to be answered."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import partial
from typing import TYPE_CHECKING, Any

from twisted.logger import Logger

from relay_protocol import json_cost, jsontext, rosbridge
from relay_protocol.errors import MalformedMessage, PeerError, Refused, SwitchboardError
from relay_protocol.json_cost import TooCostly
from relay_protocol.limits import KIB
from relay_protocol.nonfinite import NotFinite
from relay_protocol.rights import Operation
from relay_server.access import BadCredentials, Permit
from relay_server.channels.channel import Channel
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.encodings import PLAIN, TOO_COSTLY, MessageEncoding, frames
from relay_server.channels.goals import GoalStatusCode
from relay_server.channels.samples import Sample
from relay_server.common import close_codes
from relay_server.common.clock import Clock
from relay_server.common.cpu_quota import UserQuota
from relay_server.common.send_queue import DATA_PER_TOPIC, SendQueue
from relay_server.common.timers import PeriodicTimers
from relay_server.common.token_bucket import TokenBucket
from relay_server.control.controller import RobotController
from relay_server.robots.link_quality import LinkQuality
from relay_server.robots.registry import RobotState
from relay_server.sessions.advertisements import AdvertisementHandler
from relay_server.sessions.fragments import FragmentAssembler
from relay_server.sessions.goals import ActionGoalHandler
from relay_server.sessions.keepalive import Keepalive
from relay_server.sessions.message_age import MessageAge
from relay_server.sessions.ports import ActivityListener, ClientTransport, LocalNode, Timing, ignore_activity
from relay_server.sessions.publishing import PublishHandler
from relay_server.sessions.service_calls import ServiceCallHandler, is_urgent
from relay_server.sessions.session_quota import SessionQuota
from relay_server.sessions.subscriptions import SubscriptionHandler

if TYPE_CHECKING:
    pass

LEVELS = {"info": 0, "warning": 1, "error": 2, "none": 3}
LINES_A_SECOND = 1.0
LINES_AT_ONCE = 20.0
"""Lines of the log one client's refusals may cause."""

SMALL = 4 * KIB
"""Shorter messages take little time to read. That of publishing them is not counted."""

MALFORMED = 100
"""Messages in a row that are no rosbridge; then the client is cut."""


def thin_words(rate: float) -> str:
    """Why a client does not get all samples, and what it can do.

    :param rate: bytes per second its connection carries
    """
    return (
        f"your connection carries about {rate / 1000:.0f} kB/s; subscribe with a throttle_rate, a smaller "
        "compression (cbor) or queue_length 1, or to fewer topics"
    )


class Session:
    """See the module's text.

    :param number: of this client; no other of this relay has it
    :param address: where the client is, for people
    :param since: Unix time it came
    :param ended: called once when it is over
    """

    log = Logger()
    incoming: FragmentAssembler
    listening: SubscriptionHandler
    publishing: PublishHandler
    calling: ServiceCallHandler
    pursuing: ActionGoalHandler
    providing: AdvertisementHandler

    def __init__(
        self,
        clock: Clock,
        transport: ClientTransport,
        permit: Permit,
        robot: RobotState,
        channel: Channel,
        desk: RobotController,
        local: LocalNode,
        freshness: MessageAge,
        timing: Timing,
        rounds: PeriodicTimers,
        allowance: UserQuota,
        *,
        number: int,
        address: str,
        since: float,
        ended: Callable[[Session], None],
    ) -> None:
        self.number = number
        self.permit = permit
        self.robot = robot
        self.channel = channel
        self.desk = desk
        self.address = address
        self.since = since
        self.allowance = allowance
        self.refusals = 0
        self.plain_instead = 0
        self.queued_bytes = 0
        self.notice: ActivityListener = ignore_activity
        self.share = SessionQuota(self)
        self._clock = clock
        self.opened = clock.seconds()
        self._transport = transport
        self._freshness = freshness
        self._ended = ended
        self._level = LEVELS["none"]
        self.changes = TokenBucket(CHANGES_A_SECOND, CHANGES_AT_ONCE, clock.seconds)
        self._noise = TokenBucket(LINES_A_SECOND, LINES_AT_ONCE, clock.seconds)
        self._malformed = 0
        self._closed = False
        self.outbox = SendQueue(transport.send, clock.seconds, self._overflow)
        self.outbox.on_drop = self._sample_dropped
        self._rounds = rounds
        self._pinging = Keepalive(self, clock, transport, freshness, timing)
        tell = partial(self.tell, "error")
        self.incoming = FragmentAssembler(
            clock, lambda: freshness.not_before, self._joined, tell, timing.largest_message
        )
        self.listening = SubscriptionHandler(self, clock, local, rounds)
        self.publishing = PublishHandler(self, freshness)
        self.calling = ServiceCallHandler(self, local)
        self.pursuing = ActionGoalHandler(self)
        self.providing = AdvertisementHandler(self)
        permit.on_change = self._rights_changed
        permit.on_revoke = self._revoked

    @property
    def user(self) -> int:
        """Whose it is."""
        return self.permit.principal.user_id

    @property
    def name(self) -> str:
        """What the user is called at this robot."""
        return self.robot.name_of(self.permit.principal.name, self.permit.principal.realm)

    @property
    def stale_commands(self) -> int:
        """Commands dropped because they could have been too old."""
        return self.publishing.stale_commands

    @property
    def rtt(self) -> float | None:
        """Round trip to the client by websocket ping, seconds."""
        return None if self._freshness.rtt is None else self._freshness.rtt / 1e9

    @property
    def drops(self) -> int:
        """Samples the client did not take in time."""
        return self.outbox.dropped

    def reading(self) -> LinkQuality:
        """How good the way to the client is."""
        return self._freshness.reading()

    def start(self) -> None:
        """Begin: take a place on the channel, start pinging."""
        self.channel.attach(self)
        self._pinging.start(self._rounds)
        self.log.info(
            "client {number}: {user} from {address} works with {robot}",
            number=self.number,
            user=self.permit.principal.full,
            address=self.address,
            robot=self.robot.full,
        )

    def end(self, *, orderly: bool = False) -> None:
        """The transport is gone; give everything back.

        :param orderly: the client has closed it
        """
        if self._closed:
            return
        self._closed = True
        self.outbox.close()
        self._pinging.end()
        # Before what it asked for is given back: nothing of this client moves the robot any more.
        self.desk.left(self, orderly=orderly)
        self.incoming.end()
        self.listening.end()
        self.calling.end()
        self.pursuing.end()
        self.channel.detach(self)
        self._ended(self)

    def close(self, code: int, reason: str) -> None:
        """Close the transport with a code and a reason in words, and end."""
        if not self._closed:
            self.log.info("client {number} is cut: {reason}", number=self.number, reason=reason)
            self._transport.close(code, reason)
            self.end()

    # --- from the transport -------------------------------------------------------------------------------

    def _joined(self, data: bytes, since: int) -> None:
        """A message that came in fragments, the first of which can't have been sent before ``since``."""
        self.message(data, joined=True, since=since)

    @property
    def not_before(self) -> int:
        """What the client says now can't have been sent before this moment, the relay's monotonic nanoseconds."""
        return self._freshness.not_before

    def message(self, data: bytes, *, joined: bool = False, since: int | None = None) -> None:
        """One message of the client.

        :param joined: whether it came in fragments
        :param since: a moment before which its beginning can't have been sent, where other things came in between
        """
        if self._closed:
            return
        if since is not None and since < self._freshness.not_before:
            with self._freshness.as_of(since):
                self.message(data, joined=joined)
            return
        if len(data) > SMALL and not self.share.counting:
            # Even to read it takes time.
            with self.share.timed():
                self.message(data, joined=joined)
            return
        try:
            if len(data) > json_cost.COUNTED:
                self.share.check()
            operation = rosbridge.decode(data)
            if joined and isinstance(operation, rosbridge.Fragment):
                raise MalformedMessage("a message in fragments can't be a fragment itself")
        except (PeerError, NotFinite, TooCostly, Refused) as error:
            self._no_rosbridge(error, data)
            return
        try:
            if type(operation) is rosbridge.Publish:
                # Nearly all that clients send: not counted, not a change, no table to look into.
                self._malformed = 0
                if self.share.counting:
                    self.share.check()
                self.publishing.publish(operation)
                return
            if not isinstance(operation, rosbridge.Fragment):
                # What it is a part of has yet to show.
                self._malformed = 0
            perform(self, operation)
        except SwitchboardError as error:
            self.refuse(operation, error)
            self.share.refused()

    def do(self, operation: rosbridge.ClientOp, since: int | None) -> None:
        """What a client asks for that lives in the relay: as :meth:`message`, but what is refused is raised.

        :param since: a moment before which it can't have been asked for, where it may be older than a message would be
        :raises SwitchboardError: it is refused
        """
        with self._freshness.as_of(self._freshness.not_before if since is None else since):
            try:
                if isinstance(operation, rosbridge.Publish):
                    self.share.check()
                    self.publishing.publish(operation)
                else:
                    perform(self, operation)
            except SwitchboardError:
                self.refusals += 1
                self.share.refused()
                raise

    def _no_rosbridge(self, error: SwitchboardError, data: bytes) -> None:
        # What is too much, or NaN in the wrong place, is no message that is none.
        self._malformed += isinstance(error, PeerError)
        if not self.share.counting:
            self.share.refused()
        if isinstance(error, PeerError) and self._malformed == 1 and self._noise.take():
            self.log.info(
                "client {number} sent what is not rosbridge: {reason}", number=self.number, reason=str(error)
            )
        id, request = rosbridge.unreadable(data)
        self.tell("error", str(error), id)
        if request is not None:
            answer_failed(self, request, error)
        if self._malformed >= MALFORMED:
            words = f"{MALFORMED} messages in a row were not rosbridge: {error}"
            self.close(close_codes.TOO_MANY_ERRORS, words[:120])

    def pong(self, payload: bytes) -> None:
        """The client answered a ping."""
        self._freshness.pong(payload)

    def pause(self) -> None:
        """The transport's buffer is full."""
        self.outbox.pause()

    def resume(self) -> None:
        """The transport takes bytes again."""
        self.outbox.resume()

    # --- to the client ------------------------------------------------------------------------------------

    def deliver(self, listener: ClientSubscription, parcel: Sample) -> None:
        """Queue a message of a topic, opened when its turn comes."""
        outbox = self.outbox
        if not outbox.passing:
            outbox.data(listener, parcel, listener.depth or DATA_PER_TOPIC)
        elif (frames := parcel.open(listener)) is not None:
            outbox.write(frames)

    def dropped(self, listener: ClientSubscription) -> None:
        """Count a sample that gave way before it was queued here."""
        self.outbox.count_drop(listener)

    def say(self, message: bytes, form: MessageEncoding = PLAIN) -> None:
        """Queue a message that must not be lost.

        :param message: JSON
        """
        self.outbox.control(self.framed(message, form))

    def framed(self, message: bytes, form: MessageEncoding) -> bytes:
        """The websocket frames of a message, in a costly form only while the user has a share of the processor left.

        :param message: JSON
        """
        if form == PLAIN:
            return frames(message)
        if not self.allowance.may_form:
            self.plain_instead += 1
            if self._noise.take():
                self.tell("warning", TOO_COSTLY)
            return frames(message)
        with self.allowance.forming():
            return frames(message, form)

    def tell(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """A status, if the client asked for that level (roslibpy breaks on any it did not ask for)."""
        if LEVELS[level] >= self._level and self._level < LEVELS["none"]:
            self.say(rosbridge.status(level, text, id))

    def refuse(self, operation: rosbridge.ClientOp, error: SwitchboardError) -> None:
        """Tell the client that something it asked for is not done, and why."""
        self.refusals += 1
        if self._noise.take():
            # No more of one client than a disk can bear; all are counted in /relay/status.
            what = type(operation).__name__
            self.log.info(
                "client {number}: {what} refused: {reason}", number=self.number, what=what, reason=str(error)
            )
        self.tell("error", str(error), operation.id)
        answer_failed(self, operation, error)

    def ping(self) -> None:
        """Ping the client now: what it says after it has read what it was told before counts as said after that."""
        if not self._closed:
            self._pinging.ping()

    def judge_again(self) -> None:
        """The robot's topics or cameras are others: what is subscribed is judged anew."""
        self.listening.judge_again()

    def driving_since(self) -> float:
        """The clock's time of its latest command that moves; now, while something it asked for moves the robot."""
        return self._ago(self.publishing.idle_ns)

    def commanding_since(self) -> float:
        """The same for its latest command, were it a zero or one that did not pass."""
        return self._ago(self.publishing.silent_ns)

    def heard_driving(self) -> float:
        """The clock's time at which it last answered a ping; endless if it let go of all it commanded."""
        if not self.publishing.holds_on:
            return float("inf")
        if not self._transport.vouches:
            return self.driving_since()
        return self._clock.seconds() - self._freshness.silence() / 1e9

    def _ago(self, nanoseconds: int) -> float:
        return self._clock.seconds() - (0 if self.pursuing.moving else nanoseconds / 1e9)

    def control_changed(self) -> None:
        """Who moves the robot has changed."""
        self.publishing.control_changed()

    def judge(self, operation: Operation, resource: str) -> None:
        """:raises Refused: the client may not do this to that resource of the robot, with the reason"""
        verdict = self.permit.judge(operation, resource)
        if not verdict.allowed:
            raise Refused(verdict.reason)

    # --- the rest -----------------------------------------------------------------------------------------

    def set_level(self, ask: rosbridge.SetLevel) -> None:
        """From now on the client is told of this and what is worse.

        :raises Refused: there is no such level
        """
        if ask.level not in LEVELS:
            raise Refused(f"level '{ask.level[:20]}' is none of {', '.join(LEVELS)}")
        self._level = LEVELS[ask.level]

    def _sample_dropped(self, key: Hashable) -> None:
        rate = self.outbox.rate
        if rate is not None and isinstance(key, ClientSubscription):
            key.too_slow(thin_words(rate))

    def _overflow(self) -> None:
        self.close(close_codes.TOO_SLOW, "replies pile up; read faster")

    def _rights_changed(self) -> None:
        self.listening.judge_again()
        self.desk.rights_changed(self)
        self.calling.rights_changed()
        self.pursuing.rights_changed()
        self.channel.forget_denied(self, self.permit)
        self._pinging.rights_changed()

    def _revoked(self, error: Refused) -> None:
        code = close_codes.UNAUTHENTICATED if isinstance(error, BadCredentials) else close_codes.FORBIDDEN
        self.close(code, str(error))


_REFUSED_WHEN_BUSY = {
    rosbridge.Subscribe,
    rosbridge.Advertise,
    rosbridge.AdvertiseService,
    rosbridge.AdvertiseAction,
    rosbridge.CallService,
    rosbridge.SendActionGoal,
}
"""What asks for work. What takes back, cancels or answers is always done."""

_CHANGES = {
    rosbridge.Subscribe,
    rosbridge.Unsubscribe,
    rosbridge.Advertise,
    rosbridge.Unadvertise,
    rosbridge.AdvertiseService,
    rosbridge.UnadvertiseService,
    rosbridge.AdvertiseAction,
    rosbridge.UnadvertiseAction,
    rosbridge.SetLevel,
}
"""What one client may ask for only so many times. Messages and calls are not counted."""

CHANGES_A_SECOND = 50.0
CHANGES_AT_ONCE = 1000.0


def _auth(session: Session, ask: rosbridge.Auth) -> None:
    """Authenticated already; rosauth clients send it on every connection."""


_HANDLERS: dict[type, Callable[[Session, Any], None]] = {
    rosbridge.Subscribe: lambda session, ask: session.listening.subscribe(ask),
    rosbridge.Unsubscribe: lambda session, ask: session.listening.unsubscribe(ask),
    rosbridge.Advertise: lambda session, ask: session.publishing.advertise(ask),
    rosbridge.Unadvertise: lambda session, ask: session.publishing.unadvertise(ask),
    rosbridge.CallService: lambda session, ask: session.calling.call(ask),
    rosbridge.AdvertiseService: lambda session, ask: session.providing.advertise_service(ask),
    rosbridge.UnadvertiseService: lambda session, ask: session.providing.unadvertise_service(ask),
    rosbridge.ServiceResponse: lambda session, ask: session.providing.service_response(ask),
    rosbridge.AdvertiseAction: lambda session, ask: session.providing.advertise_action(ask),
    rosbridge.UnadvertiseAction: lambda session, ask: session.providing.unadvertise_action(ask),
    rosbridge.ActionFeedback: lambda session, ask: session.providing.action_feedback(ask),
    rosbridge.ActionResult: lambda session, ask: session.providing.action_result(ask),
    rosbridge.SendActionGoal: lambda session, ask: session.pursuing.send_goal(ask),
    rosbridge.CancelActionGoal: lambda session, ask: session.pursuing.cancel(ask),
    rosbridge.Fragment: lambda session, part: session.incoming.take(part),
    rosbridge.SetLevel: lambda session, ask: session.set_level(ask),
    rosbridge.Auth: _auth,
}
"""All but ``publish``, which is nearly all that clients send and takes a shorter way."""


def perform(session: Session, operation: rosbridge.ClientOp) -> None:
    """Have the desk that is concerned do what the client asks for, on the user's account.

    :raises Refused: there is none, it is too much at once, or the desk says so
    :raises SwitchboardError: whatever else keeps the desk from doing it
    """
    kind = type(operation)
    handler = _HANDLERS.get(kind)
    if handler is None:
        raise Refused(f"'{operation.__struct_config__.tag}' is not carried to robots by this relay")
    if kind in _CHANGES and not session.changes.take():
        raise Refused(f"too many changes at once; at most {CHANGES_A_SECOND:g} a second are followed")
    if kind in _REFUSED_WHEN_BUSY and not is_urgent(operation):
        session.share.check()
    with session.share.timed():
        handler(session, operation)


def answer_failed(session: Session, operation: rosbridge.ClientOp, error: Exception) -> None:
    """Answer what has to be answered, with the reason why it is not done; nobody may wait in vain."""
    if isinstance(operation, rosbridge.CallService):
        session.calling.answer(operation, False, jsontext.encode(str(error)))
    elif isinstance(operation, rosbridge.SendActionGoal):
        session.pursuing.answer(operation, GoalStatusCode.NEVER_BEGAN, False, jsontext.encode(str(error)))
