"""Notices between relays that a file was removed: the relay that has its contents deletes them.

A notice that is lost, since that relay or the bus was down, leaves the contents on that relay's disk.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from twisted.internet.defer import Deferred, succeed
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_server.cluster.bus import ClusterBus

SUBJECT = "files.removed"


class FileNotices:
    """Sends and follows the notices.

    :ivar delete: deletes what this relay has of a file
    """

    log = Logger()

    def __init__(self, bus: ClusterBus) -> None:
        self.delete: Callable[[int], Awaitable[None]] = lambda file_id: succeed(None)
        self._bus = bus
        self._unsubscribe: Callable[[], None] = lambda: None

    def start(self) -> None:
        """Follow the notices of the other relays."""
        self._unsubscribe = self._bus.subscribe(SUBJECT, self._received)

    def stop(self) -> None:
        """Follow them no longer."""
        self._unsubscribe()

    def removed(self, file_id: int) -> None:
        """This relay has removed a file."""
        self._bus.publish(SUBJECT, str(file_id).encode())

    def _received(self, subject: str, body: bytes) -> None:
        if not body.isdigit():
            self.log.error("a notice of the bus can't be read: {body!r}", body=body[:80], limited="notice")
            return
        Deferred.fromCoroutine(self._delete(int(body))).addErrback(self._failed)

    async def _delete(self, file_id: int) -> None:
        await self.delete(file_id)

    def _failed(self, failure: Failure) -> None:
        self.log.error(
            "contents of a removed file stay: {reason}", reason=failure.value, limited="file notice"
        )
