"""The process beside a module: real processes, real signals."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest

from robot_client.modules import processes, runner
from robot_client.modules.log_ring import ModuleLogLine, read
from tests.worlds.module_daemon_process import has_ended, marked

PYTHON = [sys.executable, "-u", "-c"]
RUNNER = [sys.executable, "-m", "robot_client.modules.runner"]
SOON_A_FLOOD = [
    sys.executable,
    "-c",
    "import sys\nfrom robot_client.modules import module_output, runner\n"
    "module_output.FLOOD_ALERT_SECONDS = 0.5\nsys.exit(runner.main())",
]
"""A runner to which output is a flood after half a second."""
HOPS = 30
HOPPING = f"""
import os, sys, time
for number in range({HOPS}):
    with open(f"{{number}}.new", "w") as file: file.write(str(os.getpid()))
    os.rename(f"{{number}}.new", f"{{number}}.pid")
    if number == 0 and os.fork(): sys.exit(3)
    if number == 0: continue
    if number == 1 and sys.argv[1] == "closes":
        null = os.open(os.devnull, os.O_RDWR)
        for each in range(3): os.dup2(null, each)
    while not os.path.exists(f"{{number}}.go"): time.sleep(0.001)
    if os.fork(): os._exit(0)
time.sleep(600)
"""
"""A module that ends, and leaves a process that hops as a daemon does: a child goes on, and the parent ends."""
SEES_HOPS = [
    sys.executable,
    "-c",
    f"""
import pathlib, sys, time
from robot_client.modules import processes, runner
runner.LEFTOVER_SECONDS = 0.1
hop, listed = 0, processes.pids
def list_and_let_hop():
    global hop
    found, hop = listed(), hop + 1
    if hop < {HOPS}:
        folder = pathlib.Path(sys.argv[1])
        while not (pid := folder / f"{{hop}}.pid").exists(): time.sleep(0.001)
        (folder / f"{{hop}}.go").touch()
        while (stat := processes.read_stat(int(pid.read_text()))) and not stat.has_ended: time.sleep(0.001)
    return found
processes.pids = list_and_let_hop
sys.exit(runner.main())
""",
]
"""A runner to which the process of HOPPING hops each time between the listing of the processes and their reading."""
ENDS_BEFORE_ITS_MODULE = [
    sys.executable,
    "-c",
    """
import os, signal, sys, time
from robot_client.modules import runner
own, prctl = os.getpid(), runner._prctl
def prctl_without_runner(option, value):
    if os.getpid() != own:
        os.kill(own, signal.SIGKILL)
        while os.getppid() == own: time.sleep(0.001)
    prctl(option, value)
