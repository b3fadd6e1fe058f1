"""Settings that are wrong at the start: one sentence and an exit code, never a traceback."""

from __future__ import annotations

import os
import socket
import sqlite3
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from switchboard_forks import run_command
from switchboard_processes import BIN, ros_environment

from relay_db.engine import Database
from robot_client.link.identity import Enrolment, StateFolder

SENTENCE = 400
"""Characters of a sentence, at most."""


class Yard:
    """Folders and files that are wrong in their ways; each is made when a test names it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def file(self, content: bytes = b"junk", name: str = "file") -> str:
        """A file with this in it."""
        path = self.folder / name
        path.write_bytes(content)
        return str(path)

    def data(self, name: str = "", content: bytes | None = None) -> str:
        """A data folder in which one name stands for a folder, or for a file with this in it."""
        path = self.folder / "data"
        path.mkdir()
        if name and content is None:
            (path / name).mkdir()
        elif name:
            (path / name).write_bytes(content or b"")
        return str(path)

    def database(self, statement: str) -> str:
        """A data folder with a database in which something was done."""
        path = self.folder / "data" / "switchboard.db"
        database = Database(f"sqlite:///{path}")
        database.upgrade()
        database.close()
        with sqlite3.connect(path) as connection:
            connection.execute(statement)
        connection.close()
        return str(path.parent)

    def state(self, name: str = "", content: bytes = b"", **changed: str) -> str:
        """A robot's state folder, in which one file holds something else."""
        path = self.folder / "state"
        enrolment = {"address": "127.0.0.1:1", "robot": "rover", "relay": "relay", **changed}
        StateFolder(path).prepare().commit(Enrolment(**enrolment, tls="server_name" in changed, ca=""))
        if name:
            (path / name).write_bytes(content)
        return str(path)


@pytest.fixture
def yard(tmp_path: Path) -> Yard:
    """Nothing there yet."""
    return Yard(tmp_path)


@pytest.fixture
def taken() -> Iterator[str]:
    """An address on which somebody listens."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield f"127.0.0.1:{other.getsockname()[1]}"


def told(code: int, words: str, *command: str, read_only: str = "") -> None:
    """The command ends by this code, and says one sentence with these words.

    :param read_only: a folder that it can't write; under root it has to give up what root may beyond its files' modes
    """
    if read_only:
        Path(read_only).chmod(0o500)
        less = ["setpriv", "--bounding-set=-dac_override", "--inh-caps=-dac_override", "--"]
        full = [str(BIN / command[0]), *command[1:]]
        wrapped = [*less, *full] if os.geteuid() == 0 else full
        done = subprocess.run(wrapped, capture_output=True, text=True, check=False, timeout=120)
    else:
        done = run_command(list(command), env=ros_environment(0))
    said = done.stderr.strip()
    assert "Traceback" not in done.stderr + done.stdout
    assert done.returncode == code, said
    assert words in said
    lines = [
        line for line in said.splitlines() if not line.startswith(("Usage:", "Try '", "warning:")) and line
    ]
    assert len(lines) == 1 and len(lines[0]) <= SENTENCE, said
    assert "READY" not in done.stdout


def shown(options: tuple[str, ...]) -> str:
    """As the name of a test."""
    return " ".join(options)[:60].encode("unicode_escape").decode()


# --- the relay --------------------------------------------------------------------------------------------

Make = Callable[[Yard], str]

DATA: list[tuple[str, int, str, Make]] = [
    ("a file below which it would be", 3, "Not a directory", lambda yard: yard.file() + "/data"),
    ("no database", 3, "no SQLite database", lambda yard: yard.data("switchboard.db", b"junk" * 1000)),
    ("a folder for a database", 3, "database file can't be opened", lambda yard: yard.data("switchboard.db")),
    (
        "a newer version",
        3,
        "newer",
        lambda yard: yard.database("UPDATE alembic_version SET version_num = '9999'"),
    ),
    ("no tables", 3, "lacks tables", lambda yard: yard.database("DROP TABLE robot")),
    ("a folder for a lock", 3, "Is a directory", lambda yard: yard.data("relay.lock")),
    ("a folder for a name", 1, "name can't be read", lambda yard: yard.data("relay.name")),
    ("bytes for a name", 1, "--name", lambda yard: yard.data("relay.name", b"\xff\xfe\n")),
    ("a folder for a socket", 1, "can't be replaced", lambda yard: yard.data("relay.sock")),
    ("a file for recordings", 1, "folder of recordings", lambda yard: yard.data("recordings", b"")),
]


@pytest.mark.parametrize(
    ("code", "words", "make"), [each[1:] for each in DATA], ids=[each[0] for each in DATA]
)
def test_data_folders(yard: Yard, code: int, words: str, make: Make) -> None:
    """That can't be used."""
    data = make(yard)
    told(
        code, words, "switchboard", "serve", "--data", data, "--http", "127.0.0.1:0", "--robots", "127.0.0.1:0"
    )  # fmt: skip


