"""One run of a module as the daemon sees it: its runner's process and the connection to it."""

from __future__ import annotations

import json
import os
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from twisted.internet.address import UNIXAddress
from twisted.internet.interfaces import IAddress
from twisted.internet.protocol import Factory, ProcessProtocol, connectionDone
from twisted.protocols.basic import LineReceiver
from twisted.python.failure import Failure

from robot_client.modules import processes
from robot_client.modules.module_exit import ModuleExit
from robot_client.modules.runner import SOCKET_DESCRIPTOR, RunSpec, write_in_place, write_session
from robot_client.modules.settings import ModuleSettings

LEFTOVERS_ROUNDS = 2
"""Most searches at once for processes of a run whose runner was killed; each takes some milliseconds of a CPU."""

STOPPING_SECONDS = 1.0
"""A runner has so long to report that it stops its module."""

SPEC_BYTES = 16 * 1024
"""Size of ``spec.json`` with its blanks; one that holds more is longer."""


class RunListener(Protocol):
    """Receives what a run reports."""

    def on_running(self, pid: int | None) -> None:
        """The module's process has started; ``None`` if it has ended since, and left others."""

    def on_ready(self) -> None:
        """A line of the output said that the module is ready, or it was ready when an earlier daemon ended."""

    def on_stopping(self) -> None:
        """The runner has been asked to stop the module, by this daemon or an earlier one."""

    def on_leftovers(self) -> None:
        """The module's process has ended, and others that it has left are being ended."""

    def on_unkillable(self, reason: str) -> None:
        """The run can't be ended, as these processes, in words, run on after SIGKILL; empty when they have ended."""

    def on_dead_nodes(self, nodes: dict[str, int]) -> None:
        """These nodes of a launch file have died and were not started again: exit codes by name."""

    def on_output_loss(self, reason: str) -> None:
        """Output of the module is being lost, for this reason in words; empty when no longer."""

    def on_exit(self, exit: ModuleExit) -> None:
        """Every process of the run has ended."""


