"""Jobs, and the queue that gives each owner its turn."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from typing import NamedTuple, cast

from twisted.internet.defer import Deferred

from relay_db.queries import FunctionJobRecord
from relay_protocol.functions import FunctionDescription
from relay_server.common.clock import Timer
from relay_server.offload.engine import EngineRun
from relay_server.offload.runner import Outcome
from relay_server.offload.schemas import JobState, JobStatus


class JobOwner(NamedTuple):
    """A user or a robot that has functions run.

    :param kind: ``user`` or ``robot``
    :param id: in the database
    :param name: full
    """

    kind: str
    id: int
    name: str
    realm: str

    def __str__(self) -> str:
        return f"{self.kind}:{self.name}"


class JobEnd(NamedTuple):
    """How and when a job has ended (Unix seconds)."""

    state: JobState
    outcome: Outcome
    ended: float
    expires: float | None


class Job:
    """One call of a function.

    :ivar payer: for whom it counts: its owner, or the robot that a user calls it for
    :ivar stored: whether it is in the database
    :ivar storing: fires when it was written there; ``None``: nothing is written
    :ivar end: how it ends; a stored job shows it in its state only once the database has it
    :ivar state: see :class:`relay_server.offload.schemas.JobStatus`, like all further attributes
    """

    def __init__(
        self,
        id: str,
        owner: JobOwner,
        function: FunctionDescription,
        arguments: bytes,
        *,
        created: float,
        deadline: float,
        payer: JobOwner | None = None,
    ) -> None:
        self.id = id
        self.owner = owner
        self.payer = payer or owner
        self.function = function
        self.arguments = arguments
        self.created = created
        self.deadline = deadline
        self.stored = False
        self.storing: Deferred[None] | None = None
        self.end: JobEnd | None = None
        self.state: JobState = "queued"
        self.progress = 0.0
        self.text = ""
        self.outcome: Outcome | None = None
        self.started: float | None = None
        self.ended: float | None = None
        self.expires: float | None = None
        self.attempts = 0
        self.result_bytes = 0
        self.run: EngineRun | None = None
        self.timer: Timer | None = None
        self.on_progress: Callable[[], None] = _ignore
        self._waiting: list[Deferred[None]] = []

    @property
    def over(self) -> bool:
        """Whether it shows its end."""
        return self.outcome is not None

    def restore(self, record: FunctionJobRecord) -> None:
        """Take over the state that was stored."""
        self.attempts, self.started, self.state = (
            record.attempts,
            record.started,
            cast(JobState, record.state),
        )
        if record.ended is not None:
            outcome = Outcome(record.result, record.code, record.error, record.run_seconds or 0.0)
            self.end = JobEnd(cast(JobState, record.state), outcome, record.ended, record.expires)
            self.result_bytes = record.result_bytes
            self.show_end()

    def show_end(self) -> None:
        """Take its end as its state."""
        assert self.end is not None
        self.state, self.outcome, self.ended, self.expires = self.end
        if self.state == "done":
            self.progress = 1.0

    def wait(self) -> Deferred[None]:
        """Fires at its end. Cancelling it does not end the job."""
        waiting: Deferred[None] = Deferred(self._waiting.remove)
        self._waiting.append(waiting)
        if self.over:
            self.notify()
        return waiting

    def notify(self) -> None:
        """Resume all that wait for its end."""
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.callback(None)

    def status(self) -> JobStatus:
        """Its state."""
        outcome = self.outcome or Outcome()
        return JobStatus(
            id=self.id,
            owner=str(self.owner),
            function=self.function.name,
            version=self.function.version,
            state=self.state,
            progress=self.progress,
            text=self.text,
            code=outcome.code,
            error=outcome.error,
            created=self.created,
            started=self.started,
            ended=self.ended,
            deadline=self.deadline,
            expires=self.expires,
            attempts=self.attempts,
            run_seconds=outcome.seconds if self.over else None,
            result_bytes=self.result_bytes or len(outcome.value or b""),
        )


def _ignore() -> None:
    """Progress that no one follows."""


class JobQueue:
    """Jobs that wait for a worker. Owners take turns; the jobs of one owner are begun in their order."""

    def __init__(self) -> None:
        self._of: OrderedDict[JobOwner, deque[Job]] = OrderedDict()

    def __len__(self) -> int:
        return sum(map(len, self._of.values()))

    def add(self, job: Job, *, first: bool = False) -> None:
        """Add a job.

        :param first: before the others of its owner
        """
        jobs = self._of.setdefault(job.payer, deque())
        (jobs.appendleft if first else jobs.append)(job)

    def remove(self, job: Job) -> None:
        """Remove a job, if it waits."""
        jobs = self._of.get(job.payer, deque())
        if job in jobs:
            jobs.remove(job)
        if not jobs:
            self._of.pop(job.payer, None)

    def take(self, may_start: Callable[[Job], bool]) -> Job | None:
        """The next job that may start: the first such of the owner whose latest turn is longest ago."""
        for owner, jobs in self._of.items():
            job = next((each for each in jobs if may_start(each)), None)
            if job is not None:
                self.remove(job)
                if owner in self._of:
                    self._of.move_to_end(owner)
                return job
        return None
