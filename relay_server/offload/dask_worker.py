"""Dask's side: a worker that gives calls to processes of its own, and the relay's requests to it.

A worker carries a call out once: the relay names the worker by an id that is new at each connection, and Dask can't
move the call to another one.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import dask
import msgspec
from distributed import Security, Worker, get_worker
from distributed.diagnostics.plugin import WorkerPlugin

from relay_protocol.errors import Invalid
from relay_server.offload.call_processes import CallProcesses, cancelled, outcome_of
from relay_server.offload.runner import Outcome, WorkerCall, decode_report

PLUGIN = "switchboard"
KEY = "switchboard-"
"""Keys of tasks are this and the id of the call."""

PROGRESS_TOPIC = "switchboard-progress"

RETRY_SECONDS = 1.0
"""Between attempts to reach the scheduler."""

SCHEMES = ("tcp://", "tls://")

# Losses of connections are reported by the relay and by the worker.
logging.getLogger("distributed").setLevel(logging.CRITICAL)
for _name in ("distributed.worker", "distributed.scheduler", "distributed.core", "distributed.client"):
    logging.getLogger(_name).setLevel(logging.CRITICAL)
# Arguments are part of the call, up to FUNCTION_BYTES.
dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GiB"})


class DaskCall(msgspec.Struct, frozen=True, kw_only=True):
    """A call, as it is sent to a Dask worker.

    :param id: of the call
    :param worker: id of the worker that is meant
    :param seconds: longest run
    """

    id: str
    worker: str
    call: WorkerCall
    seconds: float


class WorkerDescription(msgspec.Struct, frozen=True, kw_only=True):
    """A worker's description of itself.

    :param id: new at each connection to the scheduler
    :param functions: :class:`relay_server.offload.runner.WorkerFunctions` as MessagePack
    """

    id: str
    functions: bytes


class CallPlugin(WorkerPlugin):
    """Runs the calls of one connection of a worker to its scheduler.

    :param functions: as MessagePack
    :param memory_mib: most that a call may take; 0: as its function says
    """

    name = PLUGIN

    def __init__(self, processes: CallProcesses, functions: bytes, memory_mib: int) -> None:
        self.description = WorkerDescription(id=secrets.token_hex(8), functions=functions)
        self._processes = processes
        self._memory_mib = memory_mib
        self._lock = threading.Lock()
        self._calls: dict[str, Future[bytes] | None] = {}
        """Calls that Dask runs, by their key; ``None`` until a process has one."""
        self._ids: dict[int, str] = {}
        self._numbers = iter(range(1, 1 << 62))

    def setup(self, worker: Any) -> None:
        """Dask has added it to its worker."""
        self._worker = worker

    def teardown(self, worker: Any) -> None:
        """The scheduler is lost, or the worker is stopped: end all calls."""
        for key in list(self._calls):
            self._end(key)

    def transition(self, key: str, start: str, finish: str, **_: Any) -> None:
        """A task begins or ends. One that the relay has cancelled ends before its call."""
        if finish == "executing":
            with self._lock:
                self._calls[key] = None
        elif start in ("executing", "long-running"):
            self._end(key)

    def _end(self, key: str) -> None:
        with self._lock:
            future = self._calls.pop(key, None)
        if future is not None:
            future.cancel()

    def run(self, wanted: DaskCall) -> Outcome | bytes:
        """Carry out a call, in a thread of Dask's."""
        name, key = wanted.call.name, KEY + wanted.id
        if wanted.worker != self.description.id:
            return Outcome(code="lost", error=f"function {name} was lost with the worker that was to run it")
        limit = wanted.call.memory_mib
        with self._lock:
            if key not in self._calls:
                return cancelled(name)
            number = next(self._numbers)
            limit = min(limit, self._memory_mib or limit)
            call = msgspec.structs.replace(wanted.call, number=number, memory_mib=limit)
            future = self._calls[key] = self._processes.run(call, wanted.seconds)
            self._ids[number] = wanted.id
        try:
            return future.result()
        except BaseException as error:
            return outcome_of(name, wanted.seconds, error)
        finally:
            self._ids.pop(number, None)

    def progressed(self, datagram: bytes) -> None:
        """A process reports the progress of its call."""
        report = decode_report(datagram)
        call = self._ids.get(report.number) if report is not None else None
        if report is not None and call is not None:
            self._worker.log_event(PROGRESS_TOPIC, [call, report.done, report.text])


# --- what the relay has Dask run: on a worker, on a worker, on the scheduler ----------------------------------


def run_on_worker(wanted: DaskCall) -> bytes:
    """Carry out a call; returns an :class:`Outcome` as MessagePack."""
    done = get_worker().plugins[PLUGIN].run(wanted)
    return done if isinstance(done, bytes) else msgspec.msgpack.encode(done)


