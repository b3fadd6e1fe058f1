"""The distributed engine: calls run on Dask workers (``switchboard worker``). The relay is Dask's only client.

Dask's client runs on asyncio, so it has a thread and a loop of its own. The relay chooses the worker of each call; Dask
carries it there, and neither moves nor repeats it.
"""

from __future__ import annotations

import asyncio
import secrets
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import msgspec
from distributed import Client, Security
from twisted.internet.defer import Deferred
from twisted.internet.threads import deferToThread
from twisted.logger import Logger

from relay_protocol.errors import Unavailable
from relay_protocol.functions import FAULTS, FunctionDescription
from relay_server.common.clock import cancel
from relay_server.offload.call_processes import cancelled, functions_of, too_long
from relay_server.offload.dask_worker import (
    KEY,
    PROGRESS_TOPIC,
    RETRY_SECONDS,
    DaskCall,
    WorkerDescription,
    describe_on_worker,
    list_on_scheduler,
    run_on_worker,
)
from relay_server.offload.engine import EngineCall, OnProgress, WorkerStatus, label_words
from relay_server.offload.runner import Outcome, WorkerFunctions, decode_outcome

CONNECT_SECONDS = 5.0
LIST_SECONDS = 1.0
"""Between two lists of the workers."""

COLLECT_SECONDS = 0.001
"""Dask's client collects messages for 10 ms; the release of a result would hold up the next call."""

DESCRIBE_SECONDS = 3.0
"""Time in which a new worker must describe itself. One that stands still must not hold up the others."""

ANSWER_SECONDS = 10.0
"""A scheduler that does not answer for so long is lost."""

LATE_SECONDS = 10.0
"""A call without an end so long after its time limit is ended by the relay: its worker's host is gone."""


class DaskWorker(msgspec.Struct, frozen=True, kw_only=True):
    """A worker that is connected to the scheduler.

    :param id: new at each of its connections
    :param functions: by name and version
    """

    id: str
    address: str
    name: str
    host: str
    slots: int
    labels: dict[str, float]
    functions: dict[tuple[str, int], FunctionDescription]
    problems: list[str]

    def can_run(self, name: str, version: int, labels: Mapping[str, float]) -> bool:
        """Whether it has a function, and what this needs."""
        return (name, version) in self.functions and all(
            self.labels.get(label, 0.0) >= value for label, value in labels.items()
        )


class DaskRun:
    """See :class:`relay_server.offload.engine.EngineRun`."""

    def __init__(self, engine: DaskEngine, call: EngineCall, worker: DaskWorker | None) -> None:
        self.outcome: Deferred[Outcome] = Deferred()
        self.id = secrets.token_hex(12)
        self.call = call
        self.worker = worker
        self.task: Any = None
        self.timer: Any = None
        self._engine = engine

    def cancel(self) -> None:
        """End the call."""
        self._engine.end(self, cancelled(self.call.call.name))


