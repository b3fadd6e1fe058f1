"""A real relay in a process of its own, administered from here without starting a process for each command."""

from __future__ import annotations

import json
from typing import Any

from click.testing import CliRunner

from relay_server.cli import main
from tests.worlds import relay_process


class Relay(relay_process.Relay):
    """``switchboard serve`` on a data folder; admin commands run in this process."""

    def cli(self, *arguments: str, stdin: str = "") -> Any:
        """Run an admin command with --json; returns what it prints, decoded."""
        done = CliRunner().invoke(main, ["--data", str(self.data), *arguments, "--json"], input=stdin)
        assert done.exit_code == 0, f"{arguments}: {done.stderr}"
        return json.loads(done.stdout) if done.stdout.strip() else None

    @property
    def pid(self) -> int:
        """Its process."""
        assert self.process is not None
        return self.process.popen.pid
