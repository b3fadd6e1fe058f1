"""Events worth keeping, written to the database behind the scenes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db import queries
from relay_server.auth.login_limiter import network_of
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import TokenBucket

BURST = 20
RATE = 1.0
"""Events of one cause: so many at once, and so many per second in the long run."""

CAUSES = 10_000
"""Causes remembered; the longest quiet are forgotten first."""

WAITING = 128
"""Events that wait for the database at a time. Logins write by the same door and must find it open."""


Listener = Callable[[str, int | None, dict[str, Any]], None]
"""Is told the kind of an event, the robot's number if it is about one, and what belongs to it."""

Witness = Callable[[str, str, int | None, dict[str, Any]], None]
"""The same, and second who says so."""


@dataclass
class _Cause:
    bucket: TokenBucket
    suppressed: int = 0


class EventBus:
    """Writes events without making anyone wait for the database, and no more of one cause than is bearable.

    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(self, store: AsyncDatabase, wall: Callable[[], float]) -> None:
        self._store = store
        self._wall = wall
        self._causes: OrderedDict[str, _Cause] = OrderedDict()
        self._waiting = 0
        self._witnesses: list[Witness] = []

    def listen(self, listener: Listener) -> None:
        """Have all that happens told to somebody at once, also what is not kept."""
        self._witnesses.append(lambda kind, source, robot_id, data: listener(kind, robot_id, data))

    def witness(self, witness: Witness) -> None:
        """Have it told to somebody who wants to know who says so."""
        self._witnesses.append(witness)

    def tell(self, kind: str, robot_id: int, source: str = "relay", **data: Any) -> None:
        """Something happened that is not worth keeping, but listeners may act by it."""
        self._tell(kind, source, robot_id, data)

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
        self._tell(kind, source, robot_id, data)
        cause = network_of(cause)
        known = self._known(cause)
        if self._waiting >= WAITING or not known.bucket.take():
            if not known.suppressed:
                self.log.warn("{cause} causes too many events; some are not kept", cause=cause)
            known.suppressed += 1
            return False
        suppressed, known.suppressed = known.suppressed, 0
        if suppressed:
            self.log.warn("{count} events caused by {cause} were not kept", count=suppressed, cause=cause)
            self._write("events.suppressed", "relay", {"cause": cause, "count": suppressed})
        self._write(kind, source, data, robot_id, user_id)
        return True

    def _tell(self, kind: str, source: str, robot_id: int | None, data: dict[str, Any]) -> None:
        for witness in self._witnesses:
            try:
                witness(kind, source, robot_id, data)
            except Exception:  # what has happened goes on, and is kept, whatever becomes of what listens
                self.log.failure("who listens to events failed at '{kind}'", kind=kind)

    def _known(self, cause: str) -> _Cause:
        known = self._causes.get(cause)
        if known is None:
            known = self._causes[cause] = _Cause(TokenBucket(RATE, BURST, self._wall))
        self._causes.move_to_end(cause)
        while len(self._causes) > CAUSES:
            self._causes.popitem(last=False)
        return known

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
