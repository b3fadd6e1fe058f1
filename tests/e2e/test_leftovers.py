"""A killed test run leaves neither processes nor files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.worlds import processes
from tests.worlds.waiting import wait_for

ROOT = Path(processes.__file__).parents[2]
STARTER = """
import sys
from pathlib import Path
from tests.worlds.processes import Process
child = "import time; print('READY', flush=True); time.sleep(600)"
started = Process([sys.executable, "-c", child], Path(sys.argv[1]), "child")
started.wait_to_say("READY")
print(started.popen.pid, flush=True)
started.popen.wait()
"""


def test_a_killed_test_run_takes_its_processes_along(tmp_path: Path) -> None:
    path = ":".join([str(ROOT), *filter(None, sys.path)])
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
    """Whether the process exists and is no zombie; the adopter of an orphan may reap it late."""
    try:
        return status.read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
