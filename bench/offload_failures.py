"""``python -m bench.offload_failures``: what becomes of calls of functions when something dies at each moment of them.

Two calls begin together, one that must not be repeated and one that may be and that may run on the robot. The moments
are spread evenly from their beginning until after their end. Each must end soon by an answer, a clear error or the
local fallback; the first must never begin twice. It is a trial, not a measurement: nothing is kept.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import psutil

from bench.relay import Relay
from relay_protocol.errors import Unavailable
from relay_protocol.functions import CallFailed, function
from robot_client.offload import Cloud, Device, DeviceState, decisions, offload
from robot_client.offload.device import publish
from tests.worlds import offload_functions
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.dask_processes import DaskScheduler, FunctionWorker
from tests.worlds.processes import BIN, running
from tests.worlds.waiting import wait_for

DURATION = 0.4
MOMENTS = 0.7
"""Length of a call, and of the time in which something dies, seconds."""

GOLDEN = 0.618034

TIMEOUT = 60.0
HANG = TIMEOUT + 20.0

FAULTS = {"embedded": ("link", "relay", "worker"), "dask": ("link", "relay", "worker", "scheduler")}


class Scene:
    """A relay with one of the engines, and a program on a robot, which is this process."""

    def __init__(self, folder: Path, engine: str, stack: contextlib.ExitStack) -> None:
        self.folder = folder
        self.functions = folder / "functions"
        self.functions.mkdir()
        shutil.copy(offload_functions.__file__, self.functions)
        self.engine = engine
        options = ["--offload-folder", str(self.functions), "--offload-processes", "2"]
        if engine == "dask":
            self.scheduler = DaskScheduler(folder)
            stack.enter_context(running(self.scheduler))
            self.start_worker()
            stack.callback(lambda: self.worker.stop())
            options = ["--offload-scheduler", self.scheduler.address]
        self.relay = Relay(folder, *options)
        stack.enter_context(running(self.relay))
        self.proxy = ChaosProxy(self.relay.robots_port)
        stack.callback(self.proxy.close)
        self.state = folder / "device"
        code = self.relay.cli("robot", "add", "rover")["enrolment_code"]
        enroll = [str(BIN / "switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{self.proxy.port}"]
        enroll += ["--robot", "rover", "--code", "-", "--state", str(self.state)]
        subprocess.run(enroll, input=code, text=True, capture_output=True, timeout=60, check=True)
        self.cloud = Cloud(self.state)
        self.device = Device(self.state)

    def start_worker(self) -> None:
        """A worker of Dask."""
        self.worker = FunctionWorker(self.scheduler, "one", self.functions, "--processes", "2")

    def break_it(self, fault: str) -> None:
        """Something dies, and comes back."""
        if fault == "link":
            self.proxy.reset()
        elif fault == "relay":
            self.relay.kill()
            self.relay.start()
        elif fault == "scheduler":
            self.scheduler.kill()
            self.scheduler.start()
        elif self.engine == "dask":
            self.worker.kill()
            self.start_worker()
        else:
            for each in psutil.Process(self.relay.pid).children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    if any("spawn_main" in word for word in each.cmdline()):
                        each.kill()

    def answers(self) -> bool:
        """Whether calls are answered again."""
        try:
            return bool(self.cloud.call("add", timeout=10, version=1, a=1) == 2)
        except (Unavailable, CallFailed):
            return False


@contextlib.contextmanager
def scene(engine: str) -> Iterator[Scene]:
    """All of it, in a folder that goes with it."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, contextlib.ExitStack() as stack:
        yield Scene(Path(folder), engine, stack)


def outcome(call: Callable[[], object]) -> str:
    """How a call ends, in a word."""
    try:
        call()
    except CallFailed as error:
        return f"error: {error.code}"
    except Unavailable:
        return "error: not reached"
    return "answer"


def trial(at: Scene, fault: str, moment: float, number: int) -> tuple[str, str, int, float]:
    """How the two calls ended, how often the first began, and how long they took."""
    files = [str(at.folder / f"{fault}-{number}-{name}") for name in ("once", "often")]

    @offload("repeat", client=at.cloud, state=at.device, timeout=TIMEOUT)
    @function(name="repeat", repeatable=True)
    def repeat(duration: float, began: str) -> float:
        return duration

    def once() -> object:
        return at.cloud.call("sleep", timeout=TIMEOUT, duration=DURATION, began=files[0])

    def often() -> object:
        return repeat(DURATION, files[1])

    publish(at.state, DeviceState(time.time(), {"cpu": True}))
    began = time.monotonic()
    with ThreadPoolExecutor(2) as pool:
        calls: list[Future[str]] = [pool.submit(outcome, once), pool.submit(outcome, often)]
        time.sleep(moment)
        at.break_it(fault)
        first, second = (each.result(HANG) for each in calls)
    took = time.monotonic() - began
    if second == "answer" and decisions()[-1].where == "here":
        second = "answer: here"
    times = Path(files[0]).stat().st_size if Path(files[0]).exists() else 0
    wait_for("calls are answered again", at.answers, 120)
    return first, second, times, took


def trials(at: Scene, fault: str, runs: int) -> Iterator[tuple[str, str, int, float]]:
    """Trials, until all are done or the user interrupts. The moments of any number of first ones are spread."""
    for run in range(runs):
        try:
            found = trial(at, fault, MOMENTS * (run * GOLDEN % 1.0), run)
        except KeyboardInterrupt:
            return
        yield found


def main() -> int:
    """Try all; the code is 1 when a call hung, began twice, or had no answer though it may be repeated."""
    parser = argparse.ArgumentParser(prog="python -m bench.offload_failures", description=__doc__)
    parser.add_argument("engines", nargs="*", choices=[*FAULTS, []], help="both, if none is named")
    parser.add_argument("--fault", action="append", help="this one only (link, relay, worker, scheduler)")
    parser.add_argument("--runs", type=int, default=50, help="moments of each fault")
    asked = parser.parse_args()
    bad = 0
    for engine in asked.engines or FAULTS:
        with scene(engine) as at:
            at.answers()
            for fault in asked.fault or FAULTS[engine]:
                ends = list(trials(at, fault, asked.runs))
                once, often = (dict(Counter(each[which] for each in ends)) for which in (0, 1))
                twice = sum(each[2] > 1 for each in ends)
                failed = sum(not each[1].startswith("answer") for each in ends)
                bad += twice + failed
                longest = max(each[3] for each in ends)
                words = {
                    "once": once,
                    "repeatable": often,
                    "began twice": twice,
                    "longest s": round(longest, 1),
                }
                print(f"{engine}, {fault} dies, {len(ends)} moments: {json.dumps(words)}", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    sys.exit(main())
