"""Modules of a daemon process: real programs, real deaths."""

from __future__ import annotations

import errno
import itertools
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from twisted.internet.task import Clock

from robot_client.modules import processes
from robot_client.modules.log_ring import read
from robot_client.modules.module_exit import ModuleExit
from robot_client.modules.module_run import ModuleRun
from robot_client.modules.settings import ModuleSettings
from robot_client.modules.supervisor import READY_POLL, ModuleSupervisor
from tests.worlds.module_daemon import FolderGraph
from tests.worlds.module_daemon_process import (
    FILLER,
    Daemon,
    DoubleStartWatch,
    has_ended,
    killed_modules,
    runners,
)
from tests.worlds.waiting import wait_for

FOREVER = [sys.executable, "-u", "-c", "import os,time;print('up', os.getpid());time.sleep(600)"]
CRASHES = [sys.executable, "-u", "-c", "raise SystemExit(3)"]
SUCCEEDS = [sys.executable, "-u", "-c", "print('done')"]
UNSAVED = "orders to modules can't be saved, and are lost when the daemon ends"


def test_module_starts_and_ends_with_the_daemon(start: Callable[..., Daemon]) -> None:
    daemon = start({"name": "m", "command": FOREVER})
    daemon.is_("running")
    wait_for("a process", daemon.pids)
    daemon.end()
    assert daemon.pids() == []
    wait_for("the end of the runners", lambda: not runners(daemon.folder))


def test_python_module_is_notified_whether_the_robot_is_stopped_also_by_the_next_daemon(
    start: Callable[..., Daemon],
) -> None:
    echo = "tests.robot_client.devices.example_modules:Log"
    daemon = start({"name": "m", "python": echo, "folder": str(Path.cwd())})
    daemon.is_("running")
    daemon.order("resume the robot", "m")
    wait_for("it was notified", lambda: daemon.texts()[-1] == "stopped: False")
    daemon.kill()
    wait_for("it was notified", lambda: daemon.texts()[-1] == "stopped: True")
    daemon.start()
    daemon.is_("running", after=len(daemon.states("m")))
    daemon.order("resume the robot", "m")
    wait_for("it was notified", lambda: daemon.texts()[-1] == "stopped: False")
    daemon.end()
    assert daemon.texts().count("READY") == 1


def test_orders_start_stop_and_restart(start: Callable[..., Daemon]) -> None:
    daemon = start({"name": "m", "command": FOREVER, "autostart": False})
    daemon.order("start", "m")
    daemon.is_("running")
    (first,) = wait_for("a process", daemon.pids)
    seen = len(daemon.states("m"))
    daemon.order("restart", "m")
    daemon.is_("running", after=seen)
    assert first not in wait_for("a process", daemon.pids)
    daemon.order("stop", "m")
    daemon.is_("stopped")
    assert daemon.pids() == []
    daemon.end()


def test_crashing_module_is_restarted_and_finally_fails(start: Callable[..., Daemon]) -> None:
    daemon = start({"name": "m", "command": CRASHES, "restarts": 3})
    daemon.is_("failed")
    assert daemon.states("m").count("backing_off") == 3
    assert daemon.alerts()[-1] == "module m stays down: exit code 3"
    daemon.end()


@pytest.mark.parametrize(
    ("restart", "command", "state"),
    [("on-failure", SUCCEEDS, "stopped"), ("never", CRASHES, "failed"), ("always", SUCCEEDS, "failed")],
)
def test_the_policy_decides_about_restarts(
    start: Callable[..., Daemon], restart: str, command: list[str], state: str
) -> None:
    daemon = start({"name": "m", "command": command, "restart": restart, "restarts": 2})
    daemon.is_(state)
    assert daemon.states("m").count("backing_off") == (2 if restart == "always" else 0)
    daemon.end()


def test_module_that_ends_in_order_and_is_always_restarted_did_not_crash(
    start: Callable[..., Daemon],
) -> None:
    daemon = start({"name": "m", "command": SUCCEEDS, "restart": "always", "restarts": 2})
    daemon.is_("failed")
    often = "exit code 0, more than restarts = 2 times in within_s = 300"
    assert daemon.alerts() == [f"module m stays down: {often}"]
    daemon.end()


