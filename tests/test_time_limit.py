"""A test that never ends, on a small file made for it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.worlds.doc_scene import ROOT

CONFTEST = """
from tests.time_limit import TimeLimit

def pytest_configure(config):
    config.pluginmanager.register(TimeLimit(0.5))
"""
ENDLESS = """
import threading

import pytest
import pytest_twisted
from twisted.internet.defer import Deferred

def test_that_waits_for_a_thread():
    threading.Event().wait()

@pytest_twisted.ensureDeferred
async def test_that_waits_for_the_reactor():
    await Deferred()

@pytest.fixture
def never():
    threading.Event().wait()

def test_whose_fixture_waits(never):
    pass

def test_that_ends():
    pass
"""


def test_endless_tests_fail_with_their_stacks_and_the_others_run(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_endless.py").write_text(ENDLESS)
    command = [sys.executable, "-m", "pytest", "-n", "1", "--reactor=default", "-rA", "--tb=short"]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    for ended in (
        "FAILED test_endless.py::test_that_waits_for_a_thread",
        "FAILED test_endless.py::test_that_waits_for_the_reactor",
        "ERROR test_endless.py::test_whose_fixture_waits",
        "PASSED test_endless.py::test_that_ends",
    ):
        assert ended in done.stdout
    assert 'test_endless.py", line 9 in test_that_waits_for_a_thread' in done.stdout
