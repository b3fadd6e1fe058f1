"""Invalid settings at the start: one line and an exit code, never a traceback."""

from __future__ import annotations

import os
import socket
import sqlite3
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from robot_client.link.enrolment import Enrolment, StateFolder
from tests.worlds.empty_database import write_empty_database
from tests.worlds.forked_programs import run_command
from tests.worlds.processes import BIN, ros_environment

SENTENCE = 400
"""Characters of a sentence, at most."""


class World:
    """Invalid folders and files; each is made when a test names it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def file(self, content: bytes = b"junk", name: str = "file") -> str:
        """A file with this content."""
        path = self.folder / name
        path.write_bytes(content)
        return str(path)

    def data(self, name: str = "", content: bytes | None = None) -> str:
        """A data folder in which one name is a folder, or a file with this content."""
        path = self.folder / "data"
        path.mkdir()
        if name and content is None:
            (path / name).mkdir()
        elif name:
            (path / name).write_bytes(content or b"")
        return str(path)

    def database(self, statement: str) -> str:
        """A data folder with a used database."""
        path = self.folder / "data" / "switchboard.db"
        write_empty_database(path)
        with sqlite3.connect(path) as connection:
            connection.execute(statement)
        connection.close()
        return str(path.parent)

    def state(self, name: str = "", content: bytes = b"", **changed: str) -> str:
        """A robot's state folder with other content in one file."""
        path = self.folder / "state"
        enrolment = {"address": "127.0.0.1:1", "robot": "rover", "relay": "relay", **changed}
        StateFolder(path).prepare().commit(Enrolment(**enrolment, tls="server_name" in changed, ca=""))
        if name:
            (path / name).write_bytes(content)
        return str(path)


@pytest.fixture
def world(tmp_path: Path) -> World:
    """An empty world."""
    return World(tmp_path)


@pytest.fixture
def taken() -> Iterator[str]:
    """An address that is in use."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield f"127.0.0.1:{other.getsockname()[1]}"


def reported(code: int, words: str, *command: str, read_only: str = "") -> None:
    """The command exits with this code and prints one line with these words.

    :param read_only: a folder that it cannot write; under root it drops the privileges beyond file modes
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
    """A test id for the command."""
    return " ".join(options)[:60].encode("unicode_escape").decode()


# --- the relay --------------------------------------------------------------------------------------------

Make = Callable[[World], str]

DATA: list[tuple[str, int, str, Make]] = [
    ("a file below which it would be", 3, "Not a directory", lambda world: world.file() + "/data"),
    ("no database", 3, "not an SQLite database", lambda world: world.data("switchboard.db", b"junk" * 1000)),
    (
        "a folder for a database",
        3,
        "database file can't be opened",
        lambda world: world.data("switchboard.db"),
    ),
    (
        "a newer version",
        3,
        "newer",
        lambda world: world.database("UPDATE alembic_version SET version_num = '9999'"),
    ),
    ("no tables", 3, "lacks tables", lambda world: world.database("DROP TABLE robot")),
    ("a folder for a lock", 3, "Is a directory", lambda world: world.data("relay.lock")),
    ("a folder for a name", 1, "name can't be read", lambda world: world.data("relay.name")),
    ("bytes for a name", 1, "--name", lambda world: world.data("relay.name", b"\xff\xfe\n")),
    ("a folder for a socket", 1, "can't be replaced", lambda world: world.data("relay.sock")),
    ("a file for recordings", 1, "folder of recordings", lambda world: world.data("recordings", b"")),
]


@pytest.mark.parametrize(
    ("code", "words", "make"), [each[1:] for each in DATA], ids=[each[0] for each in DATA]
)
def test_data_folders(world: World, code: int, words: str, make: Make) -> None:
    """Unusable ones."""
    data = make(world)
    reported(
        code, words, "switchboard", "serve", "--data", data, "--http", "127.0.0.1:0", "--robots", "127.0.0.1:0"
    )  # fmt: skip


@pytest.mark.parametrize("below", ["", "/data"])
def test_read_only_data_folder(world: World, below: str) -> None:
    """Whether it exists or has to be made."""
    folder = world.data()
    reported(3, "Permission denied", "switchboard", "serve", "--data", folder + below, read_only=folder)


URLS = {
    "postgresql://h:99999/x": (3, "can't be reached"),
    "postgresql://h:abc/x": (1, "not a database URL"),
    "postgresql://[::1/x": (1, "not a database URL"),
    "postgresql://no.such.host.invalid/x": (3, "can't be reached"),
    "postgresql://127.0.0.1:1/x": (3, "can't be reached"),
    "postgresql://127.0.0.1:1/x?nonsense=1": (3, "'?'"),
    "postgresql://127.0.0.1:1/x?connect_timeout=abc": (3, "'?'"),
    "postgresql+asyncpg://h/x": (1, "is not supported"),
    "mysql://h/x": (1, "is not supported"),
    "nonsense": (1, "not a database URL"),
    "sqlite://": (1, "the database URL needs a file"),
    "sqlite:////proc/x.db": (3, "database file"),
    "sqlite:////proc": (3, "database file"),
}


