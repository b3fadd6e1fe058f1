"""Stopping many robots, and letting them move again: without a session, so that nothing stands before a stop."""

from __future__ import annotations

from relay_db.queries import RobotRecord
from relay_protocol.errors import Refused
from relay_protocol.rights import Level, Rules
from relay_server.access import Principal
from relay_server.control import Actor, Desk, Desks
from relay_server.fleet.result import Outcome
from relay_server.registry import Registry


class Halting:
    """Stops robots for who has any right on them; resumes those he owns or controls."""

    def __init__(self, desks: Desks, registry: Registry) -> None:
        self._desks = desks
        self._registry = registry

    def online(self, record: RobotRecord) -> bool:
        """Whether the robot can be told now."""
        robot = self._registry.find(record.id)
        return robot is not None and robot.control is not None

    async def stop(self, record: RobotRecord, actor: Actor, why: str) -> Outcome:
        """Stop a robot: the order is on its way before anything is waited for.

        :raises NotDone: it is stopped, but not all that belongs to it could be done
        :raises Unavailable: it can't be reached, and the order can't be kept
        """
        if await self._desk(record).stopping.stop(actor, why):
            return Outcome(True)
        return Outcome(True, "it will be stopped as soon as it can be reached", pending=True)

    async def resume(
        self, record: RobotRecord, rules: Rules, asker: Principal, actor: Actor, why: str
    ) -> Outcome:
        """Let a robot move again.

        :raises Refused: the asker neither owns nor controls it
        :raises NotDone: the robot says that it can't
        :raises Unavailable: it can't be reached
        """
        desk = self._desk(record)
        holder = desk.lease.holder
        controls = holder is not None and holder.client.user == asker.user_id
        if rules.level is not Level.OWNER and not controls:
            raise Refused("only who has control of the robot, and its owners, may resume it")
        await desk.stopping.resume(actor, why)
        return Outcome(True)

    def _desk(self, record: RobotRecord) -> Desk:
        return self._desks.of(self._registry.presence(record.id, record.name, record.realm))
