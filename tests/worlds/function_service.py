"""The function service with a real database and an engine in memory, without threads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import Unavailable
from relay_protocol.functions import FunctionDescription
from relay_server.access import Principal
from relay_server.offload.engine import EngineCall, OnProgress, WorkerStatus
from relay_server.offload.jobs import Job, JobOwner
from relay_server.offload.runner import Outcome, WorkerFunctions
from relay_server.offload.service import FunctionService
from tests.worlds.empty_database import write_empty_database

WALL = 1_000_000_000.0
"""Unix time when a world begins."""


class HeldDatabase:
    """Runs queries at once, or when they are released.

    :ivar hold: writes wait for :meth:`release`
    :ivar failures: this many writes fail
    """

    def __init__(self, database: Database) -> None:
        self.database = database
        self.hold = False
        self.failures = 0
        self._held: list[Deferred[None]] = []

    async def read(self, query: Callable[..., Any], *args: Any, **more: Any) -> Any:
        with self.database.reading() as session:
            return query(session, *args, **more)

    async def write(self, query: Callable[..., Any], *args: Any, **more: Any) -> Any:
        if self.hold:
            waiting: Deferred[None] = Deferred()
            self._held.append(waiting)
            await waiting
        if self.failures:
            self.failures -= 1
            raise Unavailable("the database does not answer")
        with self.database.begin() as session:
            return query(session, *args, **more)

    def release(self) -> None:
        """Releases the writes, newest first."""
        self.hold = False
        held, self._held = self._held, []
        for each in reversed(held):
            each.callback(None)


class MemoryRun:
    """A running call."""

    def __init__(self, call: EngineCall) -> None:
        self.call = call
        self.outcome: Deferred[Outcome] = Deferred()

    def cancel(self) -> None:
        if not self.outcome.called:
            self.outcome.callback(Outcome(code="cancelled"))


class MemoryEngine:
    """Records calls.

    :ivar slots: calls that may run at a time
    :ivar unavailable: no worker answers
    """

    name = "memory"
    on_change: Callable[[], None]

    def __init__(self) -> None:
        self.runs: list[MemoryRun] = []
        self.slots = 1000
        self.unavailable = False

    async def start(self, on_change: Callable[[], None]) -> None:
        self.on_change = on_change

    async def stop(self) -> None:
        """Ignores it."""

    async def describe(self) -> WorkerFunctions:
        """One function in two versions."""
        if self.unavailable:
            raise Unavailable("no worker answers")
        return WorkerFunctions([described(1), described(2)])

    def missing(self, function: FunctionDescription) -> str:
        """Any worker fits."""
        return ""

    def free(self, function: FunctionDescription, *, reserved: int = 0) -> bool:
        """Whether a slot is free."""
        return sum(not each.outcome.called for each in self.runs) + reserved < self.slots

    def run(self, call: EngineCall, on_progress: OnProgress) -> MemoryRun:
        """Begins a call."""
        self.runs.append(MemoryRun(call))
        return self.runs[-1]

    def workers(self) -> list[WorkerStatus]:
        """No workers."""
        return []


def described(version: int) -> FunctionDescription:
    return FunctionDescription(
        name="move",
        version=version,
        text="",
        arguments={},
        result={},
        repeatable=False,
        seconds=10.0,
        memory_mib=1,
        labels={},
    )


class RunRight:
    """Every user may run all functions on the robot, or none.

    :ivar allowed: whether they may
    :ivar robot: set by the world
    """

    reason = "you have no right run on it"
    robot: Any

    def __init__(self) -> None:
        self.allowed = True

    async def robots(self, principal: Principal) -> list[tuple[Any, RunRight]]:
        """The robot, if the token is for it."""
        return [(self.robot, self)] if principal.robot_id in (None, self.robot.id) else []

    def decide(self, operation: Any, resource: str) -> RunRight:
        """Whether an operation is allowed."""
        return self


class FunctionWorld:
    """The service on a clock.

    :ivar ann: a user
    """

    def __init__(self, folder: Path) -> None:
        self.clock = Clock()
        write_empty_database(folder / "relay.db")
        database = Database(f"sqlite:///{folder / 'relay.db'}")
        self.database = HeldDatabase(database)
        with database.begin() as session:
            self.robot_id = queries.add_robot(session, "rover", "", "default").id
            user_id = queries.add_user(session, "ann", None).id
        self.ann = Principal(user_id, "ann", "default", False, 1, None)
        self.rover = JobOwner("robot", self.robot_id, "rover", "default")
        self.rights = RunRight()
        self.rights.robot = SimpleNamespace(id=self.robot_id, name="rover", full="rover")
        self.restart()

    def restart(self) -> None:
        """Starts a relay on the same database."""
        self.engine = MemoryEngine()
        self.service = self.new_service(self.engine)

    def new_service(self, engine: MemoryEngine, relay: str = "") -> FunctionService:
        return FunctionService(
            self.clock,
            engine,
            self.rights,  # type: ignore[arg-type]
            self.database,  # type: ignore[arg-type]
            lambda: WALL + self.clock.seconds(),
            relay=relay,
        )

    def submit(self, **more: Any) -> Deferred[Job]:
        """Begins a call of the robot."""
        return Deferred.fromCoroutine(self.service.submit(self.rover, "move", b"\x80", **more))

    def state(self, job: str) -> str:
        """State of a job in the database."""
        with self.database.database.reading() as session:
            record = queries.get_job(session, job)
        return record.state if record else ""


def result(done: Deferred[Any]) -> Any:
    """The result of finished work.

    :raises Exception: its failure
    """
    found: list[Any] = []
    failed: list[Any] = []
    done.addCallbacks(found.append, failed.append)
    if failed:
        raise failed[0].value
    assert found, "it is not done"
    return found[0]
