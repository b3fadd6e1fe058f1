"""The project's programs as processes forked from one that has imported their modules.

A fresh interpreter needs a second or more for imports, and the tests start programs many hundred times. A
forked process has its environment, its streams, its signals and its name as from a shell, but shows the command
line of its origin. Signals, exit codes and children are real.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import faulthandler
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib import import_module
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path

COMMAND_SECONDS = 60.0

PROGRAMS = {
    "switchboard": "relay_server.cli",
    "switchboard-robot": "robot_client.cli",
    "switchboard-mqtt": "robot_client.mqtt_gateway",
    "switchboard-robot-service": "robot_client.services.main",
    "switchboard-sim": "robot_client.sim.main",
}
"""Our commands, and the module each has its ``main`` in."""

STACKS_SIGNAL = signal.SIGUSR2
"""Writes the stacks of all threads to the error output."""

_PR_SET_PDEATHSIG = 1
_PR_SET_NAME = 15


class Forked:
    """A running program with the parts of :class:`subprocess.Popen` that the tests use."""

    def __init__(self, process: ForkServerProcess, command: list[str]) -> None:
        self.args = command
        assert process.pid is not None
        self.pid: int = process.pid
        self._process = process

    @property
    def returncode(self) -> int | None:
        """Its exit code, the negative number of the signal that ended it, or None while it runs."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """The same."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Waits until it has ended.

        :param timeout: seconds
        :raises subprocess.TimeoutExpired: it is still running
        """
        self._process.join(timeout)
        if (code := self.returncode) is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        """Sends a signal, unless it has ended."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.kill(self.pid, number)

    def terminate(self) -> None:
        """SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """SIGKILL."""
        self.send_signal(signal.SIGKILL)


def forkable(command: Sequence[str], env: Mapping[str, str]) -> bool:
    """Whether a command is a program of the project or a script, without other module paths."""
    program = Path(command[0])
    elsewhere = env.get("PYTHONPATH") != os.environ.get("PYTHONPATH")
    return (program.name in PROGRAMS or program.suffix == ".py") and not elsewhere


def start(
    command: Sequence[str],
    out: Path,
    err: Path,
    *,
    env: Mapping[str, str] | None = None,
    stdin: Path | None = None,
) -> Forked:
    """Starts a program of the project, or a Python script, in a session of its own.

    :param command: its name or path and its arguments
    :param out: the file its standard output is appended to
    :param err: the same for its error output
    :param env: its whole environment; this process's by default
    """
    streams = (str(stdin or os.devnull), str(out), str(err))
    process = _context().Process(target=_be, args=(list(command), dict(env or os.environ), streams))
    process.start()
    return Forked(process, list(command))


def run_command(
    command: Sequence[str], *, env: Mapping[str, str] | None = None, stdin: str = ""
) -> subprocess.CompletedProcess[str]:
    """Runs a program of the project to its end.

    :param env: its whole environment; this process's by default
    :raises subprocess.TimeoutExpired: it takes longer than a minute
    """
    with tempfile.TemporaryDirectory(prefix="command-") as name:
        into, out, err = (Path(name) / each for each in ("in", "out", "err"))
        into.write_text(stdin)
        process = start(command, out, err, env=env, stdin=into)
        try:
            code = process.wait(COMMAND_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise
        return subprocess.CompletedProcess(list(command), code, out.read_text(), err.read_text())


def _context() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.worlds.warm_imports"])
    return context


def _be(command: list[str], env: dict[str, str], streams: tuple[str, str, str]) -> None:
    """Becomes the program: its environment, its streams, its end."""
    # Imported already, unless that failed: the server hides errors.
    import_module("tests.worlds.warm_imports")
    _end_with_the_server()
    ctypes.CDLL(None).prctl(_PR_SET_NAME, Path(command[0]).name.encode())
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # The paths of ROS's libraries are read at its import, which is done.
    libraries = os.environ.get("LD_LIBRARY_PATH")
    os.environ.clear()
    os.environ.update(env)
    if libraries:
        os.environ["LD_LIBRARY_PATH"] = libraries
    for descriptor, name in enumerate(streams):
        opened = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_APPEND if descriptor else os.O_RDONLY, 0o600)
        os.dup2(opened, descriptor)
        os.close(opened)
    _new_reactor()
    faulthandler.register(STACKS_SIGNAL, file=2, all_threads=True)
    sys.argv = command
    with contextlib.ExitStack() as opened_streams:
        sys.stdin = opened_streams.enter_context(open(0, encoding="utf-8", closefd=False))
        sys.stdout = opened_streams.enter_context(open(1, "w", encoding="utf-8", closefd=False))
        sys.stderr = opened_streams.enter_context(
            open(2, "w", buffering=1, encoding="utf-8", errors="backslashreplace", closefd=False)
        )
        opened_streams.callback(atexit._run_exitfuncs)
        program = Path(command[0])
        if program.suffix == ".py":
            sys.path.insert(0, str(program.parent))
            runpy.run_path(str(program), run_name="__main__")
        else:
            import_module(PROGRAMS[program.name]).main(prog_name=program.name)


def _end_with_the_server() -> None:
    """Ends with the process it was forked from, which ends with the tests."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _new_reactor() -> None:
    """Makes a new reactor, whose poll set is not shared: klein imports the reactor."""
    if (reactor := sys.modules.get("twisted.internet.reactor")) is not None:
        reactor.__init__()  # type: ignore[misc]
