"""The worker's side of a call: finds the function, runs it within its limits, and puts every end into words.

It runs in the processes of :mod:`relay_server.offload.call_processes`. A process runs one call at a time. What a
function has started itself ends with its call: at its end as a child of the process, and if the process was killed as a
member of its group, or by the variable :data:`MARK` in its environment.
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec

from relay_protocol.errors import Invalid, NotFound
from relay_protocol.functions import (
    FAULTS,
    CallFailed,
    FunctionDescription,
    FunctionRegistry,
    Reporter,
    reporter,
)
from relay_protocol.limits import MIB

REPORT_SECONDS = 0.1
"""Least time between two reports of progress."""

REPORT_BYTES = 4096

TEXT = 500
"""Longest text of an error or of a progress, characters."""

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Calls run side by side in processes, so libraries begin no threads of their own."""

_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36

GROUP = "group-"
"""Files beside the progress socket have this and the number of a process, which leads a group."""

MARK = "SWITCHBOARD_CALLS"
"""Environment variable of what functions start: the folder of the progress socket, and the number of the process."""

GROWTH_BYTES = 256 * MIB
"""A process that has grown by more, or has more threads, gives way to a new one before its next call: functions have
kept them. What the first call of each function leaves does not count, as the function may need it for all calls."""

_LEFT_CALL = "left-"
"""Files beside the progress socket have this and the number of a call that a process has left to a new one."""

CHILD_SECONDS = 1.0
"""Longest time in which the children of a call are ended."""


class WorkerCall(msgspec.Struct, frozen=True, kw_only=True):
    """A call, as it is sent to a worker.

    :param number: of its owner, for the progress
    :param arguments: MessagePack of a map
    :param max_result: most bytes of the result
    """

    number: int
    name: str
    version: int
    arguments: bytes
    memory_mib: int
    max_result: int


class Outcome(msgspec.Struct, frozen=True):
    """The end of a call.

    :param value: MessagePack of the result; ``None`` if there is none
    :param code: why not, see :class:`relay_protocol.functions.CallFailed`; ``invalid`` for arguments that don't fit
    :param error: in words
    :param seconds: for which it ran
    """

    value: bytes | None = None
    code: str = ""
    error: str = ""
    seconds: float = 0.0


class WorkerFunctions(msgspec.Struct, frozen=True):
    """The functions of a worker.

    :param problems: modules that can't be loaded
    """

    functions: list[FunctionDescription] = []
    problems: list[str] = []


class ProgressReport(msgspec.Struct, frozen=True, array_like=True):
    """The progress of a call, 0 to 1."""

    number: int
    done: float
    text: str


_registry: FunctionRegistry | None = None
_socket: socket.socket | None = None
_lock = threading.Lock()
_usual_bytes = 0
_usual_threads = 1
_called: set[tuple[str, int]] = set()


def start_process(folder: str, progress_socket: str) -> None:
    """Prepare a process: it ends with its owner, and loads the functions.

    :param folder: of further functions, or empty
    :param progress_socket: path of its owner's datagram socket
    """
    global _socket, _usual_bytes, _usual_threads
    libc = ctypes.CDLL(None)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    libc.prctl(_PR_SET_CHILD_SUBREAPER, 1)
    owned = Path(progress_socket).parent
    end_left(owned)
    os.setpgid(0, 0)
    os.environ[MARK] = _mark(owned, os.getpid())
    (owned / f"{GROUP}{os.getpid()}").touch()
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")
    _socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    _socket.setblocking(False)
    with suppress(OSError):
        _socket.connect(progress_socket)
    registry(folder)
    _usual_bytes, _usual_threads = _data_bytes(), threading.active_count()


def end_left(folder: Path, *, long_ago: bool = False) -> None:
    """Kill what the functions of processes that have ended have left.

    :param folder: of the progress socket
    :param long_ago: whether all have ended, maybe long ago: their numbers may be those of others by now, so that groups
        stay
    """
    ended = set()
    for each in folder.glob(f"{GROUP}*"):
        leader = int(each.name.removeprefix(GROUP))
        if not long_ago:
            # While the leader lives, or the number is another process's, the group is none of ours to kill.
            if Path(f"/proc/{leader}").exists():
                continue
            with suppress(OSError):
                os.killpg(leader, signal.SIGKILL)
        ended.add(f"{MARK}={_mark(folder, leader)}".encode())
        each.unlink(missing_ok=True)
    for process in Path("/proc").glob("[0-9]*") if ended else ():
        with suppress(OSError):
            if not ended.isdisjoint((process / "environ").read_bytes().split(b"\0")):
                os.kill(int(process.name), signal.SIGKILL)


def _mark(folder: Path, number: int) -> str:
    return f"{folder}:{number}"


def _end_children() -> None:
    """Kill what a call has started and left behind. Orphans of its children become children of this process."""
    end = time.monotonic() + CHILD_SECONDS
    while _has_children() and time.monotonic() < end:
        for thread in Path("/proc/self/task").iterdir():
            with suppress(OSError):
                for child in (thread / "children").read_text().split():
                    os.kill(int(child), signal.SIGKILL)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        time.sleep(0.001)


