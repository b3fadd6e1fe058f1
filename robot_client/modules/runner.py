"""The process beside each module: starts it, keeps its output, stops it with all its descendants.

A runner outlives the daemon, so a daemon that dies takes no module with it; the next daemon connects to the runner's
socket. It uses the standard library alone and waits without polling.

Protocol, JSON by line. Client (the daemon, or another module) → runner: ``{"do": "stop"}``, ``{"do": "ready"}`` (the
module is ready; the next daemon is to know it). Runner → client:

- ``{"event": "running", "pid": …, "runner": …, "ready": false}``: pids of its process and of the runner
- ``{"event": "stopping"}``: it is being stopped
- ``{"event": "leftovers"}``: its process has ended, and others that it has left are being ended; the ``pid`` of
  ``running`` is null then
- ``{"event": "unkillable", "reason": …}``: which processes still run long after SIGKILL, in words; empty when they have
  ended
- ``{"event": "dead_nodes", "nodes": {"talker-1": -9}}``: of a launch file, with their exit codes
- ``{"event": "output_loss", "reason": …}``: why its output is being lost; empty when no longer
- ``{"event": "ready"}``: a line of the output matches
- ``{"event": "exit", "run": …, "code": …, "signal": …, "error": …, "stopped": …, "ready": …, "memory_mb": …,
  "log_lost": …}``: the fields of :class:`robot_client.modules.module_exit.ModuleExit`, of which ``error`` and
  ``memory_mb`` may be missing; the runner leaves after it

The exit is also in ``exit.json``. The session that the module's process begins is in ``session.json``: if daemon and
runner are killed, the next daemon ends what is left of it.

Where the module is of kind ``python``, a client may also send ``{"do": "command", "id": …, "value": …}``, which is
answered by ``{"event": "answer", "id": …, "error": ""}``, and ``{"do": "listen"}`` for ``{"event": "feedback",
"value": …}``. The daemon sends ``{"do": "stopped", "stopped": true}``. The messages between runner and module are in
:mod:`robot_client.modules.command_relay`.
"""

from __future__ import annotations

import ctypes
import fcntl
import json
import os
import re
import resource
import selectors
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from robot_client.modules import processes
from robot_client.modules.command_relay import MESSAGE_BYTES, CommandRelay
from robot_client.modules.launched_nodes import LaunchedNodes, launch_error
from robot_client.modules.line_levels import LineLevels
from robot_client.modules.log_ring import LogRing, ModuleLogLine
from robot_client.modules.module_exit import ModuleExit
from robot_client.modules.module_output import REPORT_SECONDS, ModuleOutput, OutputLoss

READ_BYTES = 64 * 1024

FLOOD_BYTES = 1024 * 1024
FLOOD_SECONDS = 0.01
"""While output is dropped, so many bytes are read each so many seconds, about 100 MiB a second. A module that writes
more is blocked by its write, so that its output never takes a whole CPU of the runner."""

LEFTOVER_SECONDS = 2.0
"""After the module's process has ended, its descendants have so long between SIGTERM and SIGKILL."""

OUTPUT_SECONDS = 2.0
"""After all processes of the module have ended, its output is read for so long if another process holds it open."""

CLIENT_BYTES = 1024 * 1024
"""A daemon that reads nothing is disconnected when this much waits for it."""

LOCK_SECONDS = 5.0
LOCK_POLL_SECONDS = 0.02
"""The runner of the run before may need so long to leave after it has reported the end of its module."""

SOCKET_DESCRIPTOR = 3
"""File descriptor by which the daemon that starts the runner may hand on a connected socket."""

OOM_SCORE = Path("/proc/self/oom_score_adj")
"""How likely the kernel ends the process when memory is short, -1000 to 1000 (proc_pid_oom_score_adj(5))."""

SESSION_BYTES = 128
"""Size of ``session.json`` with its blanks."""

_MEMORY_SHORT = re.compile(r"MemoryError|bad_alloc|annot allocate memory|ut of memory|failed to map segment")
"""In a line of a program whose allocation failed: Python, C++, ``strerror(ENOMEM)``, and the dynamic linker."""

OnLine = Callable[[socket.socket, bytes], None]

_SET_PDEATHSIG = 1
_SET_CHILD_SUBREAPER = 36