def test_module_that_ends_before_it_is_ready_is_reported_also_by_those_that_wait_for_it(
    start: Callable[..., Daemon],
) -> None:
    daemon = start(
        {"name": "m", "command": SUCCEEDS, "ready_log": "^prepared$"},
        {"name": "next", "command": FOREVER, "after": ["m"]},
        {"name": "last", "command": FOREVER, "after": ["next", "m"]},
    )
    daemon.is_("stopped")
    ended = "exit code 0 before it was ready: no line of its output matched ready_log = '^prepared$'"
    assert daemon.alerts() == [f"module m ended: {ended}"]
    assert daemon.why("next") == f"it waits for m (has ended: {ended})"
    assert daemon.why("last") == f"it waits for next (waits too) and m (has ended: {ended})"
    daemon.order("stop", "m")
    wait_for("the end of the alert", lambda: daemon.alerts()[1:] == ["module m is stopped"])
    assert daemon.why("next") == "it waits for m (stopped by an order)"
    daemon.end()


def test_module_that_was_ready_and_ended_without_a_daemon_is_not_reported(
    start: Callable[..., Daemon], tmp_path: Path
) -> None:
    waits = "import time\nfrom pathlib import Path\nprint('ready')\nwhile not Path('end').exists(): time.sleep(0.01)"
    command = [sys.executable, "-u", "-c", waits]
    daemon = start(
        {"name": "by_log", "command": command, "ready_log": "ready", "folder": str(tmp_path)},
        {"name": "by_topic", "command": command, "ready_topic": "/scan", "folder": str(tmp_path)},
    )
    daemon.is_("running", "by_log")
    daemon.is_("starting", "by_topic")
    (tmp_path / "scan").touch()
    daemon.is_("running", "by_topic")
    daemon.kill()
    (tmp_path / "end").touch()
    wait_for("the end of the runners", lambda: not runners(daemon.folder))
    daemon.said.clear()
    daemon.start()
    daemon.is_("stopped", "by_log")
    daemon.is_("stopped", "by_topic")
    assert daemon.alerts() == []
    daemon.end()


def test_always_restarted_module_that_ends_before_it_is_ready_is_reported_until_it_is(
    start: Callable[..., Daemon], tmp_path: Path
) -> None:
    third = "from pathlib import Path; n = Path('runs'); n.open('a').write('x'); print(len(n.read_text()))"
    command = [sys.executable, "-u", "-c", f"{third}; import time; time.sleep(600 * (n.stat().st_size > 2))"]
    daemon = start(
        {"name": "m", "command": command, "ready_log": "3", "restart": "always", "folder": str(tmp_path)}
    )
    daemon.is_("running")
    ended = "ended: exit code 0 before it was ready: no line of its output matched ready_log = '3'"
    assert daemon.alerts() == [f"module m {ended}", "module m is running"]
    daemon.end()


def test_waiting_module_says_what_it_waits_for(start: Callable[..., Daemon]) -> None:
    never = {"command": FOREVER, "ready_log": "never", "ready_within_s": 600}
    daemon = start(
        {"name": "off", "command": FOREVER, "autostart": False},
        {"name": "slow", **never},
        {"name": "broken", "command": CRASHES, "restart": "never"},
        {"name": "once", "command": SUCCEEDS},
        {"name": "up", "command": FOREVER},
        {"name": "m", "command": FOREVER, "after": ["off", "slow", "broken", "once", "up"]},
    )
    daemon.is_("failed", "broken")
    daemon.is_("stopped", "once")
    daemon.is_("running", "up")
    daemon.is_("starting", "slow")
    assert daemon.why("m") == (
        "it waits for off (autostart = false) and slow (not ready yet) and broken (stays down: exit code 3) "
        "and once (has ended: exit code 0)"
    )
    assert daemon.why("up") == ""
    daemon.end()


def test_missing_program_is_named(start: Callable[..., Daemon]) -> None:
    daemon = start({"name": "m", "command": ["/no/such"], "restarts": 1})
    daemon.is_("failed")
    assert daemon.alerts()[-1] == "module m stays down: /no/such: No such file or directory"
    daemon.end()


ROS2 = f"""#!{sys.executable} -u
import signal, sys, time
from pathlib import Path
print(*sys.argv[1:])
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.alarm(600)  # nothing else ends it if the test is killed
print("[INFO] [talker-1]: process started with pid [7]")
print("[talker-1] [WARN] [1700000000.5] [talker]: no device")
print("[ERROR] [talker-1]: process has died [pid 7, exit code -9, cmd 'talker'].")
while not Path("respawn").exists(): time.sleep(0.01)
print("[INFO] [talker-1]: process started with pid [8]")
time.sleep(600)
"""


