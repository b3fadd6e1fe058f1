"""What may not be here any more: robots are cut when their key was revoked, and like realms forgotten when removed."""

from __future__ import annotations

from collections.abc import Callable, Collection

from twisted.logger import Logger

from relay_db import queries
from relay_protocol.errors import NotFound, Unavailable
from relay_server.control import Desks
from relay_server.registry import Registry
from relay_server.store import Store
from relay_server.video import Videos

log = Logger()

Told = Callable[[Collection[str], Collection[str]], None]
"""Hears the names of realms that are gone, and of all that there are; one made anew is both."""


class Realms:
    """Tells which realms that were there are gone. By their ids: one of the same name may have come in between."""

    def __init__(self, store: Store, *told: Told) -> None:
        self._store = store
        self._told = told
        self._seen: dict[str, int] = {}

    async def look(self) -> None:
        """Look, and tell.

        :raises Unavailable: the database can't be asked
        """
        there = {each.name: each.id for each in await self._store.read(queries.list_realms)}
        gone = [name for name, number in self._seen.items() if there.get(name) != number]
        self._seen = there
        for told in self._told:
            told(gone, there.keys())


async def retire(store: Store, registry: Registry, desks: Desks, videos: Videos) -> None:
    """Cut robots whose key was revoked, forget those that were removed.

    :raises Unavailable: the database can't be asked
    """
    links = [(robot, robot.control) for robot in registry]
    keys = {(robot.robot_id, robot.key) for robot, control in links if control is not None}
    live = await store.read(queries.live_keys, keys)
    there = {record.id for record in await store.read(queries.list_robots)}
    for robot, control in links:
        if robot.robot_id not in there:
            registry.forget(robot.robot_id)
            desks.forget(robot.robot_id)
            videos.end(robot, NotFound("this robot was removed from the relay"))
        elif control is not None and robot.control is control and (robot.robot_id, robot.key) not in live:
            log.info("robot {robot} is cut: its key is not accepted any more", robot=robot.full)
            control.close("the robot's key is not accepted any more")
            videos.end(robot, Unavailable("the robot's key is not accepted any more"))
