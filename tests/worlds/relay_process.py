"""A real relay on loopback, on ports from the OS, and the admin command line beside it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

from click.testing import CliRunner
from websockets.sync.client import connect

from relay_server.cli import main
from relay_server.cli.admin_socket_client import ask_status
from tests.worlds.empty_database import write_empty_database
from tests.worlds.forked_programs import run_command
from tests.worlds.processes import BIN, Process
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE


class Relay:
    """``switchboard serve`` on a data folder, and the admin command line beside it."""

    def __init__(self, folder: Path, *options: str, database: str | None = None) -> None:
        self.folder = folder
        self.data = folder / "relay-data"
        self._options = options
        self._database = database
        self.http_port = 0
        self.robots_port = 0
        self.process: Process | None = None
        if not database:
            write_empty_database(self.data / "switchboard.db")
        self.start()

    @property
    def _environment(self) -> dict[str, str]:
        extra = {"SWITCHBOARD_DB": self._database} if self._database else {}
        return {**os.environ, **extra}

    def start(self) -> None:
        """Starts it, on the ports it had before if any."""
        command = [str(BIN / "switchboard"), "serve", "--data", str(self.data), *self._options]
        command += ["--http", f"127.0.0.1:{self.http_port}", "--robots", f"127.0.0.1:{self.robots_port}"]
        self.process = Process(command, self.folder, "relay", self._environment)
        ready = self.process.wait_to_say("READY")
        words = dict(word.split("=") for word in ready.split()[1:])
        self.http_port, self.robots_port = int(words["http"]), int(words["robots"])

    def cli(self, *arguments: str, stdin: str = "") -> Any:
        """Runs an admin command with --json in this process, which takes half the processor time; not for threads.

        :returns: its decoded output
        """
        runner = CliRunner(env={"SWITCHBOARD_DB": self._database})
        done = runner.invoke(main, ["--data", str(self.data), *arguments, "--json"], input=stdin)
        assert done.exit_code == 0, f"{arguments}: {done.output} {done.exception}"
        return json.loads(done.stdout) if done.stdout.strip() else None

    def run_cli(self, *arguments: str, stdin: str = "") -> subprocess.CompletedProcess[str]:
        """Runs an admin command as a process."""
        return run_command(
            ["switchboard", "--data", str(self.data), *arguments], env=self._environment, stdin=stdin
        )

    def user(self, name: str, password: str = "correct horse", *, admin: bool = False) -> str:
        """Adds a user and returns an access token."""
        self.cli(
            "user", "add", name, "--password-stdin", *(["--admin"] if admin else []), stdin=password + "\n"
        )
        return self.token(name)

    def token(self, user: str, ttl: str = "1h") -> str:
        """An access token of a user."""
        return str(self.cli("token", "create", user, "--ttl", ttl)["token"])

    def state_of(self, robot: str) -> str:
        """``online``, ``in_use`` or ``offline``."""
        states = {each["name"]: str(each["state"]) for each in ask_status(self.data)["robots"]}
        return states.get(robot, "offline")

    def url(self, robot: str) -> str:
        """The URL of a robot's websocket."""
        return f"ws://127.0.0.1:{self.http_port}/robots/{robot}"

    def connect(self, robot: str, token: str, **options: Any) -> Client:
        """A websocket client with a Bearer token."""
        headers = {"Authorization": f"Bearer {token}"}
        # A client that has stopped reading does not see the answer to its close behind unread messages.
        options.setdefault("close_timeout", 1)
        options.setdefault("open_timeout", PATIENCE)
        return Client(connect(self.url(robot), additional_headers=headers, **options))

    def connect_by(self, port: int, robot: str, token: str) -> Client:
        """The same through a proxy."""
        headers = {"Authorization": f"Bearer {token}"}
        url = f"ws://127.0.0.1:{port}/robots/{robot}"
        return Client(connect(url, additional_headers=headers, open_timeout=PATIENCE))

    def freeze(self) -> None:
        """SIGSTOP; it stands still when this returns."""
        assert self.process is not None
        self.process.freeze()

    def thaw(self) -> None:
        """SIGCONT."""
        assert self.process is not None
        self.process.signal(signal.SIGCONT)

    def kill(self) -> None:
        """kill -9."""
        assert self.process is not None
        self.process.kill()

    def stop(self) -> int:
        """SIGTERM; the exit code."""
        assert self.process is not None
        return self.process.stop()

    @property
    def log(self) -> str:
        """The log so far."""
        assert self.process is not None
        return self.process.log.read_text()
