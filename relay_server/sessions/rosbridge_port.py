"""A client that speaks rosbridge over a websocket: decodes its text frames, and encodes the session's answers.

``publish`` goes straight to :class:`PublishHandler`, as it is nearly all that clients send. All other operations go to
:meth:`Session.perform`.
"""

from __future__ import annotations

from collections.abc import Hashable
from functools import partial

from twisted.logger import Logger

from relay_protocol import json_cost, rosbridge
from relay_protocol.errors import MalformedMessage, PeerError, Refused, SwitchboardError
from relay_protocol.json_cost import TooCostly
from relay_protocol.limits import KIB
from relay_protocol.nonfinite import NotFinite
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.encodings import PLAIN, TOO_COSTLY, MessageEncoding, frames, requested_encoding
from relay_server.channels.samples import Sample
from relay_server.common.send_queue import DATA_PER_TOPIC
from relay_server.sessions.fragments import FragmentAssembler
from relay_server.sessions.session import Session
from relay_server.sessions.websocket_port import WebsocketContext, WebsocketPort

LEVELS = {"info": 0, "warning": 1, "error": 2, "none": 3}

CLOSED = "closed"
"""Id of the status with the reason for which the connection is closed."""

SMALL = 4 * KIB
"""Bytes. The time to decode shorter messages, and to publish them, is not counted."""


NOT_READ = "your client does not read fast enough; subscribe with a throttle_rate or queue_length 1, or to fewer topics"


def slow_connection_advice(rate: float) -> str:
    """Text that says why samples are dropped, and which setting helps.

    :param rate: bytes per second that the connection carries
    """
    return (
        f"your connection carries about {rate / 1000:.0f} kB/s; subscribe with a throttle_rate, a smaller "
        "compression (cbor) or queue_length 1, or to fewer topics"
    )