def describe_on_worker(dask_worker: Any) -> bytes:
    """:class:`WorkerDescription` as MessagePack."""
    return msgspec.msgpack.encode(dask_worker.plugins[PLUGIN].description)


def list_on_scheduler(dask_scheduler: Any) -> list[dict[str, Any]]:
    """The workers."""
    return [
        {
            "address": each.address,
            "name": str(each.name),
            "host": each.host,
            "slots": each.nthreads,
            "labels": dict(each.resources),
        }
        for each in dask_scheduler.workers.values()
    ]


# --- switchboard worker -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class WorkerOptions:
    """How a worker runs.

    :param scheduler: its address
    :param processes: calls that run at a time
    :param labels: what it has, as `{"GPU": 1}`; a call takes of it what its function needs
    :param folder: of further functions, or ``None``
    :param memory_mib: most that a call may take; 0: as its function says
    """

    scheduler: str
    name: str
    processes: int = 1
    labels: dict[str, float] = field(default_factory=dict)
    folder: Path | None = None
    memory_mib: int = 0
    security: Security | None = None


async def serve_worker(options: WorkerOptions, report: Callable[[str], None]) -> None:
    """Run calls until it is cancelled. Without the scheduler it tries again.

    :param report: takes what is to be printed
    :raises Unavailable: the functions can't be loaded
    """
    processes = CallProcesses(options.processes, options.folder)
    serving = _Serving(processes)
    loop = asyncio.get_running_loop()
    port, _ = await loop.create_datagram_endpoint(
        lambda: serving, local_addr=processes.progress_socket, family=socket.AF_UNIX
    )
    try:
        functions = await asyncio.wrap_future(processes.describe())
        with tempfile.TemporaryDirectory(prefix="switchboard-") as scratch:
            while True:
                await _serve_once(options, serving, functions, scratch, report)
                await asyncio.sleep(RETRY_SECONDS)
    finally:
        port.close()
        await asyncio.to_thread(processes.stop)


class _Serving(asyncio.DatagramProtocol):
    """The processes, and the plugin of the present connection."""

    def __init__(self, processes: CallProcesses) -> None:
        self.processes = processes
        self.plugin: CallPlugin | None = None

    def datagram_received(self, data: bytes, addr: Any) -> None:
        if self.plugin is not None:
            self.plugin.progressed(data)


async def _serve_once(
    options: WorkerOptions, serving: _Serving, functions: bytes, scratch: str, report: Callable[[str], None]
) -> None:
    """Serve until the scheduler is lost."""
    plugin = CallPlugin(serving.processes, functions, options.memory_mib)
    worker = Worker(
        options.scheduler,
        nthreads=options.processes,
        # A scheduler refuses a name that it still knows from a lost connection.
        name=f"{options.name}-{plugin.description.id[:6]}",
        resources=options.labels,
        # Each call has a limit of its own.
        memory_limit=0,
        security=options.security,
        dashboard=False,
        local_directory=scratch,
        plugins=[plugin],
    )
    try:
        await worker
    except (OSError, asyncio.TimeoutError) as error:
        report(f"the scheduler {options.scheduler} can't be reached: {error or type(error).__name__}")
        await _close(worker)
        return
    serving.plugin = plugin
    report("READY")
    try:
        await worker.finished()
        report(f"the connection to the scheduler {options.scheduler} is lost")
    finally:
        serving.plugin = None
        await _close(worker)


async def _close(worker: Any) -> None:
    with suppress(OSError, asyncio.TimeoutError):
        await worker.close(timeout=2)


def security_of(scheduler: str, tls: tuple[str, str, str]) -> Security | None:
    """TLS with client certificates; ``None`` for a scheduler on this machine without TLS.

    :param tls: files of a CA, of a certificate and of its key; empty for none
    :raises Invalid: the address or a file can't be used, or the scheduler would be reached without TLS over a network
    """
    if not scheduler.startswith(SCHEMES):
        raise Invalid(
            f"'{scheduler}' is no address of a scheduler; write tls://HOST:PORT, or tcp://127.0.0.1:PORT"
        )
    if scheduler.startswith("tcp://"):
        host = scheduler.removeprefix("tcp://").rpartition(":")[0]
        if host not in ("localhost", "[::1]") and not host.startswith("127."):
            raise Invalid(
                f"'{scheduler}' is not on this machine, and a scheduler runs any code that it is sent: "
                "use tls:// with certificates"
            )
        return None
    ca, certificate, key = tls
    if not (ca and certificate and key):
        raise Invalid("a tls:// scheduler needs three PEM files: its CA, a certificate and the key of this")
    for each in tls:
        if not Path(each).is_file():
            raise Invalid(f"there is no file '{each}'")
    return Security(
        tls_ca_file=ca,
        tls_client_cert=certificate,
        tls_client_key=key,
        tls_worker_cert=certificate,
        tls_worker_key=key,
        require_encryption=True,
    )
