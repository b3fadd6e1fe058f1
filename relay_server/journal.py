"""Events worth keeping, written to the database behind the scenes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db import queries
from relay_server.store import Store


class Journal:
    """Writes events and audit entries without making anyone wait for the database.

    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(self, store: Store, wall: Callable[[], float]) -> None:
        self._store = store
        self._wall = wall

    def event(
        self,
        kind: str,
        source: str,
        *,
        robot_id: int | None = None,
        user_id: int | None = None,
        **data: Any,
    ) -> None:
        """Something happened: ``kind`` such as ``robot.online``, ``source`` who says so."""
        self._later(
            self._store.write(
                queries.record_event,
                at=self._wall(),
                kind=kind,
                source=source,
                robot_id=robot_id,
                user_id=user_id,
                data=data,
            )
        )

    def audit(self, actor: str, action: str, target: str, origin: str, **data: Any) -> None:
        """Somebody did something that must stay on record."""
        self._later(
            self._store.write(
                queries.append_audit,
                at=self._wall(),
                actor=actor,
                action=action,
                target=target,
                origin=origin,
                data=data,
            )
        )

    def _later(self, writing: Any) -> None:
        Deferred.fromCoroutine(writing).addErrback(
            lambda failure: self.log.error("an event could not be kept: {reason}", reason=failure.value)
        )
