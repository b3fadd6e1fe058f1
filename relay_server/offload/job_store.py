"""Jobs in the database: those whose caller does not wait outlast the relay."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from typing import Any

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import FunctionJobRecord
from relay_protocol.errors import Refused
from relay_protocol.functions import FunctionDescription
from relay_protocol.limits import MIB
from relay_server.access import Principal
from relay_server.common.database import AsyncDatabase
from relay_server.offload.jobs import Job, JobEnd, JobOwner
from relay_server.offload.schemas import JobStatus

MAX_STORED = 1000
MAX_STORED_BYTES = 256 * MIB
"""Most stored jobs of one owner, and bytes of their results."""


class TooManyJobs(Refused):
    """A quota is used up."""

    code = "too_many_jobs"
    http_status = 429


class KeyInUse(Refused):
    """An idempotency key was used for another call."""

    code = "key_reused"
    http_status = 422


class JobStore:
    """The jobs of the database.

    :param relay: id of this relay in its cluster; empty if it is the only one
    """

    def __init__(self, database: AsyncDatabase, relay: str) -> None:
        self._database = database
        self._relay = relay

    async def add(self, job: Job, key: str | None) -> FunctionJobRecord | None:
        """Store a job; returns the job that the owner has begun with this key before.

        :param key: idempotency key
        :raises TooManyJobs: too many of the owner are stored
        :raises KeyInUse: the key was used for another call
        """
        record = record_of_job(job, key)._replace(relay=self._relay)
        earlier = await self._database.write(_add, record)
        job.stored = earlier is None
        return _same_call(earlier, record)

    async def earlier(self, job: Job, key: str) -> FunctionJobRecord | None:
        """The job that the owner has begun with this key before.

        :raises KeyInUse: the key was used for another call
        """
        record = record_of_job(job, key)
        return _same_call(await self._database.read(queries.job_of_key, record), record)

    async def update(self, job_id: str, **values: Any) -> None:
        """Set columns of a job."""
        await self._database.write(queries.update_job, job_id, **values)

    async def begin_run(self, job: Job) -> bool:
        """A job is about to run; false if it has ended or is gone, or another relay has taken it over."""
        return await self._database.write(
            queries.update_unfinished_job,
            job.id,
            self._relay,
            state="running",
            started=job.started,
            attempts=job.attempts,
        )

    async def end(self, job_id: str, end: JobEnd) -> None:
        """Store the end of a job, once. Its arguments are not needed any more."""
        await self._database.write(
            queries.update_unfinished_job,
            job_id,
            self._relay,
            state=end.state,
            code=end.outcome.code,
            error=end.outcome.error,
            result=end.outcome.value,
            result_bytes=len(end.outcome.value or b""),
            run_seconds=end.outcome.seconds,
            ended=end.ended,
            expires=end.expires,
            arguments=b"",
        )

    async def get(self, job_id: str) -> FunctionJobRecord | None:
        """A job with its result."""
        return await self._database.read(queries.get_job, job_id)

    async def jobs(self, principal: Principal) -> list[JobStatus]:
        """The newest jobs of a user; for an administrator, of the realm."""
        user = None if principal.admin else principal.user_id
        records = await self._database.read(queries.list_jobs, realm=principal.realm, user_id=user)
        return [restored_job(each).status() for each in records]

    async def claim_unfinished(self, live: Collection[str]) -> list[FunctionJobRecord]:
        """Take over jobs that wait or run at no live relay.

        :param live: ids of the relays that work on their jobs
        """
        return await self._database.write(queries.claim_unfinished_jobs, self._relay, list(live))

    async def remove(self, job_id: str) -> None:
        """Remove a job."""
        await self._database.write(queries.remove_job, job_id)

    async def purge(self, now: float) -> None:
        """Remove jobs whose time is over."""
        await self._database.write(queries.purge_jobs, now)


def _same_call(earlier: FunctionJobRecord | None, record: FunctionJobRecord) -> FunctionJobRecord | None:
    if earlier is not None and earlier.digest != record.digest:
        raise KeyInUse(
            "this key was sent with another function, version, robot or other arguments; use a new key"
        )
    return earlier


def _add(s: Session, record: FunctionJobRecord) -> FunctionJobRecord | None:
    earlier = queries.job_of_key(s, record)
    if earlier is not None:
        return earlier
    count, size = queries.stored_jobs(s, record.user_id, record.robot_id)
    if count >= MAX_STORED or size >= MAX_STORED_BYTES:
        raise TooManyJobs(
            f"{count} jobs of {record.owner} with {size} bytes of results are stored, the most there may be; fetch or "
            "remove some"
        )
    queries.store_job(s, record)
    return None


def record_of_job(job: Job, key: str | None) -> FunctionJobRecord:
    """A job as it is stored."""
    head = f"{job.function.name}\0{job.function.version}\0{job.payer}\0"
    digest = hashlib.sha256(head.encode() + job.arguments).hexdigest()
    return FunctionJobRecord(
        id=job.id,
        realm=job.owner.realm,
        owner=job.owner.name,
        user_id=job.owner.id if job.owner.kind == "user" else None,
        robot_id=job.owner.id if job.owner.kind == "robot" else None,
        payer_id=job.payer.id if job.payer != job.owner else None,
        payer=job.payer.name if job.payer != job.owner else "",
        key=key,
        digest=digest,
        function=job.function.name,
        version=job.function.version,
        state=job.state,
        created=job.created,
        deadline=job.deadline,
        arguments=job.arguments,
        started=job.started,
        attempts=job.attempts,
    )


def restored_job(record: FunctionJobRecord, function: FunctionDescription | None = None) -> Job:
    """A job as it was stored. Without its function it can't be run."""
    kind, number = ("robot", record.robot_id) if record.user_id is None else ("user", record.user_id)
    owner = JobOwner(kind, number or 0, record.owner, record.realm)
    payer = (
        owner if record.payer_id is None else JobOwner("robot", record.payer_id, record.payer, record.realm)
    )
    job = Job(
        record.id,
        owner,
        function or _unknown(record),
        record.arguments,
        created=record.created,
        deadline=record.deadline,
        payer=payer,
    )
    job.stored = True
    job.restore(record)
    return job


def _unknown(record: FunctionJobRecord) -> FunctionDescription:
    return FunctionDescription(
        name=record.function,
        version=record.version,
        text="",
        arguments={},
        result={},
        repeatable=False,
        seconds=0.0,
        memory_mib=0,
        labels={},
    )
