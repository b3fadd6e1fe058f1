"""Audit entries about control, in memory."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred

from relay_db.queries import StopRecord
from relay_protocol.errors import SwitchboardError
from relay_server.control.actor import Actor
from relay_server.robots.registry import RobotState


class MemoryRecord:
    """Stores audit entries.

    :ivar fails: an error to raise, or None
    """

    def __init__(self) -> None:
        self.notes: list[tuple[str, str, str, dict[str, Any]]] = []
        self.actors: list[Actor] = []
        """Whose doing each of these was."""
        self.stop_events = 0
        """Events of stops, with and without an audit entry."""
        self.stops: dict[int, StopRecord] = {}
        self.fails: SwitchboardError | None = None
        self.hold = False
        """Whether what is to be written waits for ever."""
        self.deleted: list[tuple[float | None, bool]] = []
        """Times of the stops that were to be deleted, and whether that was to be announced."""
        self.held: list[Deferred[None]] = []

    def note(
        self, kind: str, robot: RobotState, actor: Actor, why: str = "", *, audit: bool = True, **data: Any
    ) -> None:
        """Stores it; for stops only if they need an audit entry."""
        if kind == "robot.stopped":
            self.stop_events += 1
            if not audit:
                return
        self.notes.append((kind, actor.name, why, data))
        self.actors.append(actor)

    @property
    def kinds(self) -> list[str]:
        """Kinds of the stored entries."""
        return [kind for kind, *_ in self.notes]

    async def save_stop(self, stop: StopRecord) -> None:
        """Stores it."""
        self._check()
        if self.hold:
            self.held.append(Deferred())
            await self.held[-1]
        self.stops[stop.robot_id] = stop

    async def delete_stop(
        self, robot: RobotState, at: float | None = None, *, announce: bool = False
    ) -> bool:
        """Returns whether there was one."""
        self._check()
        self.deleted.append((at, announce))
        kept = self.stops.get(robot.robot_id)
        if kept is None or at not in (None, kept.at):
            return False
        del self.stops[robot.robot_id]
        return True

    async def pending_stop(self, robot: RobotState) -> StopRecord | None:
        """The stored one."""
        self._check()
        return self.stops.get(robot.robot_id)

    async def pending_stops(self) -> list[StopRecord]:
        """All that are stored."""
        self._check()
        return list(self.stops.values())

    def _check(self) -> None:
        if self.fails is not None:
            raise self.fails
