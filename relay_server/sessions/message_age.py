"""How old the messages of a client can be, shown by the pings that it answers.

A websocket carries no sending times, and clients are programs of others. But messages keep their order. A message that
arrives after the pong to a ping was sent after the client had received that ping, so after the relay sent it. The
sending time of the latest answered ping is therefore the earliest time at which a message that arrives now can have
been sent (:attr:`MessageAge.earliest_sent`). This holds through stalls of any kind: a frozen relay, a frozen client, a
partition that heals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from relay_server.robots.link_quality import LinkQuality, LinkQualityMeter

MAX_UNANSWERED = 64
"""Most pings that are remembered while they are not answered."""


class MessageAge:
    """How old the messages of one client can be.

    :param now: the relay's monotonic nanoseconds; also an attribute, as the age of a message that arrives now is
        ``now() - earliest_sent``
    :param opened: when the websocket's handshake was answered; no message of the client is older
    :param token: returns eight unguessable bytes, so that a pong can't be sent in advance
    :ivar earliest_sent: earliest time at which the message that is handled now can have been sent; the relay's
        monotonic nanoseconds. For a request over HTTP it is the time of its freshness token
    """

    __slots__ = ("_meter", "_token", "_unanswered", "earliest_sent", "last_pong", "now", "rtt")

    def __init__(self, now: Callable[[], int], opened: int, token: Callable[[], bytes]) -> None:
        self.now = now
        self._token = token
        self._meter = LinkQualityMeter()
        self._unanswered: list[tuple[bytes, int]] = []
        self.earliest_sent = opened
        self.last_pong = opened
        self.rtt: int | None = None

    def ping(self) -> bytes:
        """The payload of a ping that is sent now."""
        payload = self._token()
        self._unanswered.append((payload, self.now()))
        if len(self._unanswered) > MAX_UNANSWERED:
            del self._unanswered[0]
        return payload

    def pong(self, payload: bytes) -> bool:
        """Record a pong; False if it answers no ping of the relay (RFC 6455 section 5.5.3 allows such pongs)."""
        index = next((index for index, (token, _) in enumerate(self._unanswered) if token == payload), None)
        if index is None:
            return False
        sent = self._unanswered[index][1]
        self.earliest_sent = max(self.earliest_sent, sent)
        self.last_pong = now = self.now()
        self.rtt = now - sent
        for _, before in self._unanswered[:index]:
            self._meter.unanswered(now / 1e9, (now - before) / 1e9)
        self._meter.answered(now / 1e9, self.rtt / 1e9)
        # Pings before it were answered too, or never will be.
        del self._unanswered[: index + 1]
        return True

    @contextmanager
    def as_of(self, earliest_sent: int) -> Iterator[None]:
        """Handle an older message during the block.

        :param earliest_sent: of this message
        """
        latest, self.earliest_sent = self.earliest_sent, earliest_sent
        try:
            yield
        finally:
            self.earliest_sent = latest

    def link_quality(self) -> LinkQuality:
        """The quality of the link to the client."""
        now = self.now()
        return self._meter.link_quality(now / 1e9, [(now - sent) / 1e9 for _, sent in self._unanswered])

    def silence(self) -> int:
        """Nanoseconds since the client last answered a ping."""
        return self.now() - self.last_pong
