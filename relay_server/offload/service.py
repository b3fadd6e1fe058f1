"""The rules of functions: who may run them, which limits calls have, how they end and how long results are kept."""

from __future__ import annotations

import secrets
from collections import Counter, deque
from collections.abc import Callable, Collection, Coroutine
from contextlib import suppress
from functools import partial
from statistics import median
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import deferLater
from twisted.logger import Logger

from relay_db.queries import FunctionJobRecord
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.functions import ATTEMPTS, FunctionDescription, no_function
from relay_protocol.limits import FUNCTION_BYTES, MIB
from relay_protocol.rights import Operation
from relay_server.access import Access, Principal
from relay_server.common.clock import Clock, PeriodicTimer, PeriodicTimers, Timer, as_twisted, cancel
from relay_server.common.concurrency import SingleFlight, detached, shield
from relay_server.common.database import AsyncDatabase
from relay_server.offload.engine import Engine, EngineCall
from relay_server.offload.job_store import JobStore, TooManyJobs, restored_job
from relay_server.offload.jobs import Job, JobEnd, JobOwner, JobQueue
from relay_server.offload.runner import Outcome, WorkerCall
from relay_server.offload.schemas import (
    FunctionList,
    FunctionStatistics,
    FunctionStatus,
    JobList,
    JobState,
    JobStatus,
)

MAX_OF_OWNER = 64
MAX_JOBS = 1024
MAX_WAITING_BYTES = 256 * MIB
MAX_BYTES_OF_OWNER = 64 * MIB
"""Most jobs of one owner, and of all, that wait or run; and most bytes of all arguments."""

DEADLINE_SECONDS = 60.0
"""Default time for a call, with waiting for a worker."""

DESCRIBE_SECONDS = 30.0
"""Age at which the functions of the workers are asked for again."""

KEPT_SECONDS = 86_400.0
"""Time for which a result is kept."""

FETCHED_SECONDS = 600.0
"""Time for which it is kept after it was fetched."""

KEPT_DEADLINE = 3600.0
"""Default time for a call whose caller does not wait."""

PURGE_SECONDS = 60.0

SAVE_SECONDS = 5.0
"""Time after which an end that could not be stored is stored again."""

LOOK_SECONDS = 1.0
"""Time after which the database is asked again about a job that another relay works on."""

RECENT = 200
"""Ended calls without a stored result that are still listed."""

DURATIONS = 100
"""Recent runs of which the median is shown."""

RUN_AGAIN = ("crashed", "lost")

MAX_LISTED = 200
"""Most jobs of an answer."""


class CallTooLarge(Invalid):
    """The arguments have too many bytes."""

    code = "too_large"
    http_status = 413


