"""Stops in the database: each is stored until its robot has confirmed it, in case the robot or the relay dies before.

Stops are distinguished by their time, which is compared for equality only, as clocks may be set back. Whether two
requests are the same stop is another question, see :class:`relay_server.control.stopping.StopIds`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import RobotMoved, StopRecord
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.common.clock import Clock, sleep
from relay_server.common.concurrency import detached
from relay_server.common.database import AsyncDatabase
from relay_server.robots.registry import RobotState

SAVES_AT_ONCE = 8
"""Most stops of one robot that are written to the database at a time, so that further stops do not fill its queue.
The robot is sent every stop. While it is offline, a stop beyond this limit fails, as it is not stored."""

REMEMBERED_STOPS = 256
"""Most stops of one robot remembered by their time, as a slow database may still report them."""

DELETE_RETRY_SECONDS = 10.0
"""Pause between attempts to delete a stop from the database."""


class PendingStops(Protocol):
    """Stores stops; see :class:`DatabasePendingStops`."""

    async def save_stop(self, stop: StopRecord) -> None:
        """Store a stop.

        :raises SwitchboardError: it could not be written
        """

    async def delete_stop(
        self, robot: RobotState, at: float | None = None, *, announce: bool = False
    ) -> bool:
        """Delete a stop of a robot; return whether there was one.

        :param at: time of the stop, Unix seconds, which identifies it; ``None`` for any
        :param announce: whether another relay waits for its end, as it has stored it
        :raises SwitchboardError: the database does not answer
        """

    async def pending_stop(self, robot: RobotState) -> StopRecord | None:
        """The stored stop that the robot has not confirmed.

        :raises SwitchboardError: the database does not answer
        """

    async def pending_stops(self) -> list[StopRecord]:
        """The stored stops that robots have not confirmed.

        :raises SwitchboardError: the database does not answer
        """


class DatabasePendingStops:
    """The table of stops that robots have not confirmed.

    :param announce: whether a robot may be connected to another relay of the cluster, which then must find its stop
    :param relay: id of this relay in its cluster; empty: it is the only one
    """

    def __init__(
        self, store: AsyncDatabase, announce: Callable[[int], bool] = lambda robot_id: False, relay: str = ""
    ) -> None:
        self._store = store
        self._announce = announce
        self._relay = relay

    async def save_stop(self, stop: StopRecord) -> None:
        """See :class:`PendingStops`."""
        row = stop.robot_id, stop.by, stop.why, stop.at, stop.stop_id
        if not self._announce(stop.robot_id):
            try:
                await self._store.write(queries.store_stop, *row, home=self._relay)
                return
            except RobotMoved:
                # It is connecting to another relay, and its link here is about to end.
                pass
        await self._store.write(queries.store_stop, *row, announce=True)

    async def delete_stop(
        self, robot: RobotState, at: float | None = None, *, announce: bool = False
    ) -> bool:
        """See :class:`PendingStops`."""
        return await self._store.write(queries.delete_stop, robot.robot_id, at, announce=announce)

    async def pending_stop(self, robot: RobotState) -> StopRecord | None:
        """See :class:`PendingStops`."""
        return await self._store.read(queries.pending_stop, robot.robot_id)

    async def pending_stops(self) -> list[StopRecord]:
        """See :class:`PendingStops`."""
        return await self._store.read(queries.pending_stops)


class StopWriter:
    """Stores the stops of one robot, and deletes those that are confirmed or withdrawn."""

    log = Logger()

    def __init__(self, clock: Clock, robot: RobotState, store: PendingStops) -> None:
        self._clock = clock
        self._robot = robot
        self._store = store
        self._known_times: deque[float] = deque(maxlen=REMEMBERED_STOPS)
        """Times of all stops that this relay has sent or read."""
        self._read_times: deque[float] = deque(maxlen=REMEMBERED_STOPS)
        """Those that it has read: the command line or another relay has stored them."""
        self._saving: list[StopRecord] = []
        """Stops whose write is under way."""
        self._times_to_delete: deque[float] = deque(maxlen=REMEMBERED_STOPS)
        """Times of stops that are confirmed or withdrawn, but may still be stored."""
        self._deleting = False

    @property
    def full(self) -> bool:
        """Whether no further stop can be saved now."""
        return len(self._saving) >= SAVES_AT_ONCE

    def is_known(self, stop: StopRecord) -> bool:
        """Whether a stop that was read from the database is not new here."""
        return stop.at in self._known_times

    def note(self, stop: StopRecord, *, read: bool = False) -> None:
        """Note a stop that is sent or was read, so that it is known from now on.

        :param read: whether it was read from the database
        """
        self._known_times.append(stop.at)
        if read:
            self._read_times.append(stop.at)

    async def save(self, stop: StopRecord) -> None:
        """Store a stop.

        :raises Unavailable: :data:`SAVES_AT_ONCE` stops are being written already
        :raises SwitchboardError: it could not be written
        """
        if self.full:
            raise Unavailable(f"{SAVES_AT_ONCE} stops of {self._robot.name} are being written already")
        self._saving.append(stop)
        try:
            await self._store.save_stop(stop)
        finally:
            self._saving.remove(stop)

    async def delete_now(self, stop: StopRecord) -> None:
        """Delete a stop.

        :raises SwitchboardError: the database does not answer
        """
        await self._store.delete_stop(self._robot, stop.at, announce=stop.at in self._read_times)

    def delete(self, stop: StopRecord) -> None:
        """Delete a stop in the background, so that no later relay sends it. One that is being written stays."""
        if stop not in self._saving and stop.at not in self._times_to_delete:
            self._times_to_delete.append(stop.at)
            if not self._deleting:
                self._deleting = True
                detached(self._delete_stored()).addErrback(self._log_failure)

    async def _delete_stored(self) -> None:
        try:
            while self._times_to_delete:
                at = self._times_to_delete[0]
                try:
                    await self._store.delete_stop(self._robot, at, announce=at in self._read_times)
                except SwitchboardError as error:
                    self.log.warn(
                        "a confirmed or withdrawn stop of {robot} cannot be deleted from the database: {reason}",
                        robot=self._robot.name,
                        reason=str(error),
                    )
                    await sleep(self._clock, DELETE_RETRY_SECONDS)
                else:
                    # It is missing where the bounded queue has dropped it during the wait.
                    if at in self._times_to_delete:
                        self._times_to_delete.remove(at)
        finally:
            self._deleting = False

    def _log_failure(self, failure: Any) -> None:
        self.log.error(
            "stops of {robot} could not be deleted from the database: {reason}",
            robot=self._robot.name,
            reason=failure.value,
        )
