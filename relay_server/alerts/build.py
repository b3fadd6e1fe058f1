"""Alerts, put together: what looks, what remembers, what tells, and whom people ask."""

from __future__ import annotations

import time
from typing import Any

from relay_protocol.limits import HEARTBEATS_MISSED
from relay_server.access import Access
from relay_server.alerts.alerts import AlertHub
from relay_server.alerts.monitors import Thresholds
from relay_server.alerts.service import AlertService
from relay_server.alerts.transports import Transports
from relay_server.channels.channels import Channels
from relay_server.common.database import AsyncDatabase
from relay_server.config import RelaySettings
from relay_server.control.controllers import Controllers
from relay_server.events.bus import EventBus
from relay_server.robots.registry import RobotRegistry


class AlertParts:
    """All that a relay has for alerts.

    :param reactor: Twisted's
    :raises Invalid: the settings make no sense
    """

    def __init__(
        self,
        reactor: Any,
        store: AsyncDatabase,
        access: Access,
        registry: RobotRegistry,
        channels: Channels,
        desks: Controllers,
        journal: EventBus,
        settings: RelaySettings,
    ) -> None:
        own = settings.alerts
        self._ways = Transports(
            reactor, time.time, own.webhook_networks, own.apprise_schemes, own.webhook_deny
        )
        self.alerts = AlertHub(
            reactor,
            time.time,
            store,
            access,
            registry,
            channels,
            desks,
            journal,
            Thresholds(HEARTBEATS_MISSED * settings.heartbeat, own.battery_low, own.battery_critical),
            self._ways.send,
            self._ways.room,
        )
        self.desk = AlertService(self.alerts, self._ways, store, access, journal, reactor.seconds, time.time)

    async def start(self, relay: str) -> None:
        """Take up what an earlier relay kept, and begin.

        :param relay: the relay's name, for those who are told
        """
        self._ways.start(relay)
        await self.alerts.start()

    def hush(self) -> None:
        """Tell nobody any more: robots go because the relay does."""
        self.alerts.hush()

    async def keep(self) -> None:
        """Keep what there is, if the database takes it soon."""
        await self.alerts.keep()

    def finish(self) -> None:
        """End the threads; blocks for as long as that takes."""
        self._ways.stop()
