"""One connected client: who it is, and where each of its messages goes.

Bytes come in as whole websocket messages and go out as frames; every message is judged before anything else sees it.
"""

from __future__ import annotations

import itertools
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from twisted.logger import Logger

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import MalformedMessage, PeerError, Refused, SwitchboardError
from relay_protocol.limits import KIB
from relay_protocol.rights import Level, Operation
from relay_server import closing
from relay_server.access import Permit
from relay_server.bucket import TokenBucket
from relay_server.budget import DEBT, Allowance
from relay_server.channel import Channel
from relay_server.channel.goal import Status
from relay_server.channel.listener import Listener
from relay_server.channel.sample import Sample
from relay_server.clock import Clock
from relay_server.forms import PLAIN, TOO_COSTLY, Form, frames
from relay_server.freshness import Freshness
from relay_server.outbox import DATA_PER_TOPIC, Outbox
from relay_server.registry import Presence
from relay_server.rounds import Round, Rounds
from relay_server.session.calling import Calling
from relay_server.session.incoming import Incoming
from relay_server.session.listening import Listening
from relay_server.session.providing import Providing
from relay_server.session.publishing import Publishing
from relay_server.session.pursuing import Pursuing

LEVELS = {"info": 0, "warning": 1, "error": 2, "none": 3}
CHANGES_A_SECOND = 50.0
CHANGES_AT_ONCE = 1000.0
"""Subscriptions, advertisements, offers and their ends one client may ask for; messages and calls are not counted."""

LINES_A_SECOND = 1.0
LINES_AT_ONCE = 20.0
"""Lines of the log one client's refusals may cause."""

SMALL = 4 * KIB
"""Shorter messages take little time to read. That of publishing them is not counted."""

REFUSAL = 5e-6
"""Seconds it takes to refuse something."""

ROUND_TRIP = 150e-6
"""Seconds it takes to send a question to a robot and to hand on the answer, beside what is timed."""

MALFORMED = 100
"""Messages in a row that are no rosbridge; then the client is cut."""

_numbers = itertools.count(1)


class ClientTransport(Protocol):
    """The websocket under a session."""

    def send(self, frames: bytes) -> None:
        """One or more whole websocket frames, see :mod:`relay_server.wsframe`."""

    def ping(self, payload: bytes) -> None:
        """A websocket ping."""

    def close(self, code: int, reason: str) -> None:
        """Close with a code of :mod:`relay_server.closing`."""


class LocalNode(Protocol):
    """The relay's own services and topics in every robot's graph (``/relay/…``, ``/rosapi/…``)."""

    def service(self, name: str) -> Callable[[Session, Any], Awaitable[Any]] | None:
        """The handler of a service the relay itself offers."""

    def topic(self, name: str) -> Callable[[Session], dict[str, Any]] | None:
        """What makes the messages of a topic the relay itself publishes."""


@dataclass(frozen=True)
class Timing:
    """Times of a session, seconds; see :class:`relay_server.config.Settings`."""

    client_ping: float
    driving_ping: float
    stall_limit: float


