"""Supervised modules: what supervision and the monitor cost, and whether all come back after kills.

The supervisor is measured without ROS, so that only its own work counts. The monitor is measured in a real daemon,
whose table a client of the relay watches.
"""

from __future__ import annotations

import contextlib
import http.client
import math
import random
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from bench.cpu import measured
from bench.relay import Relay
from bench.report import Options, Row
from robot_client.modules import processes
from robot_client.modules.settings import ModuleSettings
from robot_client.modules.supervisor import LONGEST_BACKOFF
from tests.worlds.module_daemon_process import FOREVER, Daemon, DoubleStartWatch, killed_modules, runners
from tests.worlds.processes import running
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for

IDLE = 10
"""Modules of the idle supervisor."""

WATCHED = 15
"""Modules of the robot whose processes are measured: with runners, daemon, guard and camera about thirty processes."""

PROC_READS = Path(__file__).parent / "proc_reads"
"""Put on ``PYTHONPATH``, it counts reads of ``/proc``."""

FASTEST = 0.1
"""Seconds between two measurements."""

KILLED = 6
"""Modules that are killed."""

RESTARTS = {"backoff_s": 0.2, "within_s": 10.0, "ready_within_s": 5.0}
"""Their settings: the pause before a restart, in which it doubles, and the time for a Python class to be ready."""

ALLOWANCE = 3.0
"""Seconds that a return may take beside what the settings say: to start a daemon, to see ends, to start programs."""


@contextlib.contextmanager
def supervisor(modules: list[dict[str, Any]]) -> Iterator[Daemon]:
    """A daemon with these modules, all running."""
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        daemon = Daemon(Path(name), *modules)
        try:
            wait_for("all modules run", daemon.runs_once)
            yield daemon
        finally:
            daemon.end()
            processes.send(runners(daemon.folder) + daemon.pids(), signal.SIGKILL)


def idle(options: Options) -> Row:
    """Processor time of the supervisor and the runners while nothing happens."""
    seconds = options.pick(1, 20)
    modules = [{"name": f"m{number}", "command": FOREVER} for number in range(int(options.pick(2, IDLE)))]
    with supervisor(modules) as daemon:
        time.sleep(options.pick(0.1, 2))  # starting is over
        with measured(daemon.process.pid, *runners(daemon.folder)) as watch:
            time.sleep(seconds)  # what is measured: the time it needs while nothing happens
    share = 100 * watch.seconds / seconds
    print(f"    idle supervisor: {share:.3f} % of a CPU", flush=True)
    return Row("modules", f"idle supervisor and runners of {IDLE} modules", "% of a CPU", share, bar=0.2)


class DaemonCost(NamedTuple):
    """Spent by a daemon in one window of time.

    :ivar share: processor time, per cent of a CPU
    :ivar reads: how often it read ``/proc``
    """

    share: float
    reads: int


