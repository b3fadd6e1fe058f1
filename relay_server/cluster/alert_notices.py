"""Alerts that the other relays have written: each relay sends its own on the bus, after they are in the database."""

from __future__ import annotations

from collections.abc import Callable, Collection

import msgspec
from twisted.logger import Logger

from relay_db.queries import AlertRecord
from relay_server.cluster.bus import ClusterBus

SUBJECT = "alerts"
MOST_RECORDS = 100
"""Most alerts in one notice; a text has at most 500 characters."""


class WrittenAlerts(msgspec.Struct, array_like=True, frozen=True):
    """Alerts that were written.

    :param relay: id of the relay that has written them
    """

    relay: str
    alerts: list[AlertRecord]


class AlertNotices:
    """Sends and follows the notices.

    :param own: id of this relay
    :ivar take: takes alerts that another relay has written
    """

    log = Logger()

    def __init__(self, bus: ClusterBus, own: str) -> None:
        self.take: Callable[[Collection[AlertRecord]], object] = lambda alerts: None
        self._bus = bus
        self._own = own
        self._unsubscribe: Callable[[], None] = lambda: None

    def start(self) -> None:
        """Follow the notices of the other relays."""
        self._unsubscribe = self._bus.subscribe(SUBJECT, self._received)

    def stop(self) -> None:
        """Follow them no longer."""
        self._unsubscribe()

    def written(self, alerts: Collection[AlertRecord]) -> None:
        """This relay has written alerts."""
        alerts = list(alerts)
        for at in range(0, len(alerts), MOST_RECORDS):
            notice = WrittenAlerts(self._own, alerts[at : at + MOST_RECORDS])
            self._bus.publish(SUBJECT, msgspec.json.encode(notice))

    def _received(self, subject: str, body: bytes) -> None:
        try:
            notice = msgspec.json.decode(body, type=WrittenAlerts)
        except msgspec.DecodeError as error:
            self.log.error("a notice of the bus can't be read: {error}", error=error, limited="notice")
            return
        if notice.relay != self._own:
            self.take(notice.alerts)
