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