class RunSpec(NamedTuple):
    """The settings of one run. Read from ``spec.json`` in the module's folder.

    :param run: id of this run, unguessable
    :param command: program and arguments
    :param environment: whole environment
    :param working_directory: of the program
    :param nice: added to the niceness
    :param cpus: CPU numbers it may use; empty for all
    :param memory: most bytes of address space of each process; 0 for no limit
    :param term_after: seconds between SIGINT and SIGTERM
    :param kill_after: seconds between SIGTERM and SIGKILL
    :param log_bytes: most bytes of its log on disk
    :param boot: id of the boot of the machine in which it was written
    :param ready_pattern: regular expression; the module is ready once a line matches. Empty for no such line
    :param launch: whether the program is ``ros2 launch``
    :param settings: of a module of kind ``python``, its first message; ``None`` for other kinds
    :param own_environment: the variables of ``environment`` that the module's settings set
    """

    run: str
    command: list[str]
    environment: dict[str, str]
    working_directory: str
    nice: int
    cpus: list[int]
    memory: int
    term_after: float
    kill_after: float
    log_bytes: int
    boot: str = ""
    ready_pattern: str = ""
    launch: bool = False
    settings: dict[str, Any] | None = None
    own_environment: dict[str, str] | None = None


class ModuleRunner:
    """One run of a module.

    :param folder: the module's folder; its lock must be held
    """

    def __init__(self, folder: Path, spec: RunSpec) -> None:
        self._folder = folder
        self._spec = spec
        self._log = LogRing(folder / "log", spec.log_bytes)
        self._levels = LineLevels()
        self._loss = OutputLoss()
        self._watches_loss = False
        self._memory_short = False
        self._nodes = LaunchedNodes()
        self._ready_line = re.compile(spec.ready_pattern) if spec.ready_pattern else None
        self._selector = selectors.DefaultSelector()
        self._clients: dict[socket.socket, bytearray] = {}
        """Connections, also that to the module, with what waits to be sent."""
        self._numbers: dict[int, socket.socket] = {}
        """Clients that have sent a command, by the number that names them to the module."""
        self._last_number = 0
        self._listeners: set[socket.socket] = set()
        self._module: socket.socket | None = None
        self._commands = CommandRelay(
            send=self._send_to_module,
            waiting=lambda: len(self._clients.get(self._module, b"")) if self._module else 0,
            answer=self._answer,
            listener=lambda message: self._send(message, self._listeners),
            on_failure=self._found_failure,
        )
        self._failure = ""
        """Why the module ends, in words, as it or ``ros2 launch`` has said."""
        self._child: subprocess.Popen[bytes] | None = None
        self._refused = os.pipe2(os.O_CLOEXEC)
        """Pipe from the child before the program runs: why a limit can't be applied."""
        self._outputs: dict[Any, ModuleOutput] = {}
        """By pipe; until it has ended."""
        self._all_ended = False
        """Whether all processes of the module have ended."""
        self._stop_steps: list[tuple[float, Callable[[], None]]] = []
        """Signals that are due, in order: time (monotonic seconds) and function. The module's end cancels them."""
        self._timers: list[tuple[float, Callable[[], None]]] = []
        """The same for calls that nothing cancels."""
        self._stopping = False
        self._kills = processes.KillAttempts(self._is_descendant)
        self._running: dict[str, Any] = {}
        self._exit: dict[str, Any] | None = None

    def run(self) -> None:
        """Run until the module and all its descendants have ended."""
        _prctl(_SET_CHILD_SUBREAPER, 1)
        self._catch_signals()
        listener = self._listen()
        if _is_socket(SOCKET_DESCRIPTOR):
            self._connected(socket.socket(fileno=SOCKET_DESCRIPTOR), self._order)
        try:
            self._start()
        except OSError as error:
            self._end_with({"code": None, "signal": None, "error": self._start_error(error)})
        except subprocess.SubprocessError:
            # What was written by _limit, in the child.
            reason = os.read(self._refused[0], READ_BYTES).decode(errors="replace")
            self._end_with({"code": None, "signal": None, "error": reason})
        self._reap()
        while not self._all_ended or self._outputs:
            self._turn()
        listener.close()
        self._finish()

    # --- starting -----------------------------------------------------------------------------------------

    def _start(self) -> None:
        spec = self._spec
        environment = {
            **spec.environment,
            processes.MARK: spec.run,
            processes.FOLDER: str(self._folder.parent.absolute()),
        }
        near, far = socket.socketpair() if spec.settings is not None else (None, None)
        self._child = subprocess.Popen(
            spec.command,
            env=environment,
            cwd=spec.working_directory,
            stdin=subprocess.DEVNULL if far is None else far.fileno(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=partial(self._limit, os.getpid()),
        )
        for stream, pipe in (("out", self._child.stdout), ("err", self._child.stderr)):
            assert pipe is not None
            os.set_blocking(pipe.fileno(), False)
            self._outputs[pipe] = ModuleOutput(stream, self._line, self._note, self._later, self._dropped)
            self._read_when_written(pipe)
        if near is not None and far is not None:
            far.close()
            self._module = near
            self._connected(near, self._from_module)
            self._send_to_module({"settings": spec.settings})
        self._running = {
            "event": "running",
            "pid": self._child.pid,
            "runner": os.getpid(),
            "ready": False,
        }
        self._send(self._running)

    def _start_error(self, error: OSError) -> str:
        spec = self._spec
        if error.filename == spec.working_directory:
            return f"folder = '{spec.working_directory}': {error.strerror}"
        hint = (
            "; source ROS 2 before the daemon starts, or set PATH in its environment" if spec.launch else ""
        )
        return f"{spec.command[0]}: {error.strerror}{hint}"

    def _limit(self, runner: int) -> None:
        """In the child, before the program: its session for later daemons, its limits, and the end with the runner."""
        with suppress(OSError):
            # Without it the daemon that runs now still finds the session.
            write_session(self._folder, self._spec.run, processes.ProcessSession.begun_by(os.getpid()))
        for number in (signal.SIGINT, signal.SIGHUP):
            # A program inherits what is ignored.
            signal.signal(number, signal.SIG_DFL)
        _prctl(_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != runner:
            # It was killed before, and its module must not run without it.
            os._exit(1)
        drop_oom_protection()
        spec = self._spec
        if spec.nice:
            os.nice(spec.nice)
        if spec.cpus:
            hint = f"the CPUs of this machine are 0 to {(os.cpu_count() or 1) - 1}"
            self._apply(f"cpus = {spec.cpus}", hint, os.sched_setaffinity, 0, spec.cpus)
        if spec.memory:
            limits = (spec.memory, spec.memory)
            hint = "the daemon itself may have no more"
            text = f"memory_mb = {spec.memory // 1024**2}"
            self._apply(text, hint, resource.setrlimit, resource.RLIMIT_AS, limits)

    def _apply(self, setting: str, hint: str, function: Callable[..., object], *arguments: Any) -> None:
        """In the child: apply a limit. If the system refuses it, the child ends and the reason is in the pipe."""
        try:
            function(*arguments)
        except (OSError, ValueError, OverflowError) as error:
            reason = f"{setting}: {getattr(error, 'strerror', None) or error}; {hint}"
            os.write(self._refused[1], reason.encode())
            raise

    def _listen(self) -> socket.socket:
        path = self._folder / "socket"
        path.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX)
        # A path of the folder's descriptor is short enough for a socket's address, however deep the folder is.
        folder = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)
        listener.bind(f"/proc/self/fd/{folder}/socket")
        os.close(folder)
        listener.listen(8)
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ, lambda: self._accept(listener))
        return listener

    def _catch_signals(self) -> None:
        reader, writer = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.signal(signal.SIGTERM, lambda *_: self._stop())
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        self._selector.register(reader, selectors.EVENT_READ, lambda: self._woken(reader))

    # --- running ------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        due = [each[0][0] for each in (self._stop_steps, self._timers) if each]
        timeout = max(0.0, min(due) - time.monotonic()) if due else None
        for key, _ in self._selector.select(timeout):
            key.data()
        for calls in (self._stop_steps, self._timers):
            while calls and calls[0][0] <= time.monotonic():
                calls.pop(0)[1]()

    def _woken(self, reader: int) -> None:
        os.read(reader, 4096)
        self._reap()

    def _reap(self) -> None:
        """Reap the module's process and orphans that became children of the runner."""
        child = self._child
        has_children = True
        while has_children:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                # Orphans become children of the runner, so there are no descendants either.
                has_children = False
                break
            if pid == 0:
                break
            if child is not None and pid == child.pid:
                number = os.waitstatus_to_exitcode(status)
                if self._module is not None:
                    # It may have said why it ends.
                    self._selector.get_key(self._module).data()
                child.returncode = number
                self._end_with(
                    {
                        "code": max(number, 0) if number >= 0 else None,
                        "signal": -number if number < 0 else None,
                    }
                )
        if self._exit is None:
            return
        if has_children:
            if not self._stop_steps:
                self._end_leftovers()
        else:
            # Nothing is left to be stopped.
            self._stop_steps.clear()
            if not self._all_ended:
                self._all_ended = True
                self._later(OUTPUT_SECONDS, self._abandon_outputs)

    def _end_with(self, exit: dict[str, Any]) -> None:
        if self._exit is None:
            self._exit = {"event": "exit", **exit}
            self._stop_steps.clear()
            if self._running:
                self._running["pid"] = None

    def _end_leftovers(self) -> None:
        self._send({"event": "leftovers"})
        self._signal(signal.SIGTERM)
        self._add_stop_step(LEFTOVER_SECONDS, self._kill)

    def _read_when_written(self, pipe: Any) -> None:
        if pipe in self._outputs:
            self._selector.register(pipe, selectors.EVENT_READ, lambda: self._read(pipe))

    def _read(self, pipe: Any) -> None:
        try:
            data = os.read(pipe.fileno(), READ_BYTES)
        except BlockingIOError:
            return
        if not data:
            self._selector.unregister(pipe)
            self._end_output(pipe)
        elif not self._outputs[pipe].received(data):
            self._drop(pipe)

    def _end_output(self, pipe: Any) -> None:
        self._outputs.pop(pipe).ended()
        pipe.close()

    def _abandon_outputs(self) -> None:
        """A process outside of the module may hold a pipe open for ever, as one that was passed its descriptor."""
        for pipe in list(self._outputs):
            with suppress(KeyError):
                # It is not there while output is dropped.
                self._selector.unregister(pipe)
            self._end_output(pipe)
            self._note("warn", "a process that does not belong to the module holds its output open")

    def _drop(self, pipe: Any) -> None:
        """Empty the pipe, then leave it alone for a moment: few long reads cost less than many short ones."""
        with suppress(OSError):
            # The system allows a user only so many large pipes; with a short one the module is blocked earlier.
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, FLOOD_BYTES)
        with suppress(BlockingIOError):
            self._outputs[pipe].drop(len(os.read(pipe.fileno(), FLOOD_BYTES - READ_BYTES)))
        self._selector.unregister(pipe)
        self._later(FLOOD_SECONDS, lambda: self._read_when_written(pipe))

    def _line(self, stream: str, text: str) -> None:
        line = ModuleLogLine(time.time(), stream, self._levels.level_of(stream, text), text)
        self._log.write(line)
        if self._log.lost:
            self._loss.not_written(time.monotonic(), self._log.lost_reason)
            self._watch_loss()
        if self._ready_line is not None and not self._running.get("ready") and self._ready_line.search(text):
            self._running["ready"] = True
            self._send({"event": "ready"})
        if self._spec.launch and (error := launch_error(text)):
            self._found_failure(f"launch = {self._spec.command[2:4]}: {error}")
        if self._spec.memory and _MEMORY_SHORT.search(text):
            self._memory_short = True
        if self._spec.launch and not self._stopping and self._nodes.received(text):
            self._send({"event": "dead_nodes", "nodes": self._nodes.dead})

    def _note(self, level: str, text: str) -> None:
        """Write a remark into the log. It is no output of the module, so nothing is looked for in it."""
        self._log.write(ModuleLogLine(time.time(), "runner", level, text))

    def _found_failure(self, reason: str) -> None:
        self._failure = reason

    def _dropped(self) -> None:
        self._loss.dropped(time.monotonic())
        self._watch_loss()

    def _watch_loss(self) -> None:
        if not self._watches_loss:
            self._watches_loss = True
            self._check_loss()

    def _check_loss(self) -> None:
        """Once a second while output is being lost."""
        self._log.report_lost(time.time())
        if self._log.lost:
            self._loss.not_written(time.monotonic(), self._log.lost_reason)
        before = self._loss.reason
        self._watches_loss = self._loss.update(time.monotonic())
        if self._loss.reason != before:
            self._send({"event": "output_loss", "reason": self._loss.reason})
        if self._watches_loss:
            self._later(REPORT_SECONDS, self._check_loss)

    # --- stopping -----------------------------------------------------------------------------------------

    def _stop(self) -> None:
        if self._stopping or self._child is None or self._exit is not None:
            return
        self._stopping = True
        self._send({"event": "stopping"})
        pause = 0.0
        for number, seconds in processes.stop_signals(self._spec.term_after, self._spec.kill_after):
            self._add_stop_step(pause, partial(self._signal, number))
            pause += seconds
        self._add_stop_step(pause, self._kill)

    def _kill(self) -> None:
        before = self._kills.unkillable
        self._kills.attempt()
        if self._kills.unkillable != before:
            self._report_unkillable()
        # Also where none was found: a search misses what is forked meanwhile. The last one's end cancels it.
        self._add_stop_step(self._kills.pause, self._kill)

    def _report_unkillable(self) -> None:
        self._send(self._unkillable())
        if self._kills.reason:
            self._note("error", f"it can't be ended: {self._kills.reason}")

    def _unkillable(self) -> dict[str, Any]:
        return {"event": "unkillable", "reason": self._kills.reason}

    @staticmethod
    def _is_descendant(pid: int, others: set[int]) -> bool:
        stat = processes.read_stat(pid)
        if stat is None or stat.has_ended:
            return False
        return stat.parent == os.getpid() or stat.parent in others

    def _signal(self, number: signal.Signals) -> None:
        processes.send(processes.descendants(os.getpid()), number)

    def _add_stop_step(self, seconds: float, call: Callable[[], None]) -> None:
        self._stop_steps.append((time.monotonic() + seconds, call))
        self._stop_steps.sort(key=lambda step: step[0])

    def _later(self, seconds: float, call: Callable[[], None]) -> None:
        self._timers.append((time.monotonic() + seconds, call))
        self._timers.sort(key=lambda timer: timer[0])

    def _finish(self) -> None:
        exit = {**(self._exit or {}), "run": self._spec.run, "stopped": self._stopping}
        exit["ready"] = bool(self._running.get("ready"))
        if self._memory_short and exit.get("code") != 0:
            exit["memory_mb"] = self._spec.memory // 1024**2
        if self._failure and exit.get("code") not in (0, None):
            exit["error"] = self._failure
        self._log_end(ModuleExit.of(exit))
        exit["log_lost"] = self._log.lost
        self._log.close()
        _write(self._folder / "exit.json", exit)
        self._send(exit)
        for client in list(self._clients):
            client.setblocking(True)
            client.settimeout(1.0)
            try:
                client.sendall(self._clients[client])
            except OSError:
                continue

    def _log_end(self, exit: ModuleExit) -> None:
        level = "info" if self._stopping or exit.succeeded else "error"
        self._note(level, f"stopped: {exit}" if self._stopping else str(exit))

    # --- the daemon ---------------------------------------------------------------------------------------

    def _accept(self, listener: socket.socket) -> None:
        try:
            client, _ = listener.accept()
        except BlockingIOError:
            return
        self._connected(client, self._order)

    def _connected(self, client: socket.socket, on_line: OnLine) -> None:
        client.setblocking(False)
        client.set_inheritable(False)
        self._clients[client] = bytearray()
        received = bytearray()
        self._selector.register(
            client, selectors.EVENT_READ, lambda: self._read_client(client, received, on_line)
        )
        if client is not self._module:
            for event in self._state():
                self._send(event, {client})

    def _state(self) -> Iterator[dict[str, Any]]:
        """The events that a new client has missed."""
        # First that it is on its end: it must not look ready for a moment.
        if self._stopping:
            yield {"event": "stopping"}
        if self._exit is not None:
            yield {"event": "leftovers"}
        if self._running:
            yield self._running
        if self._nodes.dead:
            yield {"event": "dead_nodes", "nodes": self._nodes.dead}
        if self._loss.reason:
            yield {"event": "output_loss", "reason": self._loss.reason}
        if self._kills.unkillable:
            yield self._unkillable()

    def _read_client(self, client: socket.socket, received: bytearray, on_line: OnLine) -> None:
        try:
            data = client.recv(READ_BYTES)
        except BlockingIOError:
            data = None
        except OSError:
            data = b""
        if data == b"" or len(received) > MESSAGE_BYTES:
            self._disconnect(client)
            return
        received += data or b""
        *lines, rest = bytes(received).split(b"\n")
        received[:] = rest
        for line in lines:
            if client in self._clients:
                on_line(client, line)
        if client in self._clients:
            self._flush(client)

    def _order(self, client: socket.socket, line: bytes) -> None:
        try:
            message = json.loads(line)
            order = message["do"]
        except (ValueError, KeyError, TypeError, RecursionError):
            self._disconnect(client)
            return
        if order == "stop":
            self._stop()
        elif order == "ready":
            self._running["ready"] = True
        elif order == "listen":
            self._listeners.add(client)
        elif order == "command":
            self._command(client, message)
        elif order == "stopped" and self._module is not None:
            self._commands.robot_stopped(self._number_of(client), bool(message.get("stopped", True)))

    def _send(self, message: dict[str, Any], clients: set[socket.socket] | None = None) -> None:
        data = json.dumps(message).encode() + b"\n"
        for client in list(self._clients.keys() - {self._module} if clients is None else clients):
            if client in self._clients:
                self._clients[client] += data
                self._flush(client)

    def _flush(self, client: socket.socket) -> None:
        waiting = self._clients[client]
        try:
            while waiting:
                del waiting[: client.send(waiting)]
        except BlockingIOError:
            pass
        except OSError:
            self._disconnect(client)
            return
        if len(waiting) > CLIENT_BYTES:
            self._disconnect(client)
            return
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if waiting else 0)
        key = self._selector.get_key(client)
        if key.events != events:
            self._selector.modify(client, events, key.data)

    def _disconnect(self, client: socket.socket) -> None:
        if self._clients.pop(client, None) is not None:
            self._selector.unregister(client)
            self._listeners.discard(client)
            client.close()
            if client is self._module:
                self._module = None
            for number in [number for number, each in self._numbers.items() if each is client]:
                del self._numbers[number]
                self._commands.left(number)

    # --- commands to a module of kind python ----------------------------------------------------------------

    def _command(self, client: socket.socket, message: dict[str, Any]) -> None:
        if self._module is None:
            kind = "ended" if self._spec.settings is not None else "of a kind that takes no commands"
            error = f"the module is {kind}"
            self._send({"event": "answer", "id": message.get("id"), "error": error}, {client})
            return
        self._commands.command(self._number_of(client), message.get("id"), message.get("value"))

    def _number_of(self, client: socket.socket) -> int:
        for number, each in self._numbers.items():
            if each is client:
                return number
        self._last_number += 1
        self._numbers[self._last_number] = client
        return self._last_number

    def _send_to_module(self, message: dict[str, Any]) -> None:
        if self._module is not None:
            self._send(message, {self._module})

    def _answer(self, sender: int, message: dict[str, Any]) -> None:
        client = self._numbers.get(sender)
        if client is not None:
            self._send(message, {client})

    def _from_module(self, module: socket.socket, line: bytes) -> None:
        try:
            self._commands.received(line)
        except (ValueError, TypeError, RecursionError):
            self._note("error", "a message of the module is not understood; it gets no more commands")
            self._disconnect(module)


