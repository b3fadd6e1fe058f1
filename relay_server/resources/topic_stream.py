"""Streams the messages of a topic over a session of its own."""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred

from relay_protocol import rosbridge
from relay_protocol.errors import Refused, SwitchboardError
from relay_server.in_process_sessions.in_process_port import InProcessPort

STATUSES = 16
"""Most statuses of a stream that wait for a slow reader."""


class TopicStream:
    """A subscription whose messages are streamed.

    :ivar over: fires when no more messages come
    :ivar reason: why, then
    """

    def __init__(self, port: InProcessPort, topic: str) -> None:
        self.over: Deferred[None] = Deferred()
        self.reason: SwitchboardError | None = None
        self._port = port
        self._topic = topic
        self._paused = False
        self._statuses: dict[str, str] = {}
        """Levels of statuses that came while paused, by text."""
        port.on_close = lambda: self._end(port.closed)

    def begin(
        self,
        type_name: str,
        throttle_ms: float,
        send: Callable[[bytes], None],
        send_status: Callable[[str, str], None],
    ) -> None:
        """Subscribe.

        :param throttle_ms: least time between two messages; the newest counts
        :param send: takes each message, JSON
        :param send_status: takes level and text of each status of the subscription
        :raises SwitchboardError: the client may not subscribe
        """
        self._send_status = send_status
        self._port.on_status = self._status
        self._port.subscribe(self._topic, type_name, send, throttle_rate=throttle_ms, queue_length=1)

    def check(self) -> None:
        """End the stream if the subscription was revoked; to be called every few seconds."""
        if not self._port.session.subscriptions.is_subscribed(self._topic):
            self._end(Refused(f"your right to subscribe to {self._topic} was revoked"))

    def pause(self) -> None:
        """The reader is slow: send nothing for now."""
        self._paused = True
        self._port.pause()

    def resume(self) -> None:
        """The reader accepts messages again."""
        self._paused = False
        statuses, self._statuses = self._statuses, {}
        for text, level in statuses.items():
            self._send_status(level, text)
        self._port.resume()

    def _status(self, level: str, text: str, id: rosbridge.Id) -> None:
        if id != self._topic:
            return
        if not self._paused:
            self._send_status(level, text)
        elif len(self._statuses) < STATUSES:
            self._statuses[text] = level

    def _end(self, reason: SwitchboardError | None) -> None:
        if not self.over.called:
            self.reason = reason
            self.over.callback(None)
