"""The command as a process: its imports, the files it leaves, and what other users can see."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.worlds.empty_database import write_empty_database

PASSWORD = "correct horse battery"
PROGRAM = "from relay_server.cli import main; main(prog_name='switchboard')"


def _run(
    data: Path, *arguments: str, stdin: str = "", program: str = PROGRAM, **environment: str
) -> subprocess.CompletedProcess[str]:
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "SWITCHBOARD_DATA": str(data),
        **environment,
    }
    env.pop("SWITCHBOARD_DB", None)
    return subprocess.run(
        [sys.executable, "-c", program, *arguments],
        input=stdin,
        env=env,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def new_data(folder: Path) -> Path:
    """A data folder with the database of a new relay."""
    write_empty_database(folder / "data" / "switchboard.db")
    return folder / "data"


def test_the_contract_of_the_command_line(tmp_path: Path) -> None:
    """The steps from a new relay to a token, as scripts take them."""
    data = new_data(tmp_path)
    added = _run(data, "--data", str(data), "user", "add", "ann", "--password-stdin", stdin=PASSWORD)
    assert (added.returncode, added.stderr) == (0, "")
    robot = _run(data, "--data", str(data), "robot", "add", "rover", "--json")
    assert set(json.loads(robot.stdout)) >= {"robot", "enrolment_code"}
    granted = _run(data, "--data", str(data), "right", "grant", "ann", "rover", "operator")
    assert (granted.returncode, granted.stderr) == (0, "")
    token = _run(data, "--data", str(data), "token", "create", "ann", "--ttl", "1h", "--json")
    assert json.loads(token.stdout)["token"].startswith("swb_")


def test_no_secret_is_in_the_data_folder(tmp_path: Path) -> None:
    """Passwords, tokens and codes are in no file, the write-ahead log included."""
    data = new_data(tmp_path)
    _run(data, "user", "add", "ann", "--password-stdin", stdin=PASSWORD)
    code = json.loads(_run(data, "robot", "add", "rover", "--json").stdout)["enrolment_code"]
    token = json.loads(_run(data, "token", "create", "ann", "--json").stdout)["token"]
    # A reader keeps the last writer from clearing the write-ahead log.
    import sqlite3

    reader = sqlite3.connect(data / "switchboard.db")
    reader.execute("SELECT * FROM user_account").fetchall()
    _run(data, "user", "passwd", "ann", "--password-stdin", stdin=PASSWORD + "2")
    files = {path.name: path.read_bytes() for path in data.iterdir()}
    reader.close()
    assert {"switchboard.db", "switchboard.db-wal"} <= set(files)
    assert any(b"$argon2id$" in content for content in files.values())
    secrets = (PASSWORD, token, token.removeprefix("swb_"), code, code.replace("-", ""))
    found = [
        (name, secret) for name, content in files.items() for secret in secrets if secret.encode() in content
    ]
    assert found == []


def test_admin_commands_import_neither_twisted_nor_alembic(tmp_path: Path) -> None:
    """This makes them start fast on a current database."""
    data = new_data(tmp_path)
    program = (
        "import sys\n"
        "from relay_server.cli import main\n"
        "main(standalone_mode=False)\n"
        "heavy = {'twisted', 'alembic', 'autobahn', 'klein', 'passlib', 'rich'}\n"
        "print(sorted(heavy & {name.partition('.')[0] for name in sys.modules}))\n"
    )
    result = _run(data, "user", "list", "--json", program=program)
    assert (result.returncode, result.stdout) == (0, "[]\n[]\n"), result.stderr


def test_a_failure_is_a_sentence(tmp_path: Path) -> None:
    """One line on stderr without a traceback; stdout stays empty."""
    result = _run(new_data(tmp_path), "user", "remove", "eve", "--yes")
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr == "Error: there is no user 'eve'; see 'switchboard user list'\n"


def test_arguments_that_are_no_text_are_refused(tmp_path: Path) -> None:
    """Bytes that are not UTF-8, as a shell may pass them."""
    result = _run(new_data(tmp_path), "user", "add", os.fsdecode(b"a\xff\x1b"), "--no-password")
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr.startswith("Error: the name of a user must")


def test_commands_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    """All succeed, each change is made once, and the audit chain is valid."""
    data = new_data(tmp_path)
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "SWITCHBOARD_DATA": str(data),
    }
    names = [f"user-{number}" for number in range(4)]
    running = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM, "user", "add", name, "--no-password", "--json"],
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for name in names
    ]
    outcomes = [(*process.communicate(timeout=60), process.returncode) for process in running]
    assert [(error, status) for _, error, status in outcomes] == [("", 0)] * 4
    assert [each["user"] for each in json.loads(_run(data, "user", "list", "--json").stdout)] == names
    assert _run(data, "audit", "verify").returncode == 0
