"""Modules with processes that run on after SIGKILL: they hold up nothing else, and people are told."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from robot_client.modules import processes
from robot_client.modules.processes import KillAttempts
from tests.worlds.module_daemon_process import FOREVER, Daemon, has_ended, runners
from tests.worlds.waiting import wait_for

CHILD = """
import os, signal
signal.alarm(600)  # nothing else ends it if the test is killed
open("/proc/self/comm", "w").write("unkillable")
print(os.getpid(), flush=True)
while True: signal.pause()
"""

LEAVES_A_CHILD = f"""
import subprocess, sys, time
from pathlib import Path
if Path("second").exists(): time.sleep(600)
Path("second").touch()
subprocess.Popen([sys.executable, "-c", {CHILD!r}], start_new_session=True)
while not Path("crash").exists(): time.sleep(0.01)
raise SystemExit(3)
"""
"""Its first run has an unkillable child, and crashes when the file ``crash`` is there."""


class Unkillable:
    """A daemon with the module ``m``, whose child can't be ended, and ``other``."""

    def __init__(self, start: Callable[..., Daemon], folder: Path, **settings: Any) -> None:
        self.folder = folder
        command = [sys.executable, "-u", "-c", LEAVES_A_CHILD]
        module = {"name": "m", "command": command, "folder": str(folder), **settings}
        self.daemon = start(module, {"name": "other", "command": FOREVER})
        self.pid = int(wait_for("a child", self.daemon.texts)[0])
        self.daemon.is_("running", "m")
        self.daemon.is_("running", "other")

    @property
    def reason(self) -> str:
        return f"process {self.pid} (unkillable, state S) still runs after SIGKILL"

    def alerts(self, module: str = "m") -> list[str]:
        """Alerts about a module; what changes with the moment is left out."""
        texts = [each["alert"] for each in list(self.daemon.said) if each.get("about") == module]
        return [re.sub("state [RS]", "state S", each) for each in texts]

    def is_reported(self) -> None:
        wait_for(
            f"an alert: {self.alerts()}", lambda: self.alerts() == [f"module m can't be ended: {self.reason}"]
        )
        why = re.sub("state [RS]", "state S", self.daemon.why("m"))
        assert why == f"it can't be ended: {self.reason}"
        # What it has left is found by its runner, as for the table of processes.
        runner = [each["runners"]["m"] for each in list(self.daemon.said) if "runners" in each][-1]
        assert [runner] == (runners(self.folder / "m") or [None])
        assert self.daemon.states("m")[-1] == "stopping"

    def restarts_other(self) -> None:
        seen = len(self.daemon.states("other"))
        self.daemon.order("restart", "other")
        self.daemon.is_("running", "other", after=seen)

    def end_it(self) -> None:
        os.kill(self.pid, signal.SIGKILL)


@pytest.fixture
def unkillable(
    start: Callable[..., Daemon], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Unkillable]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2] / "worlds" / "unkillable"))
    return lambda **settings: Unkillable(start, tmp_path, **settings)


def test_module_that_does_not_stop_is_reported_until_it_has(unkillable: Callable[..., Unkillable]) -> None:
    """Also by the next daemon."""
    scene = unkillable()
    daemon = scene.daemon
    daemon.order("stop", "m")
    scene.is_reported()
    assert [each["pid"] for each in daemon.said if each.get("name") == "m"][-1] is None
    scene.restarts_other()
    assert any("it can't be ended: process" in each for each in daemon.texts())
    daemon.kill()
    daemon.said.clear()
    daemon.start()
    scene.is_reported()
    scene.restarts_other()
    assert "running" not in daemon.states("m")
    scene.end_it()
    daemon.is_("stopped", "m")
    assert scene.alerts()[1:] == ["module m is stopped"] and daemon.why("m") == ""
    wait_for("the end of the runner", lambda: not runners(daemon.folder / "m"))
    daemon.end()


def test_crashed_module_is_not_started_again_while_one_of_its_processes_runs(
    unkillable: Callable[..., Unkillable],
) -> None:
    """And it does not look as if it ran, to a later daemon either. Then its policy decides."""
    scene = unkillable()
    daemon = scene.daemon
    (scene.folder / "crash").touch()
    scene.is_reported()
    daemon.kill()
    daemon.modules.append({**daemon.modules[1], "name": "next", "after": ["m"]})
    daemon.said.clear()
    daemon.start()
    scene.is_reported()
    waits = re.sub("state [RS]", "state S", daemon.why("next"))
    assert waits == f"it waits for m (can't be ended: {scene.reason})"
    assert "running" not in daemon.states("m") and daemon.states("next") == ["waiting"]
    scene.end_it()
    daemon.is_("running", "m")
    assert scene.alerts()[1:] == ["module m crashed: exit code 3", "module m is running"]
    daemon.is_("running", "next")
    daemon.end()


def test_order_counts_for_a_module_that_has_crashed_and_can_not_be_ended(
    unkillable: Callable[..., Unkillable],
) -> None:
    scene = unkillable(restart="never")
    (scene.folder / "crash").touch()
    scene.is_reported()
    scene.daemon.order("start", "m")
    scene.end_it()
    scene.daemon.is_("running", "m")
    assert scene.alerts()[1:] == ["module m is stopped"]
    scene.daemon.end()


