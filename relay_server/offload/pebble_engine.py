"""The embedded engine: processes on the relay's machine."""

from __future__ import annotations

import socket
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from concurrent.futures import TimeoutError as FutureTimeout
from pathlib import Path
from typing import Any

from pebble import ProcessExpired
from twisted.internet.defer import Deferred
from twisted.internet.protocol import DatagramProtocol
from twisted.internet.threads import deferToThread
from twisted.logger import Logger

from relay_protocol.functions import FunctionDescription
from relay_server.offload.call_processes import CallProcesses, functions_of, no_functions, outcome_of
from relay_server.offload.engine import EngineCall, OnProgress, WorkerStatus, label_words
from relay_server.offload.runner import (
    Outcome,
    ProgressReport,
    WorkerFunctions,
    decode_outcome,
    decode_report,
)


class PebbleRun:
    """See :class:`relay_server.offload.engine.EngineRun`."""

    def __init__(self, future: Future[bytes]) -> None:
        self.outcome: Deferred[Outcome] = Deferred()
        self._future = future

    def cancel(self) -> None:
        """End the call."""
        self._future.cancel()


class PebbleEngine:
    """See :class:`relay_server.offload.engine.Engine`.

    :param reactor: Twisted's
    :param processes: calls that run at a time
    :param folder: of further functions, or ``None``
    """

    log = Logger()
    name = "embedded"

    def __init__(self, reactor: Any, processes: int, folder: Path | None = None) -> None:
        self._reactor = reactor
        self._slots = processes
        self._folder = folder
        self._processes: CallProcesses | None = None
        self._port: Any = None
        self._progress: dict[int, OnProgress] = {}

    async def start(self, on_change: Callable[[], None]) -> None:
        """Processes start with the first call."""

    async def stop(self) -> None:
        """Kill all processes."""
        processes, self._processes = self._processes, None
        if processes is not None:
            await self._port.stopListening()
            await deferToThread(processes.stop)

    async def describe(self) -> WorkerFunctions:
        """The functions of the processes.

        :raises Unavailable: they can't be loaded
        """
        try:
            return functions_of(await self._waiting(self._running().describe()))
        except (FutureTimeout, ProcessExpired, CancelledError) as error:
            raise no_functions(error) from None

    def missing(self, function: FunctionDescription) -> str:
        """The relay's own machine has no labels."""
        if not function.labels:
            return ""
        return f"no worker has what function '{function.name}' needs: {label_words(function.labels)}"

    def free(self, function: FunctionDescription, *, reserved: int = 0) -> bool:
        """Whether a process is free."""
        return not function.labels and len(self._progress) + reserved < self._slots

    def run(self, call: EngineCall, on_progress: OnProgress) -> PebbleRun:
        """Run a call in a process."""
        number, name = call.call.number, call.call.name
        future = self._running().run(call.call, call.seconds)
        run = PebbleRun(future)
        self._progress[number] = on_progress
        ended = self._waiting(future).addCallbacks(
            decode_outcome, lambda failure: outcome_of(name, call.seconds, failure.value)
        )
        ended.addCallback(self._ended, number, run)
        return run

    def workers(self) -> list[WorkerStatus]:
        """All processes as one worker."""
        running = len(self._progress)
        host = socket.gethostname()
        return [WorkerStatus(name="relay", host=host, slots=self._slots, running=running, labels={})]

    def _running(self) -> CallProcesses:
        if self._processes is None:
            self._processes = CallProcesses(self._slots, self._folder)
            port = _ProgressPort(self._progressed)
            self._port = self._reactor.listenUNIXDatagram(self._processes.progress_socket, port, mode=0o600)
        return self._processes

    def _waiting(self, future: Future[bytes]) -> Deferred[bytes]:
        waiting: Deferred[bytes] = Deferred()
        future.add_done_callback(lambda done: self._reactor.callFromThread(_settle, done, waiting))
        return waiting

    def _progressed(self, report: ProgressReport) -> None:
        on_progress = self._progress.get(report.number)
        if on_progress is not None:
            on_progress(report.done, report.text)

    def _ended(self, outcome: Outcome, number: int, run: PebbleRun) -> None:
        self._progress.pop(number, None)
        run.outcome.callback(outcome)


def _settle(done: Future[bytes], waiting: Deferred[bytes]) -> None:
    try:
        value = done.result()
    except BaseException as error:
        waiting.errback(error)
    else:
        waiting.callback(value)


class _ProgressPort(DatagramProtocol):
    def __init__(self, on_report: Callable[[ProgressReport], None]) -> None:
        self._on_report = on_report

    def datagramReceived(self, datagram: bytes, addr: Any) -> None:
        report = decode_report(datagram)
        if report is not None:
            self._on_report(report)
