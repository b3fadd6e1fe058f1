"""The suite's own machinery: what becomes of a case, the table, the exit status."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CASES = '''
import pytest
from conformance_suite import case, not_offered, not_tried

@case("good", "section 1")
def test_good():
    """It works."""

@case("known", "section 2", suite="it is known (some_file.py)")
def test_known():
    """It is known to differ."""
    assert 1 == 2

@case("known", "section 2", suite="it is known (some_file.py)")
def test_known_but_good():
    """It was known to differ."""

@case("missing", "section 3")
def test_missing():
    """It can't be tried."""
    not_tried("no TOKEN was given")

@case("missing", "section 3")
def test_not_offered():
    """It is not there."""
    not_offered("no wheels")
'''
BAD = '''
@case("bad", "section 4")
@pytest.mark.parametrize("what", ["[red]"])
def test_bad(what):
    """It fails."""
    assert "this" == "that"
'''


def run(folder: Path, cases: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run cases as ``make conformance`` does."""
    file = folder / "test_cases.py"
    file.write_text(cases)
    paths = [str(HERE), str(ROOT / "protocol"), str(ROOT / "tests" / "harness")]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "conftest",
        "-c",
        os.devnull,
    ]
    command += ["--rootdir", str(folder), "--table", *options, str(file)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, cwd=folder, env=environment
    )


def test_known_differences_of_the_target_are_no_failures(tmp_path: Path) -> None:
    """With the target named, a marked case that fails differs as known, with the reason, and the status is 0."""
    done = run(tmp_path, CASES, "--target", "rosbridge_suite")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 passed, 1 differs, 1 not tried, 1 not offered" in done.stdout
    for text in ("differs as known", "it is known (some_file.py)", "no TOKEN was given", "no wheels"):
        assert text in done.stdout


def test_without_the_target_they_are(tmp_path: Path) -> None:
    """Without the target named, the same case is a failure, and the status is 1."""
    done = run(tmp_path, CASES)
    assert done.returncode == 1
    assert "2 passed, 1 failed, 1 not tried, 1 not offered" in done.stdout


def test_a_failure_is_one_whatever_the_target(tmp_path: Path) -> None:
    """A case without a mark that fails is a failure for every target; its title and remark stand as they are."""
    done = run(tmp_path, CASES + BAD, "--target", "rosbridge_suite")
    assert done.returncode == 1
    assert "It fails. [[red]]" in done.stdout
    assert "assert 'this' == 'that'" in done.stdout


def test_a_server_that_is_not_there_is_told_in_a_sentence(tmp_path: Path) -> None:
    """An address nobody listens at ends the run with status 2 and says so."""
    cases = "def test_it(server):\n    pass\n"
    done = run(tmp_path, cases, "--url", "ws://127.0.0.1:1")
    assert done.returncode == 2
    assert "ws://127.0.0.1:1 can't be reached" in done.stdout
