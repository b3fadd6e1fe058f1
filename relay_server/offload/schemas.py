"""Functions and their jobs, as the HTTP API takes them and answers with them."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from relay_protocol.functions import FunctionDescription
from relay_server.offload.engine import WorkerStatus

JobState = Literal["queued", "running", "done", "failed", "cancelled"]


class FunctionStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of a function since the relay was started.

    :param calls: that have ended
    :param failures: of these
    :param running: now
    :param queued: now
    :param median_ms: of the durations of recent runs; null before the first
    """

    calls: int
    failures: int
    running: int
    queued: int
    median_ms: float | None


class FunctionStatus(FunctionDescription, frozen=True, kw_only=True):
    """A function and its figures.

    :param statistics: of all versions
    """

    statistics: FunctionStatistics


class FunctionList(msgspec.Struct, frozen=True, kw_only=True):
    """The functions that the caller may run, and the workers.

    :param engine: `embedded` or `dask`
    :param problems: modules of functions that the workers can't load; for administrators
    """

    engine: str
    functions: list[FunctionStatus]
    workers: list[WorkerStatus]
    problems: list[str]


class JobStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A call of a function.

    :param owner: `user:ann@lab` or `robot:rover@lab`
    :param progress: 0 to 1, as the function reports it
    :param text: of the progress
    :param code: why there is no result: `error`, `timeout`, `memory`, `crashed`, `invalid`, `invalid_result`,
        `too_large`, `deadline`, `cancelled`, `lost`
    :param error: the same in words
    :param created: Unix seconds
    :param started: of the latest attempt
    :param deadline: Unix seconds at which it fails
    :param expires: Unix seconds at which it is forgotten
    :param attempts: runs that were begun
    :param run_seconds: of the run that gave the result
    :param result_bytes: size of the result as MessagePack
    """

    id: str
    owner: str
    function: str
    version: int
    state: JobState
    progress: float
    text: str
    code: str
    error: str
    created: float
    started: float | None
    ended: float | None
    deadline: float
    expires: float | None
    attempts: int
    run_seconds: float | None
    result_bytes: int


class JobList(msgspec.Struct, frozen=True):
    """The caller's jobs, the newest first; for an administrator, all of the realm."""

    jobs: list[JobStatus]


class FunctionResult(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a call.

    :param job: its id
    :param seconds: for which it ran
    """

    job: str
    seconds: float
    result: Any
