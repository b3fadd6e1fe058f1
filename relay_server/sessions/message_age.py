"""How old can a client's message be at most? Told by pings, without help from the client.

A websocket carries no sending times, and clients are not ours. But messages keep their order: whatever arrives after
the pong to a ping was sent after that ping had reached the client, so after the ping was sent. The sending time of
the latest ping that came back is therefore a moment before which nothing that arrives now can have been sent. It
holds through stalls of any kind: a frozen relay, a frozen client, a partition that heals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from relay_server.robots.link_quality import LinkQuality, LinkQualityMeter

PENDING = 64
"""Pings out at once; a client that answers none is soon cut for its silence."""


class MessageAge:
    """The earliest possible sending time of what one client says now.

    :param clock: monotonic nanoseconds
    :param opened: when the websocket's handshake was answered; the client can't have spoken before
    :param token: eight unguessable bytes at each call, so that a pong can't be sent in advance
    """

    __slots__ = ("_clock", "_meter", "_out", "_token", "last_pong", "not_before", "rtt")

    def __init__(self, clock: Callable[[], int], opened: int, token: Callable[[], bytes]) -> None:
        self._clock = clock
        self._token = token
        self._meter = LinkQualityMeter()
        self._out: list[tuple[bytes, int]] = []
        self.not_before = opened
        self.last_pong = opened
        self.rtt: int | None = None

    def ping(self) -> bytes:
        """The payload of a ping that is sent now."""
        payload = self._token()
        self._out.append((payload, self._clock()))
        if len(self._out) > PENDING:
            del self._out[0]
        return payload

    def pong(self, payload: bytes) -> bool:
        """Take a pong; False when it answers no ping of ours (RFC 6455 section 5.5.3 allows that)."""
        place = next((place for place, (token, _) in enumerate(self._out) if token == payload), None)
        if place is None:
            return False
        sent = self._out[place][1]
        self.not_before = max(self.not_before, sent)
        self.last_pong = now = self._clock()
        self.rtt = now - sent
        for _, before in self._out[:place]:
            self._meter.passed_over(now / 1e9, (now - before) / 1e9)
        self._meter.came_back(now / 1e9, self.rtt / 1e9)
        # Pings before it were answered too, or never will be.
        del self._out[: place + 1]
        return True

    def age(self) -> int:
        """Nanoseconds: no message arriving now is older than this."""
        return self._clock() - self.not_before

    @contextmanager
    def as_of(self, moment: int) -> Iterator[None]:
        """Judge by this moment, if it is the earlier one: what is handled meanwhile began to come then."""
        latest = self.not_before
        self.not_before = min(latest, moment)
        try:
            yield
        finally:
            self.not_before = latest

    def reading(self) -> LinkQuality:
        """How good the way to the client is."""
        now = self._clock()
        return self._meter.reading(now / 1e9, [(now - sent) / 1e9 for _, sent in self._out])

    def silence(self) -> int:
        """Nanoseconds since the client last answered a ping."""
        return self._clock() - self.last_pong
