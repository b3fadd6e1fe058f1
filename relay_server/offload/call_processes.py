"""Processes that run calls, each one at a time. A time limit and a cancel kill the process of the call.

The embedded engine has them on the relay's machine, and ``switchboard worker`` on its own.
"""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import shutil
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import msgspec
from pebble import ProcessExpired, ProcessPool

from relay_protocol.errors import Unavailable
from relay_server.offload.runner import (
    Outcome,
    WorkerCall,
    WorkerFunctions,
    describe_functions,
    end_left,
    run_call,
    start_process,
    took_no_call,
)

DESCRIBE_SECONDS = 60.0
"""Longest time in which a new process loads the functions."""


class CallFuture(Future[bytes]):
    """A call, which a process may leave to the one that takes its place.

    :ivar run: in the present process
    :ivar wanted: whether it was not cancelled
    """

    run: Future[bytes]
    wanted = True

    def cancel(self) -> bool:
        """End the call. The future fails when it has ended."""
        self.wanted = False
        self.run.cancel()
        return True


class CallProcesses:
    """A pool of processes; they start with the first call. Threads may share it.

    :param processes: calls that run at a time
    :param folder: of further functions, or ``None``
    :ivar progress_socket: path at which the owner listens for datagrams with the progress
    """

    def __init__(self, processes: int, folder: Path | None = None) -> None:
        self._processes = processes
        self._folder = folder
        _remove_abandoned()
        self._sockets = Path(tempfile.mkdtemp(prefix=_PREFIX))
        self._owner = _lock(self._sockets)
        self.progress_socket = str(self._sockets / "progress")
        self._lock = threading.Lock()
        self._stopped = False
        self._pool: ProcessPool | None = None

    def describe(self) -> Future[bytes]:
        """:class:`WorkerFunctions` as MessagePack; see :func:`functions_of`."""
        return self._schedule(describe_functions, (), DESCRIBE_SECONDS)

    def run(self, call: WorkerCall, seconds: float) -> Future[bytes]:
        """Run a call. Its future has an :class:`Outcome` as MessagePack, or an error for :func:`outcome_of`.

        :param seconds: longest run
        """
        made = CallFuture()
        self._begin(made, call, seconds)
        return made

    def _begin(self, future: CallFuture, call: WorkerCall, seconds: float) -> None:
        future.run = self._schedule(run_call, (msgspec.msgpack.encode(call),), seconds)
        future.run.add_done_callback(lambda run: self._done(future, call, seconds, run))
        if not future.wanted:
            future.run.cancel()

    def _done(self, future: CallFuture, call: WorkerCall, seconds: float, run: Future[bytes]) -> None:
        error = CancelledError() if run.cancelled() else run.exception()
        if isinstance(error, ProcessExpired) and took_no_call(self._sockets, call.number):
            if future.wanted and not self._stopped:
                self._begin(future, call, seconds)
                return
            error = CancelledError()
        if error is None:
            future.set_result(run.result())
        else:
            future.set_exception(error)

    def stop(self) -> None:
        """Kill all processes, and wait for their ends."""
        self._stopped = True
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.stop()
            pool.join()
            end_left(self._sockets)
        shutil.rmtree(self._sockets, ignore_errors=True)
        self._owner.close()

    def _schedule(
        self, work: Callable[..., bytes], arguments: tuple[Any, ...], seconds: float
    ) -> Future[bytes]:
        with self._lock:
            if self._pool is None or not self._pool.active:
                self._pool = ProcessPool(
                    self._processes,
                    initializer=start_process,
                    initargs=(str(self._folder or ""), self.progress_socket),
                    # A fork would take the owner's sockets and locks with it.
                    context=multiprocessing.get_context("spawn"),
                )
            future: Future[bytes] = self._pool.schedule(work, args=arguments, timeout=seconds)
            return future


_PREFIX = "switchboard-calls-"
_OWNER = "owner"
"""A file that is locked while the owner of a folder lives."""


def _lock(folder: Path) -> IO[bytes]:
    # It has its name only once it is locked.
    file = (folder / f"{_OWNER}.new").open("wb")
    fcntl.flock(file, fcntl.LOCK_EX)
    (folder / f"{_OWNER}.new").rename(folder / _OWNER)
    return file


def _remove_abandoned() -> None:
    """End what functions have left of a relay or worker that was killed, and remove its folder."""
    for each in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError):
            # Anybody may make such a folder there.
            if each.lstat().st_uid == os.getuid():
                _remove_if_abandoned(each)


def _remove_if_abandoned(folder: Path) -> None:
    """:raises OSError: its owner lives, or has just made it"""
    with (folder / _OWNER).open("rb") as owner:
        fcntl.flock(owner, fcntl.LOCK_EX | fcntl.LOCK_NB)
        end_left(folder, long_ago=True)
        shutil.rmtree(folder, ignore_errors=True)


def functions_of(body: bytes) -> WorkerFunctions:
    """Functions as a process has described them.

    :raises Unavailable: this is no description
    """
    try:
        return msgspec.msgpack.decode(body, type=WorkerFunctions)
    except msgspec.DecodeError as error:
        raise no_functions(error) from None


def no_functions(error: BaseException) -> Unavailable:
    """For a process that could not describe its functions."""
    return Unavailable(f"the functions can't be loaded: {error or type(error).__name__}")


def outcome_of(name: str, seconds: float, error: BaseException) -> Outcome:
    """How a call ended that has no outcome of its own.

    :param seconds: its time limit
    """
    if isinstance(error, FutureTimeout):
        return too_long(name, seconds)
    if isinstance(error, CancelledError):
        return cancelled(name)
    if isinstance(error, ProcessExpired):
        return Outcome(
            code="crashed", error=f"function {name} ended its process (exit code {error.exitcode})"
        )
    return Outcome(code="crashed", error=f"function {name}: {type(error).__name__}: {error}")


def too_long(name: str, seconds: float) -> Outcome:
    """The outcome of a call that was ended at its time limit."""
    words = f"function {name} ran longer than {seconds:g} s and was ended"
    return Outcome(code="timeout", error=words, seconds=seconds)


def cancelled(name: str) -> Outcome:
    """The outcome of a call that was cancelled."""
    return Outcome(code="cancelled", error=f"the call of function {name} was cancelled")