class DaskEngine:
    """See :class:`relay_server.offload.engine.Engine`.

    :param reactor: Twisted's
    :param address: of the scheduler
    :param security: certificates, for ``tls://``
    """

    log = Logger()
    name = "dask"

    def __init__(self, reactor: Any, address: str, security: Security | None = None) -> None:
        self._reactor = reactor
        self._address = address
        self._security = security
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="dask", daemon=True)
        self._client: Client | None = None
        """In the thread of the loop only, like what is named after asyncio."""
        self._connected = False
        self._workers: dict[str, DaskWorker] = {}
        self._runs: dict[str, tuple[DaskRun, OnProgress]] = {}
        self._on_change: Callable[[], None] = _ignore
        self._first: Deferred[None] | None = None
        self._serving: asyncio.Task[None] | None = None

    async def start(self, on_change: Callable[[], None]) -> None:
        """Connect. Waits for the first attempt; without the scheduler it goes on and tries again."""
        self._on_change = on_change
        self._first = Deferred()
        self._thread.start()
        asyncio.run_coroutine_threadsafe(self._serve(), self._loop)
        await self._first

    async def stop(self) -> None:
        """Leave the scheduler; calls end with the connection."""
        self._on_change = _ignore
        for run, _ in list(self._runs.values()):
            self.end(run, _lost(run, "the relay is shutting down"))
        if self._serving is not None:
            await deferToThread(self._end_thread)

    def _end_thread(self) -> None:
        asyncio.run_coroutine_threadsafe(self._leave(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def describe(self) -> WorkerFunctions:
        """The functions of all workers.

        :raises Unavailable: no worker is connected
        """
        if not self._workers:
            raise Unavailable(self._no_worker())
        found = {}
        for each in self._workers.values():
            found.update(each.functions)
        problems = {f"{each.name}: {words}" for each in self._workers.values() for words in each.problems}
        return WorkerFunctions(list(found.values()), sorted(problems))

    def missing(self, function: FunctionDescription) -> str:
        """Why no worker can run a function."""
        if any(_can_run(each, function) for each in self._workers.values()):
            return ""
        if not self._workers:
            return self._no_worker()
        needs = f" with {label_words(function.labels)}" if function.labels else ""
        return (
            f"no worker{needs} that is connected has function '{function.name}', version {function.version}"
        )

    def free(self, function: FunctionDescription, *, reserved: int = 0) -> bool:
        """Whether a worker that can run a function is free, as far as the relay knows."""
        return sum(self._room(each, function) for each in self._workers.values()) > reserved

    def run(self, call: EngineCall, on_progress: OnProgress) -> DaskRun:
        """Run a call on the worker that has the most room; those with labels are spared."""
        name, version = call.call.name, call.call.version
        able = [each for each in self._workers.values() if each.can_run(name, version, call.labels)]
        worker = min(able, key=lambda each: self._load(each, call.labels), default=None)
        run = DaskRun(self, call, worker)
        if worker is None:
            words = "no worker that has it is connected any more; it did not run"
            self._reactor.callLater(0, run.outcome.callback, _lost(run, words))
            return run
        self._runs[run.id] = run, on_progress
        run.timer = self._reactor.callLater(call.seconds + LATE_SECONDS, self._late, run)
        run.task = asyncio.run_coroutine_threadsafe(self._call(run, worker), self._loop)
        run.task.add_done_callback(lambda done: self._reactor.callFromThread(self._done, run, done))
        return run

    def workers(self) -> list[WorkerStatus]:
        """The workers at the latest list."""
        return [
            WorkerStatus(
                name=each.name,
                host=each.host,
                slots=each.slots,
                running=len(self._of(each)),
                labels=each.labels,
            )
            for each in self._workers.values()
        ]

    def end(self, run: DaskRun, outcome: Outcome) -> None:
        """End a call: its worker kills its process."""
        if self._runs.pop(run.id, None) is not None:
            cancel(run.timer)
            run.task.cancel()
            run.outcome.callback(outcome)

    def _late(self, run: DaskRun) -> None:
        self.end(run, too_long(run.call.call.name, run.call.seconds))

    def _done(self, run: DaskRun, done: Any) -> None:
        if done.cancelled() or done.exception() is not None:
            outcome = _lost(run, "its worker or the scheduler is lost")
        else:
            outcome = decode_outcome(done.result())
        self.end(run, outcome)

    # --- workers ------------------------------------------------------------------------------------------

    def _no_worker(self) -> str:
        if self._connected:
            return f"no worker is connected to the Dask scheduler {self._address}"
        return f"the Dask scheduler {self._address} can't be reached"

    def _of(self, worker: DaskWorker) -> list[DaskRun]:
        return [
            run for run, _ in self._runs.values() if run.worker is not None and run.worker.id == worker.id
        ]

    def _room(self, worker: DaskWorker, function: FunctionDescription) -> int:
        """How many calls of a function it can begin now."""
        return self._free_calls(worker, function.labels) if _can_run(worker, function) else 0

    def _free_calls(self, worker: DaskWorker, labels: Mapping[str, float]) -> int:
        """How many calls it can begin now that each take so much of what it has."""
        runs = self._of(worker)
        room = worker.slots - len(runs)
        for name, value in labels.items():
            taken = sum(run.call.labels.get(name, 0.0) for run in runs)
            room = min(room, int((worker.labels[name] - taken) / value) if value > 0 else room)
        return max(0, room)

    def _load(self, worker: DaskWorker, labels: Mapping[str, float]) -> tuple[bool, int, float]:
        """Order of workers for a call that needs these labels."""
        running = len(self._of(worker))
        return self._free_calls(worker, labels) == 0, len(worker.labels), running / max(1, worker.slots)

    def _found(self, connected: bool, workers: dict[str, DaskWorker]) -> None:
        """The workers have been listed."""
        changed = (connected, workers.keys()) != (self._connected, self._workers.keys())
        self._connected, self._workers = connected, workers
        for run, _ in list(self._runs.values()):
            if run.worker is not None and run.worker.id not in workers:
                lost = f"its worker {run.worker.name} is lost" if connected else "the scheduler is lost"
                self.end(run, _lost(run, lost))
        first, self._first = self._first, None
        if first is not None:
            first.callback(None)
        if changed:
            self.log.info(
                "the Dask scheduler {address} has {count} workers with functions"
                if connected
                else "the Dask scheduler {address} can't be reached; it is tried again",
                address=self._address,
                count=len(workers),
            )
            self._on_change()

    def _unusable(self, error: Exception) -> None:
        """Log why a scheduler that answers can't be used."""
        self.log.error(
            "the scheduler at {address} can't be used: {kind}: {error}. It needs the same packages as the workers "
            "('switchboard worker')",
            address=self._address,
            kind=type(error).__name__,
            error=str(error),
            limited="the scheduler can't be used",
        )

    def _progressed(self, id: str, done: float, text: str) -> None:
        known = self._runs.get(id)
        if known is not None:
            known[1](done, text)

    # --- in the thread of the loop --------------------------------------------------------------------------

    async def _serve(self) -> None:
        """Be connected, and connect again."""
        self._serving = asyncio.current_task()
        while True:
            try:
                await self._serve_once()
            except (OSError, asyncio.TimeoutError):
                pass
            except Exception as error:
                self._reactor.callFromThread(self._unusable, error)
            self._reactor.callFromThread(self._found, False, {})
            await asyncio.sleep(RETRY_SECONDS)

    async def _leave(self) -> None:
        """End the connection, and what is left of calls."""
        if self._serving is not None:
            self._serving.cancel()
            await asyncio.wait([self._serving])
        left = asyncio.all_tasks() - {asyncio.current_task()}
        for each in left:
            each.cancel()
        if left:
            await asyncio.wait(left, timeout=CONNECT_SECONDS)

    async def _serve_once(self) -> None:
        client = Client(
            self._address,
            asynchronous=True,
            timeout=CONNECT_SECONDS,
            security=self._security,
            set_as_default=False,
            name="switchboard",
        )
        try:
            await client
            subscribed = client.subscribe_topic(PROGRESS_TOPIC, self._event)
            if subscribed is not None:
                await subscribed
            client.scheduler_comm.interval = COLLECT_SECONDS
            self._client = client
            known: dict[str, DaskWorker] = {}
            while client.status == "running":
                known = await asyncio.wait_for(_list_workers(client, known), ANSWER_SECONDS)
                usable = {each.id: each for each in known.values() if each.id}
                self._reactor.callFromThread(self._found, True, usable)
                await asyncio.sleep(LIST_SECONDS)
        finally:
            self._client = None
            with suppress(Exception):
                await asyncio.wait_for(client.close(timeout=1), CONNECT_SECONDS)

    async def _call(self, run: DaskRun, worker: DaskWorker) -> bytes:
        """Have a call run; returns its outcome as MessagePack.

        :raises Exception: its worker or the scheduler is lost
        """
        client, call = self._client, run.call
        if client is None:
            raise ConnectionError("the scheduler is lost")
        wanted = DaskCall(id=run.id, worker=worker.id, call=call.call, seconds=call.seconds)
        future = client.submit(
            run_on_worker,
            wanted,
            key=KEY + run.id,
            workers=[worker.address],
            resources=dict(call.labels) or None,
            retries=0,
            pure=False,
        )
        try:
            body: bytes = await future
        except BaseException:
            with suppress(Exception):
                await asyncio.shield(future.cancel())
            raise
        return body

    def _event(self, event: Any) -> None:
        """Progress that a worker reports: the time, and a list."""
        with suppress(*FAULTS, LookupError):
            id, done, text = msgspec.convert(event[1], tuple[str, float, str])
            self._reactor.callFromThread(self._progressed, id, done, text)


async def _list_workers(client: Client, known: Mapping[str, DaskWorker]) -> dict[str, DaskWorker]:
    """The workers by address; new ones are asked for their functions. Other workers of Dask have no id."""
    listed = {each["address"]: each for each in await client.run_on_scheduler(list_on_scheduler)}
    found = {address: worker for address, worker in known.items() if address in listed}
    new = [each for each in listed if each not in found or found[each].name != listed[each]["name"]]
    answers = await asyncio.gather(*(_described(client, each) for each in new))
    described = {address: answer for address, answer in zip(new, answers, strict=True) if answer is not None}
    found.update({address: _worker_of(listed[address], answer) for address, answer in described.items()})
    return found


async def _described(client: Client, address: str) -> Any:
    """A worker's description of itself; ``None``: it does not answer now, and is asked again."""
    asking = client.run(describe_on_worker, workers=[address], on_error="return")
    try:
        return (await asyncio.wait_for(asking, DESCRIBE_SECONDS)).get(address)
    except asyncio.TimeoutError:
        return None


def _worker_of(listed: dict[str, Any], answer: Any) -> DaskWorker:
    description, functions = WorkerDescription(id="", functions=b""), WorkerFunctions()
    if isinstance(answer, bytes):
        with suppress(*FAULTS, Unavailable):
            description = msgspec.msgpack.decode(answer, type=WorkerDescription)
            functions = functions_of(description.functions)
    return DaskWorker(
        id=description.id,
        functions={(each.name, each.version): each for each in functions.functions},
        problems=functions.problems,
        **listed,
    )


def _can_run(worker: DaskWorker, function: FunctionDescription) -> bool:
    return worker.can_run(function.name, function.version, function.labels)


def _lost(run: DaskRun, why: str) -> Outcome:
    return Outcome(code="lost", error=f"function {run.call.call.name} was lost: {why}")


def _ignore() -> None:
    """Changes that no one follows."""
