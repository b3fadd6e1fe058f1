"""What is put on record about control, in memory."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred

from relay_db.queries import StopRecord
from relay_protocol.errors import SwitchboardError
from relay_server.control.audit import Actor
from relay_server.robots.registry import RobotState


class MemoryRecord:
    """Keeps what is put on record.

    :ivar fails: why it can't be, when it can't
    """

    def __init__(self) -> None:
        self.notes: list[tuple[str, str, str, dict[str, Any]]] = []
        self.actors: list[Actor] = []
        """Whose doing each of these was."""
        self.stops: dict[int, StopRecord] = {}
        self.fails: SwitchboardError | None = None
        self.hold = False
        """Whether what is to be written waits for ever."""
        self.held: list[Deferred[None]] = []

    def note(
        self, kind: str, robot: RobotState, actor: Actor, why: str = "", *, audit: bool = True, **data: Any
    ) -> None:
        """Keep it."""
        self.notes.append((kind, actor.name, why, data))
        self.actors.append(actor)

    @property
    def kinds(self) -> list[str]:
        """What has happened."""
        return [kind for kind, *_ in self.notes]

    async def ordered(
        self, robot: RobotState, order: StopRecord, actor: Actor, *, audit: bool = True
    ) -> None:
        """Keep an order to stop."""
        self._check()
        if self.hold:
            self.held.append(Deferred())
            await self.held[-1]
        self.stops[robot.robot_id] = order
        if audit:
            self.note("robot.stopped", robot, actor, order.why)

    async def told(self, robot: RobotState, at: float | None = None) -> bool:
        """It need not be told any more."""
        self._check()
        kept = self.stops.get(robot.robot_id)
        if kept is None or at not in (None, kept.at):
            return False
        del self.stops[robot.robot_id]
        return True

    async def pending(self, robot: RobotState) -> StopRecord | None:
        """What is still to be told."""
        self._check()
        return self.stops.get(robot.robot_id)

    def _check(self) -> None:
        if self.fails is not None:
            raise self.fails
