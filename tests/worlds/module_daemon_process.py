"""A daemon with only modules, in its own process; see :mod:`tests.worlds.module_daemon`."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from robot_client.modules import processes
from robot_client.modules.log_ring import read
from tests.worlds.private_mounts import with_private_mounts
from tests.worlds.waiting import wait_for

ROOT = Path(__file__).parents[2]
FOREVER = [sys.executable, "-c", "import signal; signal.pause()"]
PARENT = [
    sys.executable,
    "-c",
    f"import subprocess, sys; sys.exit(subprocess.run({FOREVER!r}, start_new_session=True).returncode)",
]
"""A program with a child in a session of its own; it ends with its child."""

PROCESSES_OF_A_MODULE = {"parent": 2}
"""By name of the module, where it is not one."""

NAME = "MODULE_NAME"
"""Environment variable of each module: its name."""

FILLER = "filler"
"""Begins the names of files that fill a small disk."""

INODES = 60
"""Most files and folders on a small disk."""

KILLS = ["module", "runner", "daemon", "daemon and module", "daemon and runner", "daemon and all"]


class Daemon:
    """A daemon that can be killed and restarted.

    :param disk: size in bytes of a separate disk for the folder, see :func:`with_private_mounts`; such a
        daemon is not restarted
    :param full: whether the disk is full of files, so that no file or folder can be created
    :param before: a program and its arguments that run the daemon
    """

    def __init__(
        self,
        folder: Path,
        *modules: dict[str, Any],
        disk: int = 0,
        full: bool = False,
        before: Sequence[str] = (),
    ) -> None:
        self.folder = folder
        self._has_disk = disk > 0
        self.before = _on_disk(folder, disk, full) if disk else list(before)
        self.modules = [_completed(each) for each in modules]
        self.boot = "first"
        self.said: list[dict[str, Any]] = []
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            [*self.before, *self.command],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "MODULES_OF": str(self.folder), "BOOT": self.boot},
            cwd=ROOT,
        )
        reader = threading.Thread(target=self._read, args=(self.process.stderr,), daemon=True)
        reader.start()

    @property
    def command(self) -> list[str]:
        return [
            sys.executable,
            "-m",
            "tests.worlds.module_daemon",
            str(self.folder),
            json.dumps(self.modules),
        ]

    @property
    def disk(self) -> Path:
        """The folder as the daemon sees it."""
        return Path(f"/proc/{self.process.pid}/root{self.folder}") if self._has_disk else self.folder

    def _read(self, stream: Any) -> None:
        for line in stream:
            try:
                self.said.append(json.loads(line))
            except ValueError:
                sys.stderr.write(line.decode(errors="replace"))

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def end(self) -> None:
        if self.process.poll() is None and self.process.stdin is not None:
            self.process.stdin.close()
            self.process.wait(60)

    def order(self, do: str, name: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": do, "name": name}).encode() + b"\n")
        self.process.stdin.flush()

    def states(self, name: str) -> list[str]:
        return [each["state"] for each in list(self.said) if each.get("name") == name]

    def is_(self, state: str, name: str = "m", after: int = 0) -> None:
        wait_for(f"{name} is {state}: {self.states(name)}", lambda: self.states(name)[after:][-1:] == [state])

    def why(self, name: str) -> str:
        """Why a module does not go on, now."""
        seen = len([each for each in list(self.said) if "why" in each])
        self.order("say why", name)
        answers = wait_for(
            "an answer", lambda: [each["why"] for each in list(self.said) if "why" in each][seen:]
        )
        return str(answers[0][name])

    def alerts(self) -> list[str]:
        return [each["alert"] for each in list(self.said) if "alert" in each]

    def texts(self, name: str = "m") -> list[str]:
        return [each.text for each in read(self.disk / name / "log", most=10_000).lines]

    def runs_once(self) -> bool:
        """Whether each module has one runner and the processes of one run, and there are no others."""
        expected = {}
        for each in self.modules:
            run = _run_of(self.disk / each["name"])
            expected[run] = PROCESSES_OF_A_MODULE.get(each["name"], 1)
        one_runner_each = len(runners(self.folder)) == len(self.modules)
        return one_runner_each and Counter(self._runs().values()) == expected

    def kill_at_random(self, choose: random.Random) -> str:
        """Kills processes of modules, runners, the daemon, or several of them; a dead daemon is restarted.

        :returns: the killed ones
        """
        what = choose.choice(KILLS)
        if "daemon" in what:
            self.kill()
        victims = []
        if "runner" in what:
            victims.append(choose.choice(runners(self.folder)))
        if "module" in what:
            victims.append(choose.choice(self.pids()))
        if "all" in what:
            victims += runners(self.folder) + self.pids()
        processes.send(victims, signal.SIGKILL)
        if "daemon" in what:
            self.start()
        return what

    def pids(self) -> list[int]:
        """All processes of modules, without runners."""
        return list(self._runs())

    def pids_of(self, name: str) -> list[int]:
        """The processes of one module."""
        run = _run_of(self.disk / name)
        return [pid for pid, each in self._runs().items() if each == run]

    def _runs(self) -> dict[int, str]:
        """For each process of a module the id of its run."""
        return {each.pid: each.run for each in module_processes(self.folder)}


class ModuleProcess(NamedTuple):
    """A process of a module.

    :param run: id of the run that it belongs to
    :param started: clock ticks after boot; tells it from a later process of this pid
    """

    pid: int
    started: int
    module: str
    run: str


class DoubleStartWatch:
    """Samples all processes of a daemon's modules as often as it can, in a thread.

    :ivar samples: how often it has looked
    :ivar doubles: in words, each case of two runs of a module at the same time, or of a run with too many processes
    """

    def __init__(self, folder: Path) -> None:
        self.samples = 0
        self.doubles: list[str] = []
        self._folder = folder
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> DoubleStartWatch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(0.002):
            self.sample()

    def sample(self) -> None:
        """Look once."""
        self.samples += 1
        seen = defaultdict(list)
        for each in module_processes(self._folder):
            seen[each.module].append(each)
        for module, found in seen.items():
            if _is_double(module, found):
                # They were read one after another: the first may have ended before the last began.
                left = [each for each in module_processes(self._folder) if each in found]
                if _is_double(module, left):
                    self.doubles.append(f"{module}: {left}")


def _is_double(module: str, found: list[ModuleProcess]) -> bool:
    runs = {each.run for each in found}
    return len(runs) > 1 or len(found) > PROCESSES_OF_A_MODULE.get(module, 1)


def module_processes(folder: Path) -> list[ModuleProcess]:
    """All processes of the modules of the daemon with this folder."""
    found = []
    for pid in processes.pids():
        words = [each.decode(errors="replace").partition("=") for each in _words(pid, "environ")]
        variables = {variable: value for variable, _, value in words}
        if variables.get("MODULES_OF") == str(folder) and processes.MARK in variables:
            stat = processes.read_stat(pid)
            if stat is not None:
                run = variables[processes.MARK]
                found.append(ModuleProcess(pid, stat.started, variables.get(NAME, ""), run))
    return found


def marked(run: str) -> list[int]:
    """Processes that were started in one run of a module."""
    return [pid for pid in processes.pids() if processes.is_marked(pid, run)]


def has_ended(pid: int) -> bool:
    """Whether a process has ended, also where nothing has reaped it yet."""
    stat = processes.read_stat(pid)
    return stat is None or stat.state == "Z"


def _completed(module: dict[str, Any]) -> dict[str, Any]:
    """With its name in its environment, and short times."""
    environment = {**module.get("environment", {}), NAME: module["name"]}
    short = {"term_after_s": 0.5, "kill_after_s": 0.5, "backoff_s": 0.01}
    return {**short, **module, "environment": environment}


def killed_modules(count: int) -> list[dict[str, Any]]:
    """Modules to kill: programs that wait for each other in pairs, one with a child, a Python class."""
    plain: list[dict[str, Any]] = [{"name": f"m{number}", "command": FOREVER} for number in range(count - 2)]
    for before, each in zip(plain[::2], plain[1::2], strict=False):
        each["after"] = [before["name"]]
    parent = {"name": "parent", "command": PARENT}
    python = {
        "name": "python",
        "python": "tests.robot_client.devices.example_modules:Log",
        "folder": str(ROOT),
    }
    return [{**each, "restarts": 1000} for each in (*plain, parent, python)]


def _on_disk(folder: Path, size: int, full: bool = False) -> list[str]:
    fill = f'while touch "$0/{FILLER}$((i += 1))" 2>/dev/null; do :; done;' if full else ""
    mount = f'mount -t tmpfs -o size={size},nr_inodes={INODES} tmpfs "$0" && {{ {fill} exec "$@"; }}'
    return [*with_private_mounts(), "sh", "-c", mount, str(folder)]


def _run_of(folder: Path) -> str:
    try:
        return str(json.loads((folder / "spec.json").read_text()).get("run"))
    except (OSError, ValueError):
        return ""


def _words(pid: int, name: str) -> list[bytes]:
    try:
        return Path(f"/proc/{pid}/{name}").read_bytes().split(b"\0")
    except OSError:
        return []


def runners(folder: Path) -> list[int]:
    found = []
    for pid in processes.pids():
        words = _words(pid, "cmdline")
        if b"robot_client.modules.runner" in words and any(str(folder).encode() in each for each in words):
            found.append(pid)
    return found
