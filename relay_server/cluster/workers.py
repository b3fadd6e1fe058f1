"""``switchboard serve --workers``: several relay processes of one machine behind one address.

This process opens the ports, starts the workers, and starts again each that ends. A worker is a relay of a cluster that
gets its listening sockets from here.

All workers accept clients from one socket. Robots have a socket for each worker, and the kernel chooses it by the
robot's network: all connections of a robot must reach the same relay.
"""

from __future__ import annotations

import ctypes
import os
import secrets
import signal
import socket
import struct
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
from twisted.internet.error import ProcessExitedAlready
from twisted.internet.protocol import ProcessProtocol
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import Invalid, Unavailable
from relay_server.common.clock import Clock
from relay_server.common.data_dir import DataDir, private
from relay_server.config import ListenAddress, RelaySettings, WorkerSettings
from relay_server.listeners import BACKLOG

VARIABLE = "SWITCHBOARD_WORKER"
"""Environment variable with the :class:`WorkerSettings` of a worker, as JSON."""
FOLDER = "workers"
"""Folder of the data folders of all workers but the first, below its own."""

FIRST_RESTART_SECONDS, LAST_RESTART_SECONDS = 1.0, 30.0
"""Pause before a worker that has ended is started again: at first, and at most."""
STEADY_SECONDS = 60.0
"""A worker that has run for so long is started again after the first pause."""
END_SECONDS = 45.0
"""Seconds that workers have to end: longer than a drain."""

_ATTACH_FILTER = 51
"""SO_ATTACH_REUSEPORT_CBPF of socket(7)."""
_NETWORK_HEADER = 0x100000
"""SKF_NET_OFF of linux/filter.h, negated: where the header of IP begins."""
_PR_SET_PDEATHSIG = 1
log = Logger()


# --- a worker --------------------------------------------------------------------------------------------


def this_worker() -> WorkerSettings | None:
    """What this process is as a worker; ``None``: it is none."""
    text = os.environ.pop(VARIABLE, "")
    return msgspec.json.decode(text, type=WorkerSettings) if text else None


