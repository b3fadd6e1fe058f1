"""The command line in this process with a data folder of its own, and a fake of a running relay."""

from __future__ import annotations

import json
import socketserver
import tempfile
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from relay_server.cli import main
from tests.worlds.empty_database import write_empty_database

PASSWORD = "correct horse"


class Cli:
    """``switchboard`` with a data folder.

    :ivar data: the folder, which is not there at first
    """

    def __init__(self, data: Path) -> None:
        self.data = data

    def __call__(self, *arguments: str, stdin: str | None = None, **environment: str) -> Result:
        """Runs a command with any result."""
        env = {"SWITCHBOARD_DATA": str(self.data), "SWITCHBOARD_DB": None, **environment}
        return CliRunner(env=env).invoke(main, arguments, input=stdin)

    def ok(self, *arguments: str, stdin: str | None = None) -> str:
        """Runs a command that must succeed; returns its output."""
        result = self(*arguments, stdin=stdin)
        assert (result.exit_code, result.stderr) == (0, ""), result.output
        return result.stdout

    def json(self, *arguments: str, stdin: str | None = None) -> Any:
        """Runs a command with --json; returns its answer."""
        return json.loads(self.ok(*arguments, "--json", stdin=stdin))

    def fails(self, *arguments: str, stdin: str | None = None, code: int = 1) -> str:
        """Runs a command that must fail; returns the error. stdout must be empty."""
        result = self(*arguments, stdin=stdin)
        assert (result.exit_code, result.stdout) == (code, ""), result.output
        return result.stderr

    def user(self, name: str, *options: str) -> None:
        """Adds a user with the password of these tests."""
        self.ok("user", "add", name, "--password-stdin", *options, stdin=f"{PASSWORD}\n")


@pytest.fixture
def new_cli(tmp_path: Path) -> Cli:
    """The command line with a data folder that is not there yet."""
    return Cli(tmp_path / "data")


@pytest.fixture
def cli(tmp_path: Path) -> Cli:
    """The command line with a data folder whose database has all tables."""
    write_empty_database(tmp_path / "data" / "switchboard.db")
    return Cli(tmp_path / "data")


class FakeRelay(socketserver.ThreadingUnixStreamServer):
    """Answers on a Unix socket as a relay does.

    :ivar asked: requests so far, as ``METHOD /path``
    :ivar answer: status code and body for ``GET /status``
    :ivar ordered: bodies of ``POST /fleet``, ``/stop``, ``/resume`` and ``/modules`` so far
    :ivar sent: their sending times
    :ivar lines: status code and body for the first of these
    :ivar motion: the same for the others; status 0 hangs up
    :ivar may_answer: while this is not set the others have no answer
    :ivar gone: the client has closed the connection
    """

    daemon_threads = True

    def __init__(self, path: Path) -> None:
        super().__init__(str(path), _Handler)
        self.asked: list[str] = []
        self.answer: tuple[int, bytes] = (200, b"{}")
        self.ordered: list[Any] = []
        self.sent: list[int] = []
        self.lines: tuple[int, bytes] = (200, b"")
        self.motion: tuple[int, bytes] = (200, b"{}")
        self.may_answer = threading.Event()
        self.may_answer.set()
        self.gone = False


class _Handler(BaseHTTPRequestHandler):
    server: FakeRelay

    def address_string(self) -> str:
        return "local"

    def log_message(self, *_: object) -> None:
        pass

    def _respond(self) -> None:
        self.server.asked.append(f"{self.command} {self.path}")
        status, body = self.server.answer if self.command == "GET" else (204, b"")
        path, _, _ = self.path.partition("?")
        if path in ("/fleet", "/stop", "/resume", "/modules"):
            length = int(self.headers["Content-Length"])
            self.server.ordered.append(json.loads(self.rfile.read(length)))
            self.server.sent.append(int(self.headers["Switchboard-Sent"]))
            status, body = self.server.lines if path == "/fleet" else self.server.motion
            self.server.may_answer.wait(30)
            if not status or self.server.gone:
                return
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if body:
            self.wfile.write(body)

    do_GET = do_POST = _respond


@pytest.fixture
def start_relay() -> Iterator[Callable[[Path], FakeRelay]]:
    """Starts fake relays that listen in a folder."""
    running: list[tuple[FakeRelay, threading.Thread]] = []

    def start(folder: Path) -> FakeRelay:
        folder.mkdir(exist_ok=True)
        relay = FakeRelay(folder / "relay.sock")
        thread = threading.Thread(target=relay.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        running.append((relay, thread))
        return relay

    yield start
    for relay, thread in running:
        relay.gone = True
        relay.may_answer.set()
        relay.shutdown()
        thread.join(timeout=30)
        relay.server_close()


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """A folder with a path short enough for a socket's name."""
    with tempfile.TemporaryDirectory(prefix="sb-") as folder:
        yield Path(folder)


@pytest.fixture
def relay(short_folder: Path, start_relay: Callable[[Path], FakeRelay]) -> FakeRelay:
    """A running relay on the data folder of :func:`live`."""
    return start_relay(short_folder)


@pytest.fixture
def live(relay: FakeRelay, short_folder: Path) -> Cli:
    """The command line on the data folder of a running relay."""
    write_empty_database(short_folder / "switchboard.db")
    return Cli(short_folder)
