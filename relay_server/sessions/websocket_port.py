"""The base of the ports of sessions over a websocket: the send queue, pings and the end of the connection."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping
from typing import NamedTuple

from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.samples import Sample
from relay_server.common import close_codes
from relay_server.common.clock import Clock, PeriodicTimers
from relay_server.common.send_queue import SendQueue
from relay_server.sessions.context import ClientContext
from relay_server.sessions.keepalive import Keepalive
from relay_server.sessions.message_age import MessageAge
from relay_server.sessions.ports import ClientTransport, Timing
from relay_server.sessions.session import Session

MAX_MALFORMED = 100
"""Messages in a row that can't be read, after which the connection is closed."""


class WebsocketContext(NamedTuple):
    """What each port of a websocket needs.

    :param age: how old the client's messages can be
    """

    clock: Clock
    transport: ClientTransport
    age: MessageAge
    timing: Timing
    timers: PeriodicTimers


class WebsocketPort(ABC):
    """Base of the ports whose clients are at the other end of a websocket; subclasses speak its protocol."""

    __slots__ = (
        "_age",
        "_client",
        "_clock",
        "_keepalive",
        "_malformed",
        "_quota",
        "_timers",
        "_timing",
        "_transport",
        "send_queue",
        "session",
    )

    proves_liveness = True

    def __init__(self, context: WebsocketContext) -> None:
        self._clock = context.clock
        self._transport = context.transport
        self._age = context.age
        self._timing = context.timing
        self._timers = context.timers
        self._malformed = 0
        self.send_queue = SendQueue(context.transport.send, context.clock.seconds, self._overflow)
        self.send_queue.on_drop = self._sample_dropped
        self.send_queue.render = self._render

    def attach(self, session: Session) -> None:
        """Set the session that carries out the client's operations; once, before :meth:`start`."""
        self.session = session
        self._client: ClientContext = session.client
        self._quota = session.client.quota
        self._keepalive = Keepalive(
            session.client.permit,
            self.send_queue,
            session.close,
            self._clock,
            self._transport,
            self._age,
            self._timing,
        )

    # --- the websocket ------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin the session, and pings."""
        self.session.start()
        self._keepalive.start(self._timers)

    @property
    def earliest_sent(self) -> int:
        """Of a message that comes now; see :class:`relay_server.sessions.message_age.MessageAge`."""
        return self._age.earliest_sent

    def pong(self, payload: bytes) -> None:
        """The client answered a ping."""
        self._age.pong(payload)

    def pause(self) -> None:
        """The transport's buffer is full."""
        self.send_queue.pause()

    def resume(self) -> None:
        """The transport takes bytes again."""
        self.send_queue.resume()

    def end(self, *, orderly: bool = False) -> None:
        """The websocket is closed.

        :param orderly: by the client
        """
        self.session.end(orderly=orderly)

    def close(self, code: int, reason: str) -> None:
        """Close the websocket with a code and a reason, and end the session."""
        self.session.close(code, reason)

    def _close_malformed(self, reason: str) -> None:
        """Close the websocket if too many messages in a row could not be read."""
        if self._malformed >= MAX_MALFORMED:
            self.close(close_codes.TOO_MANY_ERRORS, f"{MAX_MALFORMED} messages in a row {reason}"[:120])

    # --- ClientPort ---------------------------------------------------------------------------------------

    def dropped(self, subscription: ClientSubscription) -> None:
        """Count a sample that was evicted before it was queued here."""
        self.send_queue.count_drop(subscription)

    def forget(self, key: object) -> None:
        """Drop queued samples of a subscription, or feedback of a goal."""
        self.send_queue.forget(key)

    @property
    def dropped_samples(self) -> int:
        """Samples dropped because the client did not read in time."""
        return self.send_queue.dropped

    @property
    def drops_by_topic(self) -> Mapping[str, int]:
        """Dropped samples by topic, of the topics that are subscribed now."""
        drops = self.send_queue.drops.items()
        return {key.topic: count for key, count in drops if isinstance(key, ClientSubscription)}

    @property
    def waiting_bytes(self) -> int:
        """Bytes that wait for the client."""
        return self.send_queue.waiting_bytes

    @property
    def rate(self) -> float | None:
        """Bytes per second that the connection carries, where it has proved to be slow."""
        return self.send_queue.rate

    def ping(self) -> None:
        """Ping the client now."""
        if not self.session.closed:
            self._keepalive.ping()

    def rights_changed(self) -> None:
        """A client that may publish is pinged more often."""
        self._keepalive.rights_changed()

    def disconnect(self, code: int, reason: str) -> None:
        """Close the websocket."""
        self._transport.close(code, reason)

    def ended(self) -> None:
        """The session is over."""
        self.send_queue.close()
        self._keepalive.end()

    # --- the send queue -----------------------------------------------------------------------------------

    @abstractmethod
    def _render(self, subscription: ClientSubscription, sample: Sample) -> bytes | None:
        """The websocket frames of a sample that waited; ``None``: it is not sent."""

    @abstractmethod
    def _sample_dropped(self, key: Hashable, source: int) -> None:
        """Data with this key was dropped, as the client does not read fast enough."""

    def _overflow(self) -> None:
        self.close(close_codes.TOO_SLOW, "too many answers wait for this client; read faster")
