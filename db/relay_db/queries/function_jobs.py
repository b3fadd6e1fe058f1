"""Stored jobs of functions."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from sqlalchemy import ColumnElement, delete, func, insert, select, update
from sqlalchemy.orm import Session

from relay_db.models import FunctionJob, Realm, Robot, User
from relay_db.queries.records import FunctionJobRecord
from relay_protocol.errors import NotFound
from relay_protocol.realms import full_name

MAX_LISTED = 200
"""Most jobs of one list."""

_UNFINISHED = ("queued", "running")


def job_of_key(s: Session, job: FunctionJobRecord) -> FunctionJobRecord | None:
    """The job that the owner of a job has stored with the same key before."""
    if job.key is None:
        return None
    return _job_where(s, _owner_is(job.user_id, job.robot_id), FunctionJob.key == job.key)


def store_job(s: Session, job: FunctionJobRecord) -> None:
    """Store a new job.

    :raises NotFound: its realm was removed
    """
    realm_id = s.scalar(select(Realm.id).where(Realm.name == job.realm))
    if realm_id is None:
        raise NotFound("there is no such realm")
    values = {**job._asdict(), "realm_id": realm_id}
    del values["realm"], values["owner"], values["payer"]
    s.execute(insert(FunctionJob).values(**values))


def update_job(s: Session, /, job_id: str, **values: Any) -> None:
    """Set columns of a job, if it is still there."""
    s.execute(update(FunctionJob).where(FunctionJob.id == job_id).values(**values))


def update_unfinished_job(s: Session, /, job_id: str, relay: str, **values: Any) -> bool:
    """Set columns of a job that waits or runs; false if it has ended, was removed, or is another relay's by now."""
    unfinished = FunctionJob.id == job_id, FunctionJob.relay == relay, FunctionJob.state.in_(_UNFINISHED)
    changed = update(FunctionJob).where(*unfinished).values(**values).returning(FunctionJob.id)
    return s.scalar(changed) is not None


def get_job(s: Session, job_id: str) -> FunctionJobRecord | None:
    """A job with its result."""
    return _job_where(s, FunctionJob.id == job_id)


def list_jobs(
    s: Session, *, realm: str, user_id: int | None = None, robot_id: int | None = None
) -> list[FunctionJobRecord]:
    """The newest jobs of a user or robot, or of a realm, without arguments and results."""
    where = [Realm.name == realm]
    if user_id is not None or robot_id is not None:
        where.append(_owner_is(user_id, robot_id))
    query = _query(without_data=True).where(*where).order_by(FunctionJob.created.desc()).limit(MAX_LISTED)
    return [_record(row) for row in s.execute(query)]


def claim_unfinished_jobs(s: Session, relay: str, live: Collection[str]) -> list[FunctionJobRecord]:
    """Take over the jobs that wait or run at no live relay; returns them, the oldest first.

    :param relay: id of this relay
    :param live: ids of the relays that work on their jobs, this one included once it has begun
    """
    free = FunctionJob.relay.not_in(live)
    claimed = update(FunctionJob).where(FunctionJob.state.in_(_UNFINISHED), free).values(relay=relay)
    ids = list(s.scalars(claimed.returning(FunctionJob.id)))
    query = _query().where(FunctionJob.id.in_(ids)).order_by(FunctionJob.created)
    return [_record(row) for row in s.execute(query)]


def remove_job(s: Session, job_id: str) -> bool:
    """Remove a job; false if there is none of this id."""
    return s.scalar(delete(FunctionJob).where(FunctionJob.id == job_id).returning(FunctionJob.id)) is not None


def purge_jobs(s: Session, now: float) -> None:
    """Remove expired jobs."""
    s.execute(delete(FunctionJob).where(FunctionJob.expires < now))


def stored_jobs(s: Session, user_id: int | None, robot_id: int | None) -> tuple[int, int]:
    """Number of the jobs of a user or robot, and bytes of their results."""
    columns = func.count(), func.coalesce(func.sum(FunctionJob.result_bytes), 0)
    count, size = s.execute(select(*columns).where(_owner_is(user_id, robot_id))).one()
    return int(count), int(size)


def _owner_is(user_id: int | None, robot_id: int | None) -> ColumnElement[bool]:
    return FunctionJob.user_id == user_id if user_id is not None else FunctionJob.robot_id == robot_id


def _job_where(s: Session, *where: ColumnElement[bool]) -> FunctionJobRecord | None:
    row = s.execute(_query().where(*where)).one_or_none()
    return None if row is None else _record(row)


_COLUMNS = [
    name
    for name in FunctionJobRecord._fields
    if name not in {"realm", "owner", "payer", "arguments", "result"}
]


def _query(*, without_data: bool = False) -> Any:
    bulk = [] if without_data else [FunctionJob.arguments, FunctionJob.result]
    payer = Robot.__table__.alias("payer")
    return (
        select(
            *(getattr(FunctionJob, name) for name in _COLUMNS),
            *bulk,
            Realm.name.label("realm"),
            User.name.label("user_name"),
            Robot.name.label("robot_name"),
            payer.c.name.label("payer_name"),
        )
        .join(Realm, Realm.id == FunctionJob.realm_id)
        .outerjoin(User, User.id == FunctionJob.user_id)
        .outerjoin(Robot, Robot.id == FunctionJob.robot_id)
        .outerjoin(payer, payer.c.id == FunctionJob.payer_id)
    )


def _record(row: Any) -> FunctionJobRecord:
    fields = dict(row._mapping)
    names = {name: fields.pop(f"{name}_name") for name in ("user", "robot", "payer")}
    fields = {"arguments": b"", "result": None, **fields}
    owner = full_name(names["user"] or names["robot"], fields["realm"])
    payer = full_name(names["payer"], fields["realm"]) if names["payer"] else ""
    return FunctionJobRecord(**fields, owner=owner, payer=payer)
