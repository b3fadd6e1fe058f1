"""What becomes of recordings when their robot is removed: they go with it."""

from __future__ import annotations

from twisted.logger import Logger

from relay_db import queries
from relay_protocol.errors import Unavailable
from relay_server.journal import Journal
from relay_server.recording.recordings import Recordings
from relay_server.store import Store

SLACK_SECONDS = 60.0
"""A recording may seem to have begun so long after its robot was removed: two clocks, and what was under way then."""

_log = Logger()


async def sweep(recordings: Recordings, store: Store, journal: Journal) -> None:
    """Delete the recordings of robots that were removed; those that run are stopped before.

    What is of a robot that the database has never removed stays: it may be another database than before.

    :raises Unavailable: the database can't be asked
    """
    there = {record.id for record in await store.read(queries.list_robots)}
    left = [entry for entry in recordings.library if entry.robot_id not in there]
    removed = await store.read(queries.removed_robots, {entry.robot_full for entry in left})
    for entry in left:
        robot = entry.robot_full
        if entry.begun > removed.get(robot, -SLACK_SECONDS) + SLACK_SECONDS:
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
