"""Recordings of robots that are removed, on a real database and real files."""

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
from relay_server.channels.channels import Channels
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.recordings.library import Library, RecordingEntry, RecordingState, kept_of, text_of
from relay_server.recordings.recordings import Recordings
from relay_server.recordings.retention import SLACK_SECONDS, sweep
from relay_server.video.streams import CameraStreams

BEGUN = 1000.0


class Left:
    """A folder of recordings, as a relay finds it."""

    def __init__(self, store: AsyncDatabase, folder: Path) -> None:
        self.store = store
        self.folder = folder
        clock = Clock()
        library = Library(folder, 10**6)
        channels = Channels(clock, linger=1.0, new_ticket=str, wall_ns=lambda: 0)
        videos = CameraStreams(clock, new_ticket=str)
        self.recordings = Recordings(reactor, clock, library, channels, videos, lambda: BEGUN)
        self.journal = EventBus(store, lambda: BEGUN)
        folder.mkdir()

    def recording(
        self,
        id: str,
        robot: str,
        state: RecordingState = RecordingState.COMPLETE,
        *,
        realm: str = DEFAULT_REALM,
    ) -> int:
        """A recording of a robot; the robot's number."""
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
def left(store: AsyncDatabase, tmp_path: Path) -> Iterator[Left]:
    """An empty folder."""
    made = Left(store, tmp_path / "recordings")
    yield made
    made.recordings.close()


@pytest_twisted.ensureDeferred
async def test_recordings_go_with_their_robot(left: Left) -> None:
    """Those of others stay, also of one that has the name now."""
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
    """Those of its namesakes in other realms stay, also where that one is not in this database."""
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
    """Its name alone is not that of a robot of another realm."""
    removed = left.recording("a", "rover")
    unknown = left.recording("b", "rover", realm="lab1")
    left.removes(removed, "rover")
    left.removes(unknown, "rover@lab1", at=None)
    left.recordings.open()
    await left.sweep()
    assert [entry.id for entry in left.recordings.library] == ["b"]


@pytest_twisted.ensureDeferred
async def test_a_recording_from_before_there_were_realms_is_of_the_default_one(left: Left) -> None:
    """It goes with its robot as ever."""
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
async def test_what_becomes_of_recordings_is_told_with_the_full_name(
    left: Left, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Events are counted by it too, so that many of one robot hide none of its namesakes."""
    told: list[tuple[str, str]] = []

    def noted(kind: str, source: str, *, cause: str, robot: str, **more: Any) -> bool:
        told.append((cause, robot))
        return True

    monkeypatch.setattr(left.journal, "event", noted)
    for realm in ("lab1", "lab2"):
        left.removes(left.recording(realm, "rover", realm=realm), f"rover@{realm}")
    left.recordings.open()
    await left.sweep()
    assert sorted(told) == [("robot:rover@lab1", "rover@lab1"), ("robot:rover@lab2", "rover@lab2")]


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


def test_what_is_kept_of_a_robot_is_counted(left: Left) -> None:
    """By what is on the disk; files that say nothing count for nobody."""
    rover = left.recording("a", "rover", RecordingState.RECORDING)
    left.recording("b", "rover")
    left.recording("c", "tank")
    (left.folder / "a.mcap").unlink()
    (left.folder / "d.json").write_bytes(b"nonsense")
    left.recordings.open()
    assert kept_of(left.folder, rover) == (2, 500)
    assert kept_of(left.folder / "nowhere", rover) == (0, 0)


@pytest_twisted.ensureDeferred
async def test_what_was_recorded_in_a_realm_goes_when_the_robot_is_taken_out_of_it(left: Left) -> None:
    """What another realm has recorded of it stays, and so does all that the database knows nothing of."""
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
        for realm, told in (("lab1", True), ("lab3", False)):
            queries.unshare_robot(session, rover, realm)
            if told:
                data = {"realm": realm}
                queries.append_audit(
                    session, at=BEGUN + 1, actor="cli:root", action="robot.unshare", target="rover", data=data
                )
    left.recordings.open()
    await left.sweep()
    assert sorted(entry.id for entry in left.recordings.library) == ["a", "c", "d"]