@pytest.mark.parametrize("below", ["", "/data"])
def test_read_only_data_folder(yard: Yard, below: str) -> None:
    """Whether it is there already or would have to be made."""
    folder = yard.data()
    told(3, "Permission denied", "switchboard", "serve", "--data", folder + below, read_only=folder)


URLS = {
    "postgresql://h:99999/x": (3, "can't be reached"),
    "postgresql://h:abc/x": (1, "no database URL"),
    "postgresql://[::1/x": (1, "no database URL"),
    "postgresql://no.such.host.invalid/x": (3, "can't be reached"),
    "postgresql://127.0.0.1:1/x": (3, "can't be reached"),
    "postgresql://127.0.0.1:1/x?nonsense=1": (3, "'?'"),
    "postgresql://127.0.0.1:1/x?connect_timeout=abc": (3, "'?'"),
    "postgresql+asyncpg://h/x": (1, "no database known here"),
    "mysql://h/x": (1, "no database known here"),
    "nonsense": (1, "no database URL"),
    "sqlite://": (1, "give the database a file"),
    "sqlite:////proc/x.db": (3, "database file"),
    "sqlite:////proc": (3, "database file"),
}


@pytest.mark.parametrize(
    "command", [("user", "list"), ("serve", "--http", "127.0.0.1:0", "--robots", "127.0.0.1:0")]
)
@pytest.mark.parametrize("url", URLS)
def test_database_urls(yard: Yard, url: str, command: tuple[str, ...]) -> None:
    """Of each kind, for the relay and for a command beside it."""
    code, words = URLS[url]
    told(code, words, "switchboard", "--data", str(yard.folder / "data"), "--db", url, *command)


def test_folder_given_for_a_database_is_left_as_it_is(yard: Yard) -> None:
    """Others may still use it."""
    folder = Path(yard.data())
    folder.chmod(0o1777)
    told(3, "database file", "switchboard", "--db", f"sqlite:///{folder}", "user", "list")
    assert folder.stat().st_mode & 0o7777 == 0o1777


OPTIONS = {
    ("--http", "127.0.0.1:99999"): "HOST:PORT",
    ("--http", "[::1"): "HOST:PORT",
    ("--http", "203.0.113.9:0"): "can't listen on 203.0.113.9",
    ("--http", "no.such.host.invalid:0"): "can't listen on no.such.host.invalid",
    ("--robots", "a..b:0"): "can't listen on a..b",
    ("--heartbeat", "nan"): "--heartbeat",
    ("--heartbeat", "inf"): "--heartbeat",
    ("--recordings-gb", "nan"): "--recordings-gb",
    ("--recordings-reserve-gb", "inf"): "--recordings-reserve-gb",
    ("--events-days", "nan"): "--events-days",
    ("--requests-per-second", "nan"): "--requests-per-second",
    ("--battery-low", "nan"): "--battery-low",
    ("--control-grace", "nan"): "--control-grace",
    ("--control-idle", "nan"): "--control-idle",
    ("--webhook-networks", "nonsense"): "nonsense",
    ("--apprise-schemes", "nope"): "nope",
    ("--origin", "https://h:99999"): "https://h:99999",
    ("--name", "a\nb"): "--name",
    ("--name", "\ufffd"): "U+FFFD",
    ("--name", "a" * 300): "--name",
    ("--tls-cert", "/nope"): "go together",
    ("--tls-cert", "/nope", "--tls-key", "/nope"): "nope",
    ("--tls-cert", "/proc", "--tls-key", "/proc"): "/proc",
}


@pytest.mark.parametrize("options", OPTIONS, ids=shown)
def test_options_of_the_relay(yard: Yard, options: tuple[str, ...]) -> None:
    """With the option or the value in the sentence."""
    addresses = {"--http": "127.0.0.1:0", "--robots": "127.0.0.1:0"}
    free = [word for name, value in addresses.items() if name not in options for word in (name, value)]
    data = str(yard.folder / "data")
    code = 2 if OPTIONS[options] == "/proc" else 1
    told(code, OPTIONS[options], "switchboard", "serve", "--data", data, *free, *options)


@pytest.mark.parametrize("which", ["--http", "--robots"])
def test_ports_in_use(yard: Yard, taken: str, which: str) -> None:
    """With address and port."""
    options = {"--http": "127.0.0.1:0", "--robots": "127.0.0.1:0", which: taken}
    words = f"can't listen on 127.0.0.1 port {taken.partition(':')[2]}: Address already in use"
    data = str(yard.folder / "data")
    told(
        1, words, "switchboard", "serve", "--data", data, *(word for each in options.items() for word in each)
    )


def test_certificate_that_is_none(yard: Yard) -> None:
    """Any bytes."""
    file = yard.file(b"\xff\xfe")
    told(
        1, "certificate", "switchboard", "serve", "--data", yard.data(), "--tls-cert", file, "--tls-key", file
    )


