"""This relay as one of a cluster: its listener for the other relays, its bus, its lease, and the robots' homes."""

from __future__ import annotations

import secrets
import time
from collections.abc import Awaitable, Callable, Collection
from typing import Any

from twisted.internet.defer import Deferred, maybeDeferred, succeed
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_server import VERSION
from relay_server.cluster.alert_notices import AlertNotices
from relay_server.cluster.change_notices import ChangeNotices
from relay_server.cluster.departed import DepartedRelays
from relay_server.cluster.drain import Drain
from relay_server.cluster.file_notices import FileNotices
from relay_server.cluster.forwarding import Forwarder
from relay_server.cluster.homes import ClusterHomes
from relay_server.cluster.leadership import Leadership
from relay_server.cluster.nats_bus import NatsBus
from relay_server.cluster.overload import OverloadRelief
from relay_server.cluster.relays import (
    CLUSTER_PROTOCOL,
    OLDEST_PROTOCOL,
    RelayDirectory,
    RelayInfo,
    check_compatible,
)
from relay_server.cluster.robot_facts import RobotFactsNotices
from relay_server.cluster.status import ClusterStatus, LoadMeter
from relay_server.common.database import AsyncDatabase
from relay_server.config import ClusterSettings
from relay_server.listeners import listen
from relay_server.robots.registry import RobotRegistry

GONE_SECONDS = 20.0
"""Seconds after a change of relays until the work of those that are gone is taken over; a lost lease may come back."""


class Cluster:
    """The part of this relay in a cluster.

    :param reactor: Twisted's
    :ivar port: TCP port for the other relays; 0 until it listens
    """

    log = Logger()

    def __init__(
        self, reactor: Any, settings: ClusterSettings, database: AsyncDatabase, robots: RobotRegistry
    ) -> None:
        self.port = 0
        self.forwarder = Forwarder(reactor, settings)
        self._reactor = reactor
        self.settings = settings
        self.id = secrets.token_hex(8)
        self._started = time.time()
        self.bus = NatsBus(reactor, settings.bus)
        self.relays = RelayDirectory(reactor, self.bus, self._own)
        self.homes = ClusterHomes(reactor, database, robots, self.bus, self.relays, self.id)
        self.homes.on_home = lambda robot_id, relay: self.forwarder.robot_moved(robot_id, relay)
        self.relays.on_change = self._relays_changed
        self._departed = DepartedRelays(lambda relay: self.forwarder.answers(relay))
        self.leadership = Leadership(reactor, database, self.id)
        self.take_over: Callable[[Collection[str]], Awaitable[None]] = lambda live: succeed(None)
        """Goes on with what no live relay works on, of the ids of live relays."""
        self._taking_over: Any = None
        self.drain = Drain(reactor, robots, self._has_others)
        self.clients: Callable[[], int] = lambda: 0
        """Returns the number of sessions here."""
        self.lag: Callable[[], float] = lambda: 0.0
        """Returns the seconds since changes were read."""

        def meter() -> LoadMeter:
            return LoadMeter(
                self.drain,
                robots=lambda: sum(each.control_link is not None for each in robots),
                clients=lambda: self.clients(),
                forwarded=lambda: len(self.forwarder.websockets),
                lag=lambda: self.lag(),
            )

        self.notices = ChangeNotices(self.bus)
        self.file_notices = FileNotices(self.bus)
        self.alert_notices = AlertNotices(self.bus, self.id)
        self.robot_facts = RobotFactsNotices(reactor, self.bus, robots, self.homes, self.id)
        self.status = ClusterStatus(self.bus, self.relays, self.homes, meter(), self.id)
        # Its averages are over its own seconds.
        load = meter()
        self.overload = OverloadRelief(
            reactor, robots, lambda: 0.0 if self.drain.begun else load.measure().cpu, self._loads_of_others
        )
        self._port: Any = None

    def _own(self) -> RelayInfo:
        return RelayInfo(
            self.id,
            self.settings.host,
            self.port,
            VERSION,
            self._started,
            CLUSTER_PROTOCOL,
            OLDEST_PROTOCOL,
            self.settings.group,
        )

    def _relays_changed(self) -> None:
        self.homes.relays_changed()
        self.robot_facts.send_all()
        self._departed.note(self.others())
        if self._taking_over is None:
            self._taking_over = self._reactor.callLater(GONE_SECONDS, self._take_over)

    def _take_over(self) -> None:
        self._taking_over = None
        live = {self.id, *(each.id for each in self.relays)}
        Deferred.fromCoroutine(self._take_over_of(live)).addErrback(self._not_taken_over)

    async def _take_over_of(self, live: Collection[str]) -> None:
        # A relay that has lost the bus alone has no lease, and goes on.
        alive = await self._departed.alive([*self.relays, self._own()])
        await self.take_over({*live, *alive})
        if alive and self._taking_over is None:
            self._taking_over = self._reactor.callLater(GONE_SECONDS, self._take_over)

    def _not_taken_over(self, failure: Failure) -> None:
        self.log.info("jobs of relays that are gone stay for now: {reason}", reason=failure.value)
        self._taking_over = self._reactor.callLater(GONE_SECONDS, self._take_over)

    def others(self) -> list[RelayInfo]:
        """All other relays."""
        return [each for each in self.relays if each.id != self.id]

    def _reachable(self) -> set[str]:
        """The ids of relays that robots of this one can connect to. They can't choose between workers."""
        group = self.settings.group
        return {each.id for each in self.others() if not (group and each.group == group)}

    async def _has_others(self) -> bool:
        """Whether robots of this relay can connect to another one. Without the bus none can answer."""
        await self.relays.refresh(acquire=False)
        found = self._reachable()
        state = await self.status.read()
        taking = ("ready",) if state.bus else ("ready", "silent")
        return any(each.id in found and each.state in taking for each in state.relays)

    async def _loads_of_others(self) -> list[float]:
        """The shares of a core that the relays use to which robots of this one can connect."""
        found, state = self._reachable(), await self.status.read()
        ready = [each for each in state.relays if each.id in found and each.state == "ready"]
        return [each.load.cpu for each in ready if each.load is not None]

    async def start(self, site: Any, tls: Any) -> None:
        """Listen for the other relays, and join them.

        :param site: what the other relays reach
        :param tls: of :class:`relay_server.listeners.ServerTls`; ``None`` without TLS
        :raises CannotListenError: the address is taken
        :raises Unavailable: a relay of another version runs that this one can't work with
        """
        self._port = await listen(self._reactor, self.settings.listen, site, tls)
        self.port = self._port.getHost().port
        self.log.info("other relays connect at {address}", address=self._own().address)
        await self.bus.start()
        # Before the others learn of this one.
        await self.relays.refresh(acquire=False)
        for relay in self.relays:
            check_compatible(relay)
        self.alert_notices.start()
        self.robot_facts.start()
        await self.relays.start()
        await self.homes.start()
        self.status.start()
        self.notices.start()
        self.file_notices.start()
        await self.leadership.start()
        self.overload.start()

    async def stop(self) -> None:
        """Leave the cluster."""
        self.overload.stop()
        if self._taking_over is not None:
            self._taking_over.cancel()
        self.notices.stop()
        self.file_notices.stop()
        self.alert_notices.stop()
        self.robot_facts.stop()
        try:
            await self.leadership.stop()
            self.status.stop()
            self.homes.stop()
            await self.relays.stop()
            await self.bus.stop()
        finally:
            await self.forwarder.close()
            if self._port is not None:
                await maybeDeferred(self._port.stopListening)
