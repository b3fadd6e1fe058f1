"""One connected client of one robot: what it may, what it subscribed to, what it offers.

Bytes come in as whole websocket messages and go out the same way; every message is judged here before anything
else sees it.
"""

from __future__ import annotations

import itertools
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, Protocol

from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import PeerError, Refused, SwitchboardError, Unavailable
from relay_protocol.limits import MIB
from relay_protocol.rights import Level, Operation
from relay_protocol.ros.definition import normalise
from relay_server import closing
from relay_server.access import Permit
from relay_server.bucket import TokenBucket
from relay_server.channel import Channel, resolve
from relay_server.channel.publications import HELD_SECONDS
from relay_server.channel.topics import Listener
from relay_server.clock import Clock, looping
from relay_server.freshness import Freshness
from relay_server.outbox import Outbox
from relay_server.registry import Presence

LEVELS = {"info": 0, "warning": 1, "error": 2, "none": 3}
SUBSCRIPTIONS = 1024
CALLS = 256
CALL_BYTES = 2 * MIB
"""Arguments of calls that wait, over all of them."""

CHANGES_A_SECOND = 50.0
CHANGES_AT_ONCE = 1000.0
"""Subscriptions, advertisements and their ends one client may ask for; messages and calls are not counted."""

LINES_A_SECOND = 1.0
LINES_AT_ONCE = 20.0
"""Lines of the log one client's refusals may cause."""

MALFORMED = 100
"""Messages in a row that are no rosbridge; then the client is cut."""

_numbers = itertools.count(1)