def test_launch_file_whose_node_died_is_reported_and_stopped(
    start: Callable[..., Daemon], tmp_path: Path
) -> None:
    """By a program that behaves as ``ros2 launch`` does, also by the next daemon; it ignores SIGINT."""
    program = tmp_path / "bin" / "ros2"
    program.parent.mkdir()
    program.write_text(ROS2)
    program.chmod(0o700)
    environment = {"PATH": str(program.parent)}
    daemon = start(
        {"name": "m", "launch": ["pack", "file"], "folder": str(tmp_path), "environment": environment}
    )
    died = "module m runs without nodes that have died: talker-1 (exit code -9)"
    wait_for("an alert", lambda: daemon.alerts() == [died])
    daemon.kill()
    daemon.said.clear()
    daemon.start()
    wait_for("the alert again", lambda: daemon.alerts() == [died])
    assert [(each.level, each.text) for each in read(tmp_path / "m" / "log").lines] == [
        ("info", "launch pack file"),
        ("info", "[INFO] [talker-1]: process started with pid [7]"),
        ("warn", "[talker-1] [WARN] [1700000000.5] [talker]: no device"),
        ("error", "[ERROR] [talker-1]: process has died [pid 7, exit code -9, cmd 'talker']."),
    ]
    daemon.kill()
    (tmp_path / "respawn").touch()
    wait_for("it is started again", lambda: "pid [8]" in daemon.texts()[-1])
    daemon.said.clear()
    daemon.start()
    daemon.is_("running")
    daemon.order("stop", "m")
    daemon.is_("stopped")
    assert daemon.pids() == [] and daemon.alerts() == []
    daemon.end()


def test_module_waits_for_its_dependencies(start: Callable[..., Daemon]) -> None:
    slow = [sys.executable, "-u", "-c", "import time;time.sleep(0.3);print('ready now');time.sleep(600)"]
    daemon = start(
        {"name": "last", "command": FOREVER, "after": ["first"]},
        {"name": "first", "command": slow, "ready_log": "ready now"},
    )
    daemon.is_("running", "last")
    order = [(each["name"], each["state"]) for each in daemon.said if "name" in each]
    assert order.index(("first", "running")) < order.index(("last", "starting"))
    daemon.end()


def test_module_is_ready_when_its_topic_service_or_active_node_exists(start: Callable[..., Daemon]) -> None:
    daemon = start(
        {"name": "scanner", "command": FOREVER, "ready_topic": "/scan"},
        {"name": "mapper", "command": FOREVER, "ready_service": "/map"},
        {"name": "gripper", "command": FOREVER, "ready_lifecycle": "/arm"},
    )
    wait_for("three processes", lambda: len(daemon.pids()) == 3)
    for name, file in (("scanner", "scan"), ("mapper", "map"), ("gripper", "arm")):
        daemon.is_("starting", name)
        (daemon.folder / file).touch()
        daemon.is_("running", name)
    daemon.end()


def test_endpoints_from_before_a_run_do_not_make_it_ready(start: Callable[..., Daemon]) -> None:
    """As those of a process that was killed, which the middleware lists for a while."""
    modules = [
        {"name": "scanner", "command": FOREVER, "ready_topic": "/scan"},
        {"name": "mapper", "command": FOREVER, "ready_service": "/map"},
    ]
    daemon = start(*modules)
    for name, file in (("scanner", "scan"), ("mapper", "map")):
        daemon.is_("starting", name)
        (daemon.folder / file).write_text("first")
        daemon.is_("running", name)
        seen = len(daemon.states(name))
        (pid,) = daemon.pids_of(name)
        os.kill(pid, signal.SIGKILL)
        daemon.is_("starting", name, after=seen)
        wait_for("a process", lambda name=name: daemon.pids_of(name))
        time.sleep(3 * READY_POLL)
        assert "running" not in daemon.states(name)[seen:]
        (daemon.folder / file).write_text("first\nsecond")
        daemon.is_("running", name, after=seen)
    daemon.end()


@pytest.mark.parametrize(
    ("check", "missing"),
    [
        ({"ready_log": "never"}, "no line of its output matched ready_log = 'never'"),
        ({"ready_topic": "/scan"}, "ready_topic = '/scan' got no new publisher"),
        ({"ready_service": "/map"}, "ready_service = '/map' got no new server"),
        ({"ready_lifecycle": "/arm"}, "ready_lifecycle = '/arm' is not active"),
    ],
)
def test_late_module_counts_as_crashed(
    start: Callable[..., Daemon], check: dict[str, str], missing: str
) -> None:
    daemon = start({"name": "m", "command": FOREVER, "ready_within_s": 0.2, "restart": "never", **check})
    daemon.is_("failed")
    text = f"not ready within ready_within_s = 0.2: {missing}"
    assert daemon.alerts()[-1] == f"module m stays down: {text}"
    assert daemon.pids() == []
    daemon.end()


