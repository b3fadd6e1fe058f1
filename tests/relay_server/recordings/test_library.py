"""The folder of recordings, and its state after a restart."""

from __future__ import annotations

from pathlib import Path

import pytest

from relay_protocol.errors import Invalid, NotFound, Unavailable
from relay_protocol.realms import DEFAULT_REALM
from relay_server.recordings import library as module
from relay_server.recordings.library import NO_ROOM_NOW, Library, RecordingEntry, RecordingState, text_of


def entry(
    id: str = "a", *, robot: int = 1, begun: float = 1.0, limit: int = 1000, realm: str = DEFAULT_REALM
) -> RecordingEntry:
    """A running recording."""
    return RecordingEntry(
        id, robot, "rover", 7, "ann", ("/odom",), (), begun=begun, limit=limit, seconds=60.0, realm=realm
    )


@pytest.fixture
def library(tmp_path: Path) -> Library:
    """A folder with room for 3000 bytes."""
    library = Library(tmp_path / "recordings", 3000)
    library.open()
    return library


def test_a_robots_recordings_are_listed_the_latest_first(library: Library) -> None:
    """Recordings of other robots are neither listed nor found."""
    for each in (entry("a", begun=1), entry("b", begun=2), entry("c", robot=2)):
        library.add(each)
    assert [each.id for each in library.of(1)] == ["b", "a"]
    assert library.find(1, "a").id == "a"
    for robot, id in ((2, "a"), (1, "c"), (1, "../x")):
        with pytest.raises(NotFound):
            library.find(robot, id)


def test_running_recording_reserves_its_possible_size(library: Library) -> None:
    """A finished one counts with its size; more than the quota is refused."""
    first = entry("a", limit=2000)
    library.add(first)
    with pytest.raises(Unavailable, match="delete some"):
        library.add(entry("b", limit=1001))
    first.state, first.bytes = RecordingState.COMPLETE, 500
    library.add(entry("b", limit=2500))
    library.forget(first)
    assert library.used == 2500


def test_it_is_all_there_after_a_new_start(library: Library, tmp_path: Path) -> None:
    """A running recording is incomplete then, and temporary files are removed."""
    running, done = entry("a"), entry("b")
    done.state, done.bytes, done.problems = RecordingState.COMPLETE, 5, ["late"]
    for each in (running, done):
        library.save(each.id, text_of(each))
    folder = tmp_path / "recordings"
    (folder / "b.part").write_bytes(b"x")
    (folder / "c.new").write_bytes(b"x")
    (folder / "d.json").write_bytes(b"nonsense")
    again = Library(folder, 3000)
    again.open()
    assert again.find(1, "b") == done
    assert [each.id for each in again.incomplete()] == ["a"]
    assert again.find(1, "a").reason == "the relay ended unexpectedly"
    assert sorted(each.name for each in folder.iterdir()) == ["a.json", "b.json", "d.json"]
    assert folder.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("state", [RecordingState.RECORDING, RecordingState.INCOMPLETE])
def test_interrupted_recording_counts_with_its_file_size(
    library: Library, tmp_path: Path, state: RecordingState
) -> None:
    """A relay that was killed, or could not repair the file, has not stored its size."""
    broken, unbegun = entry("a"), entry("b")
    broken.state = unbegun.state = state
    for each in (broken, unbegun):
        library.save(each.id, text_of(each))
    library.path(broken).write_bytes(bytes(2900))
    again = Library(tmp_path / "recordings", 3000)
    again.open()
    assert (again.find(1, "a").bytes, again.find(1, "b").bytes) == (2900, 0)
    assert (again.used, again.left(DEFAULT_REALM)) == (2900, 100)


def test_a_copy_takes_room_too(library: Library) -> None:
    """As long as it exists."""
    broken = entry("b", limit=2500)
    broken.state, broken.bytes = RecordingState.INCOMPLETE, 1500
    library.add(broken)
    library.copied = broken
    assert (library.left(DEFAULT_REALM), library.left("lab1")) == (0, 3000)
    with pytest.raises(Unavailable, match="delete some"):
        library.add(entry())
    library.copied = None
    library.add(entry())


