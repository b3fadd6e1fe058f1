"""The folder of recordings, and what is found there at the start."""

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
    """A recording that runs."""
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
    """Those of others are neither listed nor found."""
    for each in (entry("a", begun=1), entry("b", begun=2), entry("c", robot=2)):
        library.add(each)
    assert [each.id for each in library.of(1)] == ["b", "a"]
    assert library.find(1, "a").id == "a"
    for robot, id in ((2, "a"), (1, "c"), (1, "../x")):
        with pytest.raises(NotFound):
            library.find(robot, id)


def test_what_runs_takes_what_it_may_become(library: Library) -> None:
    """What is finished takes what it has; more than the quota is refused."""
    first = entry("a", limit=2000)
    library.add(first)
    with pytest.raises(Unavailable, match="delete some"):
        library.add(entry("b", limit=1001))
    first.state, first.bytes = RecordingState.COMPLETE, 500
    library.add(entry("b", limit=2500))
    library.forget(first)
    assert library.used == 2500


def test_it_is_all_there_after_a_new_start(library: Library, tmp_path: Path) -> None:
    """What ran is incomplete then, and what was begun only to be replaced is gone."""
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
    assert again.find(1, "a").reason == "the relay ended without warning"
    assert sorted(each.name for each in folder.iterdir()) == ["a.json", "b.json", "d.json"]
    assert folder.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("state", [RecordingState.RECORDING, RecordingState.INCOMPLETE])
def test_what_broke_off_takes_the_room_that_its_file_has(
    library: Library, tmp_path: Path, state: RecordingState
) -> None:
    """A relay that was killed wrote nothing down of that, nor did one that could not mend it."""
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
    """As long as it is there."""
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
    """Of one robot, and in all, however small; what is deleted makes place."""
    monkeypatch.setattr(module, "ROBOT_KEPT", 2)
    monkeypatch.setattr(module, "KEPT", 3)
    for id in ("a", "b"):
        library.add(entry(id, limit=1))
    with pytest.raises(Unavailable, match=r"2 recordings of this robot are kept.*delete some of them"):
        library.add(entry("c", limit=1))
    library.add(entry("c", robot=2, limit=1))
    with pytest.raises(Unavailable, match=r"3 recordings are kept.*in all: delete some, of any robot"):
        library.add(entry("d", robot=2, limit=1))
    library.forget(library.find(1, "a"))
    assert library.full(1, DEFAULT_REALM) == library.full(2, DEFAULT_REALM) == ""
    library.add(entry("d", robot=1, limit=1))
    assert [each.id for each in library.of(1)] == ["d", "b"]


def test_a_realm_is_told_of_its_own_recordings_only(library: Library) -> None:
    """What others keep takes nothing off what it is told to have left."""
    library.add(entry("a", limit=2000))
    library.add(entry("b", robot=2, limit=500, realm="lab1"))
    assert (library.left(DEFAULT_REALM), library.left("lab1"), library.left("lab2")) == (1000, 2500, 3000)
    library.quota = 3 * 10**6
    with pytest.raises(Unavailable, match="3 MB in all, of which 2 MB are left"):
        library.add(entry("c", robot=2, limit=4 * 10**6, realm="lab1"))


def test_all_realms_together_have_no_more_than_there_is(library: Library) -> None:
    """Where others take the room a realm is told that there is none, and not how much they have."""
    library.add(entry("a", limit=2000))
    with pytest.raises(Unavailable) as caught:
        library.add(entry("b", robot=2, limit=1001, realm="lab1"))
    assert str(caught.value) == NO_ROOM_NOW
    library.add(entry("b", robot=2, limit=1000, realm="lab1"))
    assert library.used == 3000


def test_who_could_record_nothing_beside_others_is_told_before(library: Library) -> None:
    """Who takes the room himself is told how much it is."""
    library.quota = 3 * 10**6
    library.add(entry("a", limit=2 * 10**6 + 1))
    assert library.full(2, "lab1") == NO_ROOM_NOW
    assert library.full(1, DEFAULT_REALM) == ""
    with pytest.raises(Unavailable, match="of which 0 MB are left"):
        library.add(entry("b", limit=10**6))


def test_realms_keep_only_so_many_together(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who keeps them himself is told the number; others are told only that there is no room."""
    monkeypatch.setattr(module, "KEPT", 2)
    library.add(entry("a", limit=1))
    library.add(entry("b", robot=2, limit=1, realm="lab1"))
    assert library.full(1, DEFAULT_REALM) == library.full(2, "lab1") == NO_ROOM_NOW
    library.forget(library.find(2, "b"))
    library.add(entry("b", limit=1))
    assert "2 recordings are kept" in library.full(1, DEFAULT_REALM)
    assert library.full(2, "lab1") == NO_ROOM_NOW


def test_what_was_kept_before_there_were_realms_is_of_the_default_one(
    library: Library, tmp_path: Path
) -> None:
    """Its file says nothing of any; what is written now does."""
    for each in (entry("a"), entry("b", robot=2, realm="lab1")):
        library.save(each.id, text_of(each).replace(b',"realm":"default"', b""))
    again = Library(tmp_path / "recordings", 3000)
    again.open()
    assert [(each.id, each.realm) for each in (again.find(1, "a"), again.find(2, "b"))] == [
        ("a", DEFAULT_REALM),
        ("b", "lab1"),
    ]


def test_of_the_disk_some_stays_free(library: Library, tmp_path: Path) -> None:
    """More than that is free here; more than any disk has is not."""
    assert library.spare() > 0
    assert not library.nearly_full()
    careful = Library(tmp_path / "recordings", 3000, reserve=2**62)
    assert careful.nearly_full()


def test_a_deleted_recording_leaves_nothing(library: Library, tmp_path: Path) -> None:
    """Also if only one of its files is there, or none."""
    gone = entry()
    library.save(gone.id, text_of(gone))
    library.path(gone).write_bytes(b"x")
    for _ in range(2):
        library.delete(gone.id)
    assert list((tmp_path / "recordings").iterdir()) == []


def test_a_folder_that_can_not_be_used_is_told(tmp_path: Path) -> None:
    """In words."""
    (tmp_path / "recordings").write_text("a file")
    with pytest.raises(Invalid, match="the folder of recordings can't be used"):
        Library(tmp_path / "recordings", 1).open()