class Session:
    """See the module's text.

    :param address: where the client is, for people
    :param since: Unix time it came
    :param ended: called once when it is over
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        transport: ClientTransport,
        permit: Permit,
        robot: Presence,
        channel: Channel,
        local: LocalNode,
        freshness: Freshness,
        timing: Timing,
        rounds: Rounds,
        allowance: Allowance,
        *,
        address: str,
        since: float,
        ended: Callable[[Session], None],
    ) -> None:
        self.number = next(_numbers)
        self.permit = permit
        self.robot = robot
        self.channel = channel
        self.address = address
        self.since = since
        self.allowance = allowance
        self.refusals = 0
        self.plain_instead = 0
        self.queued_bytes = 0
        self._counting = False
        self._clock = clock
        self._transport = transport
        self._freshness = freshness
        self._timing = timing
        self._ended = ended
        self._level = LEVELS["none"]
        self._changes = TokenBucket(CHANGES_A_SECOND, CHANGES_AT_ONCE, clock.seconds)
        self._noise = TokenBucket(LINES_A_SECOND, LINES_AT_ONCE, clock.seconds)
        self._malformed = 0
        self._closed = False
        self.outbox = Outbox(transport.send, clock.seconds, self._overflow)
        self._rounds = rounds
        self._pinging: Round | None = None
        self.incoming = Incoming(clock, lambda: freshness.not_before, self._joined, self._given_up)
        self.listening = Listening(self, clock, local, rounds)
        self.publishing = Publishing(self, freshness)
        self.calling = Calling(self, local)
        self.pursuing = Pursuing(self)
        self.providing = Providing(self)
        permit.on_change = self._rights_changed
        permit.on_revoke = self._revoked

    @property
    def user(self) -> int:
        """Whose it is."""
        return self.permit.principal.user_id

    @property
    def name(self) -> str:
        """The user's name."""
        return self.permit.principal.name

    @property
    def stale_commands(self) -> int:
        """Commands dropped because they could have been too old."""
        return self.publishing.stale_commands

    @property
    def rtt(self) -> float | None:
        """Round trip to the client by websocket ping, seconds."""
        return None if self._freshness.rtt is None else self._freshness.rtt / 1e9

    def start(self) -> None:
        """Begin: take a place on the channel, start pinging."""
        self.channel.attach(self)
        self._pinging = Round(self._ping, self._ping_interval())
        self._rounds.start(self._pinging)
        self.log.info(
            "client {number}: {user} from {address} works with {robot}",
            number=self.number,
            user=self.name,
            address=self.address,
            robot=self.robot.name,
        )

    def end(self) -> None:
        """The transport is gone; give everything back."""
        if self._closed:
            return
        self._closed = True
        self.outbox.close()
        if self._pinging is not None:
            self._pinging.stop()
        self.incoming.end()
        self.listening.end()
        self.calling.end()
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
        if len(data) > SMALL and not self._counting:
            # Even to read it takes time.
            self._count(self.message, data, joined=joined)
            return
        try:
            operation = rosbridge.decode(data)
            if joined and isinstance(operation, rosbridge.Fragment):
                raise MalformedMessage("a message in fragments can't be a fragment itself")
        except PeerError as error:
            self._no_rosbridge(error, data)
            return
        try:
            if type(operation) is rosbridge.Publish:
                # Nearly all that clients send: not counted, not a change, no table to look into.
                self._malformed = 0
                if self._counting:
                    self._check_budget()
                self.publishing.publish(operation)
                return
            if not isinstance(operation, rosbridge.Fragment):
                # What it is a part of has yet to show.
                self._malformed = 0
            handler = _HANDLERS.get(type(operation))
            if handler is None:
                raise Refused(f"'{operation.__struct_config__.tag}' is not carried to robots by this relay")
            if type(operation) in _CHANGES and not self._changes.take():
                raise Refused(f"too many changes at once; at most {CHANGES_A_SECOND:g} a second are followed")
            if type(operation) in _REFUSED_WHEN_BUSY:
                self._check_budget()
            self._count(handler, self, operation)
        except SwitchboardError as error:
            self.refuse(operation, error)
            self._spent(REFUSAL)

    def _no_rosbridge(self, error: PeerError, data: bytes) -> None:
        self._malformed += 1
        self._spent(0.0 if self._counting else REFUSAL)
        if self._malformed == 1 and self._noise.take():
            self.log.info(
                "client {number} sent what is not rosbridge: {reason}", number=self.number, reason=str(error)
            )
        request = rosbridge.unreadable_request(data)
        self.tell("error", str(error), None if request is None else request.id)
        if request is not None:
            self._fail(request, error)
        if self._malformed >= MALFORMED:
            self.close(
                closing.TOO_MANY_ERRORS,
                f"{MALFORMED} messages in a row were not rosbridge: {error}"[:120],
            )

    # --- its share of the processor -----------------------------------------------------------------------

    def _check_budget(self) -> None:
        """:raises Refused: the user has used up his share of the processor"""
        if self.allowance.requests.left <= 0:
            raise Refused(
                "too much at once: your share of the relay's processor is used up; try again in a moment"
            )

    def _count(self, work: Callable[..., None], *args: Any, **more: Any) -> None:
        """Do some work on the user's account. What is done within it is counted along."""
        with self._counted():
            work(*args, **more)

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Around work for the client that is done later than its message is handled.

        :raises Refused: the user has used up his share of the processor
        """
        self._check_budget()
        with self._counted():
            yield

    async def own_turn(self) -> None:
        """Wait for a turn of the reactor in which nobody else's answer is made, unless the message is still handled.

        Many may wait for the same word of a robot; it must not take all of their work at once.
        """
        if not self._counting:
            await self.channel.line.turn()

    def asks_robot(self) -> None:
        """A question goes to the robot: what its way there and back takes is counted."""
        self._spent(ROUND_TRIP)

    @contextmanager
    def _counted(self) -> Iterator[None]:
        if self._counting:
            yield
            return
        self._counting = True
        began = self.allowance.worked()
        try:
            yield
        finally:
            self._counting = False
            self._spent(self.allowance.worked() - began)

    def _spent(self, work: float) -> None:
        requests = self.allowance.requests
        requests.spend(work)
        if requests.left < -DEBT:
            self.close(
                closing.TOO_MANY_ERRORS, "far too much at once: more than the relay can do beside its work"
            )

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

    def deliver(self, listener: Listener, parcel: Sample) -> None:
        """Queue a message of a topic, opened when its turn comes."""
        outbox = self.outbox
        if outbox.passing:
            frames = parcel.open(listener)
            if frames is not None:
                outbox.write(frames)
        else:
            outbox.data(listener, parcel, listener.depth or DATA_PER_TOPIC)

    def dropped(self, listener: Listener) -> None:
        """Count a sample that gave way before it was queued here."""
        self.outbox.count_drop(listener)

    def say(self, message: bytes, form: Form = PLAIN) -> None:
        """Queue a message that must not be lost.

        :param message: JSON
        """
        self.outbox.control(self.framed(message, form))

    def framed(self, message: bytes, form: Form) -> bytes:
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
        self._fail(operation, error)

    def _fail(self, operation: rosbridge.ClientOp, error: Exception) -> None:
        """Answer what has to be answered; nobody may wait in vain."""
        if isinstance(operation, rosbridge.CallService):
            self.calling.answer(operation, False, jsontext.encode(str(error)))
        elif isinstance(operation, rosbridge.SendActionGoal):
            self.pursuing.answer(operation, Status.NEVER_BEGAN, False, jsontext.encode(str(error)))

    def judge(self, operation: Operation, resource: str) -> None:
        """:raises Refused: the client may not do this to that resource of the robot, with the reason"""
        verdict = self.permit.judge(operation, resource)
        if not verdict.allowed:
            raise Refused(verdict.reason)

    # --- the rest -----------------------------------------------------------------------------------------

    def _set_level(self, ask: rosbridge.SetLevel) -> None:
        if ask.level not in LEVELS:
            raise Refused(f"level '{ask.level[:20]}' is none of {', '.join(LEVELS)}")
        self._level = LEVELS[ask.level]

    def _auth(self, ask: rosbridge.Auth) -> None:
        """Authenticated already; rosauth clients send it on every connection."""

    def _given_up(self, reason: str, id: rosbridge.Id) -> None:
        self.tell("error", reason, id)

    def _ping_interval(self) -> float:
        only_watches = all(
            grant.level is Level.VIEWER and not grant.allow for grant in self.permit.rules.grants
        )
        return self._timing.client_ping if only_watches else self._timing.driving_ping

    def _ping(self) -> None:
        silent = self._freshness.silence() / 1e9
        if silent > max(self._timing.client_ping * 3, self._timing.stall_limit):
            self.close(closing.TOO_SLOW, f"no answer to pings for {silent:.0f} s")
            return
        paused = self.outbox.paused_since
        if paused is not None and self._clock.seconds() - paused > self._timing.stall_limit:
            self.close(closing.TOO_SLOW, f"nothing was taken for {self._timing.stall_limit:g} s")
            return
        self._transport.ping(self._freshness.ping())

    def _overflow(self) -> None:
        self.close(closing.TOO_SLOW, "replies pile up; read faster")

    def _rights_changed(self) -> None:
        self.listening.rights_changed()
        self.calling.rights_changed()
        self.pursuing.rights_changed()
        self.channel.forget_denied(self, self.permit)
        if self._pinging is not None:
            self._pinging.interval = self._ping_interval()

    def _revoked(self, reason: str) -> None:
        code = closing.FORBIDDEN if "right" in reason else closing.UNAUTHENTICATED
        self.close(code, reason)


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
    rosbridge.SetLevel: Session._set_level,
    rosbridge.Auth: Session._auth,
}
