"""The port of a session that the relay opens itself: gives the session operations, and takes the answers as values.

Used for HTTP (:mod:`relay_server.in_process_sessions.pool`), fleet orders and pipes.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgspec
from twisted.internet.defer import CancelledError, Deferred

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import Invalid, Refused, SwitchboardError, Unavailable
from relay_server.channels.client_subscription import QUEUE_BYTES, ClientSubscription
from relay_server.channels.samples import RenderError, Sample
from relay_server.common.send_queue import DATA_PER_TOPIC, LASTING_BYTES
from relay_server.sessions.context import ClientContext
from relay_server.sessions.session import Session

_ABOUT_CLIENT = 4000
"""Close codes from this on are for errors of the client (SPEC 1.4)."""

FAILED = 64
"""Most operations of which the errors are remembered, and most of which the warnings are."""

READ_TOO_SLOWLY = "you read them too slowly. Request fewer by a throttle"


class MaybeDone(SwitchboardError):
    """An operation was sent, and it is not known whether it was carried out.

    :param reason: why
    """

    code = "maybe_done"

    def __init__(self, reason: SwitchboardError) -> None:
        self.reason = reason
        super().__init__(f"{str(reason).rstrip('.')}; it was sent before, and may have been done")


class ServiceReply(NamedTuple):
    """The answer of a service.

    :param values: JSON; a string with the reason when ``result`` is false
    """

    result: bool
    values: bytes

    @property
    def read(self) -> Any:
        """The values, decoded."""
        return jsontext.decode_any(self.values)


class GoalListener:
    """Follows a goal; see :meth:`InProcessPort.send_goal`."""

    def feedback(self, values: bytes) -> None:
        """Feedback, JSON."""

    def ended(self, status: int, result: bool, values: bytes) -> None:
        """The goal has ended.

        :param status: of ``action_msgs/msg/GoalStatus``; 0 for a goal that never began
        :param values: JSON; a string with the reason when ``result`` is false
        """


class InProcessPort:
    """The port of a session that the relay opens itself (:class:`relay_server.sessions.ports.ClientPort`).

    :param undated: ``earliest_sent`` of operations that are performed without one (see
        :class:`relay_server.sessions.message_age.MessageAge`); 0: they may be arbitrarily old
    """

    proves_liveness = False
    rate = None

    def __init__(self, undated: int = 0) -> None:
        self._undated = undated
        self._ids = itertools.count(1)
        self._calls: dict[str, Deferred[ServiceReply]] = {}
        self._goals: dict[str, GoalListener] = {}
        self._listeners: dict[str, Callable[[bytes], None]] = {}
        self._waiting: dict[ClientSubscription, deque[Sample]] | None = None
        """The newest sample of each topic while paused, several where each publisher's counts; ``None``: not paused."""
        self._drops: dict[str, int] = {}
        self._failed: dict[str, str] = {}
        """Errors of operations that failed after they were accepted, by id, the latest last."""
        self._warnings: dict[str, str] = {}
        """The latest warning of drops by the id of the operation that it concerns, the latest last."""
        self.on_status: Callable[[str, str, rosbridge.Id], None] = _nothing
        """Called with level, text and id of each status about an operation that was accepted."""
        self._performing: str | None = None
        self._error: SwitchboardError | None = None
        self.dropped_samples = 0
        self.closed: SwitchboardError | None = None
        """Why the session was closed; ``None``: it is open."""
        self.on_close: Callable[[], None] = _nothing

    def begin(self, session: Session) -> None:
        """Start a session."""
        self.session = session
        self.client: ClientContext = session.client
        session.start()

    # --- operations ---------------------------------------------------------------------------------------

    def check(self, *ids: str) -> None:
        """Check operations that have no answer.

        :raises SwitchboardError: one of them failed after it had been accepted, or the session was closed
        """
        if self.closed is not None:
            raise self.closed
        for id in ids:
            words = self._failed.pop(id, None)
            if words is not None:
                raise Refused(words)

    def new_id(self) -> str:
        """An id that no other operation of this client has."""
        return f"in-process-{next(self._ids)}"

    def perform(self, operation: rosbridge.ClientOp, earliest_sent: int | None = None) -> None:
        """Carry out an operation by the session.

        :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`
        :raises SwitchboardError: it is refused, or the session was closed; with the reason
        """
        if self.closed is not None:
            raise self.closed
        client = self.client
        self._performing, self._error = None if operation.id is None else str(operation.id), None
        try:
            with client.age.as_of(self._undated if earliest_sent is None else earliest_sent):
                self.session.perform(operation)
        except SwitchboardError:
            client.count_refusal()
            raise
        finally:
            self._performing, error = None, self._error
        if error is not None:
            raise error

    async def call(
        self,
        service: str,
        args: bytes,
        type_name: str = "",
        timeout: float | None = None,
        earliest_sent: int | None = None,
    ) -> ServiceReply:
        """Call a service.

        :param args: JSON
        :param timeout: seconds
        :param earliest_sent: as for :meth:`perform`
        :raises MaybeDone: the session was closed before there was an answer
        :raises SwitchboardError: it is refused, or the session was closed; with the reason
        """
        id = self.new_id()
        waiting: Deferred[ServiceReply] = Deferred()
        self._calls[id] = waiting
        try:
            call = rosbridge.CallService(
                id=id, service=service, args=msgspec.Raw(args), type=type_name, timeout=timeout
            )
            self.perform(call, earliest_sent)
            try:
                return await waiting
            except SwitchboardError as error:
                # The session was closed; a service that refuses would have answered.
                raise MaybeDone(error) from None
        finally:
            self._calls.pop(id, None)

    async def call_own(self, service: str, args: dict[str, str], earliest_sent: int | None = None) -> Any:
        """Call one of the relay's own services; nothing is encoded.

        :param earliest_sent: as for :meth:`perform`
        :returns: the answer as a JSON value
        :raises MaybeDone: the session ended before there was an answer
        :raises SwitchboardError: it is refused, or the session was closed; with the reason
        """
        if self.closed is not None:
            raise self.closed
        client = self.client
        try:
            with client.age.as_of(self._undated if earliest_sent is None else earliest_sent):
                answer = self.session.call_own(service, args)
            return await answer
        except CancelledError:
            if not self.session.closed:
                raise
            raise MaybeDone(self.closed or Unavailable("the session has ended")) from None
        except SwitchboardError:
            client.count_refusal()
            raise

    def subscribe(self, topic: str, type_name: str, listener: Callable[[bytes], None], **how: Any) -> None:
        """Subscribe to a topic.

        :param topic: resolved
        :param listener: is called with the JSON of each message
        :param how: further fields of ``subscribe``
        :raises SwitchboardError: it is refused
        """
        # First, because latched messages come at once.
        self._listeners[topic] = listener
        try:
            self.perform(rosbridge.Subscribe(id=topic, topic=topic, type=type_name or None, **how))
        except SwitchboardError:
            self._listeners.pop(topic, None)
            raise

    def unsubscribe(self, topic: str) -> None:
        """End the subscription to a topic."""
        if self._listeners.pop(topic, None) is not None and self.closed is None:
            self.perform(rosbridge.Unsubscribe(topic=topic))

    def send_goal(
        self, goal: rosbridge.SendActionGoal, listener: GoalListener, earliest_sent: int | None = None
    ) -> None:
        """Send a goal to an action.

        :param goal: with an ``id``
        :param earliest_sent: as for :meth:`perform`
        :raises SwitchboardError: it is refused
        """
        id = str(goal.id)
        self._goals[id] = listener
        try:
            self.perform(goal, earliest_sent)
        except SwitchboardError:
            self._goals.pop(id, None)
            raise

    def pause(self) -> None:
        """Keep only the newest sample of each topic, until :meth:`resume`; of a latched one some of each publisher."""
        if self._waiting is None:
            self._waiting = {}

    def resume(self) -> None:
        """Pass on samples again, first those that waited."""
        waiting, self._waiting = self._waiting, None
        for subscription, samples in (waiting or {}).items():
            for sample in samples:
                self.deliver(subscription, sample)

    # --- ClientPort ---------------------------------------------------------------------------------------

    def deliver(self, subscription: ClientSubscription, sample: Sample) -> None:
        """Pass a sample to the topic's listener."""
        if self._waiting is not None:
            self._enqueue(self._waiting.setdefault(subscription, deque()), subscription, sample)
            return
        body = sample.json()
        if isinstance(body, SwitchboardError):
            subscription.notify_error(RenderError.BROKEN, f"a message can't be converted: {body}")
            return
        listener = self._listeners.get(subscription.topic)
        if listener is not None:
            listener(body)

    def _enqueue(self, waiting: deque[Sample], subscription: ClientSubscription, sample: Sample) -> None:
        """Queue a sample while paused, and drop older ones."""
        waiting.append(sample)
        lasting = self.client.channel.subscriptions.lasting(subscription.topic).newest
        most, size = max(DATA_PER_TOPIC, lasting) if lasting else 1, sum(each.size for each in waiting)
        while len(waiting) > 1 and (
            len(waiting) > most
            or (size > QUEUE_BYTES and len(waiting) > lasting)
            or (lasting and size > LASTING_BYTES)
        ):
            size -= waiting.popleft().size
            self.dropped(subscription)
            subscription.too_slow(READ_TOO_SLOWLY)

    def dropped(self, subscription: ClientSubscription) -> None:
        """Count a sample that was evicted."""
        self.dropped_samples += 1
        self._drops[subscription.topic] = self._drops.get(subscription.topic, 0) + 1

    def forget(self, key: object) -> None:
        """Drop the sample of a subscription that waits. Feedback never waits here."""
        if isinstance(key, ClientSubscription):
            self._drops.pop(key.topic, None)
            if self._waiting is not None:
                self._waiting.pop(key, None)

    @property
    def drops_by_topic(self) -> Mapping[str, int]:
        """Dropped samples by topic, of the topics that are subscribed now."""
        return self._drops

    @property
    def waiting_bytes(self) -> int:
        """Bytes of the samples that wait."""
        return sum(sample.size for samples in (self._waiting or {}).values() for sample in samples)

    def status(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Remember a status as the error of its operation, which :meth:`perform` or :meth:`check` raises."""
        if level == "info":
            return
        key = str(id)
        if self._performing == key:
            self._error = self._error or (Invalid(text) if level == "error" else Refused(text))
            return
        self.on_status(level, text, id)
        if level == "error" and key not in self._failed:
            self._failed[key] = text
            if len(self._failed) > FAILED:
                del self._failed[next(iter(self._failed))]

    def warn_of_drops(self, text: str, id: rosbridge.Id = None) -> None:
        """Remember it for :meth:`take_warning`."""
        key = str(id)
        self._warnings.pop(key, None)
        self._warnings[key] = text
        if len(self._warnings) > FAILED:
            del self._warnings[next(iter(self._warnings))]
        self.on_status("warning", text, id)

    def take_warning(self, id: str) -> str:
        """The warning of drops that concerns an operation, once; empty: there is none."""
        return self._warnings.pop(id, "")

    def service_response(self, call: rosbridge.CallService, result: bool, values: bytes) -> None:
        """Answer a call."""
        waiting = self._calls.pop(str(call.id), None)
        if waiting is not None:
            waiting.callback(ServiceReply(result, values))

    def action_feedback(self, key: object, goal: rosbridge.SendActionGoal, values: bytes) -> None:
        """Pass feedback to the goal's listener."""
        listener = self._goals.get(str(goal.id))
        if listener is not None:
            listener.feedback(values)

    def action_result(self, goal: rosbridge.SendActionGoal, status: int, result: bool, values: bytes) -> None:
        """Pass the end of a goal to its listener."""
        listener = self._goals.pop(str(goal.id), None)
        if listener is not None:
            listener.ended(status, result, values)

    def call_service(self, service: str, id: str, args: bytes) -> None:
        """Nothing: such a client offers no services."""

    def send_action_goal(self, action: str, id: str, type: str, args: bytes, feedback: bool) -> None:
        """Nothing: such a client offers no actions."""

    def cancel_action_goal(self, action: str, id: str) -> None:
        """Nothing: such a client offers no actions."""

    def ping(self) -> None:
        """Nothing: each operation carries its own time."""

    def rights_changed(self) -> None:
        """Nothing."""

    def ended(self) -> None:
        """The session is over; if it was closed, :meth:`disconnect` gave the reason."""
        self._waiting = None

    def disconnect(self, code: int, reason: str) -> None:
        """The session was closed, as a right was revoked or the relay shuts down: calls and goals that wait fail."""
        self.closed = Unavailable(reason) if code < _ABOUT_CLIENT else Refused(reason)
        calls, self._calls = self._calls, {}
        goals, self._goals = self._goals, {}
        for waiting in calls.values():
            waiting.errback(self.closed)
        for listener in goals.values():
            listener.ended(0, False, jsontext.encode(reason))
        self.on_close()


def _nothing(*_: object) -> None:
    pass