class FunctionService:
    """
    :param clock: Twisted's
    :param wall: Unix time in seconds
    :param relay: id of this relay in its cluster; empty if it is the only one
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        engine: Engine,
        access: Access,
        database: AsyncDatabase,
        wall: Callable[[], float],
        *,
        relay: str = "",
    ) -> None:
        self.engine = engine
        self._relay = relay
        self._store = JobStore(database, relay)
        self._clock = clock
        self._access = access
        self._wall = wall
        self._jobs: dict[str, Job] = {}
        self._admitting: dict[str, Job] = {}
        """Jobs that are being stored before they are queued."""
        self._recent: deque[tuple[JobOwner, JobStatus]] = deque(maxlen=RECENT)
        self._queue = JobQueue()
        self._postponed: dict[str, tuple[FunctionJobRecord, Timer]] = {}
        """Jobs of the database that go on once a worker answers."""
        self._starting = 0
        """Jobs that are being marked as running in the database."""
        self._timers = PeriodicTimers(clock)
        self._purging = PeriodicTimer(self._purge, PURGE_SECONDS)
        self._number = 0
        self._functions: dict[str, dict[int, FunctionDescription]] = {}
        self._problems: list[str] = []
        self._described_at: float | None = None
        self._describing = SingleFlight(self._describe)
        self._figures: dict[str, _Figures] = {}
        self._closed = False

    # --- the relay ----------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Connect the engine, and go on with the jobs of the database if this is the only relay."""
        await self.engine.start(self._workers_changed)
        self._timers.start(self._purging)
        if not self._relay:
            await self.take_over(())

    async def take_over(self, live: Collection[str]) -> None:
        """Go on with the jobs that no live relay works on.

        :param live: ids of the relays that work on their jobs, this one included
        :raises Unavailable: the database does not answer
        """
        for record in await self._store.claim_unfinished(live):
            self._background(self._go_on(record))

    async def _go_on(self, record: FunctionJobRecord) -> None:
        """Queue a job that was not finished when the relay stopped."""
        words = ""
        try:
            function = await self.function(record.function, record.version)
        except Unavailable:
            self._postpone(record)
            return
        except SwitchboardError as error:
            words = str(error)
        else:
            job = restored_job(record, function)
            job.attempts = record.attempts
            ran = record.state == "running"
            if not ran or (function.repeatable and record.attempts < ATTEMPTS):
                job.state = "queued"
                self._admit(job)
                return
            words = (
                f"the relay was restarted while function '{record.function}' ran, which must not be repeated"
            )
        await self._store.end(record.id, self._end_now(Outcome(code="lost", error=words)))

    def _postpone(self, record: FunctionJobRecord) -> None:
        """Go on with a job when workers come, or look again after a time. At its deadline it fails."""
        left = record.deadline - self._wall()
        if left > 0:
            timer = self._clock.callLater(min(left, DESCRIBE_SECONDS), self._go_on_postponed, record.id)
            self._postponed[record.id] = (record, timer)
            return
        words = f"function {record.function} has no result at the deadline of the call: no worker answered"
        self._background(self._store.end(record.id, self._end_now(Outcome(code="deadline", error=words))))

    def _go_on_postponed(self, job_id: str) -> None:
        record, timer = self._postponed.pop(job_id)
        cancel(timer)
        self._background(self._go_on(record))

    def _workers_changed(self) -> None:
        """Workers have come or gone: their functions are asked for again, and calls that waited for them begin."""
        self._described_at = None
        for job_id in list(self._postponed):
            self._go_on_postponed(job_id)
        self._dispatch()

    async def stop(self) -> None:
        """End all calls. Those without a stored result fail."""
        self._closed = True
        self._purging.stop()
        for _, timer in self._postponed.values():
            cancel(timer)
        for job in list(self._jobs.values()):
            cancel(job.timer)
            if job.stored:
                # It goes on, or is lost, when the relay is back.
                job.notify()
            else:
                self._finish(job, Outcome(code="lost", error="the relay is shutting down"))
        await self.engine.stop()

    # --- functions ----------------------------------------------------------------------------------------

    async def function(self, name: str, version: int | None = None) -> FunctionDescription:
        """A function; without a version its newest.

        :raises NotFound: there is none
        :raises Unavailable: no worker answers
        """
        await self._refresh()
        versions = self._functions.get(name, {})
        found = versions.get(max(versions) if version is None else version) if versions else None
        if found is None:
            raise NotFound(no_function(name, version, versions))
        return found

    async def functions(self, principal: Principal) -> FunctionList:
        """The functions that a user may run.

        :raises Unavailable: no worker answers
        """
        await self._refresh()
        shown = [
            FunctionStatus(**_fields(each), statistics=self._statistics(name))
            for name, versions in sorted(self._functions.items())
            if principal.admin or await self._may_run(principal, name)
            for each in versions.values()
        ]
        return FunctionList(
            engine=self.engine.name,
            functions=shown,
            workers=self.engine.workers(),
            problems=self._problems if principal.admin else [],
        )

    async def _refresh(self) -> None:
        known = self._described_at
        if known is None:
            await self._describing.run()
        elif self._clock.seconds() - known > DESCRIBE_SECONDS:
            # Not awaited: the workers answer when a process is free, which may take as long as the longest call.
            self._described_at = self._clock.seconds()
            self._background(self._describe_again())

    async def _describe_again(self) -> None:
        with suppress(Unavailable):
            await self._describing.run()

    async def _describe(self) -> None:
        found = await self.engine.describe()
        self._functions = {}
        for each in found.functions:
            self._functions.setdefault(each.name, {})[each.version] = each
        if found.problems and found.problems != self._problems:
            self.log.error("functions can't be loaded: {problems}", problems="; ".join(found.problems))
        self._problems = found.problems
        self._described_at = self._clock.seconds()

    def _statistics(self, name: str) -> FunctionStatistics:
        figures = self._figures.get(name, _Figures())
        states = Counter(each.state for each in self._jobs.values() if each.function.name == name)
        return FunctionStatistics(
            calls=figures.calls,
            failures=figures.failures,
            running=states["running"],
            queued=states["queued"],
            median_ms=round(median(figures.durations) * 1000, 2) if figures.durations else None,
        )

    # --- rights -------------------------------------------------------------------------------------------

    async def user(self, principal: Principal, function: str, robot: str = "") -> tuple[JobOwner, JobOwner]:
        """A user who calls a function, and for whom the call counts.

        :param robot: for which it is called, or empty
        :raises NotFound: no such robot, or no right on it
        :raises Refused: the right ``run`` is missing
        """
        owner = job_owner(principal)
        if not robot:
            if not await self._may_run(principal, function):
                raise Refused(f"you have the right run on /{function} on no robot")
            return owner, owner
        for record, rules in await self._access.robots(principal):
            if robot in (record.name, record.full):
                decision = rules.decide(Operation.RUN, f"/{function}")
                if not decision.allowed:
                    raise Refused(decision.reason)
                return owner, JobOwner("robot", record.id, record.full, principal.realm)
        raise NotFound("there is no such robot, or you have no right on it")

    async def require_reach(self, principal: Principal, job: Job) -> None:
        """A token with limits reaches the jobs that it may begin: of its user, for a robot on which it may run them.

        :raises NotFound: it does not reach the robot of the job
        :raises Refused: it may not begin this job
        """
        if principal.scope is None and principal.robot_id is None:
            return
        if job.owner != job_owner(principal) or job.payer.kind != "robot":
            raise Refused(
                "a token with a scope or for one robot reaches only its user's jobs that were begun for a robot"
            )
        await self.user(principal, job.function.name, job.payer.name)

    async def _may_run(self, principal: Principal, function: str) -> bool:
        robots = await self._access.robots(principal)
        return any(rules.decide(Operation.RUN, f"/{function}").allowed for _, rules in robots)

    # --- jobs ---------------------------------------------------------------------------------------------

    async def submit(
        self,
        owner: JobOwner,
        name: str,
        arguments: bytes,
        *,
        version: int | None = None,
        deadline: float | None = None,
        payer: JobOwner | None = None,
        keep: bool = False,
        key: str | None = None,
    ) -> Job:
        """Begin a call, now or when a worker is free.

        :param arguments: MessagePack of a map
        :param deadline: seconds from now
        :param payer: for whom it counts, if not for its owner
        :param keep: whether to store it at once, since its caller does not wait
        :param key: idempotency key; with one that the owner has used, the job of that time is returned
        :raises KeyInUse: the key was used with another function or other arguments
        :raises NotFound: there is no such function
        :raises CallTooLarge: the arguments have too many bytes
        :raises TooManyJobs: a quota is used up
        :raises Unavailable: no worker has what the function needs
        """
        if len(arguments) > FUNCTION_BYTES:
            raise CallTooLarge(
                f"the arguments have {len(arguments)} bytes; at most {FUNCTION_BYTES} are taken"
            )
        function = await self.function(name, version)
        if missing := self.engine.missing(function):
            raise Unavailable(missing)
        now = self._wall()
        job = Job(
            secrets.token_hex(12),
            owner,
            function,
            arguments,
            created=now,
            deadline=now + (deadline or max(KEPT_DEADLINE if keep else DEADLINE_SECONDS, function.seconds)),
            payer=payer,
        )
        # A repeated call begins nothing, so it needs no room.
        earlier = None if key is None else await self._store.earlier(job, key)
        if earlier is not None:
            return self._begun_before(earlier, function)
        self._require_room(job)
        if not keep and key is None:
            self._admit(job)
            return job
        # Once it is stored it must be run, also if its caller leaves.
        self._admitting[job.id] = job
        return await detached(self._admit_stored(job, key))

    async def _admit_stored(self, job: Job, key: str | None) -> Job:
        try:
            earlier = await self._store.add(job, key)
        finally:
            del self._admitting[job.id]
        if earlier is not None:
            return self._begun_before(earlier, job.function)
        if not self._closed:
            self._admit(job)
        return job

    def _begun_before(self, record: FunctionJobRecord, function: FunctionDescription) -> Job:
        known = self._jobs.get(record.id) or self._admitting.get(record.id)
        return known or restored_job(record, function)

    async def keep(self, job: Job) -> None:
        """Store a job, since its caller waits no longer.

        :raises TooManyJobs: too many of its owner are stored; it is cancelled
        """
        if not job.stored:
            await detached(self._keep(job))

    async def _keep(self, job: Job) -> None:
        storing = job.storing = Deferred()
        try:
            await self._store.add(job, None)
        except SwitchboardError:
            self.cancel(job)
            raise
        finally:
            job.storing = None
            storing.callback(None)
            if job.end is not None:
                await self._complete(job)

    def _require_room(self, job: Job) -> None:
        if self._closed:
            raise Unavailable("the relay is shutting down; try again later")
        jobs = [*self._jobs.values(), *self._admitting.values()]
        mine = sum(each.payer == job.payer for each in jobs)
        if mine >= MAX_OF_OWNER:
            raise TooManyJobs(
                f"{mine} calls of {job.payer} wait or run, the most there may be; wait until one has ended"
            )
        mine = sum(len(each.arguments) for each in jobs if each.payer == job.payer)
        if mine + len(job.arguments) > MAX_BYTES_OF_OWNER:
            raise TooManyJobs(
                f"the arguments of the calls of {job.payer} that wait or run have {mine} bytes, and may have "
                f"{MAX_BYTES_OF_OWNER}; wait until one has ended"
            )
        waiting = sum(len(each.arguments) for each in jobs)
        if len(jobs) >= MAX_JOBS or waiting + len(job.arguments) > MAX_WAITING_BYTES:
            raise TooManyJobs("too many calls of all users wait or run; try again in a moment")

    def _admit(self, job: Job) -> None:
        self._jobs[job.id] = job
        left = max(0.0, job.deadline - self._wall())
        job.timer = self._clock.callLater(left, self._late, job)
        self._queue.add(job)
        self._dispatch()

    async def jobs(self, principal: Principal) -> JobList:
        """The jobs of a user; for an administrator, all of the realm.

        :raises Refused: the token has a scope, or is for one robot
        """
        principal.require_full_scope()
        if principal.robot_id is not None:
            raise Refused("this needs an access token that is not for one robot only")
        found = {each.id: each for each in await self._store.jobs(principal)}
        live = {each.id: each.status() for each in self._jobs.values() if _may_see(principal, each.owner)}
        recent = {each.id: each for owner, each in self._recent if _may_see(principal, owner)}
        jobs = {**recent, **found, **live}.values()
        return JobList(sorted(jobs, key=lambda each: -each.created)[:MAX_LISTED])

    async def job(self, owner: JobOwner, job_id: str, *, admin: bool = False) -> Job:
        """A job of a user or robot, or for an administrator of its realm.

        :raises NotFound: there is none of this id
        """
        job = self._jobs.get(job_id)
        if job is None:
            record = await self._store.get(job_id)
            job = None if record is None else restored_job(record)
        if job is None or not (job.owner == owner or (admin and job.owner.realm == owner.realm)):
            raise NotFound("there is no such job, or its time is over")
        return job

    async def relay_of(self, job_id: str) -> str:
        """The id of the relay of the cluster that works on a job, as the database has it; empty if there is none."""
        if job_id in self._jobs:
            return self._relay
        record = await self._store.get(job_id)
        return "" if record is None or restored_job(record).over else record.relay

    async def remove(self, job: Job) -> None:
        """End a job; remove it with its result if it has ended."""
        if job.over:
            await self._store.remove(job.id)
        else:
            self.cancel(job)
            await self.wait(job, SAVE_SECONDS)

    def fetched(self, job: Job) -> None:
        """The result of a stored job was sent: it is kept a little longer, in case the answer was lost."""
        expires = self._wall() + FETCHED_SECONDS
        if job.stored and job.outcome is not None and (job.expires is None or expires < job.expires):
            self._background(self._store.update(job.id, expires=expires))

    async def wait(self, job: Job, seconds: float) -> None:
        """Wait for the end of a job, or for a time."""
        if job.over or seconds <= 0:
            return
        if job.id in self._jobs or job.id in self._admitting:
            await job.wait().addTimeout(seconds, as_twisted(self._clock), _ignore_timeout)
            return
        # Another relay works on it.
        until = self._clock.seconds() + seconds
        while not job.over and (left := until - self._clock.seconds()) > 0:
            await deferLater(as_twisted(self._clock), min(left, LOOK_SECONDS))
            record = await self._store.get(job.id)
            if record is None:
                return
            job.restore(record)

    def cancel(self, job: Job) -> None:
        """End a job that waits or runs."""
        if job.end is None:
            if job.run is not None:
                job.run.cancel()
            words = f"the call of function {job.function.name} was cancelled"
            self._finish(job, Outcome(code="cancelled", error=words))

    # --- running ------------------------------------------------------------------------------------------

    def _dispatch(self) -> None:
        """Begin what can begin."""
        while not self._closed:
            job = self._queue.take(lambda each: self.engine.free(each.function, reserved=self._starting))
            if job is None:
                return
            job.state, job.started, job.attempts = "running", self._wall(), job.attempts + 1
            if job.stored or job.storing is not None:
                self._starting += 1
                self._background(self._run_stored(job))
            else:
                self._run(job)

    async def _run_stored(self, job: Job) -> None:
        """Run a job that the database knows as running: after a crash of the relay it must not begin again."""
        try:
            if job.storing is not None:
                await shield(job.storing)
            if job.end is None and not await self._store.begin_run(job):
                self._finish(job, Outcome(code="lost", error="the job was removed or has ended elsewhere"))
        except SwitchboardError as error:
            self._finish(job, Outcome(code="lost", error=str(error)))
        finally:
            self._starting -= 1
        if job.end is None and not self._closed:
            self._run(job)
        # While it was being marked, it counted against all workers.
        self._dispatch()

    def _run(self, job: Job) -> None:
        function = job.function
        self._number += 1
        call = EngineCall(
            call=WorkerCall(
                number=self._number,
                name=function.name,
                version=function.version,
                arguments=job.arguments,
                memory_mib=function.memory_mib,
                max_result=FUNCTION_BYTES,
            ),
            seconds=function.seconds,
            labels=function.labels,
        )
        job.run = self.engine.run(call, partial(self._progressed, job))
        job.run.outcome.addCallback(self._ended, job)
        job.run.outcome.addErrback(self._failed, job)

    def _progressed(self, job: Job, done: float, text: str) -> None:
        if job.end is None:
            job.progress, job.text = done, text
            job.on_progress()

    def _ended(self, outcome: Outcome, job: Job) -> None:
        job.run = None
        again = outcome.code in RUN_AGAIN and job.function.repeatable and job.attempts < ATTEMPTS
        if job.end is None and not (self._closed and job.stored):
            if again:
                job.state = "queued"
                self._queue.add(job, first=True)
            else:
                self._finish(job, outcome)
        self._dispatch()

    def _failed(self, failure: Any, job: Job) -> None:
        self.log.failure("a call of function {name} failed", failure, name=job.function.name)
        self._finish(job, Outcome(code="lost", error="the relay failed on this call; see its log"))

    def _late(self, job: Job) -> None:
        """The deadline has passed."""
        job.timer = None
        run, waited = job.run, job.state == "queued"
        why = "no worker was free in time" if waited else "it still ran"
        words = f"function {job.function.name} has no result at the deadline of the call: {why}"
        self._finish(job, Outcome(code="deadline", error=words))
        if run is not None:
            run.cancel()

    def _finish(self, job: Job, outcome: Outcome) -> None:
        """Decide the end of a job, once."""
        if job.end is not None:
            return
        cancel(job.timer)
        job.timer = None
        self._queue.remove(job)
        job.end = self._end_now(outcome)
        job.arguments = b""
        if job.stored:
            self._background(self._complete(job))
        elif job.storing is None:
            self._show_end(job)

    def _end_now(self, outcome: Outcome) -> JobEnd:
        now = self._wall()
        state: JobState = "cancelled" if outcome.code == "cancelled" else "failed"
        return JobEnd("done" if outcome.value is not None else state, outcome, now, now + KEPT_SECONDS)

    async def _complete(self, job: Job) -> None:
        """Store the end of a job, then show it: after a crash the database must not contradict what was shown."""
        assert job.end is not None
        try:
            if job.stored:
                await self._store.end(job.id, job.end)
        except Unavailable as error:
            self.log.error("the end of job {id} is stored later: {why}", id=job.id, why=str(error))
            if not self._closed:
                job.timer = self._clock.callLater(SAVE_SECONDS, self._complete_again, job)
        except BaseException:
            self._show_end(job)
            raise
        else:
            self._show_end(job)

    def _show_end(self, job: Job) -> None:
        job.show_end()
        self._figures.setdefault(job.function.name, _Figures()).count(job)
        self._jobs.pop(job.id, None)
        if not job.stored:
            self._recent.append((job.owner, job.status()))
        job.notify()

    def _complete_again(self, job: Job) -> None:
        job.timer = None
        self._background(self._complete(job))

    def _purge(self) -> None:
        self._background(self._store.purge(self._wall()))

    def _background(self, work: Coroutine[Deferred[Any], Any, None]) -> None:
        Deferred.fromCoroutine(work).addErrback(
            lambda failure: self.log.failure("the database could not be asked about jobs", failure)
        )


class _Figures:
    """Figures of a function."""

    def __init__(self) -> None:
        self.calls = 0
        self.failures = 0
        self.durations: deque[float] = deque(maxlen=DURATIONS)

    def count(self, job: Job) -> None:
        self.calls += 1
        if job.state == "done" and job.outcome is not None:
            self.durations.append(job.outcome.seconds)
        elif job.state == "failed":
            self.failures += 1


def job_owner(principal: Principal) -> JobOwner:
    """A user as owner of jobs."""
    return JobOwner("user", principal.user_id, principal.full, principal.realm)


def _ignore_timeout(result: Any, seconds: float) -> None:
    """The job goes on."""


def _may_see(principal: Principal, owner: JobOwner) -> bool:
    return owner == job_owner(principal) or (principal.admin and owner.realm == principal.realm)


def _fields(description: FunctionDescription) -> dict[str, Any]:
    return {name: getattr(description, name) for name in description.__struct_fields__}