class MeasuredDaemon:
    """The daemon of a robot with these modules, which counts its reads of ``/proc``."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack, modules: int) -> None:
        self._relay = Relay(folder)
        stack.enter_context(running(self._relay))
        self._token = self._relay.user("owner")
        counts = folder / "reads"
        counts.mkdir()
        command = str(FOREVER).replace("'", '"')
        robot = Robot(
            self._relay,
            "rover",
            settings="".join(
                f'[[module]]\nname = "m{number}"\ncommand = {command}\n' for number in range(modules)
            ),
            daemon_env={"PYTHONPATH": str(PROC_READS), "BENCH_PROC_READS": str(counts)},
        )
        stack.enter_context(running(robot))
        self._relay.cli("right", "grant", "owner", "rover", "owner")
        self._modules = modules
        self._pid = robot.daemon.popen.pid
        self._count = counts / str(self._pid)

    def wait_for_modules(self) -> None:
        """Wait until all of them run."""

        def all_run() -> bool:
            states = [each["state"] for each in self._relay.cli("module", "list", "rover")["modules"]]
            return states == ["running"] * self._modules

        wait_for("all modules run", all_run)

    def wait_for_rest(self) -> None:
        """Wait until no process is measured any more."""

        def at_rest() -> bool:
            before = self._reads()
            time.sleep(10 * FASTEST)  # longer than between two measurements, to prove that there are none
            return self._reads() == before

        wait_for("nothing is measured any more", at_rest)

    def cost(self, seconds: float) -> DaemonCost:
        """Its cost in the next seconds."""
        before = self._reads()
        with measured(self._pid) as watch:
            time.sleep(seconds)  # what is measured: the daemon meanwhile
        return DaemonCost(100 * watch.seconds / seconds, self._reads() - before)

    def watched(self) -> contextlib.AbstractContextManager[list[None]]:
        """A client that watches the processes; it notes each event."""
        return watching(self._relay.http_port, self._token)

    def processes(self) -> int:
        """How many processes the robot reports."""
        return len(self._relay.cli("top", "rover", "--every", str(FASTEST))["processes"])

    def _reads(self) -> int:
        return int.from_bytes(self._count.read_bytes(), sys.byteorder)


def monitor(options: Options) -> list[Row]:
    """Processor time of the daemon and its reads of ``/proc``: before a client watches processes, while one does so ten
    times a second, and after it has left.
    """
    seconds = options.pick(1, 15)
    rounds = range(int(options.pick(1, 3)))
    after: list[DaemonCost] = []
    during: list[DaemonCost] = []
    rates: list[float] = []
    with tempfile.TemporaryDirectory(prefix="bench-") as name, contextlib.ExitStack() as stack:
        daemon = MeasuredDaemon(Path(name), stack, int(options.pick(2, WATCHED)))
        daemon.wait_for_modules()
        daemon.wait_for_rest()
        before = [daemon.cost(seconds) for _ in rounds]
        for _ in rounds:
            with daemon.watched() as events:
                came = len(events)
                during.append(daemon.cost(seconds))
                rates.append((len(events) - came) / seconds)
            daemon.wait_for_rest()
            after.append(daemon.cost(seconds))
        count = daemon.processes()
    idle_share, without, with_client = (
        statistics.median(each.share for each in costs) for costs in (before, after, during)
    )
    read = sum(each.reads for each in after)
    read_watched = sum(each.reads for each in during) / len(during) / seconds
    print(
        f"    {count} processes ten times a second: {with_client - without:.2f} % of a CPU, "
        f"{read_watched:.0f} reads of /proc a second; "
        f"after that {without:.2f} % and {read} reads, before {idle_share:.2f} %",
        flush=True,
    )
    at_10_hz, unwatched = f"{count} processes measured at 10 Hz", f"{count} processes, no client watches"
    left = f"{count} processes, daemon after its last client has left"
    note = f"beyond the {without:.1f} % that the daemon takes while no client watches"
    return [
        Row("modules", at_10_hz, "% of a CPU", with_client - without, bar=3.0, note=note),
        Row("modules", f"{at_10_hz}, reads of /proc", "a second", read_watched),
        Row("modules", f"{unwatched}: reads of /proc", "reads", read, bar=0),
        Row("modules", left, "% of a CPU", without, idle_share, "before the first", ratio_bar=1.1),
        Row("modules", "time between two measurements, mean", "ms", 1000 / min(rates), bar=105.0),
    ]


@contextlib.contextmanager
def watching(port: int, token: str) -> Iterator[list[None]]:
    """A client that watches the processes of the robot; it notes each event."""
    connection = http.client.HTTPConnection("127.0.0.1", port)
    headers = {"Authorization": f"Bearer {token}", "Accept": "text/event-stream"}
    connection.request("GET", f"/api/v1/robots/rover/processes?every={FASTEST}", headers=headers)
    answer = connection.getresponse()
    ended = threading.Event()
    events: list[None] = []

    def read() -> None:
        with contextlib.suppress(OSError, ValueError, AttributeError):
            while not ended.is_set() and (line := answer.readline()):
                events.extend([None] * line.startswith(b"event: processes"))

    reader = threading.Thread(target=read)
    reader.start()
    try:
        yield events
    finally:
        # The next event ends the thread.
        ended.set()
        reader.join()
        connection.close()


class ReturnPolicy:
    """How long modules may take to be back, by their settings."""

    def __init__(self, modules: list[ModuleSettings]) -> None:
        self._modules = {each.name: each for each in modules}
        self._crashes: dict[str, list[float]] = {}

    def daemon_restarted(self) -> None:
        """It counts crashes from zero again."""
        self._crashes.clear()

    def seconds(self, crashed: list[str], now: float) -> float:
        """Seconds that a return may take.

        :param crashed: names of the modules that crashed in it, each as often as it did
        :param now: the end of the return, seconds
        """
        own: dict[str, float] = defaultdict(float)
        for name in crashed:
            settings = self._modules[name]
            recent = [each for each in self._crashes.get(name, []) if each >= now - settings.within_s]
            self._crashes[name] = [*recent, now]
            own[name] += min(LONGEST_BACKOFF, settings.backoff_s * 2 ** len(recent))
            # What a killed program or runner leaves behind is ended first.
            own[name] += settings.term_after_s + settings.kill_after_s
            if settings.ready_pattern:
                own[name] += settings.ready_within_s
        return ALLOWANCE + max(self._with_dependencies(name, own) for name in self._modules)

    def _with_dependencies(self, name: str, own: dict[str, float]) -> float:
        """The module's own seconds, after those of the modules that it waits for."""
        before = [self._with_dependencies(each, own) for each in self._modules[name].after]
        return own[name] + max(before, default=0.0)


