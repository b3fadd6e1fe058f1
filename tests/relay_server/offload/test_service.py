"""Jobs of functions while the database is slow or fails, and the quotas of parallel calls."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import msgspec
import pytest
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_db.queries import RobotKeyRecord
from relay_protocol.errors import MalformedMessage, NotFound, Refused, Unavailable
from relay_protocol.frames import FrameDecoder, SampleFrame
from relay_protocol.function_link import FUNCTION_FRAME, CallFunction, decode_reply
from relay_protocol.scopes import Scope
from relay_server.http.limits import ConnectionLimits
from relay_server.offload import job_store
from relay_server.offload import service as module
from relay_server.offload.job_store import KeyInUse, TooManyJobs
from relay_server.offload.jobs import JobOwner
from relay_server.offload.robot_link import MAX_LINKS, FunctionLinks
from relay_server.offload.runner import Outcome, WorkerFunctions
from relay_server.offload.service import DESCRIBE_SECONDS, MAX_OF_OWNER, SAVE_SECONDS
from relay_server.robots.connection import LinkTiming, RobotConnection
from tests.worlds.function_service import FunctionWorld, MemoryEngine, described, result
from tests.worlds.robot_links import Transport


@pytest.fixture
def world(tmp_path: Path) -> FunctionWorld:
    return FunctionWorld(tmp_path)


def keep(world: FunctionWorld, job: Any) -> Deferred[None]:
    return Deferred.fromCoroutine(world.service.keep(job))


def test_a_job_that_would_run_while_it_is_stored_waits_until_it_is_stored_as_running(
    world: FunctionWorld,
) -> None:
    world.engine.slots = 0
    job = result(world.submit())
    world.database.hold = True
    keeping = keep(world, job)
    world.engine.slots = 1
    other = result(world.submit())
    world.service.cancel(other)
    assert world.engine.runs == []
    world.database.release()
    result(keeping)
    assert world.state(job.id) == "running"
    assert len(world.engine.runs) == 1


def test_a_job_that_waits_for_a_worker_begins_when_one_comes(world: FunctionWorld) -> None:
    result(Deferred.fromCoroutine(world.service.start()))
    world.engine.slots = 0
    result(world.submit())
    world.engine.slots = 1
    world.engine.on_change()
    assert len(world.engine.runs) == 1


def test_a_stored_job_goes_on_once_a_worker_answers(world: FunctionWorld) -> None:
    world.engine.slots = 0
    job = result(world.submit(keep=True))
    world.restart()
    world.engine.unavailable = True
    result(Deferred.fromCoroutine(world.service.start()))
    assert world.state(job.id) == "queued"
    world.engine.unavailable = False
    world.engine.on_change()
    assert (world.state(job.id), len(world.engine.runs)) == ("running", 1)


def test_a_stored_job_fails_at_its_deadline_if_no_worker_comes(world: FunctionWorld) -> None:
    """It is looked for one all the time."""
    world.engine.slots = 0
    job = result(world.submit(keep=True, deadline=100.0))
    result(Deferred.fromCoroutine(world.service.stop()))
    world.restart()
    world.engine.unavailable = True
    result(Deferred.fromCoroutine(world.service.start()))
    world.clock.pump([10.0] * 9)
    assert world.state(job.id) == "queued"
    world.clock.pump([10.0] * 4)
    found = result(Deferred.fromCoroutine(world.service.job(world.rover, job.id)))
    assert (world.state(job.id), found.outcome.code) == ("failed", "deadline")
    assert "no worker answered" in found.outcome.error


def test_a_call_does_not_wait_until_the_workers_are_asked_again(
    world: FunctionWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They answer only when one of their processes is free."""
    result(world.submit())
    asked: list[Deferred[Any]] = []

    def describe() -> Deferred[Any]:
        asked.append(Deferred())
        return asked[-1]

    monkeypatch.setattr(world.engine, "describe", describe)
    world.clock.advance(DESCRIBE_SECONDS + 1)
    for _ in range(3):
        result(world.submit())
    assert (len(world.engine.runs), len(asked)) == (4, 1)