@pytest.mark.parametrize(
    "command", [("user", "list"), ("serve", "--http", "127.0.0.1:0", "--robots", "127.0.0.1:0")]
)
@pytest.mark.parametrize("url", URLS)
def test_database_urls(world: World, url: str, command: tuple[str, ...]) -> None:
    """Of each kind, for the relay and for another command."""
    code, words = URLS[url]
    reported(code, words, "switchboard", "--data", str(world.folder / "data"), "--db", url, *command)


def test_folder_given_for_a_database_is_left_as_it_is(world: World) -> None:
    """Others may still use it."""
    folder = Path(world.data())
    folder.chmod(0o1777)
    reported(3, "database file", "switchboard", "--db", f"sqlite:///{folder}", "user", "list")
    assert folder.stat().st_mode & 0o7777 == 0o1777


OPTIONS = {
    ("--http", "127.0.0.1:99999"): "HOST:PORT",
    ("--http", "[::1"): "HOST:PORT",
    ("--http", "203.0.113.9:0"): "cannot listen on 203.0.113.9",
    ("--http", "no.such.host.invalid:0"): "cannot listen on no.such.host.invalid",
    ("--robots", "a..b:0"): "cannot listen on a..b",
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
def test_options_of_the_relay(world: World, options: tuple[str, ...]) -> None:
    """The error names the option or the value."""
    addresses = {"--http": "127.0.0.1:0", "--robots": "127.0.0.1:0"}
    free = [word for name, value in addresses.items() if name not in options for word in (name, value)]
    data = str(world.folder / "data")
    code = 2 if OPTIONS[options] == "/proc" else 1
    reported(code, OPTIONS[options], "switchboard", "serve", "--data", data, *free, *options)


@pytest.mark.parametrize("which", ["--http", "--robots"])
def test_ports_in_use(world: World, taken: str, which: str) -> None:
    """With address and port."""
    options = {"--http": "127.0.0.1:0", "--robots": "127.0.0.1:0", which: taken}
    words = f"cannot listen on 127.0.0.1 port {taken.partition(':')[2]}: Address already in use"
    data = str(world.folder / "data")
    reported(
        1, words, "switchboard", "serve", "--data", data, *(word for each in options.items() for word in each)
    )


def test_invalid_certificate(world: World) -> None:
    """The file has random bytes."""
    file = world.file(b"\xff\xfe")
    reported(
        1,
        "certificate",
        "switchboard",
        "serve",
        "--data",
        world.data(),
        "--tls-cert",
        file,
        "--tls-key",
        file,
    )


# --- the robot --------------------------------------------------------------------------------------------

ENROLMENTS = {
    ("--relay", "no.such.host.invalid:9"): "can't be resolved",
    ("--relay", "127.0.0.1:99999"): "host:port",
    ("--relay", "http://127.0.0.1:1"): "host:port",
    ("--relay", "127.0.0.1:1"): "refuses connections",
    ("--relay", "127.0.0.1:1", "--ca", "/nope"): "/nope",
    ("--relay", "127.0.0.1:1", "--tls", "--server-name", "a..b"): "--server-name",
    ("--relay", "127.0.0.1:1", "--state", "/proc/x"): "can't be written",
    ("--relay", "127.0.0.1:1", "--robot", "r\ufffd"): "robot",
}


@pytest.mark.parametrize("options", ENROLMENTS, ids=shown)
def test_enrolments(world: World, options: tuple[str, ...]) -> None:
    """The state folder is unchanged."""
    state = world.folder / "state"
    usual = {"--state": str(state), "--robot": "rover", "--code": "abc"}
    words = [word for name, value in usual.items() if name not in options for word in (name, value)]
    reported(1, ENROLMENTS[options], "switchboard-robot", "enroll", *words, *options)
    assert not state.exists()


def test_read_only_state_folder(world: World) -> None:
    """The error comes before the code is spent."""
    state = world.data()
    enrolling = "--relay", "127.0.0.1:1", "--robot", "rover", "--code", "abc", "--state", state + "/rover"
    reported(1, "Permission denied", "switchboard-robot", "enroll", *enrolling, read_only=state)


STATES: list[tuple[str, Make]] = [
    ("is damaged", lambda world: world.state("robot.json", b"{")),
    ("is damaged", lambda world: world.state("robot.json", b'{"address":"\xff"}')),
    ("is damaged", lambda world: world.state("robot.key", b"x")),
    ("no robot is enrolled", lambda world: str(world.folder / "none")),
]


@pytest.mark.parametrize(("words", "make"), STATES)
def test_states_of_a_robot(world: World, words: str, make: Make) -> None:
    """Unusable ones."""
    reported(1, words, "switchboard-robot", "run", "--state", make(world))


CONFIGS = {
    b"x = 1": "outside of a table",
    b"[x": "is not TOML",
    b"\xff\xfe\x00": "is not TOML",
    b"[safety]\nnope = 1": "nope",
    b"[cameras]\n'/c' = 5": "cameras",
    b"[ros]\nnode = 'a b'": "node",
    b"[video]\nstreams = -1": "streams",
    b"[video]\ntarget_delay_ms = nan": "target_delay_ms",
}


@pytest.mark.parametrize("content", CONFIGS)
def test_settings_of_a_robot(world: World, content: bytes) -> None:
    """The error names the key."""
    file = world.file(content, "robot.toml")
    reported(1, CONFIGS[content], "switchboard-robot", "run", "--state", world.state(), "--config", file)


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
    """Programs of a robot."""
    reported(*PROGRAMS[command], *command)