def test_stop_order_for_a_late_module_holds(start: Callable[..., Daemon]) -> None:
    """It is being stopped already, and ignores SIGINT for a while."""
    slow = "import signal,time;signal.signal(2, signal.SIG_IGN);print('up');time.sleep(600)"
    daemon = start(
        {
            "name": "m",
            "command": [sys.executable, "-u", "-c", slow],
            "ready_log": "never",
            "ready_within_s": 0.5,
            "term_after_s": 2.0,
        }
    )
    daemon.is_("stopping")
    daemon.order("stop", "m")
    daemon.is_("stopped")
    assert daemon.pids() == []
    daemon.end()


def test_modules_outlive_the_daemon_and_the_next_one_adopts_them(
    start: Callable[..., Daemon], tmp_path: Path
) -> None:
    names = ["m", "by_log", "by_topic"]
    daemon = start(
        {"name": "m", "command": FOREVER},
        {"name": "by_log", "command": FOREVER, "ready_log": "^up"},
        {"name": "by_topic", "command": FOREVER, "ready_topic": "/scan"},
    )
    daemon.is_("starting", "by_topic")
    (tmp_path / "scan").touch()
    for name in names:
        daemon.is_("running", name)
    before = sorted(wait_for("processes", lambda: len(daemon.pids()) == len(names) and daemon.pids()))
    # A module that was ready stays so, whatever has become of its topic.
    (tmp_path / "scan").unlink()
    daemon.kill()
    assert sorted(daemon.pids()) == before
    daemon.said.clear()
    daemon.start()
    for name in names:
        daemon.is_("running", name)
    assert sorted(daemon.pids()) == before
    daemon.order("stop", "m")
    daemon.is_("stopped")
    daemon.end()
    assert daemon.pids() == []


def test_module_stopped_by_an_order_stays_stopped_after_the_daemons_death(
    start: Callable[..., Daemon],
) -> None:
    daemon = start({"name": "m", "command": FOREVER}, {"name": "other", "command": FOREVER})
    daemon.is_("running")
    daemon.order("stop", "m")
    daemon.is_("stopped")
    daemon.kill()
    daemon.said.clear()
    daemon.start()
    daemon.is_("running", "other")
    assert "running" not in daemon.states("m")
    daemon.end()


def test_order_holds_for_the_next_daemon_until_autostart_is_changed(start: Callable[..., Daemon]) -> None:
    """Also for a module that had no order: only its settings count. Changed back, an old order stays forgotten."""
    names = ["ordered", "again", "plain"]
    daemon = start(*({"name": name, "command": FOREVER} for name in names))

    def restart_runs(*running: str, **autostart: bool) -> None:
        """The next daemon, with these settings, runs these modules and no others."""
        daemon.kill()
        for each in daemon.modules:
            each["autostart"] = autostart.get(each["name"], True)
        daemon.said.clear()
        daemon.start()
        for name in running:
            daemon.is_("running", name)
        # All were started at the same time, so the others would have states by now.
        for name in set(names).difference(running):
            if daemon.states(name):
                daemon.is_("stopped", name)

    for name in names:
        daemon.is_("running", name)
    daemon.order("stop", "ordered")
    daemon.is_("stopped", "ordered")
    daemon.order("restart", "again")
    daemon.is_("running", "again", after=len(daemon.states("again")))
    restart_runs("again", "plain")
    restart_runs("again", plain=False)
    restart_runs("plain", ordered=False, again=False)
    restart_runs(*names)
    daemon.order("stop", "plain")
    daemon.is_("stopped", "plain")
    restart_runs("ordered", "again")
    daemon.kill()
    processes.send(runners(daemon.folder) + daemon.pids(), signal.SIGKILL)
    wait_for("their end", lambda: not runners(daemon.folder) and not daemon.pids())
    daemon.boot = "second"
    restart_runs(*names)
    daemon.end()


@pytest.mark.parametrize("damage", ["", "[]", "{}", '{"boot": "first", "orders": {"m": 7}}', '{"boot": '])
def test_damaged_file_of_orders_counts_as_none(
    start: Callable[..., Daemon], tmp_path: Path, damage: str
) -> None:
    (tmp_path / "orders.json").write_text(damage)
    daemon = start({"name": "m", "command": FOREVER})
    daemon.is_("running")
    daemon.order("stop", "m")
    daemon.is_("stopped")
    daemon.end()


