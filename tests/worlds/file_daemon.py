"""A robot's daemon on a platform without ROS, as a process: ``python -m tests.worlds.file_daemon STATE SETTINGS``."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from robot_client import config, logs
from robot_client.link.enrolment import StateFolder
from robot_client.motion.stop_store import DiskStopStore
from robot_client.run import DaemonProcess
from robot_client.twisted_types import monotonic_reactor
from tests.worlds.memory_platform import MemoryPlatform
from tests.worlds.processes import Process

PRESSURE = {
    "SWITCHBOARD_ROBOT_OFFLOAD_CYCLE_SECONDS": "0.5",
    "SWITCHBOARD_ROBOT_OFFLOAD_CRITICAL_MEMORY": "0",
}
"""Settings by which the memory of any machine is critical; without them nothing is (``tests/conftest.py``)."""


def file_daemon(state: Path, settings: Path, folder: Path, **variables: str) -> Process:
    """Starts such a daemon.

    :param settings: the file of its settings
    :param folder: for its output
    :param variables: further settings, as environment variables
    """
    command = [sys.executable, "-m", "tests.worlds.file_daemon", str(state), str(settings)]
    return Process(
        command, folder, "daemon", {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), **variables}
    )


def main() -> None:
    state, path = Path(sys.argv[1]), Path(sys.argv[2])
    settings = config.load(path, os.environ)
    enrolment, identity = StateFolder(state).load()
    logs.begin(False)
    reactor = monotonic_reactor()
    store = DiskStopStore(state)
    process = DaemonProcess(
        reactor, settings, enrolment, identity, store, state / "modules", MemoryPlatform()
    )
    process.start()
    reactor.addSystemEventTrigger("before", "shutdown", process.stop)
    reactor.run()


if __name__ == "__main__":
    main()
