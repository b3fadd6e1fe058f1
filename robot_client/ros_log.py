"""A place for the log files of ROS 2, without which it refuses to start."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import MutableMapping
from pathlib import Path


def ensure_log_folder(environment: MutableMapping[str, str] = os.environ) -> None:
    """Point ``ROS_LOG_DIR`` to a temporary folder when the usual one can't be written. Call before ``rclpy.init``.

    Services often run as a user without a home. The order of the places is that of rcl_logging
    (``rcl_logging_get_logging_directory``): ROS_LOG_DIR, ROS_HOME/log, ~/.ros/log.
    """
    if environment.get("ROS_LOG_DIR") or environment.get("ROS_HOME"):
        return
    usual = Path(environment.get("HOME") or "/", ".ros", "log")
    try:
        usual.mkdir(parents=True, exist_ok=True)
    except OSError:
        usable = False
    else:
        usable = os.access(usual, os.W_OK | os.X_OK)
    if not usable:
        environment["ROS_LOG_DIR"] = folder = tempfile.mkdtemp(prefix="ros-log-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