def _is_socket(descriptor: int) -> bool:
    try:
        return stat.S_ISSOCK(os.fstat(descriptor).st_mode)
    except OSError:
        return False


def drop_oom_protection() -> None:
    """Have the kernel end this process rather than the daemon, which may be protected, when memory is short."""
    try:
        if int(OOM_SCORE.read_text()) < 0:
            OOM_SCORE.write_text("0")
    except OSError:
        # A limit of the machine: the module runs all the same.
        return


def _prctl(option: int, value: int) -> None:
    ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0)


def _write(path: Path, content: dict[str, Any]) -> None:
    """Write a file whole or not at all. On a full disk the old one stays."""
    new = path.with_suffix(".new")
    try:
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "w") as file:
            json.dump(content, file)
        new.replace(path)
    except OSError:
        new.unlink(missing_ok=True)


def write_in_place(path: Path, content: dict[str, Any], size: int) -> None:
    """Write a file into the place that it had before, so that a full disk has room for it.

    :param size: bytes, filled up with blanks
    :raises OSError: it can't be written
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    with os.fdopen(os.open(path, flags, 0o600), "wb") as file:
        file.write(json.dumps(content).encode().ljust(size))
        file.truncate()


def write_session(folder: Path, run: str, session: processes.ProcessSession) -> None:
    """Write ``session.json``.

    :param folder: the module's
    :raises OSError: it can't be written
    """
    write_in_place(folder / "session.json", {"run": run, **session._asdict()}, SESSION_BYTES)


def lock(folder: Path) -> int | None:
    """Lock a module's folder for this process's lifetime; ``None`` if another runner has it and keeps it."""
    descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    until = time.monotonic() + LOCK_SECONDS
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            if time.monotonic() > until:
                os.close(descriptor)
                return None
            time.sleep(LOCK_POLL_SECONDS)
        else:
            return descriptor


def main() -> int:
    """``python -m robot_client.modules.runner FOLDER``; returns 75 if the module runs already."""
    folder = Path(sys.argv[1])
    # A signal to the daemon's terminal is not for modules.
    os.setsid()
    if lock(folder) is None:
        return 75
    spec = RunSpec(**json.loads((folder / "spec.json").read_text()))
    (folder / "exit.json").unlink(missing_ok=True)
    ModuleRunner(folder, spec).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
