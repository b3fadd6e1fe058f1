"""ROS 2 finds a folder for its logs, with and without a home."""

from pathlib import Path

from robot_client.ros_log import ensure_log_folder


def test_a_writable_home_is_used_as_ever(tmp_path: Path) -> None:
    """Nothing is changed where ROS's own place works."""
    environment = {"HOME": str(tmp_path)}
    ensure_log_folder(environment)
    assert environment == {"HOME": str(tmp_path)}
    assert (tmp_path / ".ros" / "log").is_dir()


def test_without_a_home_logs_go_to_a_temporary_folder(tmp_path: Path) -> None:
    """A home that can't be made (here: below a file) is replaced by a folder that is there."""
    (tmp_path / "file").touch()
    environment = {"HOME": str(tmp_path / "file")}
    ensure_log_folder(environment)
    assert Path(environment["ROS_LOG_DIR"]).is_dir()


def test_a_chosen_folder_stays_chosen() -> None:
    """Who set ROS_LOG_DIR or ROS_HOME knows why."""
    for name in ("ROS_LOG_DIR", "ROS_HOME"):
        environment = {name: "/chosen", "HOME": "/nonexistent"}
        ensure_log_folder(environment)
        assert environment == {name: "/chosen", "HOME": "/nonexistent"}