def test_orders_that_can_not_be_saved_are_an_alert(start: Callable[..., Daemon], tmp_path: Path) -> None:
    (tmp_path / "orders.json").mkdir()
    daemon = start({"name": "m", "command": FOREVER})
    daemon.is_("running")
    daemon.order("stop", "m")
    daemon.is_("stopped")
    assert [(each["about"], each["alert"]) for each in daemon.said if "alert" in each] == [
        ("daemon", f"{UNSAVED}: Is a directory")
    ]
    (tmp_path / "orders.json").rmdir()
    wait_for("them on disk", lambda: daemon.alerts()[1:] == ["orders to modules are saved again"])
    assert json.loads((tmp_path / "orders.json").read_text())["orders"]["m"]["wanted"] is False
    daemon.end()


def test_module_that_died_without_a_daemon_is_started_again(start: Callable[..., Daemon]) -> None:
    daemon = start({"name": "m", "command": FOREVER})
    daemon.is_("running")
    (pid,) = wait_for("a process", daemon.pids)
    daemon.kill()
    os.kill(pid, signal.SIGKILL)
    wait_for("the end of the runner", lambda: not runners(daemon.folder))
    daemon.said.clear()
    daemon.start()
    daemon.is_("running")
    assert wait_for("a process", daemon.pids) != [pid]
    daemon.end()


SLOW_TO_STOP = """
import signal, time
from pathlib import Path
signal.alarm(600)  # nothing else ends it if the test is killed
stopping, asked = Path("stopping"), []
signal.signal(signal.SIGINT, lambda *_: (stopping.touch(), asked.append(1)))
print("up")
while not asked or stopping.exists():
    time.sleep(0.01)
"""


@pytest.mark.parametrize("gone", [False, True], ids=["still stopping", "stopped meanwhile"])
def test_module_that_an_earlier_daemon_was_stopping_is_started_again(
    start: Callable[..., Daemon], tmp_path: Path, gone: bool
) -> None:
    """The earlier daemon ended before its module did, as at a quick restart of the service."""
    command = [sys.executable, "-u", "-c", SLOW_TO_STOP]
    daemon = start({"name": "m", "command": command, "folder": str(tmp_path), "term_after_s": 600})
    wait_for("it is up", lambda: daemon.texts() == ["up"])
    assert daemon.process.stdin is not None
    daemon.process.stdin.close()
    wait_for("it is being stopped", (tmp_path / "stopping").exists)
    daemon.kill()
    daemon.said.clear()
    if gone:
        (tmp_path / "stopping").unlink()
        wait_for("the end of the runner", lambda: not runners(daemon.folder))
    daemon.start()
    if not gone:
        daemon.is_("stopping")
        (tmp_path / "stopping").unlink()
    daemon.is_("running")
    wait_for("it is up again", lambda: daemon.texts()[-1:] == ["up"] and daemon.texts().count("up") == 2)
    assert not any("crashed" in each for each in daemon.alerts())
    daemon.kill()


def test_module_that_left_the_settings_while_no_daemon_ran_is_ended(start: Callable[..., Daemon]) -> None:
    daemon = start({"name": "m", "command": FOREVER}, {"name": "old", "command": FOREVER})
    daemon.is_("running", "m")
    daemon.is_("running", "old")
    (kept,) = wait_for("a process", lambda: daemon.pids_of("m"))
    daemon.kill()
    del daemon.modules[1]
    daemon.modules.append({**daemon.modules[0], "name": "new"})
    daemon.said.clear()
    daemon.start()
    daemon.is_("running", "m")
    daemon.is_("running", "new")
    wait_for("the end of the old module", lambda: not runners(daemon.folder / "old"))
    assert sorted(daemon.pids()) == sorted([kept, *daemon.pids_of("new")])
    daemon.end()
    assert daemon.pids() == []


@pytest.mark.parametrize(
    "change",
    [{"command": [*FOREVER, "other"]}, {"environment": {"OTHER": "1"}}, {"domain": 7}, {"term_after_s": 0.6}],
    ids=["command", "environment", "domain", "term_after_s"],
)
def test_module_whose_settings_changed_while_no_daemon_ran_is_restarted(
    start: Callable[..., Daemon], change: dict[str, Any]
) -> None:
    daemon = start({"name": "m", "command": FOREVER}, {"name": "other", "command": FOREVER})
    daemon.is_("running", "m")
    daemon.is_("running", "other")
    (before,) = wait_for("a process", lambda: daemon.pids_of("m"))
    (other,) = wait_for("a process", lambda: daemon.pids_of("other"))
    daemon.kill()
    daemon.modules[0].update(change)
    daemon.said.clear()
    daemon.start()
    wait_for("it stopped", lambda: "stopped" in daemon.states("m"))
    daemon.is_("running", "m")
    daemon.is_("running", "other")
    assert daemon.alerts() == [] and before not in daemon.pids()
    assert daemon.pids_of("other") == [other]
    daemon.end()


