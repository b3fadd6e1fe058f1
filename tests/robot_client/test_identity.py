"""The state folder."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from robot_client.link.identity import KEY, Enrolment, StateError, StateFolder

ENROLMENT = Enrolment(address="relay:9091", robot="r1", relay="relay-1", tls=True, ca="/etc/ca.pem")


def enrolled(path: Path) -> StateFolder:
    folder = StateFolder(path)
    folder.prepare().commit(ENROLMENT)
    return folder


def test_key_is_for_its_owner_alone(tmp_path: Path) -> None:
    """The key has mode 0600 in a folder of mode 0700."""
    enrolled(tmp_path / "s")
    assert stat.S_IMODE((tmp_path / "s" / KEY).stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o700


def test_what_was_written_is_read(tmp_path: Path) -> None:
    """A committed enrolment loads with the key that was prepared."""
    enrolment, me = enrolled(tmp_path / "s").load()
    assert enrolment == ENROLMENT
    assert (me.robot, me.relay, len(me.key)) == ("r1", "relay-1", 32)
    assert sorted(each.name for each in (tmp_path / "s").iterdir()) == ["robot.json", "robot.key"]


def test_refused_enrolment_leaves_nothing(tmp_path: Path) -> None:
    """A preparation that is abandoned leaves neither key nor folder."""
    StateFolder(tmp_path / "s").prepare().abandon()
    assert not (tmp_path / "s").exists()


def test_refused_replacement_keeps_the_old(tmp_path: Path) -> None:
    """Abandoning a second enrolment leaves the first as it was."""
    folder = enrolled(tmp_path / "s")
    before = folder.load()
    folder.prepare().abandon()
    assert folder.load() == before


def test_not_enrolled_says_what_to_do(tmp_path: Path) -> None:
    """A folder without an enrolment says how to enrol."""
    with pytest.raises(StateError, match="switchboard-robot enroll"):
        StateFolder(tmp_path).load()


def test_readable_key_is_refused(tmp_path: Path) -> None:
    """A key that others may read is not used."""
    folder = enrolled(tmp_path / "s")
    (tmp_path / "s" / KEY).chmod(0o644)
    with pytest.raises(StateError, match="chmod 600"):
        folder.load()


@pytest.mark.parametrize(("name", "content"), [("robot.json", b"{"), ("robot.key", b"short")])
def test_damage_is_said(tmp_path: Path, name: str, content: bytes) -> None:
    """A damaged file is an error in words, not a traceback."""
    folder = enrolled(tmp_path / "s")
    (tmp_path / "s" / name).write_bytes(content)
    with pytest.raises(StateError, match="damaged"):
        folder.load()