class ModuleRun:
    """One run.

    :param reactor: Twisted's
    :param folder: the module's
    :param run: the run's id
    """

    def __init__(self, reactor: Any, folder: Path, run: str, listener: RunListener) -> None:
        self._reactor = reactor
        self._folder = folder
        self._run = run
        self._listener = listener
        self.runner_pid: int | None = None
        """``None`` before it is known, and after its end."""
        self._link: RunnerLink | None = None
        self._exit: ModuleExit | None = None
        self._has_ended = False
        self._session: processes.ProcessSession | None = None
        """The session that the module's process began; ``None`` before it is known."""
        self._spec: dict[str, Any] = {}

    @classmethod
    def start(
        cls,
        reactor: Any,
        folder: Path,
        settings: ModuleSettings,
        environment: Mapping[str, str],
        boot: str,
        listener: RunListener,
    ) -> ModuleRun:
        """Start a runner with the module.

        :param boot: id of this boot of the machine
        :raises OSError: it can't be started
        """
        spec = run_spec(settings, environment)._replace(boot=boot)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # It takes the room that the runner needs.
        write_session(folder, "", processes.ProcessSession(0, 0))
        _write_spec(folder, spec._asdict())
        made = cls(reactor, folder, spec.run, listener)
        near, far = socket.socketpair()
        null = os.open(os.devnull, os.O_RDWR)
        try:
            reactor.spawnProcess(
                _RunnerProcess(),
                sys.executable,
                [sys.executable, "-m", "robot_client.modules.runner", str(folder)],
                env=dict(os.environ),
                childFDs={0: null, 1: null, 2: 2, SOCKET_DESCRIPTOR: far.fileno()},
            )
            made._link = _link_over(reactor, near, made._message, made._runner_gone)
        finally:
            os.close(null)
            near.close()
            far.close()
        return made

    @classmethod
    def reconnect(cls, reactor: Any, folder: Path, boot: str, listener: RunListener) -> ModuleRun | None:
        """Connect to the run that an earlier daemon left behind, if there is one whose end no daemon has seen.

        :param boot: id of this boot of the machine; a run of an earlier one ended with it, and is no crash
        """
        spec = _read(folder / "spec.json")
        if not spec:
            return None
        if spec.get("boot") != boot:
            _clear_traces(folder)
            return None
        made = cls(reactor, folder, str(spec.get("run")), listener)
        made._spec = spec
        try:
            made._link = connect_runner(reactor, folder, made._message, made._runner_gone)
        except OSError:
            # The listener must know of the run before its end.
            reactor.callLater(0, made._runner_gone)
        return made

    def has_settings(self, settings: ModuleSettings) -> bool:
        """Whether the run, which an earlier daemon started, has these settings.

        The daemon's own variables don't count: systemd sets some that differ from start to start.
        """
        return _comparable(self._spec) == _comparable(run_spec(settings, {})._asdict())

    def save_ready(self) -> None:
        """Have the runner remember, for the next daemon, that the module is ready."""
        self._order("ready")

    def stop(self) -> None:
        """Ask every process of the run to end: SIGINT, then SIGTERM, then SIGKILL."""
        self._order("stop")

    def robot_stopped(self, stopped: bool) -> None:
        """Notify the module, which must be of kind ``python``, whether the robot is stopped."""
        self._order("stopped", stopped=stopped)

    def _order(self, order: str, **more: Any) -> None:
        if self._link is not None:
            self._link.order(order, **more)

    def _message(self, message: dict[str, Any]) -> None:
        event = message.get("event")
        if event == "running":
            self.runner_pid = message.get("runner")
            if message["pid"] is not None:
                self._session = processes.ProcessSession.begun_by(message["pid"])
            self._listener.on_running(message["pid"])
            if message["ready"]:
                self._listener.on_ready()
        elif event == "ready":
            self._listener.on_ready()
        elif event == "stopping":
            self._listener.on_stopping()
        elif event == "leftovers":
            self._listener.on_leftovers()
        elif event == "unkillable":
            self._listener.on_unkillable(message["reason"])
        elif event == "dead_nodes":
            self._listener.on_dead_nodes(message["nodes"])
        elif event == "output_loss":
            self._listener.on_output_loss(message["reason"])
        elif event == "exit":
            self._exit = ModuleExit.of(message)

    def _runner_gone(self) -> None:
        """The runner has left. Without a report of how the module ended, it was killed."""
        self._link = self.runner_pid = None
        exit = self._exit or self._recorded_exit()
        if exit is not None:
            self._ended(exit)
        else:
            session = self._session or self._recorded_session()
            left = processes.RunProcesses(session, self._run)
            # The kernel may make a thread wait that reads about a process that can't be ended.
            threading.Thread(target=self._end_leftovers, args=(left,), name="leftovers", daemon=True).start()

    def _recorded_session(self) -> processes.ProcessSession | None:
        found = _read(self._folder / "session.json")
        if found.get("run") != self._run:
            return None
        return processes.ProcessSession(int(found["id"]), int(found["started"]))

    def _recorded_exit(self) -> ModuleExit | None:
        message = _read(self._folder / "exit.json")
        return ModuleExit.of(message) if message.get("run") == self._run else None

    def _end_leftovers(self, left: processes.RunProcesses) -> None:
        """In a thread of its own."""
        kills = processes.KillAttempts(lambda pid, _: left.hold(pid), LEFTOVERS_ROUNDS)
        reported = ""
        while (pause := kills.attempt()) is not None:
            if kills.reason != reported:
                reported = kills.reason
                self._reactor.callFromThread(self._listener.on_unkillable, reported)
            time.sleep(pause)
        self._reactor.callFromThread(self._ended, ModuleExit(error="its runner was killed"))

    def _ended(self, exit: ModuleExit) -> None:
        if not self._has_ended:
            self._has_ended = True
            # The next daemon must not find a run whose end was seen.
            _clear_traces(self._folder)
            self._listener.on_exit(exit)


def _comparable(spec: dict[str, Any]) -> str:
    left_out = ("run", "boot", "environment")
    # As text, since NaN is not equal to itself.
    return json.dumps({key: value for key, value in spec.items() if key not in left_out}, sort_keys=True)


def _clear_traces(folder: Path) -> None:
    with suppress(OSError):
        _write_spec(folder, {})
    with suppress(OSError):
        (folder / "exit.json").unlink(missing_ok=True)