class Kills:
    """Kills at random, and how all modules come back after each.

    :ivar killed: how often each kind was
    :ivar wrong: kills after which not each module ran exactly once
    :ivar late: returns that took longer than their policy allows
    :ivar slowest: the longest return, seconds
    :ivar closest: the least time that was left of what a policy allows, seconds
    """

    def __init__(self, daemon: Daemon) -> None:
        self.killed: Counter[str] = Counter()
        self.wrong, self.late = 0, 0
        self.slowest, self.closest = 0.0, math.inf
        self._daemon = daemon
        self._policy = ReturnPolicy(msgspec.convert(daemon.modules, list[ModuleSettings]))
        self._choose = random.Random(18)

    def kill(self) -> None:
        """Kill something, and wait until all modules run again."""
        began, said = time.monotonic(), len(self._daemon.said)
        what = self._daemon.kill_at_random(self._choose)
        self.killed[what] += 1
        try:
            wait_for(f"all modules after {what}", self._daemon.runs_once)
        except AssertionError:
            self.wrong += 1
        now = time.monotonic()
        if "daemon" in what:
            self._policy.daemon_restarted()
        crashed = [each["name"] for each in self._daemon.said[said:] if each.get("state") == "backing_off"]
        spare = self._policy.seconds(crashed, now) - (now - began)
        self.late += spare < 0
        self.slowest = max(self.slowest, now - began)
        self.closest = min(self.closest, spare)


def kills(options: Options) -> list[Row]:
    """Kills of modules, runners, the daemon or several of them: after how many not each module runs exactly once, and
    after how many not as soon as the settings of the modules say.

    All the time a thread looks for modules that run twice.
    """
    runs = int(options.pick(4, 200))
    with supervisor([{**each, **RESTARTS} for each in killed_modules(KILLED)]) as daemon:
        made = Kills(daemon)
        with DoubleStartWatch(daemon.folder) as watch:
            for _ in range(runs):
                made.kill()
        daemon.end()
        left = len(daemon.pids()) + len(runners(daemon.folder))
    print(
        f"    {runs} kills: {made.wrong} wrong, {made.late} late, slowest {made.slowest:.1f} s, "
        f"at least {made.closest:.1f} s before its policy's time, {left} processes left at the end; "
        f"{dict(made.killed)}; {watch.samples} samples, double starts: {watch.doubles}",
        flush=True,
    )
    what = f"of {runs} kills"
    kinds = "killed: " + ", ".join(f"{kind} {count}" for kind, count in sorted(made.killed.items()))
    samples = f"in {watch.samples} samples of all processes"
    policy = (
        f"the policy: pauses of {RESTARTS['backoff_s']:g} s, doubled by each crash within "
        f"{RESTARTS['within_s']:g} s, times to stop and to be ready, and {ALLOWANCE:g} s for all the rest"
    )
    twice, remain = "a module seen twice during the kills", "processes left when the daemon has ended"
    return [
        Row("modules", f"{what}: a module missing, or there twice", "kills", made.wrong, bar=0, note=kinds),
        Row("modules", f"{what}: {twice}", "times", len(watch.doubles), bar=0, note=samples),
        Row("modules", f"{what}: {remain}", "processes", left, bar=0),
        Row("modules", f"{what}: returns later than their policy", "kills", made.late, bar=0, note=policy),
        Row("modules", f"slowest return after one of {runs} kills", "s", made.slowest),
    ]


def run(options: Options) -> list[Row]:
    """Idle, watched, killed."""
    return [idle(options), *monitor(options), *kills(options)]