def test_there_are_only_so_many(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    """Per robot and in total, for any size; deleting makes room."""
    monkeypatch.setattr(module, "ROBOT_KEPT", 2)
    monkeypatch.setattr(module, "KEPT", 3)
    for id in ("a", "b"):
        library.add(entry(id, limit=1))
    with pytest.raises(Unavailable, match=r"2 recordings of this robot are stored.*delete some of them"):
        library.add(entry("c", limit=1))
    library.add(entry("c", robot=2, limit=1))
    with pytest.raises(Unavailable, match=r"3 recordings are stored.*in all: delete some, of any robot"):
        library.add(entry("d", robot=2, limit=1))
    library.forget(library.find(1, "a"))
    assert library.full(1, DEFAULT_REALM) == library.full(2, DEFAULT_REALM) == ""
    library.add(entry("d", robot=1, limit=1))
    assert [each.id for each in library.of(1)] == ["d", "b"]


def test_a_realm_sees_only_its_own_recordings(library: Library) -> None:
    """The free space that a realm sees does not depend on others."""
    library.add(entry("a", limit=2000))
    library.add(entry("b", robot=2, limit=500, realm="lab1"))
    assert (library.left(DEFAULT_REALM), library.left("lab1"), library.left("lab2")) == (1000, 2500, 3000)
    library.quota = 3 * 10**6
    with pytest.raises(Unavailable, match="3 MB in all, of which 2 MB are left"):
        library.add(entry("c", robot=2, limit=4 * 10**6, realm="lab1"))


def test_all_realms_together_have_no_more_than_there_is(library: Library) -> None:
    """The error does not say how much other realms use."""
    library.add(entry("a", limit=2000))
    with pytest.raises(Unavailable) as caught:
        library.add(entry("b", robot=2, limit=1001, realm="lab1"))
    assert str(caught.value) == NO_ROOM_NOW
    library.add(entry("b", robot=2, limit=1000, realm="lab1"))
    assert library.used == 3000


def test_recording_is_refused_beforehand_without_space(library: Library) -> None:
    """The error has the size only if the realm itself uses the space."""
    library.quota = 3 * 10**6
    library.add(entry("a", limit=2 * 10**6 + 1))
    assert library.full(2, "lab1") == NO_ROOM_NOW
    assert library.full(1, DEFAULT_REALM) == ""
    with pytest.raises(Unavailable, match="of which 0 MB are left"):
        library.add(entry("b", limit=10**6))


def test_realms_keep_only_so_many_together(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error has the number only if the realm itself has them; otherwise it says that there is no room."""
    monkeypatch.setattr(module, "KEPT", 2)
    library.add(entry("a", limit=1))
    library.add(entry("b", robot=2, limit=1, realm="lab1"))
    assert library.full(1, DEFAULT_REALM) == library.full(2, "lab1") == NO_ROOM_NOW
    library.forget(library.find(2, "b"))
    library.add(entry("b", limit=1))
    assert "2 recordings are stored" in library.full(1, DEFAULT_REALM)
    assert library.full(2, "lab1") == NO_ROOM_NOW


def test_old_entries_belong_to_the_default_realm(library: Library, tmp_path: Path) -> None:
    """Their files name no realm; new ones do."""
    for each in (entry("a"), entry("b", robot=2, realm="lab1")):
        library.save(each.id, text_of(each).replace(b',"realm":"default"', b""))
    again = Library(tmp_path / "recordings", 3000)
    again.open()
    assert [(each.id, each.realm) for each in (again.find(1, "a"), again.find(2, "b"))] == [
        ("a", DEFAULT_REALM),
        ("b", "lab1"),
    ]


def test_of_the_disk_some_stays_free(library: Library, tmp_path: Path) -> None:
    """A small reserve is available here; more than any disk has is not."""
    assert library.spare() > 0
    assert not library.nearly_full()
    careful = Library(tmp_path / "recordings", 3000, reserve=2**62)
    assert careful.nearly_full()


def test_a_deleted_recording_leaves_nothing(library: Library, tmp_path: Path) -> None:
    """Even if only one of its files exists, or none."""
    gone = entry()
    library.save(gone.id, text_of(gone))
    library.path(gone).write_bytes(b"x")
    for _ in range(2):
        library.delete(gone.id)
    assert list((tmp_path / "recordings").iterdir()) == []


def test_an_unusable_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "recordings").write_text("a file")
    with pytest.raises(Invalid, match="the folder of recordings cannot be used"):
        Library(tmp_path / "recordings", 1).open()
