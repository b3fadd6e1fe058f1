"""The state folder."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from robot_client.cli import main as robot_program
from robot_client.link.enrolment import KEY, Enrolment, StateError, StateFolder
from robot_client.mqtt_gateway import main as gateway_program

ENROLMENT = Enrolment(address="relay:9091", robot="r1", relay="relay-1", tls=True, ca="/etc/ca.pem")


def enrolled(path: Path) -> StateFolder:
    folder = StateFolder(path)
    folder.prepare().commit(ENROLMENT)
    return folder


def test_only_the_owner_may_read_the_key(tmp_path: Path) -> None:
    enrolled(tmp_path / "s")
    assert stat.S_IMODE((tmp_path / "s" / KEY).stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o700


def test_committed_enrolment_is_loaded(tmp_path: Path) -> None:
    enrolment, me = enrolled(tmp_path / "s").load()
    assert enrolment == ENROLMENT
    assert (me.robot, me.relay, len(me.key)) == ("r1", "relay-1", 32)
    assert sorted(each.name for each in (tmp_path / "s").iterdir()) == ["robot.json", "robot.key"]


def test_authorities_are_stored_with_the_enrolment(tmp_path: Path) -> None:
    """So the folder can be moved, and read by another user who may not read where they came from."""
    StateFolder(tmp_path / "s").prepare().commit(ENROLMENT, b"PEM")
    (tmp_path / "s").rename(tmp_path / "moved")
    enrolment, _ = StateFolder(tmp_path / "moved").load()
    assert (enrolment.ca, Path(enrolment.ca).read_bytes()) == (str(tmp_path / "moved" / "ca.pem"), b"PEM")


def test_abandoned_preparation_leaves_nothing(tmp_path: Path) -> None:
    StateFolder(tmp_path / "s").prepare().abandon()
    assert not (tmp_path / "s").exists()


def test_abandoned_replacement_keeps_the_enrolment(tmp_path: Path) -> None:
    folder = enrolled(tmp_path / "s")
    before = folder.load()
    folder.prepare().abandon()
    assert folder.load() == before


@pytest.mark.parametrize(
    ("program", "arguments"), [(robot_program, ["run"]), (gateway_program, [])], ids=["robot", "gateway"]
)
def test_folder_that_a_daemon_uses_is_refused_to_another_one(
    tmp_path: Path, program: click.Command, arguments: list[str]
) -> None:
    folder = enrolled(tmp_path / "s")
    descriptor = folder.lock()
    try:
        options = [*arguments, "--state", str(folder.path)]
        environment = {"SWITCHBOARD_ROBOT_MQTT_BROKER": "127.0.0.1:1"}
        done = CliRunner().invoke(program, options, env=environment)
        assert done.exit_code == 1
        assert f"another daemon runs with the state folder {folder.path}; stop it first" in done.output
        assert not os.get_inheritable(descriptor)
        folder.prepare().commit(ENROLMENT)  # as does 'enroll --replace'
    finally:
        os.close(descriptor)
    os.close(folder.lock())


def test_error_without_an_enrolment_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(StateError, match="switchboard-robot enroll"):
        StateFolder(tmp_path).load()


def test_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    folder = enrolled(tmp_path / "s")
    (tmp_path / "s" / KEY).chmod(0o644)
    with pytest.raises(StateError, match="chmod 600"):
        folder.load()


@pytest.mark.parametrize(("name", "content"), [("robot.json", b"{"), ("robot.key", b"short")])
def test_damaged_files_are_reported(tmp_path: Path, name: str, content: bytes) -> None:
    folder = enrolled(tmp_path / "s")
    (tmp_path / "s" / name).write_bytes(content)
    with pytest.raises(StateError, match="damaged"):
        folder.load()