def _write_spec(folder: Path, spec: dict[str, Any]) -> None:
    write_in_place(folder / "spec.json", spec, SPEC_BYTES)


def run_spec(settings: ModuleSettings, environment: Mapping[str, str]) -> RunSpec:
    """The settings of one run, for its runner.

    :param environment: the daemon's
    """
    own = settings.own_environment
    return RunSpec(
        run=secrets.token_hex(8),
        command=command_of(settings),
        # The log is a pipe, to which Python programs write in blocks of 8 KiB: a line may come minutes later.
        environment={"PYTHONUNBUFFERED": "1", **environment, **own},
        own_environment=own,
        working_directory=settings.folder or str(Path.cwd()),
        nice=settings.nice,
        cpus=settings.cpus,
        memory=settings.memory_mb * 1024 * 1024,
        term_after=settings.term_after_s,
        kill_after=settings.kill_after_s,
        log_bytes=int(settings.log_mb * 1024 * 1024),
        ready_pattern=settings.ready_pattern,
        launch=bool(settings.launch),
        settings=settings.settings if settings.python else None,
    )


def command_of(settings: ModuleSettings) -> list[str]:
    """Program and arguments of a module of any kind."""
    if settings.launch:
        return ["ros2", "launch", *settings.launch]
    if settings.python:
        return [sys.executable, "-u", "-m", "robot_client.devices.host", settings.python]
    return settings.command


class _RunnerProcess(ProcessProtocol):
    """Reaps the runner; its end is noticed by its connection."""


class RunnerLink(LineReceiver):
    """A connection to a runner.

    :param on_message: receives the runner's messages, see :mod:`robot_client.modules.runner`
    :param on_lost: called at the end of the connection
    """

    transport: Any
    delimiter = b"\n"
    MAX_LENGTH = 1024 * 1024

    def __init__(self, on_message: Callable[[dict[str, Any]], None], on_lost: Callable[[], None]) -> None:
        self._on_message = on_message
        self._on_lost = on_lost

    def order(self, order: str, **more: Any) -> None:
        """Send one message."""
        self.transport.write(json.dumps({"do": order, **more}, ensure_ascii=False).encode() + b"\n")

    def close(self) -> None:
        """End the connection."""
        self.transport.loseConnection()

    def lineReceived(self, line: bytes) -> None:
        self._on_message(json.loads(line))

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        self._on_lost()


def connect_runner(
    reactor: Any, folder: Path, on_message: Callable[[dict[str, Any]], None], on_lost: Callable[[], None]
) -> RunnerLink:
    """Connect to the runner of a module.

    :param folder: the module's
    :raises OSError: it does not run
    """
    with _connected(folder) as connection:
        return _link_over(reactor, connection, on_message, on_lost)


def stop_left_running(folder: Path) -> None:
    """Have the runners that an earlier daemon left behind stop their modules. It does not wait for their ends.

    It needs no reactor.

    :param folder: holds a folder for each module
    """
    for spec in sorted(folder.glob("*/spec.json")):
        with suppress(OSError), _connected(spec.parent, STOPPING_SECONDS) as connection:
            connection.sendall(b'{"do": "stop"}\n')
            with connection.makefile("rb") as events:
                # It would not read an order of a client that has left.
                next(
                    (each for each in events if json.loads(each)["event"] in ("stopping", "leftovers")), None
                )


def _connected(folder: Path, timeout: float | None = None) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX)
    connection.settimeout(timeout)
    # A path of the folder's descriptor is short enough for a socket's address.
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        connection.connect(f"/proc/self/fd/{descriptor}/socket")
    except OSError:
        connection.close()
        raise
    finally:
        os.close(descriptor)
    return connection


def _link_over(
    reactor: Any,
    connection: socket.socket,
    on_message: Callable[[dict[str, Any]], None],
    on_lost: Callable[[], None],
) -> RunnerLink:
    connection.setblocking(False)
    link = RunnerLink(on_message, on_lost)
    reactor.adoptStreamConnection(connection.fileno(), socket.AF_UNIX, _LinkFactory(link))
    return link


class _LinkFactory(Factory):
    noisy = False

    def __init__(self, link: RunnerLink) -> None:
        self._link = link

    def buildProtocol(self, addr: IAddress | UNIXAddress | None) -> RunnerLink:
        return self._link


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
