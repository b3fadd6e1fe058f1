"""A topic told message by message to whoever takes them, by a connection of its own."""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred

from relay_protocol.errors import Refused, SwitchboardError
from relay_server.http_sessions.loopback_client import LoopbackClient
from relay_server.sessions.session import Session


class TopicStream:
    """One that follows a topic.

    :ivar over: fires when there is nothing more to come
    :ivar reason: why, then
    """

    def __init__(self, session: Session, client: LoopbackClient, topic: str) -> None:
        self.over: Deferred[None] = Deferred()
        self.reason: SwitchboardError | None = None
        self._session = session
        self._client = client
        self._topic = topic
        client.on_close = lambda: self._end(client.closed)

    def begin(self, type_name: str, throttle_ms: float, tell: Callable[[bytes], None]) -> None:
        """Listen.

        :param throttle_ms: least time between two messages; the newest counts
        :param tell: is given each message, JSON
        :raises SwitchboardError: it may not be heard
        """
        self._client.hear(self._topic, type_name, tell, throttle_rate=throttle_ms, queue_length=1)

    def look(self) -> None:
        """End where the topic may not be heard any more; to be called every few seconds."""
        if not self._session.listening.hears(self._topic):
            self._end(Refused(f"{self._topic} may not be heard any more"))

    def pause(self) -> None:
        """Whoever is told takes nothing now."""
        self._session.pause()

    def resume(self) -> None:
        """He does again."""
        self._session.resume()

    def _end(self, reason: SwitchboardError | None) -> None:
        if not self.over.called:
            self.reason = reason
            self.over.callback(None)