def test_leftovers_of_a_killed_runner_hold_up_nothing(unkillable: Callable[..., Unkillable]) -> None:
    scene = unkillable()
    processes.send(runners(scene.folder / "m"), signal.SIGKILL)
    scene.is_reported()
    scene.restarts_other()
    scene.end_it()
    scene.daemon.is_("running", "m")
    assert scene.alerts()[1:] == ["module m crashed: its runner was killed", "module m is running"]
    scene.daemon.end()


def test_module_that_left_the_settings_and_can_not_be_ended_holds_up_no_other(
    unkillable: Callable[..., Unkillable],
) -> None:
    scene = unkillable()
    daemon = scene.daemon
    daemon.kill()
    daemon.modules[0] = {**daemon.modules[1], "name": "new"}
    daemon.said.clear()
    daemon.start()
    daemon.is_("running", "new")
    text = f"module m, which the settings no longer have, can't be ended: {scene.reason}"
    assert scene.alerts() == [text]
    scene.end_it()
    wait_for("the end of the alert", lambda: scene.alerts()[1:] == ["module m has ended"])
    daemon.end()


@pytest.mark.parametrize("when", ["before", "after"])
def test_daemon_ends_without_a_module_that_can_not_be_ended(
    unkillable: Callable[..., Unkillable], when: str
) -> None:
    """Whether that is known before or after the daemon is stopped."""
    scene = unkillable()
    if when == "before":
        scene.daemon.order("stop", "m")
        scene.is_reported()
    scene.daemon.end()
    assert scene.daemon.process.returncode == 0
    wait_for("the end of the other's runner", lambda: not runners(scene.folder / "other"))
    assert len(runners(scene.folder / "m")) == 1 and not has_ended(scene.pid)
    scene.end_it()
    wait_for("the end of the runner", lambda: not runners(scene.folder))


OF_ANOTHER_USER = """
import os, signal
signal.alarm(600)  # nothing else ends it if the test is killed
print(os.getpid(), flush=True)
os.setuid(65534)
while True: signal.pause()
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can start a process of another user")
def test_process_of_another_user_is_named_and_the_module_goes_on_after_its_end(
    start: Callable[..., Daemon],
) -> None:
    """A real one, that the kernel does not let the runner kill."""
    command = [sys.executable, "-u", "-c", OF_ANOTHER_USER]
    without_right = ["setpriv", "--bounding-set=-kill", "--inh-caps=-kill"]
    daemon = start({"name": "m", "command": command, "ready_log": r"^\d+$"}, before=without_right)
    daemon.is_("running")
    pid = int(daemon.texts()[0])
    daemon.order("stop", "m")
    wait_for("an alert", daemon.alerts)
    program = Path(sys.executable).name[:15]
    runs = f"process {pid} ({program}, of another user) still runs after SIGKILL"
    assert daemon.alerts() == [f"module m can't be ended: {runs}"]
    os.kill(pid, signal.SIGKILL)
    daemon.is_("stopped")
    daemon.end()


class Stubborn:
    """Processes 7, 8, … of which some never end."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        self.left: set[int] = set()
        monkeypatch.setattr(processes, "kill_all", lambda belongs, rounds: set(self.left))
        monkeypatch.setattr(processes, "read_stat", lambda pid: None)
        self.kills = KillAttempts(lambda pid, others: True, clock=lambda: self.now)

    def attempt(self, *left: int) -> float | None:
        """The pause after an attempt, which passes."""
        self.left = set(left)
        pause = self.kills.attempt()
        self.now += pause or 0.0
        return pause


def test_attempts_to_kill_become_rare_while_there_is_nothing_new(monkeypatch: pytest.MonkeyPatch) -> None:
    stubborn = Stubborn(monkeypatch)
    pauses = [stubborn.attempt(7) for _ in range(10)]
    assert pauses == [0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0]
    assert stubborn.attempt(7, 8) == 0.05
    assert stubborn.attempt() is None


def test_processes_are_unkillable_ten_seconds_after_they_were_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    stubborn, seen = Stubborn(monkeypatch), []
    for _ in range(10):
        stubborn.attempt(7, 9)
        seen.append((stubborn.now < 10, stubborn.kills.unkillable))
    assert all(unkillable == [] for early, unkillable in seen if early)
    assert stubborn.kills.unkillable == [7, 9]
    assert stubborn.kills.reason == "processes 7, 9 still run after SIGKILL"
    stubborn.attempt(9)
    assert stubborn.kills.reason == "process 9 still runs after SIGKILL"
    stubborn.attempt(9, 10, 11, 12, 13, 14, 15)
    stubborn.now += 10
    stubborn.attempt(9, 10, 11, 12, 13, 14, 15)
    assert stubborn.kills.reason == "processes 9, 10, 11, 12, 13 and 2 more still run after SIGKILL"
    stubborn.attempt()
    assert (stubborn.kills.unkillable, stubborn.kills.reason) == ([], "")
