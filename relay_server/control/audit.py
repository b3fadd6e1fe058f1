"""What is put on record about control: events for those who listen, entries of the audit log, orders to stop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import msgspec

from relay_db import queries
from relay_db.queries import StopRecord
from relay_protocol import jsontext
from relay_protocol.errors import SwitchboardError
from relay_protocol.realms import full_name
from relay_server.audit_log import AuditLog, AuditLogEntry
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.robots.registry import RobotState

WHY = 500
"""Characters that are kept of a reason somebody gives."""


def reason_of(value: Any) -> str:
    """The reason of a stop, as far as it can be used: no robot goes on moving for the sake of words.

    :param value: what was given as one
    """
    return value[:WHY] if isinstance(value, str) else ""


def reason_in(json: msgspec.Raw) -> str:
    """The same for one in JSON, also where that is none."""
    try:
        return reason_of(jsontext.decode_any(bytes(json)))
    except SwitchboardError:
        return ""


class Actor(NamedTuple):
    """Who does something about control.

    :param name: for people
    :param source: for the record: ``user:ann``, ``cli:root``, ``relay``
    :param user: the user's number, where it is one
    :param address: from where
    :param connection: the number of the connection it is done by, 0 for none
    """

    name: str
    source: str
    user: int | None = None
    address: str = ""
    connection: int = 0


RELAY = Actor("the relay", "relay")


class AuditSink(Protocol):
    """Where that goes: the database, or a list in tests."""

    def note(
        self, kind: str, robot: RobotState, actor: Actor, why: str = "", *, audit: bool = True, **data: Any
    ) -> None:
        """Something has happened; nobody waits for it to be written."""

    async def ordered(
        self, robot: RobotState, order: StopRecord, actor: Actor, *, audit: bool = True
    ) -> None:
        """Keep an order to stop until it is told, and write its audit entry.

        :param audit: false for one of many that need no entry of their own
        :raises SwitchboardError: it can't be kept
        """

    async def told(self, robot: RobotState, at: float | None = None) -> bool:
        """The order to stop of this moment need not be told any more; whether there was one.

        :param at: Unix seconds, as it was ordered; ``None`` for whatever there is

        :raises SwitchboardError: it can't be taken out
        """

    async def pending(self, robot: RobotState) -> StopRecord | None:
        """The order to stop that is still to be told.

        :raises SwitchboardError: nobody can say
        """


class DatabaseAuditSink:
    """The record of a relay in service.

    :param wall: Unix time in seconds
    """

    def __init__(
        self, store: AsyncDatabase, journal: EventBus, audit: AuditLog, wall: Callable[[], float]
    ) -> None:
        self._store = store
        self._journal = journal
        self._audit = audit
        self._wall = wall

    def note(
        self, kind: str, robot: RobotState, actor: Actor, why: str = "", *, audit: bool = True, **data: Any
    ) -> None:
        """An event, as far as one user may cause them, and an entry of the audit log in any case."""
        self._event(kind, robot, actor, why, **data)
        if audit:
            self._audit.append(self._entry(kind, robot, actor, {"why": why, **data}))

    async def ordered(
        self, robot: RobotState, order: StopRecord, actor: Actor, *, audit: bool = True
    ) -> None:
        """The entry waits where the database does not take it; so it is written also for an order that is not kept."""
        self.note("robot.stopped", robot, actor, order.why, audit=audit)
        await self._store.write(queries.order_stop, order.robot_id, order.by, order.why, order.at)

    async def told(self, robot: RobotState, at: float | None = None) -> bool:
        """See :class:`AuditSink`."""
        return await self._store.write(queries.stop_told, robot.robot_id, at)

    async def pending(self, robot: RobotState) -> StopRecord | None:
        """See :class:`AuditSink`."""
        return await self._store.read(queries.pending_stop, robot.robot_id)

    def _event(self, kind: str, robot: RobotState, actor: Actor, why: str, **data: Any) -> None:
        self._journal.event(
            kind,
            actor.source,
            # Not that of the user's other events: who comes and goes must not hide who stops a robot.
            cause=f"control:{_full(actor, robot)}",
            robot_id=robot.robot_id,
            user_id=actor.user,
            robot=robot.name,
            user=actor.name,
            connection=actor.connection,
            address=actor.address,
            why=why,
            **data,
        )

    def _entry(self, kind: str, robot: RobotState, actor: Actor, data: dict[str, Any]) -> AuditLogEntry:
        data = {"connection": actor.connection, **data}
        who, robots = _full(actor, robot), (robot.robot_id,)
        return AuditLogEntry(self._wall(), who, kind, robot.full, actor.address, data, robots)


def _full(actor: Actor, robot: RobotState) -> str:
    """Who it is for the whole relay: without a realm users are those of the robot's own."""
    name, at, realm = actor.source.partition("@")
    return actor.source if actor.user is None else full_name(name, realm if at else robot.realm)
