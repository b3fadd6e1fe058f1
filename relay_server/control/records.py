"""The records of control: events and audit entries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from relay_protocol.realms import full_name
from relay_server.audit_log import AuditLog, AuditLogEntry
from relay_server.control.actor import Actor
from relay_server.events.bus import EventBus
from relay_server.robots.registry import RobotState


class AuditSink(Protocol):
    """Records control; see :class:`ControlAuditSink`."""

    def note(
        self, kind: str, robot: RobotState, actor: Actor, why: str = "", *, audit: bool = True, **data: Any
    ) -> None:
        """Record an event without waiting for the database.

        :param audit: whether to write an audit entry as well
        """


class ControlAuditSink:
    """Records control in the event log and the audit log.

    :param wall: Unix time in seconds
    """

    def __init__(self, bus: EventBus, audit: AuditLog, wall: Callable[[], float]) -> None:
        self._bus = bus
        self._audit = audit
        self._wall = wall

    def note(
        self, kind: str, robot: RobotState, actor: Actor, why: str = "", *, audit: bool = True, **data: Any
    ) -> None:
        """See :class:`AuditSink`. The rate of events is limited for each user, that of audit entries is not."""
        self._event(kind, robot, actor, why, **data)
        if audit:
            self._audit.append(self._entry(kind, robot, actor, {"why": why, **data}))

    def _event(self, kind: str, robot: RobotState, actor: Actor, why: str, **data: Any) -> None:
        self._bus.publish(
            kind,
            robot.robot_id,
            actor.source,
            robot=robot.name,
            user=actor.name,
            connection=actor.connection,
            address=actor.address,
            why=why,
            **data,
        )

    def _entry(self, kind: str, robot: RobotState, actor: Actor, data: dict[str, Any]) -> AuditLogEntry:
        data = {"connection": actor.connection, **data}
        originator, robots = _full_name_of(actor, robot), (robot.robot_id,)
        return AuditLogEntry(self._wall(), originator, kind, robot.full, actor.address, data, robots)


def _full_name_of(actor: Actor, robot: RobotState) -> str:
    """The originator's name, unique in the relay; a user without a realm belongs to the robot's realm."""
    name, at, realm = actor.source.partition("@")
    return actor.source if actor.user is None else full_name(name, realm if at else robot.realm)
