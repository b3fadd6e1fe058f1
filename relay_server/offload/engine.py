"""The interface of engines, which run calls on workers. Engines may forget: the relay's database owns the jobs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import msgspec
from twisted.internet.defer import Deferred

from relay_protocol.functions import FunctionDescription
from relay_server.offload.runner import Outcome, WorkerCall, WorkerFunctions

OnProgress = Callable[[float, str], None]


@dataclass(frozen=True, kw_only=True)
class EngineCall:
    """A call to run.

    :param seconds: longest run
    :param labels: what its worker must have
    """

    call: WorkerCall
    seconds: float
    labels: Mapping[str, float] = field(default_factory=dict)


def label_words(labels: Mapping[str, float]) -> str:
    """Labels for users."""
    return ", ".join(f"{name}={value:g}" for name, value in labels.items())


class WorkerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A worker.

    :param name: of the worker, or the process
    :param host: on which it runs
    :param slots: calls that it runs at a time
    :param running: calls that run now
    :param labels: what it has, as `{"GPU": 1}`
    """

    name: str
    host: str
    slots: int
    running: int
    labels: dict[str, float]


class EngineRun(Protocol):
    """One call that an engine has taken.

    :ivar outcome: fires once, with every end; never with a failure
    """

    outcome: Deferred[Outcome]

    def cancel(self) -> None:
        """End the call: its worker process is killed if it runs."""


class Engine(Protocol):
    """Runs calls.

    :ivar name: for users
    """

    name: str

    async def start(self, on_change: Callable[[], None]) -> None:
        """Connect. Without its workers it starts too, and tries again.

        :param on_change: called when workers have come or gone
        """

    async def stop(self) -> None:
        """End all calls and processes."""

    async def describe(self) -> WorkerFunctions:
        """The functions of the workers.

        :raises Unavailable: no worker answers
        """

    def missing(self, function: FunctionDescription) -> str:
        """Why no worker, free or not, can run a function; empty if one can."""

    def free(self, function: FunctionDescription, *, reserved: int = 0) -> bool:
        """Whether a worker that can run a function is free now.

        :param reserved: calls that will run in a moment
        """

    def run(self, call: EngineCall, on_progress: OnProgress) -> EngineRun:
        """Run a call now."""

    def workers(self) -> list[WorkerStatus]:
        """The workers, as far as they are known."""
