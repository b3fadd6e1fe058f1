"""A real command on terminals without Unicode, to a full disk and to a closed pipe."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from tests.worlds.empty_database import write_empty_database
from tests.worlds.processes import BIN


def switchboard(data: Path, *arguments: str, **options: object) -> subprocess.CompletedProcess[bytes]:
    command = [str(BIN / "switchboard"), "--data", str(data), *arguments]
    return subprocess.run(command, stderr=subprocess.PIPE, check=False, **options)  # type: ignore[call-overload,no-any-return]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot whose description has characters of several alphabets."""
    data = tmp_path_factory.mktemp("data")
    write_empty_database(data / "switchboard.db")
    added = switchboard(data, "robot", "add", "rover", "--description", "Tür – 門", stdout=subprocess.DEVNULL)
    assert added.returncode == 0, added.stderr
    return data


@pytest.mark.parametrize(
    ("encoding", "shown"), [("ascii", b"T?r ? ?"), ("latin-1", b"T\xfcr ? ?"), ("utf-8", "Tür – 門".encode())]
)
def test_a_list_is_printed_on_any_terminal(data: Path, encoding: str, shown: bytes) -> None:
    env = {**os.environ, "PYTHONIOENCODING": encoding}
    done = switchboard(data, "robot", "list", stdout=subprocess.PIPE, env=env)
    assert (done.returncode, done.stderr) == (0, b"")
    assert shown in done.stdout


def test_a_full_disk_is_told(data: Path) -> None:
    with Path("/dev/full").open("wb") as full:
        done = switchboard(data, "robot", "list", stdout=full)
    assert done.returncode == 1
    assert done.stderr == b"Error: the output cannot be written: No space left on device\n"


def test_a_closed_pipe_ends_it_silently(data: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = switchboard(data, "robot", "list", stdout=writing)
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (1, b"")