def _has_children() -> bool:
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return False
    return True


def registry(folder: str = "") -> FunctionRegistry:
    """The functions of this process, loaded once.

    :param folder: of further functions, or empty
    """
    global _registry
    with _lock:
        if _registry is None:
            loaded = FunctionRegistry()
            loaded.load(Path(folder) if folder else None)
            _registry = loaded
        return _registry


def describe_functions() -> bytes:
    """:class:`WorkerFunctions` as MessagePack."""
    functions = registry()
    return msgspec.msgpack.encode(WorkerFunctions(functions.describe(), functions.problems))


def run_call(body: bytes) -> bytes:
    """Carry out a :class:`WorkerCall`; returns an :class:`Outcome`, both as MessagePack. It raises nothing."""
    global _usual_bytes, _usual_threads
    call = msgspec.msgpack.decode(body, type=WorkerCall)
    before = _data_bytes()
    if before > _usual_bytes + GROWTH_BYTES or threading.active_count() > _usual_threads:
        _leave(call.number)
    began = time.monotonic()
    outcome = _run(call, _to_socket(call.number))
    _end_children()
    if (call.name, call.version) not in _called:
        _called.add((call.name, call.version))
        _usual_bytes += max(0, _data_bytes() - before)
        _usual_threads = max(_usual_threads, threading.active_count())
    return msgspec.msgpack.encode(msgspec.structs.replace(outcome, seconds=time.monotonic() - began))


def _leave(number: int) -> None:
    """End this process before a call, which a new one begins in its place."""
    (Path(os.environ[MARK].rpartition(":")[0]) / f"{_LEFT_CALL}{number}").touch()
    os._exit(os.EX_TEMPFAIL)


def took_no_call(folder: Path, number: int) -> bool:
    """Whether a process that has ended has left its call to a new one; to be asked once.

    :param folder: of the progress socket
    """
    try:
        (folder / f"{_LEFT_CALL}{number}").unlink()
    except OSError:
        return False
    return True


def _run(call: WorkerCall, report: Reporter) -> Outcome:
    token = reporter.set(_throttled(report))
    try:
        spec = registry().find(call.name, call.version)
        with _memory_limit(call.memory_mib):
            value = spec.run(call.arguments)
    except (Invalid, NotFound) as error:
        return Outcome(code="invalid", error=str(error)[:TEXT])
    except CallFailed as error:
        return Outcome(code=error.code, error=str(error)[:TEXT])
    except MemoryError:
        return _out_of_memory(call)
    except BaseException as error:
        if "nsufficient memory" in str(error):  # OpenCV's own error
            return _out_of_memory(call)
        words = f"function {call.name} failed: {type(error).__name__}: {error}"
        return Outcome(code="error", error=words[:TEXT])
    finally:
        reporter.reset(token)
    if len(value) > call.max_result:
        words = (
            f"the result of function {call.name} has {len(value)} bytes; at most {call.max_result} are taken"
        )
        return Outcome(code="too_large", error=words)
    return Outcome(value=value)


def _out_of_memory(call: WorkerCall) -> Outcome:
    return Outcome(
        code="memory", error=f"function {call.name} took more than {call.memory_mib} MiB of memory"
    )


@contextmanager
def _memory_limit(mib: int) -> Iterator[None]:
    """Limit the memory that the process may take beside what it has. Mapped files don't count."""
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    try:
        resource.setrlimit(resource.RLIMIT_DATA, (_data_bytes() + mib * MIB, hard))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))


def _data_bytes() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmData:"):
            return int(line.split()[1]) * 1024
    return 0


def _throttled(report: Reporter) -> Reporter:
    latest = -REPORT_SECONDS

    def throttled(done: float, text: str) -> None:
        nonlocal latest
        now = time.monotonic()
        if now - latest >= REPORT_SECONDS or done >= 1.0:
            latest = now
            report(done, text[:TEXT])

    return throttled


def _to_socket(number: int) -> Reporter:
    def send(done: float, text: str) -> None:
        if _socket is not None:
            # The newest progress counts; one that finds the socket full is left out.
            with suppress(OSError):
                _socket.send(msgspec.msgpack.encode(ProgressReport(number, done, text)))

    return send


def decode_outcome(body: Any) -> Outcome:
    """The outcome that a worker has sent. A worker that sends something else counts as crashed."""
    try:
        return msgspec.msgpack.decode(body, type=Outcome)
    except FAULTS as error:
        return Outcome(code="crashed", error=f"the worker has sent no result: {error}"[:TEXT])


def decode_report(datagram: bytes) -> ProgressReport | None:
    """Progress as a process has sent it; ``None`` for anything else."""
    try:
        return msgspec.msgpack.decode(datagram[:REPORT_BYTES], type=ProgressReport)
    except FAULTS:
        return None
