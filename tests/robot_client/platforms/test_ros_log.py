"""ROS 2 finds a folder for its logs, with and without a home and a disk."""

import tempfile
from pathlib import Path

import pytest

from robot_client.ros_log import ensure_log_folder


def test_writable_default_folder_is_used(tmp_path: Path) -> None:
    environment = {"HOME": str(tmp_path)}
    ensure_log_folder(environment)
    assert environment == {"HOME": str(tmp_path)}
    assert (tmp_path / ".ros" / "log").is_dir()


@pytest.mark.parametrize("variable", ["HOME", "ROS_HOME", "ROS_LOG_DIR"])
def test_instead_of_a_folder_that_can_not_be_written_there_is_a_temporary_one(
    tmp_path: Path, variable: str
) -> None:
    (tmp_path / "file").touch()
    environment = {"HOME": str(tmp_path), variable: str(tmp_path / "file")}
    ensure_log_folder(environment)
    assert environment["ROS_LOG_DIR"] != str(tmp_path / "file")
    assert Path(environment["ROS_LOG_DIR"]).is_dir()


@pytest.mark.parametrize(
    ("variable", "value", "folder"),
    [("ROS_LOG_DIR", "{}/chosen", "chosen"), ("ROS_HOME", "{}/ros", "ros/log"), ("ROS_LOG_DIR", "~/l", "l")],
)
def test_configured_folder_is_not_changed(tmp_path: Path, variable: str, value: str, folder: str) -> None:
    chosen = value.format(tmp_path)
    environment = {"HOME": str(tmp_path), variable: chosen}
    ensure_log_folder(environment)
    assert environment == {"HOME": str(tmp_path), variable: chosen}
    assert (tmp_path / folder).is_dir()


def test_if_no_disk_can_be_written_logs_are_kept_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: [str(tmp_path / "file")])
    environment = {"HOME": str(tmp_path / "file")}
    ensure_log_folder(environment)
    assert environment["ROS_LOG_DIR"].startswith("/dev/shm/")
