"""Hostile modules beside one that must not be disturbed: real programs, all at the same time."""

from __future__ import annotations

import sys
from collections.abc import Callable

from tests.worlds.hostile_module import HOSTILE
from tests.worlds.module_daemon_process import Daemon, has_ended, runners
from tests.worlds.waiting import wait_for

WITNESS = """
import signal, time
signal.alarm(600)  # nothing else ends it if the test is killed
for number in range(10**6):
    print(number)
    time.sleep(0.05)
"""


def test_hostile_modules_are_stopped_and_disturb_no_other(start: Callable[..., Daemon]) -> None:
    hostile = [
        {
            "name": name,
            "command": [sys.executable, "-u", "-m", "tests.worlds.hostile_module", name],
            "ready_log": "^up$",
            "nice": 19,
            "log_mb": 0.1,
            "memory_mb": 512,
        }
        for name in HOSTILE
    ]
    daemon = start({"name": "witness", "command": [sys.executable, "-u", "-c", WITNESS]}, *hostile)
    for name in HOSTILE:
        daemon.is_("running", name)
    (witness,) = wait_for("a process", lambda: daemon.pids_of("witness"))
    hidden = int(daemon.texts("leaves_its_process_group")[0])
    seen = len(daemon.texts("witness"))
    wait_for("it goes on", lambda: len(daemon.texts("witness")) > seen + 10)
    for name in HOSTILE:
        daemon.order("stop", name)
    for name in HOSTILE:
        daemon.is_("stopped", name)
    assert daemon.pids() == [witness] and has_ended(hidden)
    wait_for("the end of their runners", lambda: len(runners(daemon.folder)) == 1)
    texts = daemon.texts("witness")
    wait_for("it goes on", lambda: len(daemon.texts("witness")) > len(texts) + 5)
    # No line is missing, and it was never started again.
    texts = daemon.texts("witness")
    assert texts == [str(number) for number in range(len(texts))]
    assert daemon.states("witness") == ["waiting", "starting", "running"]
    assert daemon.pids_of("witness") == [witness]
    assert all("witness" not in each for each in daemon.alerts())
    daemon.end()
