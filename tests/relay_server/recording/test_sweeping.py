"""Recordings of robots that are removed, on a real database and real files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.task import Clock

from relay_db import queries
from relay_protocol.errors import Unavailable
from relay_server.channel import Channels
from relay_server.journal import Journal
from relay_server.recording import Library, Recordings, kept_of, sweep
from relay_server.recording.library import Entry, State, text_of
from relay_server.recording.sweeping import SLACK_SECONDS
from relay_server.store import Store
from relay_server.video import Videos

BEGUN = 1000.0


class Left:
    """A folder of recordings, as a relay finds it."""

    def __init__(self, store: Store, folder: Path) -> None:
        self.store = store
        self.folder = folder
        clock = Clock()
        library = Library(folder, 10**6)
        channels = Channels(clock, linger=1.0, new_ticket=str, wall_ns=lambda: 0)
        videos = Videos(clock, new_ticket=str)
        self.recordings = Recordings(reactor, clock, library, channels, videos, lambda: BEGUN)
        self.journal = Journal(store, lambda: BEGUN)
        folder.mkdir()

    def recording(self, id: str, robot: str, state: State = State.COMPLETE) -> int:
        """A recording of a robot; the robot's number."""
        with self.store.database.begin() as session:
            found = queries.find_robot(session, robot) or queries.add_robot(session, robot)
        entry = Entry(id, found.id, robot, 1, "ann", ("/odom",), (), BEGUN, 1000, 60.0, state=state)
        (self.folder / f"{id}.json").write_bytes(text_of(entry))
        (self.folder / f"{id}.mcap").write_bytes(b"x" * 500)
        return found.id

    def removes(self, robot: int, name: str, at: float | None = BEGUN + 1) -> None:
        """Somebody removes the robot; at no time: it was never in this database."""
        with self.store.database.begin() as session:
            queries.remove_robot(session, robot)
            if at is not None:
                queries.append_audit(session, at=at, actor="cli:root", action="robot.remove", target=name)

    async def sweep(self) -> None:
        """As relays do."""
        await sweep(self.recordings, self.store, self.journal)

    @property
    def files(self) -> list[str]:
        """What there is."""
        return sorted(each.name for each in self.folder.iterdir())


@pytest.fixture
def left(store: Store, tmp_path: Path) -> Iterator[Left]:
    """An empty folder."""
    made = Left(store, tmp_path / "recordings")
    yield made
    made.recordings.close()


@pytest_twisted.ensureDeferred
async def test_recordings_go_with_their_robot(left: Left) -> None:
    """Those of others stay, also of one that has the name now."""
    rover = left.recording("a", "rover")
    left.recording("b", "rover", State.RECORDING)
    left.recording("c", "tank")
    left.removes(rover, "rover")
    left.recording("d", "rover")
    left.recordings.open()
    await left.sweep()
    assert left.files == ["c.json", "c.mcap", "d.json", "d.mcap"]
    assert sorted(entry.id for entry in left.recordings.library) == ["c", "d"]


@pytest.mark.parametrize("at", [None, BEGUN - SLACK_SECONDS - 1])
@pytest_twisted.ensureDeferred
async def test_what_was_never_removed_stays(left: Left, at: float | None) -> None:
    """A relay that was started on another database, or an older copy of its own, deletes nothing."""
    robot = left.recording("a", "rover")
    left.removes(robot, "rover", at)
    left.recordings.open()
    await left.sweep()
    assert left.files == ["a.json", "a.mcap"]


@pytest.mark.parametrize("how", ["delete", "stop"])
@pytest_twisted.ensureDeferred
async def test_what_can_not_be_deleted_stays_for_now(
    left: Left, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """Nor what can't be stopped before; the others go, and the next time it is tried again."""
    rover = left.recording("a", "rover")
    left.recording("b", "rover")
    left.removes(rover, "rover")
    left.recordings.open()
    does = getattr(left.recordings, how)

    def refuses(entry: Entry, *reason: str) -> Any:
        if entry.id == "a":
            raise Unavailable("not now")
        return does(entry, *reason)

    monkeypatch.setattr(left.recordings, how, refuses)
    await left.sweep()
    assert left.files == ["a.json", "a.mcap"]
    monkeypatch.undo()
    await left.sweep()
    assert left.files == []


def test_what_is_kept_of_a_robot_is_counted(left: Left) -> None:
    """By what is on the disk; files that say nothing count for nobody."""
    rover = left.recording("a", "rover", State.RECORDING)
    left.recording("b", "rover")
    left.recording("c", "tank")
    (left.folder / "a.mcap").unlink()
    (left.folder / "d.json").write_bytes(b"nonsense")
    left.recordings.open()
    assert kept_of(left.folder, rover) == (2, 500)
    assert kept_of(left.folder / "nowhere", rover) == (0, 0)
