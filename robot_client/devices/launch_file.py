"""A launch file that a module starts and stops by itself, as with arguments from a command.

A launch file that always runs needs no class: it is a module of its own (``launch = [PACKAGE, FILE]``).
"""

from __future__ import annotations

import os
import secrets
import subprocess
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress

from robot_client.modules import processes
from robot_client.modules.launched_nodes import LaunchedNodes


class LaunchFile:
    """One run of ``ros2 launch``, with its nodes as its output reports them.

    :param package: of the launch file
    :param file: its name, as ``robot.launch.py``
    :param arguments: of the launch file, by name
    :param died: called with the name and exit code of a node that has died, in a thread of the launch file. An
        exception is printed, and the launch goes on
    :param ended: called in such a thread when the launch has ended without :meth:`stop`, with its exit code, which is
        negative for a signal. What it left running has been ended by then, or can't be ended, see :meth:`start`
    """

    def __init__(
        self,
        package: str,
        file: str,
        arguments: dict[str, str] | None = None,
        died: Callable[[str, int], object] = lambda node, code: None,
        ended: Callable[[int], object] = lambda code: None,
    ) -> None:
        self._command = ["ros2", "launch", package, file]
        self._command += [f"{name}:={value}" for name, value in (arguments or {}).items()]
        self._died = died
        self._ended = ended
        self._nodes = LaunchedNodes()
        self._process: subprocess.Popen[str] | None = None
        """``None`` while it does not run."""
        self._left = processes.RunProcesses(None, "")
        self._gave_up = False
        """Whether processes of the run before could not be ended."""
        self._is_stopping = False
        self._watcher: threading.Thread | None = None

    @property
    def nodes(self) -> dict[str, int]:
        """Its nodes that run: process ids by name."""
        return dict(self._nodes.running)

    @property
    def running(self) -> bool:
        """Whether it runs."""
        return self._process is not None

    def start(self) -> None:
        """Start it; no effect while it runs. Its output goes to the module's log.

        :raises OSError: there is no program ``ros2``, or it can't be started
        :raises RuntimeError: a process of the run before still runs, as it could not be ended
        """
        if self._process is not None:
            return
        if self._gave_up:
            self._check_ended()
        run = secrets.token_hex(8)
        self._process = process = subprocess.Popen(
            self._command,
            env={**os.environ, processes.LAUNCH_MARK: run},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        session = processes.ProcessSession.begun_by(process.pid)
        self._left = processes.RunProcesses(session, run, processes.LAUNCH_MARK)
        self._nodes = LaunchedNodes()
        self._is_stopping = self._gave_up = False
        self._watcher = threading.Thread(target=self._watch, args=(process,), daemon=True)
        self._watcher.start()

    def stop(self) -> None:
        """Stop it with all its processes, also those that began a session: SIGINT, then SIGTERM, then SIGKILL.

        Returns when they have ended, or can't be ended, which the module's log says.
        """
        process, watcher = self._process, self._watcher
        if process is None or watcher is None:
            return
        self._is_stopping = True
        for number, seconds in processes.stop_signals(processes.TERM_SECONDS, processes.KILL_SECONDS):
            if process.poll() is None:
                processes.send(filter(self._left.hold, processes.pids()), number)
                with suppress(subprocess.TimeoutExpired):
                    process.wait(seconds)
        process.kill()
        watcher.join()

    def _watch(self, process: subprocess.Popen[str]) -> None:
        """Waits for the end of the launch, and ends what it has left running."""
        reader = threading.Thread(target=self._read, args=(process,), daemon=True)
        reader.start()
        code = process.wait()
        self._end_leftovers()
        reader.join(1.0)
        self._nodes.running.clear()
        was_stopped, self._process = self._is_stopping, None
        if not was_stopped:
            self._ended(code)

    def _end_leftovers(self) -> None:
        left = self._left
        kills = processes.KillAttempts(lambda pid, _: left.hold(pid))
        while (pause := kills.attempt()) is not None:
            if kills.unkillable:
                print(f"the launch file can't be ended: {kills.reason}; it is left alone", flush=True)
                self._gave_up = True
                return
            time.sleep(pause)

    def _check_ended(self) -> None:
        if left := [pid for pid in processes.pids() if self._left.hold(pid)]:
            some = ", ".join(str(pid) for pid in left[: processes.NAMED_PROCESSES])
            more = ", …" if len(left) > processes.NAMED_PROCESSES else ""
            raise RuntimeError(
                "the launch file can't be started again: processes of the run before could not be ended and still run: "
                f"{some}{more}; end them first"
            )

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            before = dict(self._nodes.dead)
            if self._nodes.received(line):
                for name, code in self._nodes.dead.items() - before.items():
                    self._report_death(name, code)

    def _report_death(self, name: str, code: int) -> None:
        try:
            self._died(name, code)
        except Exception:
            # A launch whose output is not read would stand still when the pipe is full.
            traceback.print_exc()