def test_the_arguments_of_one_caller_leave_room_for_others(
    world: FunctionWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_BYTES_OF_OWNER", 2)
    for _ in range(2):
        result(world.submit())
    with pytest.raises(
        TooManyJobs, match="calls of robot:rover that wait or run have 2 bytes, and may have 2"
    ):
        result(world.submit())
    other = JobOwner("user", world.ann.user_id, "ann", "default")
    result(world.submit(payer=other))


def test_a_job_that_could_not_be_stored_is_not_run(world: FunctionWorld) -> None:
    world.engine.slots = 0
    job = result(world.submit())
    world.database.hold = True
    keeping = keep(world, job)
    keeping.addErrback(lambda failure: None)
    world.engine.slots = 1
    result(world.submit())
    world.database.failures = 1
    world.database.release()
    assert job.state == "cancelled"
    assert len(world.engine.runs) == 1


def test_a_caller_that_leaves_while_its_job_is_stored_does_not_lose_it(world: FunctionWorld) -> None:
    world.database.hold = True
    submitting = world.submit(keep=True)
    submitting.addErrback(lambda failure: None)
    submitting.cancel()
    world.database.release()
    assert len(world.engine.runs) == 1


def test_the_start_of_a_run_does_not_overwrite_an_end(world: FunctionWorld) -> None:
    world.engine.slots = 0
    job = result(world.submit(keep=True))
    world.database.hold = True
    world.engine.slots = 1
    result(world.submit())
    assert job.state == "running"
    world.service.cancel(job)
    # The newest write is first: the end, then the start.
    world.database.release()
    assert world.state(job.id) == "cancelled"


def test_an_end_that_could_not_be_stored_is_stored_later(world: FunctionWorld) -> None:
    job = result(world.submit(keep=True))
    world.database.failures = 1
    world.engine.runs[0].outcome.callback(Outcome(value=b"\x01"))
    assert world.state(job.id) == "running"
    world.clock.advance(SAVE_SECONDS)
    assert world.state(job.id) == "done"
    assert job.state == "done"


@pytest.mark.parametrize("stored_later", [False, True])
def test_a_stored_job_shows_its_end_once_the_end_is_stored(world: FunctionWorld, stored_later: bool) -> None:
    job = result(world.submit(keep=not stored_later))
    world.database.hold = True
    if stored_later:
        keep(world, job)
    ended: list[None] = []
    job.wait().addCallback(ended.append)
    world.engine.runs[0].outcome.callback(Outcome(value=b"\x01"))
    found = result(Deferred.fromCoroutine(world.service.job(world.rover, job.id)))
    assert (found.status().state, ended) == ("running", [])
    world.database.release()
    assert (world.state(job.id), job.status().state, ended) == ("done", "done", [None])


def test_a_job_that_is_not_stored_ends_without_the_database(world: FunctionWorld) -> None:
    job = result(world.submit())
    world.database.hold = True
    world.engine.runs[0].outcome.callback(Outcome(value=b"\x01"))
    assert job.state == "done"


def test_a_job_that_ends_before_it_could_be_stored_keeps_its_result(world: FunctionWorld) -> None:
    job = result(world.submit())
    world.database.hold = True
    keep(world, job).addErrback(lambda failure: None)
    world.engine.runs[0].outcome.callback(Outcome(value=b"\x01"))
    world.database.failures = 1
    world.database.release()
    assert job.state == "done"


def test_other_relays_know_which_one_works_on_a_job(world: FunctionWorld) -> None:
    """Until it ends: then each can show it."""
    one, two = (world.new_service(MemoryEngine(), relay) for relay in ("one", "two"))

    def known() -> list[str]:
        return [result(Deferred.fromCoroutine(each.relay_of(job.id))) for each in (one, two)]

    world.service = one
    job = result(world.submit(keep=True))
    assert known() == ["one", "one"]
    result(Deferred.fromCoroutine(one.remove(job)))
    assert known()[1] == ""
    assert result(Deferred.fromCoroutine(two.relay_of("unknown"))) == ""


def test_a_cancelled_job_is_cancelled_in_the_answer(world: FunctionWorld) -> None:
    job = result(world.submit(keep=True))
    world.database.hold = True
    removing = Deferred.fromCoroutine(world.service.remove(job))
    assert not removing.called
    world.database.release()
    result(removing)
    assert job.state == world.state(job.id) == "cancelled"


def test_parallel_calls_do_not_pass_the_quota(world: FunctionWorld) -> None:
    world.database.hold = True
    begun: list[Any] = []
    for _ in range(MAX_OF_OWNER + 5):
        world.submit(keep=True).addBoth(begun.append)
    assert len(begun) == 5
    assert all(each.check(TooManyJobs) for each in begun)
    world.database.release()
    assert len(world.engine.runs) == MAX_OF_OWNER


def test_a_robot_has_at_most_4_function_links(world: FunctionWorld) -> None:
    links = FunctionLinks(world.clock, world.service, world.database, ("*",))  # type: ignore[arg-type]
    key = RobotKeyRecord(world.robot_id, "rover", "default", b"")
    connection: Any = None
    roles = [links.handler(connection, key, "key") for _ in range(MAX_LINKS)]
    assert MAX_LINKS == 4
    with pytest.raises(Unavailable, match="4 function links"):
        links.handler(connection, key, "key")
    links.lost(roles[0])
    links.handler(connection, key, "key")


def test_json_of_a_function_link_is_bounded_before_it_is_parsed(world: FunctionWorld) -> None:
    links = FunctionLinks(world.clock, world.service, world.database, ("*",))  # type: ignore[arg-type]
    connection: Any = None
    role: Any = links.handler(connection, RobotKeyRecord(world.robot_id, "rover", "default", b""), "key")
    with pytest.raises(MalformedMessage, match="JSON of more than 1048576 bytes"):
        role.message(b'{"op":"bye","x":"' + b"x" * 2**20 + b'"}')


def test_a_slow_link_loses_no_result(world: FunctionWorld) -> None:
    links = FunctionLinks(world.clock, world.service, world.database, ("*",))  # type: ignore[arg-type]
    key = RobotKeyRecord(world.robot_id, "rover", "default", b"")
    connection = RobotConnection(
        world.clock,
        lambda: 0,
        LinkTiming(1.0),
        lambda each: links.handler(each, key, "key"),
        ConnectionLimits(10),
    )
    transport: Any = Transport()
    transport.protocol = connection
    connection.makeConnection(transport)
    connection.pause()
    role: Any = connection._handler
    for number in range(50):
        role.sample(
            SampleFrame(number, 0, msgspec.msgpack.encode(CallFunction(function="move", arguments=b"\x80")))
        )
    for run in world.engine.runs:
        run.outcome.callback(Outcome(value=bytes(200_000)))
    connection.resume()
    world.clock.advance(0.1)
    frames: Any = FrameDecoder(FUNCTION_FRAME).feed(transport.value())
    assert [each.number for each in frames] == list(range(50))
    assert {decode_reply(each.body).state for each in frames} == {"done"}
    assert connection.reply_bytes == 0


def user_job(world: FunctionWorld, **more: Any) -> Any:
    owner, payer = result(
        Deferred.fromCoroutine(world.service.user(world.ann, "move", more.pop("robot", "")))
    )
    return result(
        Deferred.fromCoroutine(world.service.submit(owner, "move", b"\x80", payer=payer, keep=True, **more))
    )


@pytest.mark.parametrize("limit", ["scope", "robot"])
def test_a_token_with_limits_reaches_only_jobs_of_its_robot(world: FunctionWorld, limit: str) -> None:
    limits: dict[str, Any] = {"scope": Scope("admin")} if limit == "scope" else {"robot_id": world.robot_id}
    limited = dataclasses.replace(world.ann, **limits)

    def reach(job: Any) -> None:
        result(Deferred.fromCoroutine(world.service.require_reach(limited, job)))

    reach(user_job(world, robot="rover"))
    for job in (user_job(world), result(world.submit(keep=True))):
        with pytest.raises(Refused):
            reach(job)
    with pytest.raises(Refused):
        result(Deferred.fromCoroutine(world.service.jobs(limited)))


def test_a_token_for_another_robot_reaches_no_job(world: FunctionWorld) -> None:
    job = user_job(world, robot="rover")
    limited = dataclasses.replace(world.ann, robot_id=world.robot_id + 1)
    with pytest.raises(NotFound):
        result(Deferred.fromCoroutine(world.service.require_reach(limited, job)))


@pytest.mark.parametrize("limit", [(module, "MAX_OF_OWNER"), (job_store, "MAX_STORED")])
def test_a_call_is_repeated_though_a_quota_is_used_up(
    world: FunctionWorld, monkeypatch: pytest.MonkeyPatch, limit: tuple[Any, str]
) -> None:
    """Else the caller would learn that it may not begin what it has begun."""
    job = user_job(world, key="k")
    monkeypatch.setattr(*limit, 1)
    assert user_job(world, key="k").id == job.id
    with pytest.raises(TooManyJobs):
        user_job(world, key="other")


@pytest.mark.parametrize("other", [{"version": 1}, {"robot": "rover"}])
def test_a_key_of_a_call_is_for_one_version_and_robot(world: FunctionWorld, other: dict[str, Any]) -> None:
    job = user_job(world, key="k")
    assert user_job(world, key="k").id == job.id
    with pytest.raises(KeyInUse):
        user_job(world, key="k", **other)


class TwoWorkers(MemoryEngine):
    """One has ``move``, the other ``look``; each runs one call at a time."""

    async def describe(self) -> WorkerFunctions:
        return WorkerFunctions([described(1), msgspec.structs.replace(described(1), name="look")])

    def free(self, function: Any, *, reserved: int = 0) -> bool:
        mine = [each for each in self.runs if each.call.call.name == function.name]
        return sum(not each.outcome.called for each in mine) + reserved < 1


def test_a_job_for_one_worker_does_not_wait_for_what_begins_on_another(
    world: FunctionWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While that is marked as running in the database, it counts against all workers."""
    world.service = world.new_service(TwoWorkers())
    engine: Any = world.service.engine
    marking: list[Deferred[None]] = []
    write = world.database.write

    async def held(query: Any, *args: Any, **more: Any) -> Any:
        if query is queries.update_unfinished_job:
            marking.append(Deferred())
            await marking[-1]
        return await write(query, *args, **more)

    monkeypatch.setattr(world.database, "write", held)
    world.submit(keep=True)
    (begun,) = marking
    other = result(Deferred.fromCoroutine(world.service.submit(world.rover, "look", b"\x80")))
    assert (other.state, engine.runs) == ("queued", [])
    begun.callback(None)
    assert [each.call.call.name for each in engine.runs] == ["move", "look"]
    assert other.state == "running"


def test_a_job_that_another_relay_has_taken_over_is_not_begun(world: FunctionWorld) -> None:
    """This one was cut off from the others, but not from the database."""
    engine = MemoryEngine()
    engine.slots = 0
    one, two = world.new_service(engine, "one"), world.new_service(MemoryEngine(), "two")
    world.service = one
    job = result(world.submit(keep=True))
    result(Deferred.fromCoroutine(two.take_over(["two"])))
    begun: Any = two.engine
    assert len(begun.runs) == 1
    engine.slots = 1
    one._dispatch()
    assert engine.runs == []
    assert job.over
    assert world.state(job.id) == "running"
    shown = result(Deferred.fromCoroutine(one.job(world.rover, job.id)))
    assert shown.state == "running"
    waiting = Deferred.fromCoroutine(one.wait(shown, 30.0))
    begun.runs[0].outcome.callback(Outcome(value=b"\x01"))
    assert world.state(job.id) == "done"
    assert not waiting.called
    world.clock.advance(1.0)
    result(waiting)
    assert (shown.state, shown.outcome.value) == ("done", b"\x01")
