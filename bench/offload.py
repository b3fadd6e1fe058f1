"""Functions on the relay's workers: what they take off a robot's processor, and what the way there costs.

A program on a robot calls them over its own link through a proxy, which is also the thin uplink. The tables are
those of the paper on switching brains between a robot and a cloud; its figures stand beside ours.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from bench.child import Child
from bench.relay import Relay
from bench.report import Options, Row, Unavailable
from tests.worlds import offload_functions
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.dask_processes import DaskScheduler, FunctionWorker
from tests.worlds.http_requests import ask
from tests.worlds.processes import BIN, running
from tests.worlds.waiting import wait_for

PAPER = "the paper's"
MEGABITS = (None, 10, 1)
"""Uplinks, Mbit/s; ``None``: as fast as it goes."""

HERTZ = 5
ANALYSED = 100
SHARE = 0.5
"""Most of the paper's share of the processor with the cloud."""

ADDED = {"embedded": 5.0, "dask": 20.0}
"""Most that a call of a function with a frame of 100 KB may add, milliseconds, p50."""


class Device(Child):
    """``bench/offload_device.py``, enrolled as a robot of its own.

    :ivar proxy: its uplink
    """

    def __init__(self, relay: Relay) -> None:
        self.proxy = ChaosProxy(relay.robots_port)
        state = relay.folder / "device"
        code = relay.cli("robot", "add", "rover")["enrolment_code"]
        enroll = [str(BIN / "switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{self.proxy.port}"]
        enroll += ["--robot", "rover", "--code", "-", "--state", str(state)]
        subprocess.run(enroll, input=code, text=True, capture_output=True, timeout=60, check=True)
        command = [sys.executable, "-m", "bench.offload_device"]
        environment = {**os.environ, "SWITCHBOARD_ROBOT_STATE": str(state)}
        super().__init__(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        self.ready(Unavailable("the program on the robot does not start; see above"))

    def do(self, what: str, **how: Any) -> dict[str, Any]:
        """Have it do something."""
        assert self.popen.stdin is not None
        self.popen.stdin.write(json.dumps({"do": what, **how}) + "\n")
        self.popen.stdin.flush()
        return dict(json.loads(self.line()))

    def stop(self) -> None:
        """End."""
        super().stop()
        self.proxy.close()


@contextlib.contextmanager
def embedded() -> Iterator[Device]:
    """A relay with the embedded engine, and the program."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        relay = Relay(Path(folder), "--offload-folder", str(_functions(Path(folder))))
        with running(relay):
            device = Device(relay)
            with running(device):
                yield device


@contextlib.contextmanager
def dask() -> Iterator[tuple[Relay, Device, DaskScheduler]]:
    """A relay with a Dask scheduler and one worker, and the program."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        functions = _functions(Path(folder))
        scheduler = DaskScheduler(Path(folder))
        with running(scheduler), running(FunctionWorker(scheduler, "one", functions)):
            relay = Relay(Path(folder), "--offload-scheduler", scheduler.address)
            with running(relay):
                device = Device(relay)
                with running(device):
                    yield relay, device, scheduler


def _functions(folder: Path) -> Path:
    made = folder / "functions"
    made.mkdir()
    shutil.copy(offload_functions.__file__, made)
    return made


def added(device: Device, engine: str, options: Options) -> Row:
    """The time that a call adds to that of its function."""
    device.do("calls", count=3)
    found = device.do("calls", count=int(options.pick(3, 300)))["added"]
    note = f"{engine}: p99 {sorted(found)[int(len(found) * 0.99)]:.1f} ms"
    what = f"added by a call with 100 KB, {engine} engine, p50"
    return Row("offload", what, "ms", statistics.median(found), bar=ADDED[engine], note=note)


def shares(device: Device, options: Options) -> list[Row]:
    """Processor time of the program, with the cloud and without.

    Over a thin uplink it takes fewer frames, and is measured at the rate it reaches. Otherwise its share is that at
    the full rate, also where a busy machine has slowed it down.
    """
    rows = []
    cases = [("here", None, 68.98), ("cloud", None, 45.84), ("cloud", 10, None), ("cloud", 1, None)]
    for where, megabits, paper in cases[:2] if options.quick else cases:
        device.do("follow", where=where, seconds=1, hertz=HERTZ)
        device.proxy.squeeze(megabits and megabits * 1e6)
        found = device.do("follow", where=where, seconds=options.pick(1, 30), hertz=HERTZ)
        device.proxy.squeeze(None)
        percent = found["ms"] * (found["hertz"] if megabits else HERTZ) / 10
        where_it_runs = _where(where, megabits)
        what = f"faces found and followed at {HERTZ} Hz, {where_it_runs}: device"
        note = f"{where_it_runs}: {found['hertz']:.1f} frames a second of 640×480"
        bar = SHARE if paper and where == "cloud" else None
        against = PAPER if paper else ""
        rows.append(Row("offload", what, "% of a CPU", percent, paper, against, bar, note=note))
    return rows


def analysis(device: Device, options: Options) -> list[Row]:
    """All about a hundred frames at once."""
    count = int(options.pick(4, ANALYSED))
    rows = []
    paper: dict[tuple[str, int | None], tuple[float, float]] = {
        ("here", None): (98.69, 1292),
        ("cloud", None): (25.53, 1100),
    }
    cases = [("here", None), *(("cloud", each) for each in MEGABITS)]
    for where, megabits in cases[:2] if options.quick else cases:
        device.proxy.squeeze(megabits and megabits * 1e6)
        found = device.do("analyse", where=where, count=count)
        device.proxy.squeeze(None)
        percent, took = paper.get((where, megabits), (None, None))
        what = f"{ANALYSED} frames analysed, {_where(where, megabits)}"
        note = f"{ANALYSED} frames of 320×240, {found['bytes'] / 1e6:.1f} MB"
        bar = SHARE if percent and where == "cloud" else None
        rows += [
            Row(
                "offload",
                f"{what}: device",
                "% of a CPU",
                found["percent"],
                percent,
                PAPER if percent else "",
                bar,
            ),
            Row("offload", what, "ms", found["ms"], took, PAPER if took else "", note=note),
        ]
    return rows


def times(device: Device, options: Options) -> list[Row]:
    """Time to find a face and to follow it: here, there, and there with the way."""
    rows = []
    paper = {"detect_faces": (195, 157, 576), "track_face": (None, None, None)}
    for name, verb in (("detect_faces", "find a face"), ("track_face", "follow a face")):
        count = int(options.pick(2, 30))
        here = device.do("once", where="here", name=name, count=count)
        alone, there, whole = paper[name]
        rows.append(_time(f"{verb}, alone", here["alone"], alone))
        for megabits in MEGABITS[:1] if options.quick else MEGABITS:
            device.do("once", where="cloud", name=name, count=1)
            device.proxy.squeeze(megabits and megabits * 1e6)
            found = device.do("once", where="cloud", name=name, count=count if megabits != 1 else count // 3)
            device.proxy.squeeze(None)
            if megabits is None:
                rows.append(_time(f"{verb}, on the worker", found["alone"], there))
            note = f"a frame has {found['bytes'] / 1000:.0f} KB; to follow a face takes two"
            rows.append(
                _time(
                    f"{verb}, {_where('cloud', megabits)}",
                    found["whole"],
                    whole if not megabits else None,
                    note,
                )
            )
    return rows


def _time(what: str, found: list[float], paper: float | None, note: str = "") -> Row:
    against = PAPER if paper else ""
    return Row("offload", f"{what}, median", "ms", statistics.median(found), paper, against, note=note)


def _where(where: str, megabits: int | None = None) -> str:
    if where == "here":
        return "alone"
    return "with the cloud" if megabits is None else f"with the cloud over {megabits} Mbit/s"


def scaling(relay: Relay, scheduler: DaskScheduler, options: Options) -> list[Row]:
    """Time of many calls by one worker and by two; where calls with a label run."""
    count = int(options.pick(4, 40))
    token = relay.user("ann")
    relay.cli("right", "grant", "ann", "rover", "operator")

    def call(duration: float) -> int:
        body = {"arguments": {"duration": duration}}
        headers = {"Prefer": "wait=60"}
        return ask(
            relay.http_port, "POST", "/api/v1/functions/sleep", body, headers=headers, token=token
        ).status

    def calls() -> float:
        began = time.perf_counter()
        with ThreadPoolExecutor(count) as pool:
            codes = list(pool.map(call, [0.1] * count))
        if set(codes) != {200}:
            raise RuntimeError(f"calls were answered with {set(codes)}")
        return (time.perf_counter() - began) * 1000 / count

    def state() -> dict[str, Any]:
        return dict(ask(relay.http_port, "GET", "/api/v1/functions", token=token).json)

    calls()
    one = calls()
    with running(FunctionWorker(scheduler, "two", scheduler.folder / "functions", "--label", "GPU=1")):
        wait_for("two workers", lambda: len(state()["workers"]) == 2)
        two = calls()
    workers = "calls of 100 ms, by two workers, per call"
    return [
        Row("offload", workers, "ms", two, one, "one worker", ratio_bar=0.6, note=f"{count} calls at once")
    ]


def run(options: Options) -> list[Row]:
    """The way, the device's processor, the times; then the way by Dask, and two workers."""
    with embedded() as device:
        rows = [added(device, "embedded", options), *shares(device, options)]
        rows += [*analysis(device, options), *times(device, options)]
    if options.quick:
        # A scheduler and workers take ten seconds to start; tests of the engines have them.
        return rows
    with dask() as (relay, device, scheduler):
        return [*rows, added(device, "dask", options), *scaling(relay, scheduler, options)]
