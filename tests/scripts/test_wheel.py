"""The wheel of a release, built once, and tried where no checkout is."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.scripts.test_packaging import ROOT, SOURCES

CHECK = ROOT / "scripts/check_wheel.py"
INPUTS = ("setup.cfg", "pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md")
PAGE = "relay_server/portal/index.html"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, since building writes into the checkout."""
    folder = tmp_path_factory.mktemp("checkout")
    for each in INPUTS:
        shutil.copy(ROOT / each, folder)
    for each in (ROOT / "deploy", *SOURCES.values()):
        shutil.copytree(
            each, folder / each.relative_to(ROOT), ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
        )
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", folder], check=True, stdout=subprocess.DEVNULL
    )
    (built,) = (folder / "dist").glob("*.whl")
    return built


def check(wheel: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """``scripts/check_wheel.py``"""
    return subprocess.run(
        [sys.executable, CHECK, wheel, *options],
        cwd=wheel.parent,
        capture_output=True,
        text=True,
        check=False,
    )


def test_wheel_has_each_file_of_the_packages_and_no_other(wheel: Path) -> None:
    expected = {
        f"{package}/{file.relative_to(folder)}"
        for package, folder in SOURCES.items()
        for file in folder.rglob("*")
        if file.is_file() and "__pycache__" not in file.parts and ".egg-info" not in str(file)
    }
    found = {each for each in zipfile.ZipFile(wheel).namelist() if not each.startswith("robot_switchboard-")}
    assert found == expected
    assert PAGE in found


def test_relay_and_robot_of_the_wheel_work_without_the_checkout(wheel: Path) -> None:
    dependencies = next(Path(each) for each in sys.path if Path(each, "twisted").is_dir())
    done = check(
        wheel, "--relay", sys.executable, "--robot", sys.executable, "--dependencies", str(dependencies)
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "serves the portal, logs in" in done.stdout
    assert "robot on Python" in done.stdout


@pytest.mark.parametrize(
    ("left_out", "added", "words"),
    [
        (PAGE, "", f"missing ['{PAGE}'"),
        ("relay_server/portal/assets/index-", "", "missing ['assets/index-"),
        ("relay_db/migrations/env.py", "", "missing ['relay_db/migrations/env.py']"),
        ("-", "tests/conftest.py", "not expected ['tests/conftest.py']"),
    ],
)
def test_incomplete_wheels_and_strange_files_are_refused(
    wheel: Path, tmp_path: Path, left_out: str, added: str, words: str
) -> None:
    damaged = tmp_path / wheel.name
    with zipfile.ZipFile(wheel) as whole, zipfile.ZipFile(damaged, "w") as changed:
        for each in whole.namelist():
            if not each.startswith(left_out):
                changed.writestr(each, whole.read(each))
        if added:
            changed.writestr(added, "")
    done = check(damaged)
    assert done.returncode != 0
    assert words in done.stderr
