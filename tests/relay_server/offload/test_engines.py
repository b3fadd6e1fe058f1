"""The embedded engine and Dask: the same calls and the same results."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.internet.task import deferLater

from relay_protocol.errors import Unavailable
from relay_protocol.functions import decode_value, encode_value
from relay_server.offload.dask_engine import DaskEngine
from relay_server.offload.engine import Engine, EngineCall
from relay_server.offload.pebble_engine import PebbleEngine
from relay_server.offload.runner import Outcome, WorkerCall
from tests.worlds import offload_functions
from tests.worlds.dask_processes import DaskScheduler, FunctionWorker
from tests.worlds.processes import running

MAX_RESULT = 1_000_000


class Bench:
    """An engine with the functions of the tests."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.number = 0

    def run(
        self, name: str, *, seconds: float = 20.0, memory_mib: int = 256, version: int = 1, **arguments: Any
    ) -> Any:
        """Begins a call."""
        self.number += 1
        self.progress: list[tuple[float, str]] = []
        call = WorkerCall(
            number=self.number,
            name=name,
            version=version,
            arguments=encode_value(arguments),
            memory_mib=memory_mib,
            max_result=MAX_RESULT,
        )
        return self.engine.run(
            EngineCall(call=call, seconds=seconds), lambda done, text: self.progress.append((done, text))
        )

    async def until_free(self) -> None:
        """Waits for a free worker."""
        while True:
            try:
                functions = (await self.engine.describe()).functions
                if self.engine.free(functions[0]):
                    return
            except Unavailable:
                pass
            await deferLater(reactor, 0.05)

    def outcome(self, name: str, **arguments: Any) -> Deferred[Outcome]:
        return self.run(name, **arguments).outcome


@pytest.fixture(scope="module", params=["embedded", "dask"])
def bench(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("functions")
    shutil.copy(offload_functions.__file__, folder)
    with ExitStack() as stack:
        if request.param == "embedded":
            engine: Engine = PebbleEngine(reactor, 2, folder)
        else:
            scheduler = DaskScheduler(tmp_path_factory.mktemp("dask"))
            stack.enter_context(running(scheduler))
            stack.enter_context(running(FunctionWorker(scheduler, "one", folder, "--processes", "2")))
            engine = DaskEngine(reactor, scheduler.address)
        pytest_twisted.blockon(Deferred.fromCoroutine(engine.start(lambda: None)))
        stack.callback(lambda: pytest_twisted.blockon(Deferred.fromCoroutine(engine.stop())))
        made = Bench(engine)
        pytest_twisted.blockon(Deferred.fromCoroutine(made.until_free()))
        yield made


def value(outcome: Outcome) -> Any:
    assert outcome.value is not None, outcome
    return decode_value(outcome.value)


@pytest_twisted.inlineCallbacks
def test_a_call_returns_its_result(bench: Bench) -> Any:
    assert value((yield bench.outcome("add", a=1, b=2))) == 3
    assert value((yield bench.outcome("add", version=2, a=1)))["words"] == "1 + 1"
    assert value((yield bench.outcome("size_of", data=bytes(16_000_000)))) == 16_000_000


@pytest_twisted.inlineCallbacks
@pytest.mark.parametrize(
    ("name", "options", "code", "words"),
    [
        ("loop_for_ever", {"seconds": 0.5}, "timeout", "ran longer than 0.5 s"),
        ("eat_memory", {"memory_mib": 64}, "memory", "more than 64 MiB"),
        ("crash", {}, "crashed", "process"),
        ("fail", {"words": "no light"}, "error", "RuntimeError: no light"),
        ("wrong_result", {}, "invalid_result", "Expected `int`, got `str`"),
        ("unsendable", {}, "invalid_result", "object can't be sent"),
        ("large_result", {"size": MAX_RESULT}, "too_large", "at most 1000000"),
        ("add", {"a": "one"}, "invalid", "Expected `float`, got `str`"),
    ],
)
def test_a_call_without_a_result_ends_with_a_reason_and_disturbs_no_other(
    bench: Bench, name: str, options: dict[str, Any], code: str, words: str
) -> Any:
    beside = bench.outcome("sleep", duration=0.3)
    outcome = yield bench.outcome(name, **options)
    assert (outcome.value, outcome.code) == (None, code)
    assert words in outcome.error
    assert value((yield beside)) == 0.3
    assert value((yield bench.outcome("add", a=1))) == 2


@pytest_twisted.inlineCallbacks
def test_a_process_whose_functions_keep_memory_gives_way_to_a_new_one(bench: Bench) -> Any:
    """Before its next call, which the new one carries out. So the limits of many calls do not add up."""
    kept = []
    for _ in range(12):
        kept.append(value((yield bench.outcome("keep", mib=90, memory_mib=150))))
    processes = {process for _, process in kept}
    assert len(processes) > 2
    # The first call of a process does not count; the processes share the calls.
    assert max(mib for mib, _ in kept) <= 5 * 90


@pytest_twisted.inlineCallbacks
def test_a_process_in_which_a_function_has_left_a_thread_gives_way_to_a_new_one(bench: Bench) -> Any:
    seen: Counter[int] = Counter()
    for _ in range(6):
        seen[value((yield bench.outcome("keep", mib=0, thread=True)))[1]] += 1
    assert max(seen.values()) <= 2


@pytest_twisted.inlineCallbacks
def test_what_a_function_has_started_ends_with_its_call(bench: Bench, tmp_path: Path) -> Any:
    """In the group of its process, and in a session of its own; also when the call is killed."""
    number = value((yield bench.outcome("leave_child", number=str(tmp_path / "left"))))
    assert not Path(f"/proc/{number}").exists()
    for session in (False, True):
        file = tmp_path / f"killed {session}"
        outcome = yield bench.outcome(
            "leave_child", number=str(file), session=session, forever=True, seconds=2.0
        )
        assert outcome.code == "timeout"
        number = int(file.read_text())
        end = time.monotonic() + 60
        while Path(f"/proc/{number}").exists():
            assert time.monotonic() < end
            yield deferLater(reactor, 0.05)
    assert value((yield bench.outcome("add", a=1))) == 2


@pytest_twisted.inlineCallbacks
def test_a_running_call_reports_progress_and_is_cancelled(bench: Bench, tmp_path: Path) -> Any:
    run = bench.run("report", steps=2, go_on=str(tmp_path / "never"))
    while not bench.progress:
        yield deferLater(reactor, 0.01)
    assert bench.progress[0] == (0.5, "half")
    run.cancel()
    assert (yield run.outcome).code == "cancelled"
    assert value((yield bench.outcome("add", a=1))) == 2