def test_variables_of_the_daemon_that_differ_from_start_to_start_restart_no_module(
    start: Callable[..., Daemon], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As systemd's INVOCATION_ID."""
    daemon = start({"name": "m", "command": FOREVER, "environment": {"OWN": "1"}})
    daemon.is_("running")
    before = wait_for("a process", daemon.pids)
    daemon.kill()
    monkeypatch.setenv("INVOCATION_ID", "another")
    daemon.said.clear()
    daemon.start()
    daemon.is_("running")
    assert daemon.pids() == before and "stopped" not in daemon.states("m")
    daemon.end()


def test_exit_is_explained() -> None:
    assert [
        str(ModuleExit(code=3)),
        str(ModuleExit(signal=9)),
        str(ModuleExit(error="no program")),
        str(ModuleExit(code=1, log_lost=12)),
        str(ModuleExit(code=1, memory_mb=64)),
    ] == [
        "exit code 3",
        "ended by signal 9 (SIGKILL)",
        "no program",
        "exit code 1; the last 12 lines of its output could not be logged",
        "exit code 1; it reported that memory is short, of which it has memory_mb = 64",
    ]


def test_modules_that_ended_with_the_machine_did_not_crash(start: Callable[..., Daemon]) -> None:
    """Also one that is never restarted starts at the next boot."""
    daemon = start({"name": "m", "command": FOREVER, "restart": "never"})
    daemon.is_("running")
    # As at a power cut: nothing is left of the processes, everything of the files.
    daemon.kill()
    processes.send(runners(daemon.folder) + daemon.pids(), signal.SIGKILL)
    wait_for("their end", lambda: not runners(daemon.folder) and not daemon.pids())
    daemon.boot = "second"
    daemon.said.clear()
    daemon.start()
    daemon.is_("running")
    assert daemon.states("m") == ["waiting", "starting", "running"]
    daemon.end()


def test_every_module_runs_once_after_random_kills(start: Callable[..., Daemon]) -> None:
    """Of modules, their runners and the daemon: no orphan, no double start, none missing. The bench kills 200 times."""
    daemon = start(*killed_modules(4))
    choose = random.Random(7)
    wait_for("all modules", daemon.runs_once)
    with DoubleStartWatch(daemon.folder) as watch:
        for _ in range(12):
            what = daemon.kill_at_random(choose)
            wait_for(f"all modules after {what}: {daemon.pids()}", daemon.runs_once)
    daemon.end()
    assert daemon.pids() == []
    wait_for("the end of the runners", lambda: not runners(daemon.folder))
    assert watch.samples > 0 and watch.doubles == []


@pytest.mark.parametrize("change", [{processes.MARK: "another"}, {}], ids=["another run", "the same run"])
def test_double_start_is_seen(start: Callable[..., Daemon], change: dict[str, str]) -> None:
    """Otherwise the test above would show nothing."""
    daemon = start({"name": "m", "command": FOREVER})
    (pid,) = wait_for("a process", lambda: daemon.runs_once() and daemon.pids())
    environment = dict(
        each.split("=", 1) for each in Path(f"/proc/{pid}/environ").read_text().split("\0")[:-1]
    )
    watch = DoubleStartWatch(daemon.folder)
    watch.sample()
    assert watch.doubles == []
    with subprocess.Popen(FOREVER, env={**environment, **change}, stdout=subprocess.PIPE) as second:
        assert second.stdout is not None
        second.stdout.readline()
        watch.sample()
        second.kill()
    assert len(watch.doubles) == 1


WITHOUT_VARIABLES = """
import subprocess, sys, time
code = "import os, signal, time; signal.alarm(600); print(os.getpid(), flush=True); time.sleep(600)"
subprocess.run([sys.executable, "-c", code], env={})
"""


@pytest.mark.parametrize("with_daemon", [False, True], ids=["runner", "runner and daemon"])
def test_process_that_cleared_its_variables_ends_with_a_killed_runner(
    start: Callable[..., Daemon], with_daemon: bool
) -> None:
    """It is known by its session; docs/guides/modules.md names what is not found."""
    daemon = start({"name": "m", "command": [sys.executable, "-u", "-c", WITHOUT_VARIABLES]})
    hidden = int(wait_for("a line", lambda: daemon.texts())[0])
    daemon.is_("running")
    assert hidden not in daemon.pids()
    if with_daemon:
        daemon.kill()
    processes.send(runners(daemon.folder), signal.SIGKILL)
    if with_daemon:
        daemon.start()
    wait_for("it is started again", lambda: len(daemon.texts()) == 2)
    assert has_ended(hidden)
    daemon.end()


BEGINS_A_SESSION = """
import subprocess, sys
left = subprocess.Popen([sys.executable, "-c", "import signal, time; signal.alarm(600); time.sleep(600)"])
print(left.pid, flush=True)
sys.stdin.read()
"""


def test_session_is_known_by_the_start_of_its_leader() -> None:
    """A later process may have its number; what is left of it without a leader still belongs to it."""
    command = [sys.executable, "-c", BEGINS_A_SESSION]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
    ) as leader:
        assert leader.stdin is not None and leader.stdout is not None
        left = int(leader.stdout.readline())
        session = processes.ProcessSession.begun_by(leader.pid)
        stat = processes.read_stat(left)
        assert stat is not None
        assert session.holds(stat)
        assert not session._replace(started=session.started - 1).holds(stat)
        leader.stdin.close()
        leader.wait()
        assert session.holds(stat)
        processes.send([left], signal.SIGKILL)


