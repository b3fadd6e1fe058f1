"""What becomes of recordings when their robot is removed, or taken out of their realm: they go with it."""

from __future__ import annotations

from twisted.logger import Logger

from relay_db import queries
from relay_protocol.errors import Unavailable
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.recordings.recordings import Recordings

SLACK_SECONDS = 60.0
"""A recording may seem to have begun so long after its robot was removed: two clocks, and what was under way then."""

_log = Logger()


async def sweep(recordings: Recordings, store: AsyncDatabase, journal: EventBus) -> None:
    """Delete the recordings of robots that were removed, and what was recorded of one in a realm that it was taken out
    of, where nobody could have it any more; those that run are stopped before.

    What is of a robot that the database has never removed or taken out stays: it may be another database than before.

    :raises Unavailable: the database can't be asked
    """
    there = {record.id: record.realm for record in await store.read(queries.list_robots)}
    shares = await store.read(queries.robot_shares)
    left = [
        entry
        for entry in recordings.library
        if entry.realm != there.get(entry.robot_id) and entry.realm not in shares.get(entry.robot_id, ())
    ]
    names = {entry.robot_full for entry in left}
    removed = await store.read(queries.removed_robots, names)
    unshared = await store.read(queries.unshared_robots, names)
    for entry in left:
        robot = entry.robot_full
        gone = unshared.get((robot, entry.realm)) if entry.robot_id in there else removed.get(robot)
        if gone is None or entry.begun > gone + SLACK_SECONDS:
            continue
        try:
            await recordings.stop(entry, "the robot was removed from the relay")
            if not recordings.library.has(entry):
                continue
            await recordings.delete(entry)
        except Unavailable as error:
            _log.error(
                "recording {id} of a removed robot stays for now: {reason}", id=entry.id, reason=str(error)
            )
        else:
            journal.event(
                "recording.removed",
                "relay",
                cause=f"robot:{robot}",
                robot=robot,
                recording=entry.id,
                bytes=entry.bytes,
            )
