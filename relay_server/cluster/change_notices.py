"""Notices between relays that the database has changed: rights, tokens, users, robots. Polling finds what gets lost."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from twisted.internet.defer import Deferred, succeed
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import SwitchboardError
from relay_server.cluster.bus import ClusterBus

SUBJECT = "changes"


class ChangeNotices:
    """Publishes the revision of the database that this relay has applied, and applies those of the others.

    :ivar apply: applies all changes of the database
    """

    log = Logger()

    def __init__(self, bus: ClusterBus) -> None:
        self.apply: Callable[[], Awaitable[None]] = lambda: succeed(None)
        self._bus = bus
        self._newest = -1
        """The newest revision that any relay has announced, this one included."""
        self._unsubscribe: Callable[[], None] = _nothing

    def start(self) -> None:
        """Follow the notices of the other relays."""
        self._unsubscribe = self._bus.subscribe(SUBJECT, self._received)

    def stop(self) -> None:
        """Follow them no longer."""
        self._unsubscribe()

    def applied(self, revision: int) -> None:
        """This relay has applied a revision; the others are notified unless they have announced it."""
        if revision > self._newest:
            self._newest = revision
            self._bus.publish(SUBJECT, str(revision).encode())

    def _received(self, subject: str, body: bytes) -> None:
        if not body.isdigit():
            self.log.error("a notice of the bus can't be read: {body!r}", body=body[:80], limited="notice")
            return
        if int(body) > self._newest:
            self._newest = int(body)
            Deferred.fromCoroutine(self._apply()).addErrback(self._failed)

    async def _apply(self) -> None:
        await self.apply()

    def _failed(self, failure: Failure) -> None:
        """The database does not answer. Polling tries again, and logs it."""
        if not failure.check(SwitchboardError):
            self.log.failure("changes of the database could not be applied", failure)


def _nothing() -> None:
    """Nothing is subscribed yet."""
