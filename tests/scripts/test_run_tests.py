"""``make test`` gives a few failed tests a second chance, on small test files made for it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

FAILS = "def test_fails():\n    assert False\n"
"""Fails each time."""

FLAKY = """
from pathlib import Path

def test_flaky():
    mark = Path(__file__).with_name("mark")
    first = not mark.exists()
    mark.touch()
    assert not first
"""
"""Fails the first time."""

VANISHES = """
from pathlib import Path
import pytest

@pytest.mark.parametrize("run", ["second" if Path("build/ran").exists() else "first"])
def test_vanishes(run):
    Path("build/ran").touch()
    assert False
"""
"""Fails, and has another name in the second run."""

PASSES = "def test_passes():\n    pass\n"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with a copy of the script."""
    (tmp_path / "scripts").mkdir()
    shutil.copy("scripts/run_tests.py", tmp_path / "scripts")
    return tmp_path


def run(project: Path, **files: str) -> subprocess.CompletedProcess[str]:
    """Write test files, and run them."""
    for name, text in files.items():
        (project / f"test_{name}.py").write_text(text)
    command = [sys.executable, "scripts/run_tests.py"]
    return subprocess.run(command, cwd=project, capture_output=True, text=True, check=False)


def flaky(project: Path) -> list[str]:
    return (project / "build" / "flaky.txt").read_text().splitlines()


def test_a_test_that_passes_the_second_time_is_listed_and_fails_nothing(project: Path) -> None:
    done = run(project, one=FLAKY, two=PASSES)
    assert done.returncode == 0, done.stdout + done.stderr
    assert flaky(project) == ["test_one.py::test_flaky"]
    assert "flaky: test_one.py::test_flaky" in done.stdout


def test_a_test_that_is_not_found_again_fails_the_run(project: Path) -> None:
    done = run(project, one=FLAKY, two=VANISHES)
    assert done.returncode == 1
    assert flaky(project) == ["test_one.py::test_flaky"]


@pytest.mark.parametrize(("count", "runs"), [(10, 2), (11, 1)])
def test_failures_in_more_than_ten_files_fail_at_once(project: Path, count: int, runs: int) -> None:
    twice = FAILS + FAILS.replace("fails", "fails_too")
    done = run(project, **{f"many_{number}": twice for number in range(count)})
    assert done.returncode == 1
    assert done.stdout.count(f"{2 * count} failed in") == runs
    assert flaky(project) == []


def test_an_error_of_the_run_itself_has_no_second_chance(project: Path) -> None:
    """No tests at all."""
    done = run(project)
    assert done.returncode == 5
    assert done.stdout.count("no tests ran") == 1