FILLS_THE_DISK = """
import signal, time
from pathlib import Path
signal.alarm(600)  # nothing else ends it if the test is killed
print("up")
while not Path("full").exists(): time.sleep(0.01)
for number in range(10_000): print("a line that can not be kept", number)  # more than fits into the pipe
Path("written").touch()
while Path("full").exists(): time.sleep(0.01)
print("there is room")
time.sleep(600)
"""


def test_log_that_can_not_be_written_affects_no_other_module_and_is_reported(
    start: Callable[..., Daemon], tmp_path: Path
) -> None:
    """A limit of the log's size stands for the disk."""
    fills = {"command": [sys.executable, "-u", "-c", FILLS_THE_DISK], "folder": str(tmp_path)}
    daemon = start({"name": "m", **fills}, {"name": "other", "command": FOREVER})
    wait_for("a line", lambda: daemon.texts() == ["up"])
    (runner,) = runners(tmp_path / "m")
    full = (tmp_path / "m" / "log" / "log.0").stat().st_size
    resource.prlimit(runner, resource.RLIMIT_FSIZE, (full, resource.RLIM_INFINITY))
    (tmp_path / "full").touch()
    wait_for("all lines are written", (tmp_path / "written").exists)
    assert daemon.texts() == ["up"]
    alert = "module m runs without its log, into which lines can't be written: File too large"
    wait_for("an alert", lambda: daemon.alerts() == [alert])
    daemon.is_("running", "other")
    seen = len(daemon.states("other"))
    processes.send(daemon.pids_of("other"), signal.SIGKILL)
    daemon.is_("running", "other", after=seen)
    resource.prlimit(runner, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    (tmp_path / "full").unlink()
    wait_for("there is room", lambda: daemon.texts()[-1:] == ["there is room"])
    assert any("lines of output were lost: File too large" in each for each in daemon.texts())
    wait_for("the end of the alert", lambda: "module m is running" in daemon.alerts())
    assert daemon.states("m") == ["waiting", "starting", "running"]
    daemon.end()


TICKS = """
import signal, time
signal.alarm(600)  # nothing else ends it if the test is killed
for number in range(10**6):
    print("tick", number)
    time.sleep(0.02)
"""


def test_on_a_full_disk_modules_run_and_obey_orders(start: Callable[..., Daemon], tmp_path: Path) -> None:
    """The whole folder of the modules is on a small disk of its own, which is filled."""
    modules = [
        {"name": name, "command": [sys.executable, "-u", "-c", TICKS]}
        for name in ("witness", "again", "ends")
    ]
    daemon = start(*modules, disk=1024 * 1024)
    for each in modules:
        wait_for("a line", lambda name=each["name"]: daemon.texts(name))
    before = {each["name"]: daemon.pids_of(each["name"]) for each in modules}
    filler = daemon.disk / "filler"
    fill(filler)
    lost = "runs without its log, into which lines can't be written: No space left on device"
    alerts = {f"module {each['name']} {lost}" for each in modules}
    wait_for("an alert for each", lambda: alerts <= set(daemon.alerts()))
    seen = len(daemon.states("again"))
    daemon.order("restart", "again")
    daemon.order("stop", "ends")
    daemon.is_("running", "again", after=seen)
    daemon.is_("stopped", "ends")
    assert daemon.pids_of("ends") == []
    assert f"{UNSAVED}: No space left on device" in daemon.alerts()
    assert wait_for("another process", lambda: daemon.pids_of("again")) != before["again"]
    seen = len(daemon.alerts())
    filler.unlink()
    wait_for("the end of the alerts", lambda: "module witness is running" in daemon.alerts()[seen:])
    texts = daemon.texts("witness")
    assert any("lines of output were lost: No space left on device" in each for each in texts)
    wait_for("lines that follow", lambda: len(daemon.texts("witness")) > len(texts))
    assert daemon.pids_of("witness") == before["witness"]
    assert daemon.states("witness") == ["waiting", "starting", "running"]
    daemon.end()


def fill(path: Path) -> None:
    """Write until the disk is full."""
    with path.open("wb", buffering=0) as file, suppress(OSError):
        while file.write(bytes(4096)):
            pass


def test_module_that_could_not_start_on_a_full_disk_starts_when_there_is_room(
    start: Callable[..., Daemon], tmp_path: Path
) -> None:
    """However often; a limit of the size of files stands for the disk."""
    daemon = start({"name": "m", "command": FOREVER, "autostart": False, "restarts": 1})
    assert daemon.why("m") == ""
    pid, unlimited = daemon.process.pid, (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
    daemon.order("start", "m")
    wait_for("several attempts", lambda: daemon.states("m").count("backing_off") > 3)
    assert daemon.alerts() == [
        f"{UNSAVED}: File too large",
        "module m crashed: it can't be started: File too large",
    ]
    resource.prlimit(pid, resource.RLIMIT_FSIZE, unlimited)
    daemon.is_("running")
    daemon.end()


def test_attempts_on_a_full_disk_are_no_crashes(start: Callable[..., Daemon], tmp_path: Path) -> None:
    """So those of the module have all restarts left when there is room; a limit of the size of files stands for the
    disk.
    """
    daemon = start({"name": "m", "command": CRASHES, "autostart": False, "restarts": 1})
    assert daemon.why("m") == ""
    pid, unlimited = daemon.process.pid, (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
    daemon.order("start", "m")
    wait_for("several attempts", lambda: daemon.states("m").count("backing_off") > 3)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, unlimited)
    daemon.is_("failed")
    assert daemon.texts() == ["exit code 3"] * 2
    daemon.end()


def test_attempts_on_a_full_disk_come_each_minute_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts: list[float] = []

    def no_room(reactor: Clock, *_: Any) -> None:
        attempts.append(reactor.seconds())
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(ModuleRun, "start", no_room)
    clock = Clock()
    supervisor = ModuleSupervisor(
        [ModuleSettings(name="m", command=FOREVER)],
        tmp_path,
        reactor=clock,
        environment={},
        graph=FolderGraph(tmp_path),
        alert=lambda *_, **__: None,
        boot="first",
    )
    supervisor.start()
    clock.pump([1.0] * 60 * 1200)
    pauses = [after - before for before, after in itertools.pairwise(attempts)]
    assert pauses[:7] == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0]
    assert len(pauses) > 1100
    assert set(pauses[6:]) == {60.0}


def test_new_module_on_a_full_disk_is_tried_until_there_is_room(
    start: Callable[..., Daemon], tmp_path: Path
) -> None:
    daemon = start(
        {"name": "m", "command": FOREVER, "restarts": 1},
        {"name": "after", "command": FOREVER, "after": ["m"]},
        disk=1024 * 1024,
        full=True,
    )
    wait_for("several attempts", lambda: daemon.states("m").count("backing_off") > 3)
    assert daemon.alerts() == ["module m crashed: it can't be started: No space left on device"]
    assert daemon.why("after").startswith("it waits for m (")
    for filler in daemon.disk.glob(f"{FILLER}*"):
        filler.unlink()
    daemon.is_("running", "m")
    daemon.is_("running", "after")
    daemon.end()


def test_module_whose_folder_can_not_be_created_affects_no_other_module(
    start: Callable[..., Daemon], tmp_path: Path
) -> None:
    (tmp_path / "m").touch()
    daemon = start({"name": "m", "command": FOREVER, "restarts": 1}, {"name": "other", "command": FOREVER})
    daemon.is_("failed", "m")
    daemon.is_("running", "other")
    assert daemon.alerts()[-1] == "module m stays down: it can't be started: File exists"
    daemon.end()


def test_settings_of_the_next_run_take_the_room_of_those_before(
    start: Callable[..., Daemon], tmp_path: Path
) -> None:
    """So a module is started again though the disk is full."""
    daemon = start({"name": "m", "command": FOREVER})
    daemon.is_("running")
    before = (tmp_path / "m" / "spec.json").stat()
    daemon.order("restart", "m")
    daemon.is_("running", after=len(daemon.states("m")))
    after = (tmp_path / "m" / "spec.json").stat()
    assert (after.st_ino, after.st_size) == (before.st_ino, before.st_size)
    daemon.end()
    assert after.st_size == (tmp_path / "m" / "spec.json").stat().st_size
