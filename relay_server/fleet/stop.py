"""Stopping many robots, and letting them move again: without a session, so that nothing stands before a stop."""

from __future__ import annotations

from relay_db.queries import RobotRecord
from relay_protocol.errors import Refused
from relay_protocol.rights import Level
from relay_server.access import Permit
from relay_server.control.audit import Actor
from relay_server.control.controller import RobotController
from relay_server.control.controllers import Controllers
from relay_server.control.types import acts_for
from relay_server.fleet.result import TaskOutcome
from relay_server.robots.registry import RobotRegistry


class FleetStop:
    """Stops robots for who has any right on them; resumes those he owns or controls."""

    def __init__(self, desks: Controllers, registry: RobotRegistry) -> None:
        self._desks = desks
        self._registry = registry

    def online(self, record: RobotRecord) -> bool:
        """Whether the robot can be told now."""
        robot = self._registry.find(record.id)
        return robot is not None and robot.control is not None

    async def stop(self, record: RobotRecord, actor: Actor, why: str) -> TaskOutcome:
        """Stop a robot: the order is on its way before anything is waited for.

        :raises NotDone: it is stopped, but not all that belongs to it could be done
        :raises Unavailable: it can't be reached, and the order can't be kept
        """
        if await self._desk(record).stopping.stop(actor, why):
            return TaskOutcome(True)
        return TaskOutcome(True, "it will be stopped as soon as it can be reached", pending=True)

    async def resume(
        self, record: RobotRecord, permit: Permit, actor: Actor, why: str, sent: int
    ) -> TaskOutcome:
        """Let a robot move again.

        :param permit: of who asks
        :param sent: a moment before which it can't have been asked for, the relay's monotonic nanoseconds
        :raises Refused: he neither owns nor controls it, or asks by a token that is for less
        :raises StoppedSince: the robot may have been stopped after that
        :raises NotDone: the robot says that it can't
        :raises Unavailable: it can't be reached
        """
        desk = self._desk(record)
        holder = desk.lease.holder
        controls = holder is not None and acts_for(permit, holder.client)
        if permit.rules.level is not Level.OWNER and not controls:
            raise Refused("only who has control of the robot, and its owners, may resume it")
        await desk.stopping.resume(actor, why, sent)
        return TaskOutcome(True)

    def _desk(self, record: RobotRecord) -> RobotController:
        return self._desks.of(self._registry.presence(record.id, record.name, record.realm))
