"""Searches for processes, among real ones."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress

import pytest

from robot_client.modules import processes
from tests.worlds.module_daemon_process import has_ended
from tests.worlds.waiting import wait_for

FORKS_AND_ENDS = "import os, sys, time; sys.stdin.read(); os.fork() and os._exit(0); time.sleep(600)"


def test_process_is_killed_that_was_forked_by_one_that_ended_during_the_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    program = subprocess.Popen(
        [sys.executable, "-c", FORKS_AND_ENDS], stdin=subprocess.PIPE, start_new_session=True
    )
    listed = processes.pids

    def list_and_let_fork() -> list[int]:
        found = listed()
        program.communicate()
        return found

    left = processes.RunProcesses(processes.ProcessSession.begun_by(program.pid), "no run has this id")
    monkeypatch.setattr(processes, "pids", list_and_let_fork)
    try:
        killed = processes.kill_all(lambda pid, _: left.hold(pid), rounds=2)
        assert len(killed) == 1 and killed != {program.pid}
        wait_for("its end", lambda: all(has_ended(each) for each in killed))
    finally:
        with suppress(ProcessLookupError):
            os.killpg(program.pid, signal.SIGKILL)