# --- the robot --------------------------------------------------------------------------------------------

ENROLMENTS = {
    ("--relay", "no.such.host.invalid:9"): "can't be resolved",
    ("--relay", "127.0.0.1:99999"): "host:port",
    ("--relay", "http://127.0.0.1:1"): "host:port",
    ("--relay", "127.0.0.1:1"): "nobody listens",
    ("--relay", "127.0.0.1:1", "--ca", "/nope"): "/nope",
    ("--relay", "127.0.0.1:1", "--tls", "--server-name", "a..b"): "--server-name",
    ("--relay", "127.0.0.1:1", "--state", "/proc/x"): "can't be written",
    ("--relay", "127.0.0.1:1", "--robot", "r\ufffd"): "robot",
}


@pytest.mark.parametrize("options", ENROLMENTS, ids=shown)
def test_enrolments(yard: Yard, options: tuple[str, ...]) -> None:
    """The state folder is left as it was."""
    state = yard.folder / "state"
    usual = {"--state": str(state), "--robot": "rover", "--code": "abc"}
    words = [word for name, value in usual.items() if name not in options for word in (name, value)]
    told(1, ENROLMENTS[options], "switchboard-robot", "enroll", *words, *options)
    assert not state.exists()


def test_read_only_state_folder(yard: Yard) -> None:
    """Said before the code is spent."""
    state = yard.data()
    enrolling = "--relay", "127.0.0.1:1", "--robot", "rover", "--code", "abc", "--state", state + "/rover"
    told(1, "Permission denied", "switchboard-robot", "enroll", *enrolling, read_only=state)


STATES: list[tuple[str, Make]] = [
    ("is damaged", lambda yard: yard.state("robot.json", b"{")),
    ("is damaged", lambda yard: yard.state("robot.json", b'{"address":"\xff"}')),
    ("is damaged", lambda yard: yard.state("robot.key", b"x")),
    ("no robot is enrolled", lambda yard: str(yard.folder / "none")),
]


@pytest.mark.parametrize(("words", "make"), STATES)
def test_states_of_a_robot(yard: Yard, words: str, make: Make) -> None:
    """That can't be used."""
    told(1, words, "switchboard-robot", "run", "--state", make(yard))


CONFIGS = {
    b"x = 1": "outside of a table",
    b"[x": "is not TOML",
    b"\xff\xfe\x00": "is not TOML",
    b"[safety]\nnope = 1": "nope",
    b"[cameras]\n'/c' = 5": "cameras",
    b"[ros]\nnode = 'a b'": "node",
    b"[video]\nstreams = -1": "streams",
    b"[video]\ntarget_ms = nan": "target_ms",
}


@pytest.mark.parametrize("content", CONFIGS)
def test_settings_of_a_robot(yard: Yard, content: bytes) -> None:
    """With the key in the sentence."""
    file = yard.file(content, "robot.toml")
    told(1, CONFIGS[content], "switchboard-robot", "run", "--state", yard.state(), "--config", file)


PROGRAMS = {
    ("switchboard-robot", "run", "--state", "/nope", "--config", "/nope"): (1, "/nope"),
    ("switchboard-sim", "--record", "/proc/x"): (1, "/proc/x"),
    ("switchboard-sim", "--namespace", "a b"): (2, "a b"),
    ("switchboard-sim", "--seed", "-1"): (2, "--seed"),
    ("switchboard-sim", "--charge", "nan"): (2, "--charge"),
    ("switchboard-robot-service", "gps", "/nope"): (1, "/nope"),
    ("switchboard-robot-service", "gps", "tcp://h:99999"): (1, "tcp://h:99999"),
    ("switchboard-robot-service", "battery", "--topic", "a b"): (1, "a b"),
    ("switchboard-robot-service", "battery", "--namespace", "a b"): (2, "a b"),
    ("switchboard-robot-service", "battery", "--volts", "nan", "1"): (2, "--volts"),
    ("switchboard-robot-service", "obstacles", "--scan", "a b"): (1, "a b"),
    ("switchboard-robot-service", "obstacles", "--near", "nan"): (2, "--near"),
    ("switchboard-robot-service", "faces", "--people", "/nope"): (1, "/nope"),
    ("switchboard-robot-service", "speech", "--out", "/nope/x"): (1, "/nope/x"),
    ("switchboard-robot-service", "markers", "--size", "nan"): (2, "--size"),
    ("switchboard-robot-service", "markers", "--size", "0.1", "--dictionary", "nope"): (2, "nope"),
    ("switchboard", "robot", "call", "r", "/s", "--timeout", "nan"): (2, "--timeout"),
}
"""Code 2 is of what Click judges."""


@pytest.mark.parametrize("command", PROGRAMS, ids=" ".join)
def test_other_programs(command: tuple[str, ...]) -> None:
    """Of a robot."""
    told(*PROGRAMS[command], *command)
