"""Workers of a Dask scheduler: the choice of workers, and results when workers or the scheduler die."""

from __future__ import annotations

import shutil
import signal
import socket
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.internet.task import deferLater

from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.functions import FunctionDescription, decode_value, encode_value
from relay_server.offload.dask_engine import DaskEngine, DaskRun, DaskWorker
from relay_server.offload.dask_worker import security_of
from relay_server.offload.engine import EngineCall
from relay_server.offload.runner import Outcome, WorkerCall
from tests.worlds import offload_functions
from tests.worlds.dask_processes import DaskScheduler, FunctionWorker
from tests.worlds.processes import running
from tests.worlds.waiting import eventually


class Cluster:
    """A scheduler, workers that tests start, and the engine."""

    def __init__(self, folder: Path) -> None:
        self.functions = folder / "functions"
        self.functions.mkdir()
        shutil.copy(offload_functions.__file__, self.functions)
        self.scheduler = DaskScheduler(folder, tls=True)
        self.workers: dict[str, FunctionWorker] = {}
        address, tls = self.scheduler.address, self.scheduler.tls
        self.engine = DaskEngine(reactor, address, security_of(address, tls))
        self.changes = 0
        pytest_twisted.blockon(Deferred.fromCoroutine(self.engine.start(self._changed)))
        self._number = 0

    def _changed(self) -> None:
        self.changes += 1

    async def worker(self, name: str, *options: str) -> FunctionWorker:
        """Starts a worker if it does not run; waits until the engine has it."""
        if name not in self.workers:
            self.workers[name] = FunctionWorker(self.scheduler, name, self.functions, *options)
        await eventually(f"the worker {name}", lambda: self.names().get(name))
        return self.workers[name]

    async def kill(self, name: str) -> None:
        self.workers.pop(name).kill()

    def names(self) -> dict[str, bool]:
        """Names of the workers, without their suffixes."""
        return {each.name.rpartition("-")[0]: True for each in self.engine.workers()}

    async def function(self, name: str) -> FunctionDescription:
        return next(each for each in (await self.engine.describe()).functions if each.name == name)

    def run(self, name: str, *, seconds: float = 60.0, **arguments: Any) -> Deferred[Outcome]:
        self._number += 1
        call = WorkerCall(
            number=self._number,
            name=name,
            version=1,
            arguments=encode_value(arguments),
            memory_mib=256,
            max_result=1000,
        )
        labels = {"GPU": 1.0} if name == "on_gpu" else {}
        run = self.engine.run(EngineCall(call=call, seconds=seconds, labels=labels), lambda done, text: None)
        return run.outcome

    def stop(self) -> None:
        pytest_twisted.blockon(Deferred.fromCoroutine(self.engine.stop()))
        for each in self.workers.values():
            each.stop()
        self.scheduler.stop()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    with running(made):
        yield made


def value(outcome: Outcome) -> Any:
    assert outcome.value is not None, outcome
    return decode_value(outcome.value)


