"""A module that is a Python class, run by a real runner, without a daemon."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from robot_client.modules.log_ring import read
from robot_client.modules.module_run import run_spec
from robot_client.modules.settings import ModuleSettings
from tests.worlds.waiting import wait_for

ROOT = Path(__file__).parents[2]


class RunnerClient:
    """A connection to a runner, as the daemon or another module has it."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.messages: list[dict[str, Any]] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        self._count = 0

    def _read(self) -> None:
        for line in self.connection.makefile("rb"):
            self.messages.append(json.loads(line))

    def send(self, do: str, **more: Any) -> None:
        self.connection.sendall(json.dumps({"do": do, **more}).encode() + b"\n")

    def command(self, value: Any) -> str:
        """Sends a command; returns the error, or None."""
        self._count += 1
        self.send("command", id=self._count, value=value)
        return self.answer(self._count)

    def answer(self, id: int) -> str:
        answers = wait_for("an answer", lambda: [each for each in self.messages if each.get("id") == id])
        return str(answers[0]["error"])

    def feedback(self) -> list[Any]:
        return [each["value"] for each in list(self.messages) if each["event"] == "feedback"]

    def close(self) -> None:
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self.connection.close()


class PythonModule:
    """A running module of this class.

    :param folder: of all modules; the module's own is below it
    :param python: ``package.module:Class``
    :param environment: variables beside those of this process
    :param cwd: folder that the class is in
    :param term_after_s: time to stop after SIGINT; one with ROS takes seconds on a busy machine
    """

    def __init__(
        self,
        folder: Path,
        python: str,
        *,
        name: str = "m",
        environment: Any = (),
        cwd: Path = ROOT,
        term_after_s: float = 20,
        **settings: Any,
    ) -> None:
        self.folder = folder / name
        self.folder.mkdir(parents=True, exist_ok=True)
        own = ModuleSettings(
            name=name,
            python=python,
            settings=settings,
            folder=str(cwd),
            term_after_s=term_after_s,
            kill_after_s=20,
        )
        spec = run_spec(own, {**os.environ, **dict(environment)})._asdict()
        (self.folder / "spec.json").write_text(json.dumps(spec))
        near, far = socket.socketpair()
        with far:
            os.set_inheritable(far.fileno(), True)
            number = far.fileno()
            # The runner expects it at its own file descriptor.
            code = f"import os,runpy;os.dup2({number}, 3);"
            code += "runpy.run_module('robot_client.modules.runner', run_name='__main__')"
            self.process = subprocess.Popen(
                [sys.executable, "-c", code, str(self.folder)], pass_fds=[number], cwd=ROOT
            )
        self.daemon = RunnerClient(near)
        self.daemon.send("listen")

    def ready(self) -> PythonModule:
        self.logs("READY")
        return self

    def connect(self) -> RunnerClient:
        client = socket.socket(socket.AF_UNIX)
        here = os.open(self.folder, os.O_RDONLY)
        client.connect(f"/proc/self/fd/{here}/socket")
        os.close(here)
        return RunnerClient(client)

    def texts(self) -> list[str]:
        return [each.text for each in read(self.folder / "log", most=10_000).lines]

    def logs(self, text: str) -> None:
        wait_for(text, lambda: any(text in each for each in self.texts()))

    def feeds_back(self, value: Any) -> None:
        wait_for(f"{value} of {self.daemon.feedback()}", lambda: value in self.daemon.feedback())

    def pid(self) -> int:
        return int(next(each["pid"] for each in self.daemon.messages if each["event"] == "running"))

    def ended(self) -> dict[str, Any]:
        self.process.wait(60)
        found: dict[str, Any] = json.loads((self.folder / "exit.json").read_text())
        return found

    def stop(self) -> dict[str, Any]:
        self.daemon.send("stop")
        return self.ended()

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait(60)
        self.daemon.close()
