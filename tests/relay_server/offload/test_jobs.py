"""The queue of jobs."""

from __future__ import annotations

from relay_protocol.functions import FunctionDescription
from relay_server.offload.jobs import Job, JobOwner, JobQueue

ANN = JobOwner("user", 1, "ann", "lab")
BOB = JobOwner("user", 2, "bob", "lab")
ROVER = JobOwner("robot", 1, "rover", "lab")


def job(
    owner: JobOwner, id: str, *, labels: dict[str, float] | None = None, payer: JobOwner | None = None
) -> Job:
    function = FunctionDescription(
        name="add",
        version=1,
        text="",
        arguments={},
        result={},
        repeatable=False,
        seconds=1.0,
        memory_mib=1,
        labels=labels or {},
    )
    return Job(id, owner, function, b"", created=0.0, deadline=1.0, payer=payer)


def order(queue: JobQueue) -> list[str]:
    taken = []
    while (found := queue.take(lambda each: True)) is not None:
        taken.append(found.id)
    return taken


def test_owners_take_turns_and_each_keeps_its_order() -> None:
    queue = JobQueue()
    for each in (
        job(ANN, "a1"),
        job(ANN, "a2"),
        job(ANN, "a3"),
        job(BOB, "b1"),
        job(ROVER, "r1"),
        job(BOB, "b2"),
    ):
        queue.add(each)
    assert order(queue) == ["a1", "b1", "r1", "a2", "b2", "a3"]
    assert len(queue) == 0


def test_calls_for_one_robot_share_its_turn() -> None:
    queue = JobQueue()
    for each in (job(ANN, "a1", payer=ROVER), job(ROVER, "r1"), job(BOB, "b1")):
        queue.add(each)
    assert order(queue) == ["a1", "b1", "r1"]


def test_a_job_whose_workers_are_busy_holds_up_no_other() -> None:
    queue = JobQueue()
    waits, runs = job(ANN, "gpu", labels={"GPU": 1.0}), job(ANN, "cpu")
    queue.add(waits)
    queue.add(runs)
    assert queue.take(lambda each: not each.function.labels) is runs
    queue.remove(waits)
    assert queue.take(lambda each: True) is None


def test_a_job_that_is_run_again_goes_first() -> None:
    queue = JobQueue()
    queue.add(job(ANN, "a1"))
    queue.add(job(ANN, "a0"), first=True)
    assert order(queue) == ["a0", "a1"]
