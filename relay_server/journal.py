"""Events worth keeping, written to the database behind the scenes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db import queries
from relay_server.limiter import network_of
from relay_server.store import Store

BURST = 20
RATE = 1.0
"""Events of one cause: so many at once, and so many per second in the long run."""

CAUSES = 10_000
"""Causes remembered; the longest quiet are forgotten first."""

WAITING = 128
"""Events that wait for the database at a time. Logins write by the same door and must find it open."""


@dataclass
class _Bucket:
    tokens: float
    at: float
    suppressed: int = 0


class Journal:
    """Writes events without making anyone wait for the database, and no more of one cause than is bearable.

    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(self, store: Store, wall: Callable[[], float]) -> None:
        self._store = store
        self._wall = wall
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()
        self._waiting = 0

    def event(
        self,
        kind: str,
        source: str,
        *,
        cause: str,
        robot_id: int | None = None,
        user_id: int | None = None,
        **data: Any,
    ) -> bool:
        """Something happened: ``kind`` such as ``robot.online``, ``source`` who says so.

        :param cause: who can make this happen at will: an address, or something like ``robot:r2-d2``
        :returns: whether it is kept. What is not is counted, and told with the next of the same cause.
        """
        cause = network_of(cause)
        bucket = self._bucket(cause)
        if bucket.tokens < 1 or self._waiting >= WAITING:
            if not bucket.suppressed:
                self.log.warn("{cause} causes too many events; some are not kept", cause=cause)
            bucket.suppressed += 1
            return False
        bucket.tokens -= 1
        suppressed, bucket.suppressed = bucket.suppressed, 0
        if suppressed:
            self.log.warn("{count} events caused by {cause} were not kept", count=suppressed, cause=cause)
            self._write("events.suppressed", "relay", {"cause": cause, "count": suppressed})
        self._write(kind, source, data, robot_id, user_id)
        return True

    def _bucket(self, cause: str) -> _Bucket:
        now = self._wall()
        bucket = self._buckets.setdefault(cause, _Bucket(BURST, now))
        self._buckets.move_to_end(cause)
        while len(self._buckets) > CAUSES:
            self._buckets.popitem(last=False)
        # Wall clocks may be set back: that is no time gone by.
        bucket.tokens = min(BURST, bucket.tokens + max(0.0, now - bucket.at) * RATE)
        bucket.at = now
        return bucket

    def _write(
        self,
        kind: str,
        source: str,
        data: dict[str, Any],
        robot_id: int | None = None,
        user_id: int | None = None,
    ) -> None:
        self._waiting += 1
        writing = self._store.write(
            queries.record_event,
            at=self._wall(),
            kind=kind,
            source=source,
            robot_id=robot_id,
            user_id=user_id,
            data=data,
        )
        Deferred.fromCoroutine(writing).addErrback(
            lambda failure: self.log.error("an event could not be kept: {reason}", reason=failure.value)
        ).addBoth(self._written)

    def _written(self, _: object) -> None:
        self._waiting -= 1
