"""Recordings of removed robots, with a real database and real files."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.task import Clock

from relay_db import queries
from relay_protocol.errors import Unavailable
from relay_protocol.realms import DEFAULT_REALM
from relay_server.channels.channel import Channels
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import BusEvent, EventBus
from relay_server.maintenance import SLACK_SECONDS, sweep
from relay_server.recordings.library import Library, RecordingEntry, RecordingState, kept_of, text_of
from relay_server.recordings.recordings import Recordings
from relay_server.video.streams import CameraStreams

BEGUN = 1000.0


class Left:
    """A folder of recordings at a relay's start."""

    def __init__(self, store: AsyncDatabase, folder: Path) -> None:
        self.store = store
        self.folder = folder
        clock = Clock()
        library = Library(folder, 10**6)
        channels = Channels(clock, linger=1.0, new_ticket=str, wall_ns=lambda: 0)
        videos = CameraStreams(clock, new_ticket=str)
        self.recordings = Recordings(reactor, clock, library, channels, videos, lambda: BEGUN)
        self.bus = EventBus()
        folder.mkdir()

    def recording(
        self,
        id: str,
        robot: str,
        state: RecordingState = RecordingState.COMPLETE,
        *,
        realm: str = DEFAULT_REALM,
    ) -> int:
        """A recording of a robot; returns the robot's number."""
        with self.store.database.begin() as session:
            if realm not in {each.name for each in queries.list_realms(session)}:
                queries.add_realm(session, realm)
            found = queries.find_robot(session, robot, realm) or queries.add_robot(
                session, robot, realm=realm
            )
        entry = RecordingEntry(
            id, found.id, robot, 1, "ann", ("/odom",), (), BEGUN, 1000, 60.0, state=state, realm=realm
        )
        (self.folder / f"{id}.json").write_bytes(text_of(entry))
        (self.folder / f"{id}.mcap").write_bytes(b"x" * 500)
        return found.id

    def removes(self, robot: int, name: str, at: float | None = BEGUN + 1) -> None:
        """Removes the robot; without a time the database never had it."""
        with self.store.database.begin() as session:
            queries.remove_robot(session, robot)
            if at is not None:
                queries.append_audit(session, at=at, actor="cli:root", action="robot.remove", target=name)

    async def sweep(self) -> None:
        """Sweeps as the relay does."""
        await sweep(self.recordings, self.store, self.bus)

    @property
    def files(self) -> list[str]:
        """Names of the files."""
        return sorted(each.name for each in self.folder.iterdir())


@pytest.fixture
def left(store: AsyncDatabase, tmp_path: Path) -> Iterator[Left]:
    """An empty folder."""
    made = Left(store, tmp_path / "recordings")
    yield made
    made.recordings.close()


@pytest_twisted.ensureDeferred
async def test_recordings_go_with_their_robot(left: Left) -> None:
    """Recordings of other robots stay, including those of a new robot with the same name."""
    rover = left.recording("a", "rover")
    left.recording("b", "rover", RecordingState.RECORDING)
    left.recording("c", "tank")
    left.removes(rover, "rover")
    left.recording("d", "rover")
    left.recordings.open()
    await left.sweep()
    assert left.files == ["c.json", "c.mcap", "d.json", "d.mcap"]
    assert sorted(entry.id for entry in left.recordings.library) == ["c", "d"]


@pytest_twisted.ensureDeferred
async def test_recordings_go_with_a_robot_of_any_realm(left: Left) -> None:
    """Recordings of robots with the same name in other realms stay, even if their robot is not in this
    database.
    """
    removed = left.recording("a", "rover", realm="lab1")
    unknown = left.recording("b", "rover", realm="lab2")
    left.recording("c", "rover")
    left.removes(removed, "rover@lab1")
    left.removes(unknown, "rover@lab2", at=None)
    left.recordings.open()
    await left.sweep()
    assert sorted(entry.id for entry in left.recordings.library) == ["b", "c"]


@pytest_twisted.ensureDeferred
async def test_a_removed_namesake_in_the_default_realm_takes_nothing_along(left: Left) -> None:
    """A name alone does not identify a robot of another realm."""
    removed = left.recording("a", "rover")
    unknown = left.recording("b", "rover", realm="lab1")
    left.removes(removed, "rover")
    left.removes(unknown, "rover@lab1", at=None)
    left.recordings.open()
    await left.sweep()
    assert [entry.id for entry in left.recordings.library] == ["b"]


