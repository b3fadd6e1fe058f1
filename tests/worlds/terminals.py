"""Commands of a document, run as its reader does."""

from __future__ import annotations

import os
import re
import subprocess
from contextlib import ExitStack
from pathlib import Path

from tests.worlds.processes import BIN, Process, ros_environment, running
from tests.worlds.ros_domains import free_domain
from tests.worlds.waiting import PATIENCE

PATIENT = {f"SWITCHBOARD_ROBOT_SAFETY_{name}": "5000" for name in ("DEADLINE_MS", "STOP_WITHIN_MS")}
"""The robot's settings: on a busy machine commands come late."""


class Terminals:
    """The reader's terminals: their folder, their variables and the programs that run in them.

    :ivar places: parts of the text, such as addresses, and those in use
    """

    def __init__(self, folder: Path, stack: ExitStack, places: dict[str, str]) -> None:
        self.places = places
        self._folder, self._stack = folder, stack
        path = f"{BIN}:{os.environ['PATH']}"
        self._environment = {**os.environ, **ros_environment(free_domain()), **PATIENT, "PATH": path}

    def here(self, text: str) -> str:
        """Text with the addresses in use."""
        for shown, used in self.places.items():
            text = text.replace(shown, used)
        return text

    def start(self, command: str) -> Process:
        """Starts a program that stays."""
        shell = ["bash", "-c", f"cd {self._folder} && exec {self.here(command)}"]
        name = re.sub(r"\W+", "-", command[:24])
        process = Process(shell, self._folder, name, self._environment)
        self._stack.enter_context(running(process))
        return process

    def run(self, command: str, typed: str = "") -> str:
        """Runs a command to its end, and returns its output. Variables that it sets remain.

        :param typed: its input
        """
        script = f'set -e\n{self.here(command)}\nprintf "\\nTOKEN=%s" "${{TOKEN-}}"'
        done = subprocess.run(
            ["bash", "-c", script],
            cwd=self._folder,
            env=self._environment,
            input=typed,
            capture_output=True,
            text=True,
            timeout=5 * PATIENCE,
            check=False,
        )
        assert done.returncode == 0, (command, done.stdout, done.stderr)
        output, _, self._environment["TOKEN"] = done.stdout.rpartition("\nTOKEN=")
        return output
