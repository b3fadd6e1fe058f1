"""A test run that is killed leaves nothing behind."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import switchboard_processes
from switchboard_waiting import wait_for

HARNESS = Path(switchboard_processes.__file__).parent
STARTER = """
import sys
from pathlib import Path
from switchboard_processes import Process
child = "import time; print('READY', flush=True); time.sleep(600)"
started = Process([sys.executable, "-c", child], Path(sys.argv[1]), "child")
started.wait_to_say("READY")
print(started.popen.pid, flush=True)
started.popen.wait()
"""


def test_a_killed_test_run_takes_its_processes_along(tmp_path: Path) -> None:
    """What the harness started ends when the process that started it is killed by SIGKILL."""
    path = ":".join([str(HARNESS), *filter(None, sys.path)])
    starter = subprocess.Popen(
        [sys.executable, "-c", STARTER, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        env={"PYTHONPATH": path, "PATH": "/usr/bin:/bin"},
    )
    try:
        assert starter.stdout is not None
        status = Path("/proc") / starter.stdout.readline().strip() / "stat"
        assert _runs(status)
    finally:
        starter.kill()
        starter.communicate(timeout=30)
    wait_for("the child has ended", lambda: not _runs(status))


def _runs(status: Path) -> bool:
    """Whether there is such a process and it is no zombie; orphans are reaped by whoever adopts them."""
    try:
        return status.read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