def settings_of(worker: WorkerSettings, settings: RelaySettings) -> RelaySettings:
    """The settings of a worker: its share of what the machine has, and a folder of its own.

    :raises Unavailable: the process that started it has ended
    """
    _end_with(worker.parent)
    cluster = settings.cluster
    assert cluster is not None
    listen = cluster.listen
    if listen.port:
        listen = ListenAddress(listen.host, listen.port + worker.number - 1)
    data = data_of(worker.number, settings.data)
    data.mkdir(mode=0o700, parents=True, exist_ok=True)
    return replace(
        settings,
        data=data,
        name=worker.name,
        worker=worker,
        cluster=replace(cluster, listen=listen, group=worker.group),
        recordings=settings.recordings // worker.count,
        offload=replace(settings.offload, processes=max(1, settings.offload.processes // worker.count)),
    )


def _end_with(parent: int) -> None:
    """Have the kernel end this process when the one that holds its sockets has ended.

    :raises Unavailable: it has ended already
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        raise Unavailable("the process that started this worker has ended")


def data_of(number: int, data: Path) -> Path:
    """The data folder of a worker; the first has that of the relay, so that the command line finds it."""
    return data if number == 1 else data / FOLDER / str(number)


# --- sockets ---------------------------------------------------------------------------------------------


def open_socket(where: ListenAddress) -> socket.socket:
    """A listening socket for all workers.

    :raises Invalid: the address is taken, or not of this machine
    """
    return _bound_socket(where, shared=False)


def open_sockets(where: ListenAddress, count: int) -> list[socket.socket]:
    """One listening socket for each worker, on one port. Connections of one network reach the same socket.

    :raises Invalid: the address is taken, or not of this machine; or this is not Linux
    """
    # Two relays could share a port without noticing; this finds the other one.
    with _bound_socket(where, shared=False) as probe:
        where = ListenAddress(where.host, probe.getsockname()[1])
    sockets = [_bound_socket(where, shared=True) for _ in range(count)]
    program = _by_network(count)
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *each) for each in program))
    try:
        option = struct.pack("@HP", len(program), ctypes.addressof(code))
        sockets[0].setsockopt(socket.SOL_SOCKET, _ATTACH_FILTER, option)
    except OSError as error:
        raise Invalid(
            f"--workers needs Linux 4.5 or newer: connections can't be shared out ({error.strerror})"
        ) from None
    return sockets


def _bound_socket(where: ListenAddress, *, shared: bool) -> socket.socket:
    opened = socket.socket(socket.AF_INET6 if ":" in where.host else socket.AF_INET)
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if shared:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        opened.setblocking(False)
        opened.bind((where.host, where.port))
        opened.listen(BACKLOG)
    except OSError as error:
        opened.close()
        raise Invalid(f"cannot listen on {where}: {error.strerror or error}") from None
    return opened


def _by_network(count: int) -> list[tuple[int, int, int, int]]:
    """Instructions of classic BPF (bpf(2)) that return the number of a socket by the source of a packet.

    They hash what :func:`relay_server.auth.login_limiter.network_of` distinguishes: an IPv4 address, an IPv6 /64.
    Each is an operation, two jumps and an operand.
    """
    at = (1 << 32) - _NETWORK_HEADER
    return [
        (0x30, 0, 0, at),  # A = the byte with the version
        (0x74, 0, 0, 4),  # A >>= 4
        (0x15, 0, 2, 4),  # not IPv4: skip two
        (0x20, 0, 0, at + 12),  # A = source address
        (0x05, 0, 0, 4),  # skip four
        (0x20, 0, 0, at + 8),  # A = first word of the source address
        (0x07, 0, 0, 0),  # X = A
        (0x20, 0, 0, at + 12),  # A = second word
        (0xAC, 0, 0, 0),  # A ^= X
        (0x24, 0, 0, 2654435761),  # A *= a prime, so that regular addresses are spread, too
        (0x74, 0, 0, 16),  # A >>= 16
        (0x94, 0, 0, count),  # A %= count
        (0x16, 0, 0, 0),  # return A
    ]


# --- the process that starts them ------------------------------------------------------------------------


class WorkerOutput(ProcessProtocol):
    """Passes on the lines that a worker prints, and its exit."""

    def __init__(self, on_line: Callable[[bytes], None], on_exit: Callable[[int], None]) -> None:
        self._on_line = on_line
        self._on_exit = on_exit
        self._unread = b""

    def outReceived(self, data: bytes) -> None:
        """Bytes of its output."""
        *lines, self._unread = (self._unread + data).split(b"\n")
        for line in lines:
            self._on_line(line)

    def processExited(self, reason: Failure) -> None:
        """It has ended; processes that it started may still have its output open."""
        status: Any = reason.value
        self._on_exit(-status.signal if status.exitCode is None else status.exitCode)


class WorkerProcess:
    """One worker.

    :ivar process: Twisted's transport of it; ``None`` while it does not run
    :ivar ready: whether it has ever been ready
    """

    def __init__(self, number: int, clock: Clock, spawn: Callable[[WorkerProcess], Any]) -> None:
        self.number = number
        self.process: Any = None
        self.ready = False
        self._clock = clock
        self._spawn = spawn
        self._pause = FIRST_RESTART_SECONDS
        self._began = 0.0

    def start(self) -> None:
        """Start it."""
        self._began = self._clock.seconds()
        self.process = self._spawn(self)

    def ended(self) -> float:
        """It has ended; returns the pause before it is started again, seconds."""
        self.process = None
        if self._clock.seconds() - self._began >= STEADY_SECONDS:
            self._pause = FIRST_RESTART_SECONDS
        pause, self._pause = self._pause, min(2 * self._pause, LAST_RESTART_SECONDS)
        return pause

    def signal(self, number: int) -> None:
        """Send it a signal, if it runs."""
        if self.process is not None:
            with suppress(ProcessExitedAlready):
                self.process.signalProcess(number)


class WorkerSupervisor:
    """The process that starts the workers.

    :param settings: of the relay, before :func:`settings_of`
    :param secret: whether to make a secret for all workers, since the user has given none
    """

    def __init__(self, reactor: Any, settings: RelaySettings, count: int, *, secret: bool) -> None:
        self._reactor = reactor
        self._settings = settings
        self._secret = secret
        self._name = ""
        self._group = secrets.token_hex(8)
        self._http = open_socket(settings.http)
        self._robots = open_sockets(settings.robots, count)
        self._workers = [WorkerProcess(number, reactor, self._spawn) for number in range(1, count + 1)]
        self._ending = False
        self._exit_code = 0

    def run(self) -> int:
        """Run until a signal has ended all workers; returns the exit code."""
        self._prepare()
        self._reactor.callWhenRunning(self._begin)
        self._reactor.run()
        return self._exit_code

    def _prepare(self) -> None:
        folder = DataDir(self._settings.data)
        self._name = self._settings.name or folder.relay_name()
        folder.release()
        if self._secret:
            secret_file(self._settings.data).parent.mkdir(mode=0o700, exist_ok=True)
            with private(secret_file(self._settings.data)) as stream:
                stream.write(secrets.token_hex(32).encode())

    def _begin(self) -> None:
        # In place of Twisted's handlers, which log a traceback at a second signal.
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self._reactor.callFromThread(self._end, 0))
        signal.signal(signal.SIGHUP, lambda *_: self._reactor.callFromThread(self._send, signal.SIGHUP))
        # Alone at first, since it may have to upgrade the database.
        self._workers[0].start()

    def _spawn(self, worker: WorkerProcess) -> Any:
        http, robots = self._http.fileno(), self._robots[worker.number - 1].fileno()
        settings = WorkerSettings(
            number=worker.number,
            count=len(self._workers),
            http=http,
            robots=robots,
            group=self._group,
            name=self._name,
            parent=os.getpid(),
        )
        output = WorkerOutput(partial(self._line_received, worker), partial(self._worker_ended, worker))
        with Path(os.devnull).open("rb") as nothing:
            return self._reactor.spawnProcess(
                output,
                sys.executable,
                [sys.executable, *sys.argv],
                {**os.environ, VARIABLE: msgspec.json.encode(settings).decode()},
                childFDs={0: nothing.fileno(), 1: "r", 2: 2, http: http, robots: robots},
            )

    def _line_received(self, worker: WorkerProcess, line: bytes) -> None:
        if not line.startswith(b"READY"):
            _print(line)
        elif not worker.ready:
            worker.ready = True
            if all(each.ready for each in self._workers):
                _print(line)
            for each in self._workers:
                if each.process is None and not each.ready and not self._ending:
                    each.start()

    def _worker_ended(self, worker: WorkerProcess, code: int) -> None:
        pause = worker.ended()
        if self._ending:
            self._stop_when_ended()
        elif worker.ready:
            log.error(
                "worker {number} has ended with {code}; it is started again", number=worker.number, code=code
            )
            self._reactor.callLater(pause, self._start_again, worker)
        else:
            # It says on stderr why it can't start.
            self._end(code if code > 0 else 1)

    def _start_again(self, worker: WorkerProcess) -> None:
        if not self._ending:
            worker.start()

    def _end(self, exit_code: int) -> None:
        """End all workers, and then this process."""
        if self._ending:
            return
        self._ending, self._exit_code = True, exit_code
        self._send(signal.SIGTERM)
        self._reactor.callLater(END_SECONDS, self._send, signal.SIGKILL)
        self._stop_when_ended()

    def _stop_when_ended(self) -> None:
        if all(each.process is None for each in self._workers):
            self._reactor.stop()

    def _send(self, number: int) -> None:
        for each in self._workers:
            each.signal(number)


def secret_file(data: Path) -> Path:
    """File with the secret of workers for which the user has given none."""
    return data / FOLDER / "secret"


def _print(line: bytes) -> None:
    sys.stdout.buffer.write(line + b"\n")
    sys.stdout.flush()


def check_database(url: str, given: Sequence[str]) -> None:
    """:raises Invalid: the database can't be shared by workers, or they have no bus

    :param given: addresses of the bus
    """
    if url.startswith("sqlite"):
        raise Invalid(
            "--workers needs PostgreSQL (--db postgresql://…): with SQLite only one process can write at a time, so "
            "the workers would wait for each other"
        )
    if not given:
        raise Invalid(
            "--workers needs NATS, by which the workers know where each robot is: start 'nats-server --jetstream' "
            "and give --cluster-bus nats://127.0.0.1:4222"
        )
