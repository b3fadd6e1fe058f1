"""Jobs of functions."""

from __future__ import annotations

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import FunctionJobRecord


def record(
    id: str, user_id: int, *, key: str | None = None, robot_id: int | None = None
) -> FunctionJobRecord:
    return FunctionJobRecord(
        id=id,
        realm="default",
        owner="ann",
        user_id=user_id,
        robot_id=None,
        payer_id=robot_id,
        payer="rover" if robot_id else "",
        key=key,
        digest="0" * 64,
        function="add",
        version=1,
        state="queued",
        created=float(len(id)),
        deadline=100.0,
        arguments=b"\x80",
    )


def test_a_job_is_stored_with_its_end(database: Database) -> None:
    with database.begin() as s:
        ann, rover = queries.add_user(s, "ann", None).id, queries.add_robot(s, "rover").id
        job = record("j1", ann, robot_id=rover)
        queries.store_job(s, job)
        assert queries.claim_unfinished_jobs(s, "", []) == [job]
        assert queries.claim_unfinished_jobs(s, "two", [""]) == []
        assert queries.claim_unfinished_jobs(s, "two", ["three"]) == [job._replace(relay="two")]
        queries.update_job(s, "j1", state="done", result=b"\x01", result_bytes=1, arguments=b"", expires=50.0)
    with database.begin() as s:
        found = queries.get_job(s, "j1")
        assert found is not None
        assert (found.state, found.result, found.arguments) == ("done", b"\x01", b"")
        assert queries.claim_unfinished_jobs(s, "", []) == []
        assert [each.result for each in queries.list_jobs(s, realm="default", user_id=ann)] == [None]
        assert queries.stored_jobs(s, ann, None) == (1, 1)
        queries.purge_jobs(s, 51.0)
        assert queries.get_job(s, "j1") is None


def test_a_key_names_one_job_of_its_owner(database: Database) -> None:
    with database.begin() as s:
        ann, bob = queries.add_user(s, "ann", None).id, queries.add_user(s, "bob", None).id
        first = record("j1", ann, key="k")
        queries.store_job(s, first)
        assert queries.job_of_key(s, record("j2", ann, key="k")) == first
        assert queries.job_of_key(s, record("j3", bob, key="k")) is None
        assert queries.job_of_key(s, record("j4", ann)) is None
        queries.store_job(s, record("j4", ann))
        assert queries.remove_job(s, "j4")
        assert not queries.remove_job(s, "j4")
        assert queries.list_jobs(s, realm="other") == []
