"""Pings to a client: they show whether it is still there, and bound the age of its messages (``message_age``)."""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol.rights import Level
from relay_server.access import Permit
from relay_server.common import close_codes
from relay_server.common.clock import Clock, PeriodicTimer, PeriodicTimers
from relay_server.common.send_queue import SendQueue
from relay_server.sessions.message_age import MessageAge
from relay_server.sessions.ports import ClientTransport, Timing


class Keepalive:
    """Pings one client, and closes its connection when it answers no ping, or reads nothing, for too long."""

    __slots__ = ("_age", "_clock", "_close", "_permit", "_send_queue", "_timer", "_timing", "_transport")

    def __init__(
        self,
        permit: Permit,
        send_queue: SendQueue,
        close: Callable[[int, str], None],
        clock: Clock,
        transport: ClientTransport,
        age: MessageAge,
        timing: Timing,
    ) -> None:
        self._permit = permit
        self._send_queue = send_queue
        self._close = close
        self._clock = clock
        self._transport = transport
        self._age = age
        self._timing = timing
        self._timer: PeriodicTimer | None = None

    def start(self, timers: PeriodicTimers) -> None:
        """Ping now, and periodically from now on."""
        self._timer = PeriodicTimer(self.ping, self._interval())
        timers.start(self._timer)

    def end(self) -> None:
        """The client is gone."""
        if self._timer is not None:
            self._timer.stop()

    def rights_changed(self) -> None:
        """Ping a client that may publish more often than one that only watches."""
        if self._timer is not None:
            self._timer.interval = self._interval()

    def ping(self) -> None:
        """Ping the client; close its connection if it has been silent, or has read nothing, for too long."""
        silent = self._age.silence() / 1e9
        if silent > max(self._timing.client_ping * 3, self._timing.stall_limit):
            self._close(close_codes.TOO_SLOW, f"no answer to pings for {silent:.0f} s")
            return
        paused = self._send_queue.paused_since
        if paused is not None and self._clock.seconds() - paused > self._timing.stall_limit:
            self._close(close_codes.TOO_SLOW, f"nothing was taken for {self._timing.stall_limit:g} s")
            return
        self._transport.ping(self._age.ping())

    def _interval(self) -> float:
        only_watches = all(
            grant.level is Level.VIEWER and not grant.allow for grant in self._permit.rules.grants
        )
        return self._timing.client_ping if only_watches else self._timing.driving_ping