class ClientTransport(Protocol):
    """The websocket under a session."""

    def send(self, message: bytes) -> None:
        """One text message."""

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
        self.stale_commands = 0
        self.refusals = 0
        self._clock = clock
        self._transport = transport
        self._local = local
        self._freshness = freshness
        self._timing = timing
        self._ended = ended
        self._level = LEVELS["none"]
        self._listeners: dict[str, Listener] = {}
        self._calls: set[Deferred[None]] = set()
        self._call_bytes = 0
        self._changes = TokenBucket(CHANGES_A_SECOND, CHANGES_AT_ONCE, clock.seconds)
        self._noise = TokenBucket(LINES_A_SECOND, LINES_AT_ONCE, clock.seconds)
        self._malformed = 0
        self._closed = False
        self.outbox = Outbox(transport.send, clock.seconds, self._overflow)
        self._pinging = looping(clock, self._ping)
        self._telling = looping(clock, self._publish_local)
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
    def rtt(self) -> float | None:
        """Round trip to the client by websocket ping, seconds."""
        return None if self._freshness.rtt is None else self._freshness.rtt / 1e9

    def start(self) -> None:
        """Begin: take a place on the channel, start pinging."""
        self.channel.attach(self)
        self._pinging.start(self._ping_interval(), now=True)
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
        for loop in (self._pinging, self._telling):
            if loop.running:
                loop.stop()
        for listener in self._listeners.values():
            listener.close()
        # Nobody is left to hear the answers, and their places are wanted by others.
        for call in list(self._calls):
            call.cancel()
        self.channel.detach(self)
        self._ended(self)

    def close(self, code: int, reason: str) -> None:
        """Close the transport with a code and a reason in words, and end."""
        if not self._closed:
            self.log.info("client {number} is cut: {reason}", number=self.number, reason=reason)
            self._transport.close(code, reason)
            self.end()

    # --- from the transport -------------------------------------------------------------------------------

    def message(self, data: bytes) -> None:
        """One message of the client."""
        if self._closed:
            return
        try:
            operation = rosbridge.decode(data)
        except PeerError as error:
            self._malformed += 1
            if self._malformed == 1:
                self.log.info(
                    "client {number} sent what is not rosbridge: {reason}",
                    number=self.number,
                    reason=str(error),
                )
            self.tell("error", str(error))
            if self._malformed >= MALFORMED:
                self.close(
                    closing.TOO_MANY_ERRORS,
                    f"{MALFORMED} messages in a row were not rosbridge: {error}"[:120],
                )
            return
        self._malformed = 0
        try:
            handler = _HANDLERS.get(type(operation))
            if handler is None:
                raise Refused("services offered by clients are not carried to robots by this relay")
            if type(operation) in _CHANGES and not self._changes.take():
                raise Refused(f"too many changes at once; at most {CHANGES_A_SECOND:g} a second are followed")
            handler(self, operation)
        except SwitchboardError as error:
            self._refuse(operation, error)

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

    def deliver(self, topic: str, payload: bytes, depth: int) -> None:
        """Queue a sample of a topic."""
        if depth:
            self.outbox.data(topic, payload, depth)
        else:
            self.outbox.data(topic, payload)

    def tell(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """A status, if the client asked for that level (roslibpy breaks on any it did not ask for)."""
        if LEVELS[level] >= self._level and self._level < LEVELS["none"]:
            self.outbox.control(rosbridge.status(level, text, id))

    def _refuse(self, operation: rosbridge.ClientOp, error: SwitchboardError) -> None:
        self.refusals += 1
        if self._noise.take():
            # No more of one client than a disk can bear; all are counted in /relay/status.
            what = type(operation).__name__
            self.log.info(
                "client {number}: {what} refused: {reason}", number=self.number, what=what, reason=str(error)
            )
        self.tell("error", str(error), operation.id)
        if isinstance(operation, rosbridge.CallService):
            self._answer(operation, False, jsontext.encode(str(error)))

    def _answer(self, call: rosbridge.CallService, result: bool, values: bytes) -> None:
        self.outbox.control(rosbridge.service_response(call.service, call.id, result, values))

    def _judge(self, operation: Operation, resource: str) -> None:
        verdict = self.permit.judge(operation, resource)
        if not verdict.allowed:
            raise Refused(verdict.reason)

    # --- topics out ---------------------------------------------------------------------------------------

    def _subscribe(self, ask: rosbridge.Subscribe) -> None:
        topic = resolve(ask.topic)
        self._judge(Operation.SUBSCRIBE, topic)
        if ask.compression not in ("none", ""):
            self.tell(
                "warning", f"compression {ask.compression} is not served; {topic} comes as plain JSON", ask.id
            )
        listener = self._listeners.get(topic)
        if listener is None:
            if len(self._listeners) >= SUBSCRIPTIONS:
                raise Refused(f"at most {SUBSCRIPTIONS} topics can be subscribed on one connection")
            listener = Listener(self._clock, self, ask.topic)
        if self._local.topic(topic) is not None:
            listener.add(ask)
            self._listeners[topic] = listener
            if not self._telling.running:
                self._telling.start(1.0, now=True)
            return
        self.channel.subscriptions.check(topic, normal_type(ask.type))
        listener.add(ask)
        self.channel.subscriptions.add(self, listener, normal_type(ask.type), ask.qos)
        self._listeners[topic] = listener

    def _unsubscribe(self, ask: rosbridge.Unsubscribe) -> None:
        topic = resolve(ask.topic)
        listener = self._listeners.get(topic)
        if listener is None:
            return
        if ask.id is not None and listener.remove(ask.id):
            if self._local.topic(topic) is None:
                self.channel.subscriptions.add(self, listener, "", None)
            return
        self._drop(topic)

    def _drop(self, topic: str) -> None:
        listener = self._listeners.pop(topic)
        listener.close()
        self.outbox.forget(listener.name)
        self.channel.subscriptions.remove(self, topic)

    def _publish_local(self) -> None:
        makers = [(name, self._local.topic(name)) for name in self._listeners]
        for name, make in makers:
            if make is not None:
                body = jsontext.encode(make(self))
                listener = self._listeners[name]
                self.deliver(listener.name, rosbridge.publish(listener.name, body), 1)
        if not any(make for _, make in makers):
            self._telling.stop()

    # --- topics in ----------------------------------------------------------------------------------------

    def _advertise(self, ask: rosbridge.Advertise) -> None:
        self._judge(Operation.PUBLISH, resolve(ask.topic))
        self.channel.publications.advertise(self, ask, normal_type(ask.type))

    def _unadvertise(self, ask: rosbridge.Unadvertise) -> None:
        self.channel.publications.unadvertise(self, resolve(ask.topic), ask.id)

    def _publish(self, ask: rosbridge.Publish) -> None:
        topic = resolve(ask.topic)
        self._judge(Operation.PUBLISH, topic)
        if self.robot.control is None:
            raise Unavailable(f"robot {self.robot.name} is offline; the message was dropped")
        publication = self.channel.publications.get(self, topic, normal_type(ask.type))
        good_for = HELD_SECONDS
        if self.robot.is_motion(topic, publication.type):
            age_ms = self._freshness.age() / 1e6
            deadline_ms = self.robot.description.motion.deadline_ms
            if age_ms > deadline_ms:
                self.stale_commands += 1
                self.tell(
                    "warning",
                    f"a command to {topic} was dropped: it may be {age_ms:.0f} ms old, by the last ping "
                    f"answered; the robot takes none older than {deadline_ms} ms",
                    ask.id,
                )
                return
            good_for = (deadline_ms - age_ms) / 1000

        def failed(reason: str) -> None:
            self.tell("error", reason, ask.id)

        stamp = self._freshness.not_before
        self.channel.publications.publish(self, publication, bytes(ask.msg), stamp, failed, good_for)

    # --- services -----------------------------------------------------------------------------------------

    def _call(self, ask: rosbridge.CallService) -> None:
        service = resolve(ask.service)
        if len(self._calls) >= CALLS:
            raise Refused(f"{CALLS} calls of this connection are waiting already")
        raw = bytes(ask.args or b"")
        size = len(raw)
        if self._call_bytes + size > CALL_BYTES:
            raise Refused(
                "the arguments of the calls that wait already are too large together; wait for answers"
            )
        local = self._local.service(service)
        if local is None:
            self._judge(Operation.CALL, service)
            answer: Awaitable[bytes] = self.channel.call(
                service, normal_type(ask.type, "srv"), raw, ask.timeout
            )
        else:
            args = jsontext.decode_any(raw) if raw else {}
            answer = self._call_local(local, args)
        running = Deferred.fromCoroutine(self._finish(ask, answer))
        self._calls.add(running)
        self._call_bytes += size
        running.addErrback(self._unexpected, ask)
        running.addBoth(self._call_ended, running, size)

    def _call_ended(self, _: Any, running: Deferred[None], size: int) -> None:
        self._calls.discard(running)
        self._call_bytes -= size

    async def _call_local(self, local: Callable[[Session, Any], Awaitable[Any]], args: Any) -> bytes:
        return jsontext.encode(await local(self, args))

    async def _finish(self, ask: rosbridge.CallService, answer: Awaitable[bytes]) -> None:
        try:
            self._answer(ask, True, await answer)
        except SwitchboardError as error:
            self._refuse(ask, error)

    def _unexpected(self, failure: Any, ask: rosbridge.CallService) -> None:
        if self._closed and failure.check(CancelledError):
            return
        self.log.failure("a call of {service} failed", failure, service=ask.service)
        self._answer(ask, False, jsontext.encode("the relay failed on this call; its log tells more"))

    # --- the rest -----------------------------------------------------------------------------------------

    def _set_level(self, ask: rosbridge.SetLevel) -> None:
        if ask.level not in LEVELS:
            raise Refused(f"level '{ask.level[:20]}' is none of {', '.join(LEVELS)}")
        self._level = LEVELS[ask.level]

    def _auth(self, ask: rosbridge.Auth) -> None:
        """Authenticated already; rosauth clients send it on every connection."""

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
        for topic in list(self._listeners):
            verdict = self.permit.judge(Operation.SUBSCRIBE, topic)
            if not verdict.allowed:
                self._drop(topic)
                self.tell("error", f"unsubscribed from {topic}: {verdict.reason}")
        self.channel.publications.forget_denied(self, self.permit)
        if self._pinging.running:
            self._pinging.interval = self._ping_interval()

    def _revoked(self, reason: str) -> None:
        code = closing.FORBIDDEN if "right" in reason else closing.UNAUTHENTICATED
        self.close(code, reason)


def normal_type(name: str | None, kind: str = "msg") -> str:
    """ROS 1 habit ``pkg/Name`` becomes ``pkg/msg/Name`` (or ``srv``); empty stays empty.

    :raises Invalid: no type name
    """
    if not name:
        return ""
    package, slash, rest = name.partition("/")
    return normalise(f"{package}/{kind}/{rest}" if slash and "/" not in rest else name)


_CHANGES = {
    rosbridge.Subscribe,
    rosbridge.Unsubscribe,
    rosbridge.Advertise,
    rosbridge.Unadvertise,
    rosbridge.SetLevel,
}

_HANDLERS: dict[type, Callable[[Session, Any], None]] = {
    rosbridge.Subscribe: Session._subscribe,
    rosbridge.Unsubscribe: Session._unsubscribe,
    rosbridge.Advertise: Session._advertise,
    rosbridge.Unadvertise: Session._unadvertise,
    rosbridge.Publish: Session._publish,
    rosbridge.CallService: Session._call,
    rosbridge.SetLevel: Session._set_level,
    rosbridge.Auth: Session._auth,
}
