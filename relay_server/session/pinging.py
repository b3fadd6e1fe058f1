"""Pings to one client: they tell how old what it says can be, and whether it is still there."""

from __future__ import annotations

from typing import Protocol

from relay_protocol.rights import Level
from relay_server import closing
from relay_server.access import Permit
from relay_server.clock import Clock
from relay_server.freshness import Freshness
from relay_server.outbox import Outbox
from relay_server.rounds import Round, Rounds
from relay_server.session.ends import ClientTransport, Timing


class Pinged(Protocol):
    """Whose client is pinged: a session, as far as this goes."""

    permit: Permit
    outbox: Outbox

    def close(self, code: int, reason: str) -> None:
        """Close with a code, and end."""


class Pinging:
    """Pings one client, and cuts it when it answers none or takes nothing any more."""

    __slots__ = ("_clock", "_freshness", "_round", "_session", "_timing", "_transport")

    def __init__(
        self,
        session: Pinged,
        clock: Clock,
        transport: ClientTransport,
        freshness: Freshness,
        timing: Timing,
    ) -> None:
        self._session = session
        self._clock = clock
        self._transport = transport
        self._freshness = freshness
        self._timing = timing
        self._round: Round | None = None

    def start(self, rounds: Rounds) -> None:
        """Ping now, and from now on."""
        self._round = Round(self.ping, self._interval())
        rounds.start(self._round)

    def end(self) -> None:
        """The client is gone."""
        if self._round is not None:
            self._round.stop()

    def rights_changed(self) -> None:
        """Who may publish now, or may not any more, is pinged as often as that takes."""
        if self._round is not None:
            self._round.interval = self._interval()

    def ping(self) -> None:
        """Ping the client, unless it has been silent, or has taken nothing, for too long."""
        silent = self._freshness.silence() / 1e9
        if silent > max(self._timing.client_ping * 3, self._timing.stall_limit):
            self._session.close(closing.TOO_SLOW, f"no answer to pings for {silent:.0f} s")
            return
        paused = self._session.outbox.paused_since
        if paused is not None and self._clock.seconds() - paused > self._timing.stall_limit:
            self._session.close(closing.TOO_SLOW, f"nothing was taken for {self._timing.stall_limit:g} s")
            return
        self._transport.ping(self._freshness.ping())

    def _interval(self) -> float:
        only_watches = all(
            grant.level is Level.VIEWER and not grant.allow for grant in self._session.permit.rules.grants
        )
        return self._timing.client_ping if only_watches else self._timing.driving_ping