@pytest_twisted.ensureDeferred
async def test_a_recording_from_before_there_were_realms_is_of_the_default_one(left: Left) -> None:
    """It is removed with its robot."""
    rover = left.recording("a", "rover")
    file = left.folder / "a.json"
    found = json.loads(file.read_bytes())
    del found["realm"]
    file.write_text(json.dumps(found))
    left.removes(rover, "rover")
    left.recordings.open()
    await left.sweep()
    assert left.files == []


@pytest_twisted.ensureDeferred
async def test_a_removed_recording_is_an_event_in_its_realm(left: Left) -> None:
    """It has the full name of the removed robot."""
    reported: list[BusEvent] = []
    left.bus.subscribe(reported.append)
    for realm in ("lab1", "lab2"):
        left.removes(left.recording(realm, "rover", realm=realm), f"rover@{realm}")
    left.recordings.open()
    await left.sweep()
    assert [each.kind for each in reported] == ["recording.removed"] * 2
    assert sorted((each.data["realm"], each.data["robot"]) for each in reported) == [
        ("lab1", "rover@lab1"),
        ("lab2", "rover@lab2"),
    ]


@pytest.mark.parametrize("at", [None, BEGUN - SLACK_SECONDS - 1])
@pytest_twisted.ensureDeferred
async def test_recordings_of_unremoved_robots_stay(left: Left, at: float | None) -> None:
    """A relay that was started with another database, or an older copy, deletes nothing."""
    robot = left.recording("a", "rover")
    left.removes(robot, "rover", at)
    left.recordings.open()
    await left.sweep()
    assert left.files == ["a.json", "a.mcap"]


@pytest.mark.parametrize("how", ["delete", "stop"])
@pytest_twisted.ensureDeferred
async def test_undeletable_file_stays_for_now(left: Left, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    """This includes a recording that cannot be stopped. Others are removed, and the next sweep retries."""
    rover = left.recording("a", "rover")
    left.recording("b", "rover")
    left.removes(rover, "rover")
    left.recordings.open()
    does = getattr(left.recordings, how)

    def refuses(entry: RecordingEntry, *reason: str) -> Any:
        if entry.id == "a":
            raise Unavailable("not now")
        return does(entry, *reason)

    monkeypatch.setattr(left.recordings, how, refuses)
    await left.sweep()
    assert left.files == ["a.json", "a.mcap"]
    monkeypatch.undo()
    await left.sweep()
    assert left.files == []


def test_stored_bytes_of_a_robot_are_counted(left: Left) -> None:
    """By the sizes on disk; invalid files count for no robot."""
    rover = left.recording("a", "rover", RecordingState.RECORDING)
    left.recording("b", "rover")
    left.recording("c", "tank")
    (left.folder / "a.mcap").unlink()
    (left.folder / "d.json").write_bytes(b"nonsense")
    left.recordings.open()
    assert kept_of(left.folder, rover) == (2, 500)
    assert kept_of(left.folder / "nowhere", rover) == (0, 0)


@pytest_twisted.ensureDeferred
async def test_recordings_in_a_realm_go_with_the_robots_membership(left: Left) -> None:
    """Recordings of another realm stay, and so do those of robots that the database does not know."""
    rover = left.recording("a", "rover")
    with left.store.database.begin() as session:
        for realm in ("lab1", "lab2", "lab3"):
            queries.add_realm(session, realm)
            queries.share_robot(session, rover, realm)
    for id, realm in (("b", "lab1"), ("c", "lab2"), ("d", "lab3")):
        entry = RecordingEntry(
            id, rover, "rover", 1, "ann", ("/odom",), (), BEGUN, 1000, 60.0, realm=realm, home=DEFAULT_REALM
        )
        entry.state = RecordingState.COMPLETE
        (left.folder / f"{id}.json").write_bytes(text_of(entry))
        (left.folder / f"{id}.mcap").write_bytes(b"x")
    with left.store.database.begin() as session:
        for realm, reported in (("lab1", True), ("lab3", False)):
            queries.unshare_robot(session, rover, realm)
            if reported:
                data = {"realm": realm}
                queries.append_audit(
                    session, at=BEGUN + 1, actor="cli:root", action="robot.unshare", target="rover", data=data
                )
    left.recordings.open()
    await left.sweep()
    assert sorted(entry.id for entry in left.recordings.library) == ["a", "c", "d"]
