"""The machine's address changes under a running robot: in a network namespace, with real DDS."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ALONE = ["unshare", "--net", *(["--map-root-user"] if os.getuid() else [])]
"""Runs a program in a network of its own."""


def _missing() -> str:
    """What this machine does not allow; empty: nothing."""
    if shutil.which("unshare") is None or shutil.which("ip") is None:
        return "unshare and ip (util-linux, iproute2) are not installed"
    words = "ip link add robot0 type veth peer name robot1"
    done = subprocess.run([*ALONE, "sh", "-c", words], capture_output=True, text=True, check=False)
    return f"no network of its own can be made: {done.stderr.strip()}" if done.returncode else ""


def test_the_daemon_stays_with_nodes_that_run_and_then_finds_those_that_started_since(tmp_path: Path) -> None:
    """When the only address has been replaced by another."""
    if reason := _missing():
        pytest.skip(reason)
    done = subprocess.run(
        [*ALONE, sys.executable, "-m", "tests.e2e.moved_network", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.splitlines() == ["THE FORMER NODES WORK", "THE NEW NODE IS FOUND"], done.stderr