def parent(pid: int) -> int:
    """The parent of a process."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


@pytest_twisted.ensureDeferred
async def test_a_call_goes_to_a_worker_with_its_labels_and_spares_such_workers_otherwise(
    cluster: Cluster,
) -> None:
    plain = await cluster.worker("plain")
    on_gpu, process_id = await cluster.function("on_gpu"), await cluster.function("process_id")
    assert cluster.engine.missing(on_gpu) == (
        "no worker with GPU=1 that is connected has function 'on_gpu', version 1"
    )
    assert not cluster.engine.free(on_gpu)
    changes = cluster.changes
    gpu = await cluster.worker("gpu", "--label", "GPU=1")
    assert cluster.changes > changes
    assert (cluster.engine.missing(on_gpu), cluster.engine.free(on_gpu)) == ("", True)
    labelled, other = cluster.run("on_gpu"), cluster.run("process_id")
    assert not cluster.engine.free(on_gpu)
    assert not cluster.engine.free(process_id)
    assert parent(value(await labelled)) == gpu.process.popen.pid
    assert parent(value(await other)) == plain.process.popen.pid


@pytest_twisted.ensureDeferred
async def test_two_workers_run_two_calls_at_the_same_time(cluster: Cluster, tmp_path: Path) -> None:
    await cluster.worker("plain")
    await cluster.worker("gpu", "--label", "GPU=1")
    files = [tmp_path / "a", tmp_path / "b"]
    runs = [cluster.run("sleep", duration=30, began=str(each)) for each in files]
    await eventually("both run", lambda: all(each.exists() for each in files))
    assert [(each.slots, each.running) for each in cluster.engine.workers()] == [(1, 1), (1, 1)]
    for run, _ in list(cluster.engine._runs.values()):
        run.cancel()
    assert [(await each).code for each in runs] == ["cancelled", "cancelled"]
    assert value(await cluster.run("add", a=1)) == 2


@pytest_twisted.ensureDeferred
async def test_the_call_of_a_worker_that_is_killed_is_lost_and_is_not_repeated(
    cluster: Cluster, tmp_path: Path
) -> None:
    began = tmp_path / "began"
    await cluster.worker("gpu", "--label", "GPU=1")
    await cluster.worker("plain")
    lost = cluster.run("sleep", duration=60, began=str(began))
    await eventually("it runs", began.exists)
    await cluster.kill("plain")
    outcome = await lost
    assert (outcome.code, "its worker" in outcome.error) == ("lost", True)
    assert value(await cluster.run("add", a=1)) == 2
    assert began.read_bytes() == b"x"


@pytest_twisted.ensureDeferred
async def test_a_worker_that_stands_still_does_not_hold_its_call(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("relay_server.offload.dask_engine.LATE_SECONDS", 0.1)
    gpu = await cluster.worker("gpu", "--label", "GPU=1")
    gpu.process.freeze()
    outcome = await cluster.run("on_gpu", seconds=0.1)
    assert (outcome.code, "longer than 0.1 s" in outcome.error) == ("timeout", True)
    gpu.process.signal(signal.SIGCONT)
    assert value(await cluster.run("on_gpu"))


@pytest_twisted.ensureDeferred
async def test_calls_are_lost_with_the_scheduler_and_workers_come_back(
    cluster: Cluster, tmp_path: Path
) -> None:
    began = tmp_path / "began"
    gpu = await cluster.worker("gpu", "--label", "GPU=1")
    connections = gpu.connections()
    lost = cluster.run("sleep", duration=60, began=str(began))
    await eventually("it runs", began.exists)
    cluster.scheduler.kill()
    assert (await lost).code == "lost"
    await eventually("the loss", lambda: not cluster.engine.workers())
    with pytest.raises(Unavailable, match="can't be reached"):
        await cluster.engine.describe()
    cluster.scheduler.start()
    await eventually("the worker comes back", lambda: gpu.connections() > connections)
    await cluster.worker("gpu")
    assert value(await cluster.run("add", a=1)) == 2
    assert began.read_bytes() == b"x"


def test_a_client_without_a_certificate_is_refused(cluster: Cluster) -> None:
    host, port = cluster.scheduler.address.removeprefix("tls://").split(":")
    context = ssl.create_default_context(cafile=cluster.scheduler.tls[0])
    with socket.create_connection((host, int(port))) as plain, pytest.raises(ssl.SSLError, match="required"):
        context.wrap_socket(plain, server_hostname=host).recv(1)


@pytest.mark.parametrize(
    ("address", "tls", "words"),
    [
        ("10.0.0.5:8786", ("", "", ""), "no address of a scheduler"),
        ("tcp://10.0.0.5:8786", ("", "", ""), "use tls://"),
        ("tcp://localhost.example.org:8786", ("", "", ""), "use tls://"),
        ("tls://10.0.0.5:8786", ("", "", ""), "three PEM files"),
        ("tls://10.0.0.5:8786", ("/nowhere", "/nowhere", "/nowhere"), "no file '/nowhere'"),
    ],
)
def test_a_scheduler_over_a_network_needs_certificates(
    address: str, tls: tuple[str, str, str], words: str
) -> None:
    with pytest.raises(Invalid, match=words):
        security_of(address, tls)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:8786", "tcp://localhost:8786", "tcp://[::1]:8786"])
def test_a_scheduler_on_this_machine_needs_none(address: str) -> None:
    assert security_of(address, ("", "", "")) is None


@pytest_twisted.ensureDeferred
async def test_a_new_worker_that_stands_still_does_not_hold_up_the_others(cluster: Cluster) -> None:
    """It does not say which functions it has. To an engine that connects all workers are new."""
    await cluster.worker("plain")
    still = await cluster.worker("gpu", "--label", "GPU=1")
    still.process.freeze()
    address, tls = cluster.scheduler.address, cluster.scheduler.tls
    engine = DaskEngine(reactor, address, security_of(address, tls))
    try:
        await Deferred.fromCoroutine(engine.start(lambda: None))
        await eventually("the other worker", engine.workers)
        for _ in range(3):
            assert [each.name.rpartition("-")[0] for each in engine.workers()] == ["plain"]
            assert (await Deferred.fromCoroutine(engine.describe())).functions
            await deferLater(reactor, 1.5)
        still.process.signal(signal.SIGCONT)
        await eventually("it answers", lambda: len(engine.workers()) == 2)
    finally:
        still.process.signal(signal.SIGCONT)
        await Deferred.fromCoroutine(engine.stop())


def test_a_call_goes_to_a_worker_whose_labels_are_free() -> None:
    """Not to one that has more free processes, and whose only GPU is taken."""
    gpu, plain = (
        FunctionDescription(
            name=name, version=1, text="", arguments={}, result={}, repeatable=False, seconds=10.0, memory_mib=1,
            labels=labels,
        )
        for name, labels in (("gpu", {"GPU": 1.0}), ("plain", {}))
    )  # fmt: skip
    engine = DaskEngine(reactor, "tcp://127.0.0.1:1")
    known = {("gpu", 1): gpu, ("plain", 1): plain}
    for name in ("a", "b"):
        engine._workers[name] = DaskWorker(
            id=name,
            address=name,
            name=name,
            host="here",
            slots=4,
            labels={"GPU": 1.0},
            functions=known,
            problems=[],
        )
    for function, worker in ((gpu, "a"), (plain, "b"), (plain, "b")):
        call = EngineCall(
            call=WorkerCall(
                number=1, name=function.name, version=1, arguments=b"", memory_mib=1, max_result=1
            ),
            seconds=10.0,
            labels=function.labels,
        )
        run = DaskRun(engine, call, engine._workers[worker])
        engine._runs[run.id] = run, lambda done, text: None
    assert engine.free(gpu)
    assert min(engine._workers.values(), key=lambda each: engine._load(each, gpu.labels)).name == "b"
    assert min(engine._workers.values(), key=lambda each: engine._load(each, {})).name == "a"