class RosbridgePort(WebsocketPort):
    """The port of a session whose client speaks rosbridge (:class:`relay_server.sessions.ports.ClientPort`)."""

    log = Logger()

    __slots__ = ("_fragments", "_level", "_publish", "_user_quota")

    def __init__(self, context: WebsocketContext) -> None:
        super().__init__(context)
        self._level = LEVELS["none"]
        self._fragments: FragmentAssembler | None = None

    def attach(self, session: Session) -> None:
        """Set the session that carries out the client's operations; once, before :meth:`start`."""
        super().attach(session)
        self._user_quota = session.client.quota.user
        self._publish = session.publish_handler.publish

    # --- the websocket ------------------------------------------------------------------------------------

    def message(self, data: bytes, earliest_sent: int | None = None, joined: bool = False) -> None:
        """One text message of the client.

        :param earliest_sent: of its first frame, if other messages came in between; ``None``: :attr:`earliest_sent`
        :param joined: whether it came in fragments
        """
        if self.session.closed:
            return
        if earliest_sent is not None and earliest_sent < self._age.earliest_sent:
            with self._age.as_of(earliest_sent):
                self.message(data, None, joined)
            return
        quota, long = self._quota, len(data) > SMALL
        if long and not quota.being_timed:
            # Decoding a long message takes time that counts.
            with quota.timed():
                self.message(data, None, joined)
            return
        try:
            if long and len(data) > json_cost.COUNTED:
                quota.check()
            operation = rosbridge.decode(data)
            if joined and isinstance(operation, rosbridge.Fragment):
                raise MalformedMessage("a message in fragments can't be a fragment itself")
        except (PeerError, NotFinite, TooCostly, Refused) as error:
            self._unreadable(error, data)
            return
        if type(operation) is not rosbridge.Publish:
            self._perform(operation)
            return
        # Nearly all that clients send, so it skips the timing and the table of handlers.
        self._malformed = 0
        try:
            if quota.being_timed:
                quota.check()
            self._publish(operation)
        except SwitchboardError as error:
            self._client.refuse(operation, error)
            quota.count_refusal()

    # --- operations ---------------------------------------------------------------------------------------

    def _add_fragment(self, fragment: rosbridge.Fragment) -> None:
        if self._fragments is None:
            user_bytes = self._transport.unfinished
            assert user_bytes is not None
            self._fragments = FragmentAssembler(
                self._clock,
                lambda: self._age.earliest_sent,
                self._fragments_complete,
                partial(self.status, "error"),
                user_bytes,
                self._timing.largest_message,
            )
        with self._quota.timed():
            self._fragments.add(fragment)

    def _fragments_complete(self, data: bytes, earliest_sent: int) -> None:
        self.message(data, earliest_sent, joined=True)

    def _perform(self, operation: rosbridge.ClientOp) -> None:
        try:
            if isinstance(operation, rosbridge.Fragment):
                self._add_fragment(operation)
                return
            # A fragment may turn out to be part of a malformed message.
            self._malformed = 0
            if isinstance(operation, rosbridge.SetLevel):
                self._set_level(operation)
            elif not isinstance(operation, rosbridge.Auth):
                # Clients of rosauth send their token again on every connection.
                self.session.perform(operation)
        except SwitchboardError as error:
            self._client.refuse(operation, error)
            self._quota.count_refusal()

    def _set_level(self, operation: rosbridge.SetLevel) -> None:
        """:raises Refused: there is no such level"""
        self.session.count_change()
        if operation.level not in LEVELS:
            raise Refused(f"level '{operation.level[:20]}' is none of {', '.join(LEVELS)}")
        self._level = LEVELS[operation.level]

    def _unreadable(self, error: SwitchboardError, data: bytes) -> None:
        # JSON that is too costly, or NaN in the wrong place, does not count as malformed.
        self._malformed += isinstance(error, PeerError)
        if not self._quota.being_timed:
            self._quota.count_refusal()
        if isinstance(error, PeerError) and self._malformed == 1 and self._client.log_lines.take():
            self.log.info(
                "client {number} sent what is not rosbridge: {reason}",
                number=self._client.number,
                reason=str(error),
            )
        id, request = rosbridge.unreadable(data)
        self.status("error", str(error), id)
        if request is not None:
            self._client.answer_failed(request, error)
        self._close_malformed(f"were not rosbridge: {error}")

    # --- ClientPort: samples ------------------------------------------------------------------------------

    def deliver(self, subscription: ClientSubscription, sample: Sample) -> None:
        """Send a sample, or queue it; a queued sample is rendered when it can be sent."""
        queue = self.send_queue
        if not queue.passing:
            lasting = self._client.channel.subscriptions.lasting(subscription.topic)
            queue.send_droppable(subscription, sample, subscription.depth or DATA_PER_TOPIC, lasting=lasting)
            return
        if subscription.format is sample.plain_format:
            # Most clients use plain JSON, which was rendered and framed once for all.
            queue.write(sample.plain)
            return
        rendered = sample.render(subscription.format, self._user_quota)
        if isinstance(rendered, bytes):
            queue.write(rendered)
        elif (left := subscription.report(rendered)) is not None:
            queue.write(left)

    def _render(self, subscription: ClientSubscription, sample: Sample) -> bytes | None:
        rendered = sample.render(subscription.format, self._user_quota)
        return rendered if isinstance(rendered, bytes) else subscription.report(rendered)

    # --- ClientPort: answers ------------------------------------------------------------------------------

    def status(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Send a status if the client requested that level. roslibpy breaks on a status that it did not request."""
        if self._shows(level):
            self._send(rosbridge.status(level, text, id))

    def _shows(self, level: str) -> bool:
        return LEVELS[level] >= self._level and self._level < LEVELS["none"]

    def disconnect(self, code: int, reason: str) -> None:
        """Close the websocket. A client that has requested errors gets a status with the reason before."""
        farewell = frames(rosbridge.status("error", reason, CLOSED)) if self._shows("error") else b""
        self._transport.close(code, reason, farewell)

    def warn_of_drops(self, text: str, id: rosbridge.Id = None) -> None:
        """Send a warning."""
        self.status("warning", text, id)

    def service_response(self, call: rosbridge.CallService, result: bool, values: bytes) -> None:
        """Answer a call in the encoding that it requested."""
        message = rosbridge.service_response(call.service, call.id, result, values)
        self._send(message, requested_encoding(call, _ignore))

    def action_feedback(self, key: object, goal: rosbridge.SendActionGoal, values: bytes) -> None:
        """Send feedback; a client that reads slowly gets only the newest."""
        message = rosbridge.action_feedback(goal.action, goal.id, values)
        self.send_queue.send_droppable(key, self._encode(message, requested_encoding(goal, _ignore)), 1)

    def action_result(self, goal: rosbridge.SendActionGoal, status: int, result: bool, values: bytes) -> None:
        """End a goal, in the encoding that it requested."""
        message = rosbridge.action_result(goal.action, goal.id, status, result, values)
        self._send(message, requested_encoding(goal, _ignore))

    def call_service(self, service: str, id: str, args: bytes) -> None:
        """Call a service that the client offers."""
        self._send(rosbridge.call_service(service, id, args))

    def send_action_goal(self, action: str, id: str, type: str, args: bytes, feedback: bool) -> None:
        """Send the client a goal for an action that it offers."""
        self._send(rosbridge.send_action_goal(action, id, type, args, feedback))

    def cancel_action_goal(self, action: str, id: str) -> None:
        """Request the client to cancel a goal that it executes."""
        self._send(rosbridge.cancel_action_goal(action, id))

    def _send(self, message: bytes, encoding: MessageEncoding = PLAIN) -> None:
        """Queue a message that must not be lost.

        :param message: JSON
        """
        self.send_queue.send_reliable(self._encode(message, encoding))

    def _encode(self, message: bytes, encoding: MessageEncoding) -> bytes:
        """The websocket frames of a message, in a costly encoding only within the user's CPU quota.

        :param message: JSON
        """
        if encoding == PLAIN:
            return frames(message)
        if not self._user_quota.may_encode:
            self._client.plain_instead += 1
            if self._client.log_lines.take():
                self.status("warning", TOO_COSTLY)
            return frames(message)
        with self._user_quota.encoding():
            return frames(message, encoding)

    def ended(self) -> None:
        """The session is over."""
        super().ended()
        if self._fragments is not None:
            self._fragments.end()

    def _sample_dropped(self, key: Hashable, source: int) -> None:
        queue = self.send_queue
        if not isinstance(key, ClientSubscription):
            return
        if queue.rate is not None:
            key.too_slow(slow_connection_advice(queue.rate))
        elif not queue.passing:
            # Otherwise it waited within its throttle, and more wait there than the client has requested.
            key.too_slow(NOT_READ)


def _ignore(level: str, text: str, id: rosbridge.Id) -> None:
    """Send nothing: the client was notified of a wrong encoding when it requested it."""
