"""A folder for the log files of ROS 2, which does not start without one."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import MutableMapping
from pathlib import Path

from twisted.logger import Logger

from robot_client.temporary import temporary_parent


def ensure_log_folder(environment: MutableMapping[str, str] = os.environ) -> None:
    """Set ``ROS_LOG_DIR`` to a temporary folder if no file can be created where ROS 2 logs. Call before
    ``rclpy.init``.

    Services often run as a user without a home, and a disk may be full or read-only.
    """
    folder = _chosen_folder(environment)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.NamedTemporaryFile(dir=folder).close()
    except OSError as error:
        temporary = _temporary_folder()
        if temporary:
            environment["ROS_LOG_DIR"] = temporary
            Logger("ros").warn(
                "ROS 2 logs into {temporary}, as {folder} can't be written: {reason}",
                temporary=temporary,
                folder=str(folder),
                reason=error.strerror,
            )


def _chosen_folder(environment: MutableMapping[str, str]) -> Path:
    """By the order of rcl_logging (``rcl_logging_get_logging_directory``)."""
    home = environment.get("HOME") or "/"
    chosen = environment.get("ROS_LOG_DIR")
    if not chosen:
        chosen = f"{environment.get('ROS_HOME') or '~/.ros'}/log"
    return Path(home + chosen[1:] if chosen.startswith("~") else chosen)


def _temporary_folder() -> str:
    """A folder that is removed when the program ends; empty if there can be none."""
    try:
        folder = tempfile.mkdtemp(prefix="ros-log-", dir=temporary_parent())
    except OSError:
        return ""
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