runner._prctl = prctl_without_runner
runner.main()
""",
]
"""A runner that is killed when the process of its module has been forked, and does not end with it yet."""
READY = "print('ready', flush=True);"
FOREVER = f"import time;{READY}time.sleep(600)"
IGNORES = f"import signal,time;[signal.signal(n, signal.SIG_IGN) for n in (2, 15)];{READY}time.sleep(600)"
GRANDCHILD = (
    "import subprocess,sys,time;"
    "p = subprocess.Popen([sys.executable, '-c', 'import os,signal,time;os.setsid();"
    "signal.signal(2, signal.SIG_IGN);time.sleep(600)']);"
    "print('grandchild', p.pid, flush=True);"
)


def wait_for(check: Callable[[], Any], what: str) -> Any:
    for _ in range(3000):
        found = check()
        if found:
            return found
        time.sleep(0.01)
    raise AssertionError(f"not in 30 s: {what}")


class Run:
    """A runner with its module, and a connection to it."""

    def __init__(self, folder: Path, command: list[str], runner: list[str], /, **spec: Any) -> None:
        self.folder = folder
        self.run = os.urandom(6).hex()
        folder.mkdir(parents=True, exist_ok=True)
        fields = {
            "run": self.run,
            "command": command,
            "environment": dict(os.environ),
            "working_directory": str(folder),
            "nice": 0,
            "cpus": [],
            "memory": 0,
            "term_after": 0.3,
            "kill_after": 0.3,
            "log_bytes": 1024 * 1024,
            **spec,
        }
        (folder / "spec.json").write_text(json.dumps(fields))
        self.process = subprocess.Popen([*runner, str(folder)])

    def connect(self) -> socket.socket:
        client = socket.socket(socket.AF_UNIX)
        client.settimeout(30.0)

        def connected() -> bool:
            try:
                client.connect(str(self.folder / "socket"))
            except (FileNotFoundError, ConnectionRefusedError):
                return False
            return True

        wait_for(connected, "a socket")
        return client

    def lines(self) -> list[ModuleLogLine]:
        return read(self.folder / "log", most=100_000).lines

    def texts(self) -> list[str]:
        return [each.text for each in self.lines()]

    def says(self, text: str) -> str:
        return str(wait_for(lambda: next((each for each in self.texts() if text in each), None), text))

    def stop(self) -> None:
        client = self.connect()
        client.sendall(b'{"do": "stop"}\n')
        self.ended()
        client.close()

    def ended(self) -> dict[str, Any]:
        assert self.process.wait(60) == 0
        found: dict[str, Any] = json.loads((self.folder / "exit.json").read_text())
        return found

    def alive(self) -> list[int]:
        return marked(self.run)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Run]]:
    runs: list[Run] = []

    def begin(*command: str, runner: list[str] = RUNNER, **spec: Any) -> Run:
        runs.append(Run(tmp_path / f"module{len(runs)}", list(command), runner, **spec))
        return runs[-1]

    yield begin
    for each in runs:
        if each.process.poll() is None:
            each.process.kill()
            each.process.wait()
        processes.send(each.alive(), signal.SIGKILL)


@pytest.mark.parametrize("code", [0, 3])
def test_exit_code_is_recorded(start: Callable[..., Run], code: int) -> None:
    ended = start(*PYTHON, f"raise SystemExit({code})").ended()
    assert (ended["code"], ended["signal"], ended["stopped"]) == (code, None, False)


def test_ending_signal_is_recorded_and_logged(start: Callable[..., Run]) -> None:
    run = start(*PYTHON, "import os;os.kill(os.getpid(), 9)")
    ended = run.ended()
    assert (ended["code"], ended["signal"]) == (None, 9)
    (line,) = run.lines()
    assert (line.stream, line.level, line.text) == ("runner", "error", "ended by signal 9 (SIGKILL)")


def test_missing_program_is_named(start: Callable[..., Run]) -> None:
    assert start("/no/such/program").ended()["error"] == "/no/such/program: No such file or directory"


@pytest.mark.parametrize(
    ("spec", "error"),
    [
        ({"working_directory": "/no/folder"}, "folder = '/no/folder': No such file or directory"),
        ({"cpus": [9999]}, "cpus = [9999]: Invalid argument; the CPUs of this machine are 0 to "),
        ({"memory": 2**70}, f"memory_mb = {2**50}: "),
    ],
)
def test_wrong_setting_is_named(start: Callable[..., Run], spec: dict[str, Any], error: str) -> None:
    assert start(*PYTHON, FOREVER, **spec).ended()["error"].startswith(error)


def test_both_streams_are_logged_with_their_levels(start: Callable[..., Run]) -> None:
    run = start(*PYTHON, "import sys;print('[WARN] [1.5] [base]: slow');print('oops', file=sys.stderr)")
    run.ended()
    kept = {(each.stream, each.level, each.text) for each in run.lines()}
    end = ("runner", "info", "exit code 0")
    assert kept == {("out", "warn", "[WARN] [1.5] [base]: slow"), ("err", "info", "oops"), end}


def test_module_that_ends_by_sigint_gets_no_other_signal(start: Callable[..., Run]) -> None:
    run = start(*PYTHON, FOREVER, term_after=60.0)
    run.says("ready")
    run.stop()
    ended = run.ended()
    assert ended["stopped"] and (ended["signal"] == 2 or ended["code"] == 1)


def test_module_that_ignores_signals_is_killed(start: Callable[..., Run]) -> None:
    run = start(*PYTHON, IGNORES)
    run.says("ready")
    run.stop()
    assert run.ended()["signal"] == 9


FIRST_THREAD_ENDS = """
import ctypes, os, signal, threading, time
signal.alarm(600)  # nothing else ends it if the test is killed
threading.Thread(target=time.sleep, args=(600,)).start()
print("ready", os.getpid(), flush=True)
ctypes.CDLL(None).pthread_exit(None)
"""


def test_module_whose_first_thread_has_ended_is_stopped(start: Callable[..., Run]) -> None:
    """The system shows it as a zombie, though others run."""
    run = start(*PYTHON, FIRST_THREAD_ENDS)
    pid = int(run.says("ready").split()[1])

    def state() -> str:
        stat = processes.read_stat(pid)
        return stat.state if stat is not None else ""

    wait_for(lambda: state() == "Z", "the end of the first thread")
    run.stop()
    assert state() == ""


def test_grandchildren_in_sessions_of_their_own_end_too(start: Callable[..., Run]) -> None:
    run = start(*PYTHON, GRANDCHILD + "time.sleep(600)")
    run.says("grandchild")
    assert len(run.alive()) == 2
    run.stop()
    assert run.alive() == []


def test_leftover_processes_of_a_crashed_module_are_ended(start: Callable[..., Run]) -> None:
    run = start(*PYTHON, GRANDCHILD + "raise SystemExit(1)")
    assert run.ended()["code"] == 1
    assert run.alive() == []


@pytest.mark.parametrize("output", ["closes", "holds"])
def test_leftover_process_that_no_search_finds_is_ended(start: Callable[..., Run], output: str) -> None:
    run = start(*PYTHON, HOPPING, output, runner=SEES_HOPS)
    assert run.ended()["code"] == 3
    assert run.alive() == []
    assert (run.folder / f"{HOPS - 1}.go").exists()


def test_module_ends_with_its_runner(start: Callable[..., Run]) -> None:
    run = start(*PYTHON, FOREVER)
    run.says("ready")
    run.process.kill()
    wait_for(lambda: not run.alive(), "the end of the module")


def test_module_does_not_begin_without_its_runner(start: Callable[..., Run]) -> None:
    run = start(*PYTHON, "import time;time.sleep(600)", runner=ENDS_BEFORE_ITS_MODULE)
    assert run.process.wait(60) == -signal.SIGKILL
    pid = json.loads((run.folder / "session.json").read_text())["id"]
    wait_for(lambda: has_ended(pid), "the end of its process")


def test_module_runs_only_once_at_a_time(start: Callable[..., Run]) -> None:
    run = start(*PYTHON, FOREVER)
    run.says("ready")
    again = subprocess.run([*RUNNER, str(run.folder)], check=False)
    assert again.returncode == 75
    assert len(run.alive()) == 1


def test_output_over_the_rate_is_dropped_and_reported(start: Callable[..., Run]) -> None:
    flood = "import sys;[sys.stdout.write('x' * 1023 + chr(10)) for _ in range(40_000)];print('end')"
    run = start(*PYTHON, flood, log_bytes=256 * 1024)
    run.ended()
    assert sum(each.stat().st_size for each in (run.folder / "log").iterdir()) < 320 * 1024
    assert {each.level for each in run.lines() if "bytes of output were dropped" in each.text} == {"error"}


def test_remarks_of_the_runner_do_not_make_a_module_ready(start: Callable[..., Run]) -> None:
    flood = "import sys;[sys.stdout.write('x' * 1023 + chr(10)) for _ in range(40_000)]"
    run = start(*PYTHON, flood, ready_pattern="bytes of output were dropped", log_bytes=256 * 1024)
    ended = run.ended()
    assert any("bytes of output were dropped" in each for each in run.texts())
    assert not ended["ready"]


def test_flood_is_reported_until_it_ends(start: Callable[..., Run]) -> None:
    flood = (
        "import os, time\n"
        "while not os.path.exists('enough'): print(('x' * 1023 + chr(10)) * 256, flush=True); time.sleep(0.02)\n"
        "time.sleep(600)"
    )
    run = start(*PYTHON, flood, runner=SOON_A_FLOOD)
    with closing(run.connect()) as client, client.makefile() as events:
        reasons = (each["reason"] for each in map(json.loads, events) if each["event"] == "output_loss")
        reason = "without part of its log: it writes more than 1 MiB a second to one of its streams"
        assert next(reasons) == reason
        (run.folder / "enough").touch()
        assert next(reasons) == ""


def test_runner_ends_though_another_process_holds_the_output_open(start: Callable[..., Run]) -> None:
    """As one that was passed the descriptor; what it writes later is not of the module."""
    run = start(*PYTHON, FOREVER)
    run.says("ready")
    (pid,) = run.alive()
    with Path(f"/proc/{pid}/fd/1").open("w") as held:
        held.write("from elsewhere\n")
        held.flush()
        run.stop()
    assert run.texts()[:2] == ["ready", "from elsewhere"]
    assert "a process that does not belong to the module holds its output open" in run.texts()


def test_endless_line_is_cut(start: Callable[..., Run]) -> None:
    run = start(*PYTHON, "import sys;sys.stdout.write('x' * 100_000)")
    run.ended()
    assert max(len(each) for each in run.texts()) <= 16 * 1024


def test_memory_niceness_and_cpus_are_limited(start: Callable[..., Run]) -> None:
    script = "import os,resource;print(os.nice(0), resource.getrlimit(resource.RLIMIT_AS)[0], os.sched_getaffinity(0))"
    run = start(*PYTHON, script, nice=5, memory=2**31, cpus=[0])
    run.ended()
    assert run.texts()[0] == f"{min(os.nice(0) + 5, 19)} {2**31} {{0}}"


@pytest.mark.parametrize(("before", "after"), [("-500\n", "0"), ("0\n", "0\n"), ("200\n", "200\n")])
def test_module_does_not_inherit_the_daemons_protection_when_memory_is_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str, after: str
) -> None:
    """The daemon's unit sets OOMScoreAdjust=-500; to lower a score takes a right that tests don't have."""
    score = tmp_path / "oom_score_adj"
    score.write_text(before)
    monkeypatch.setattr(runner, "OOM_SCORE", score)
    runner.drop_oom_protection()
    assert score.read_text() == after


def test_client_receives_events(start: Callable[..., Run]) -> None:
    run = start(*PYTHON, FOREVER)
    run.says("ready")
    client = run.connect()
    client.sendall(b'{"do": "stop"}\n')
    with client.makefile() as file:
        events = [json.loads(line) for line in file]
    assert [events[0]["event"], events[-1]["event"]] == ["running", "exit"]
    assert marked(run.run) == [] and events[0]["pid"] > 0
    client.close()


@pytest.mark.parametrize("pattern", ["^ready$", ""])
def test_runner_remembers_that_the_module_is_ready(start: Callable[..., Run], pattern: str) -> None:
    """By a line that has left its log since, or because a daemon reported it."""
    script = READY + "[print('x' * 1000) for _ in range(100)];print('last');time.sleep(600)"
    run = start(*PYTHON, "import time;" + script, ready_pattern=pattern, log_bytes=64 * 1024)
    run.says("last")
    assert "ready" not in run.texts()
    first = run.connect()
    with first.makefile() as file:
        assert json.loads(file.readline())["ready"] is bool(pattern)
        first.sendall(b'{"do": "ready"}\n{"do": "command", "id": 1}\n')
        # Orders are carried out in turn, so the first one was.
        file.readline()
    second = run.connect()
    with second.makefile() as file:
        assert json.loads(file.readline())["ready"]
    first.close()
    second.close()


@pytest.mark.parametrize("order", [b"nonsense\n", b'{"do": 1}\n', b"[]\n", b"x" * 200_000])
def test_invalid_order_affects_no_other_client(start: Callable[..., Run], order: bytes) -> None:
    run = start(*PYTHON, FOREVER)
    run.says("ready")
    client = run.connect()
    with suppress(OSError):
        client.sendall(order)
    client.close()
    assert len(run.alive()) == 1
    run.stop()
