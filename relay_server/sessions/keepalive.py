"""Pings to one client: they tell how old what it says can be, and whether it is still there."""

from __future__ import annotations

from typing import Protocol

from relay_protocol.rights import Level
from relay_server.access import Permit
from relay_server.common import close_codes
from relay_server.common.clock import Clock
from relay_server.common.send_queue import SendQueue
from relay_server.common.timers import PeriodicTimer, PeriodicTimers
from relay_server.sessions.message_age import MessageAge
from relay_server.sessions.ports import ClientTransport, Timing


class KeepalivePort(Protocol):
    """Whose client is pinged: a session, as far as this goes."""

    permit: Permit
    outbox: SendQueue

    def close(self, code: int, reason: str) -> None:
        """Close with a code, and end."""


class Keepalive:
    """Pings one client, and cuts it when it answers none or takes nothing any more."""

    __slots__ = ("_clock", "_freshness", "_round", "_session", "_timing", "_transport")

    def __init__(
        self,
        session: KeepalivePort,
        clock: Clock,
        transport: ClientTransport,
        freshness: MessageAge,
        timing: Timing,
    ) -> None:
        self._session = session
        self._clock = clock
        self._transport = transport
        self._freshness = freshness
        self._timing = timing
        self._round: PeriodicTimer | None = None

    def start(self, rounds: PeriodicTimers) -> None:
        """Ping now, and from now on."""
        self._round = PeriodicTimer(self.ping, self._interval())
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
            self._session.close(close_codes.TOO_SLOW, f"no answer to pings for {silent:.0f} s")
            return
        paused = self._session.outbox.paused_since
        if paused is not None and self._clock.seconds() - paused > self._timing.stall_limit:
            self._session.close(close_codes.TOO_SLOW, f"nothing was taken for {self._timing.stall_limit:g} s")
            return
        self._transport.ping(self._freshness.ping())

    def _interval(self) -> float:
        only_watches = all(
            grant.level is Level.VIEWER and not grant.allow for grant in self._session.permit.rules.grants
        )
        return self._timing.client_ping if only_watches else self._timing.driving_ping
